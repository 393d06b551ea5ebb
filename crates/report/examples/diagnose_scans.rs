//! Compares the scans of a spinning sensor with an ideal one and draws figures: `lidarshift diagnose --scans` without
//! the detectors.
//!
//! `cargo run --release -p lidarshift-report --example diagnose_scans -- DATASET SENSOR.toml OUT`

use data::{Dataset, write_atomic};
use diagnose::{Options, Rig, diagnose_scans};
use std::path::PathBuf;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let words: Vec<PathBuf> = std::env::args().skip(1).map(PathBuf::from).collect();
    let [dataset, sensor, out] = words.as_slice() else { return Err("DATASET SENSOR.toml OUT are wanted".into()) };
    let rig = Rig::read(sensor)?;
    let outcome = diagnose_scans(&Dataset::open(dataset)?, &rig, &Options::default(), &|_, _, _| ())?;
    write_atomic(&out.join("diagnosis.json"), &serde_json::to_vec_pretty(&outcome.diagnosis)?)?;
    let extended = &outcome.extended;
    write_atomic(&out.join("extended.toml"), extended.as_bytes())?;
    Ok(lidarshift_report::write_finding_pictures(&outcome.diagnosis, out)?)
}
