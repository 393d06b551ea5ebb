//! `lidarshift doctor`: what is wrong with a data set, in words.

use anyhow::Result;
use clap::Args;
use data::Dataset;
use data::doctor::{AnchorFacts, DetectorFacts, doctor};
use models::config::{DetectorConfig, NetworkConfig};
use models::find_detector;
use std::path::PathBuf;

/// Examine a data set before anything is trained on it: files, splits, duplicates, boxes, and whether the labels mean what is declared.
///
/// Exit code 0 only when nothing is wrong; notes do not count.
///
/// Examples:
///   lidarshift doctor datasets/road
///   lidarshift doctor /data/kitti --detector pointpillars --json doctor.json
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct DoctorArgs {
    /// Data set: its folder or its TOML
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// Also tell how the data fit this detector: its name or its TOML
    #[arg(long, value_name = "T")]
    detector: Option<String>,
    /// Write the report as JSON too
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

impl DoctorArgs {
    /// Prints the report; `true` when nothing is wrong.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<bool> {
        let detector = self.detector.as_deref().map(find_detector).transpose()?;
        let dataset = Dataset::open(&self.dataset)?;
        let report = doctor(&dataset, detector.as_ref().map(facts).as_ref())?;
        if let Some(path) = &self.json {
            data::write_json(path, &report)?;
        }
        println!("{report}");
        Ok(report.sound)
    }
}

/// What the doctor needs to know of a detector.
fn facts(detector: &DetectorConfig) -> DetectorFacts {
    // By way of the decimal text, so that an f32 of 3.9 does not print as 3.9000000953674316.
    let number = |v: f32| v.to_string().parse::<f64>().unwrap_or(v.into());
    let anchors = match &detector.network {
        NetworkConfig::PointPillars(network) => network.anchors.as_slice(),
        NetworkConfig::PointRcnn(_) => &[], // its boxes begin at points
    };
    let anchors = anchors.iter().map(|anchor| AnchorFacts {
        class: anchor.class.clone(),
        size: anchor.size_m.map(number),
        bottom: number(anchor.bottom_m),
    });
    let anchors = anchors.collect();
    DetectorFacts { classes: detector.classes.clone(), range: detector.range_m.map(number), anchors }
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::write::write_bin;
    use data::{Cloud, write_atomic};

    fn args(dataset: PathBuf, json: Option<PathBuf>) -> DoctorArgs {
        DoctorArgs { dataset, detector: Some("pointpillars".into()), json }
    }

    #[test]
    fn an_unsound_data_set_is_reported_in_json_too() {
        let folder = tempfile::tempdir().unwrap();
        write_bin(&folder.path().join("velodyne/000000.bin"), &Cloud { values: vec![1.0; 40], channels: 4 }).unwrap();
        write_atomic(&folder.path().join("label_2/000000.txt"), b"").unwrap();
        let json = folder.path().join("doctor.json");
        assert!(!args(folder.path().into(), Some(json.clone())).run().unwrap());
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
        assert_eq!(report["schema"], "lidarshift/doctor/1");
        assert_eq!(report["sound"], false);
        assert_eq!(report["findings"][0]["severity"], "problem");
    }

    #[test]
    fn what_is_no_data_set_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let error = args(folder.path().into(), None).run().unwrap_err().to_string();
        assert!(error.contains("neither dataset.toml nor velodyne/"), "{error}");
    }

    #[test]
    fn real_scans_fit_the_published_network() {
        let root = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti/training"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        assert!(args(root, None).run().unwrap());
    }
}
