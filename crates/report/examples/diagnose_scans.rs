//! Compares the scans of a spinning sensor with an ideal one and draws figures: `lidarshift diagnose --scans` without
//! the detectors.
//!
//! `cargo run --release -p lidarshift-report --example diagnose_scans -- DATASET SENSOR.toml OUT`

use data::{Dataset, write_atomic};
use diagnose::{Options, SensorRig, diagnose_scans, extended_toml};
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let args: Vec<PathBuf> = std::env::args().skip(1).map(PathBuf::from).collect();
    let [dataset, sensor, out] = args.as_slice() else {
        return Err("usage: diagnose_scans DATASET SENSOR.toml OUT".into());
    };
    let rig = SensorRig::read(sensor)?;
    let outcome = diagnose_scans(&Dataset::open(dataset)?, &rig, &Options::default(), &|_, _, _| ())?;
    write_atomic(&out.join("diagnosis.json"), &serde_json::to_vec_pretty(&outcome.diagnosis)?)?;
    let extended = extended_toml(&outcome.diagnosis, &rig, &outcome.rows_deg);
    write_atomic(&out.join("extended.toml"), extended.as_bytes())?;
    Ok(lidarshift_report::write_finding_pictures(&outcome.diagnosis, out)?)
}
