//! `lidarshift doctor`: checks a data set for errors.

use crate::json::JsonArgs;
use crate::outln;
use anyhow::{Result, anyhow};
use clap::Args;
use data::Dataset;
use data::doctor::{AnchorFacts, DetectorFacts, doctor};
use models::config::DetectorConfig;
use models::find_detector;
use models::suggest::{Change, LabelledBoxes, suggest};
use std::path::{Path, PathBuf};

/// Check a data set before training: files, splits, duplicates, boxes, and whether the labels agree with the declared
/// label frame.
///
/// Exit code 0 if no problem is found; notes are not problems.
///
/// Examples:
///   lidarshift doctor datasets/road
///   lidarshift doctor /data/kitti --detector pointpillars --json -
///   lidarshift doctor datasets/road --detector pointpillars_small --suggest mine.toml
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct DoctorArgs {
    /// Data set: its folder or its TOML
    #[arg(value_name = "DATASET")]
    dataset: PathBuf,
    /// Also check the data against the range and the anchors of this detector: a name or a TOML
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    /// Write a detector of the same kind to this TOML, fitted to the labels: range, grid and anchors, with the reason
    /// for each change
    #[arg(long, value_name = "TOML", requires = "detector")]
    suggest: Option<PathBuf>,
    #[command(flatten)]
    json: JsonArgs,
}

impl DoctorArgs {
    /// Prints the report; `true` if no problem is found.
    pub fn run(self) -> Result<bool> {
        self.json.check([])?;
        let detector = self.detector.as_deref().map(find_detector).transpose()?;
        let dataset = Dataset::open(&self.dataset)?;
        let report = doctor(&dataset, detector.as_ref().map(facts).as_ref())?;
        self.json.write(&report)?;
        let suggestion = match (&self.suggest, &detector) {
            (Some(path), Some(detector)) => Some(self.write_suggestion(path, detector, &dataset)),
            _ => None,
        };
        outln!("{report}");
        if let Some(suggestion) = suggestion {
            outln!("{}", suggestion?);
        }
        Ok(report.sound)
    }

    /// Writes a fitted detector; what was changed and why, as text.
    fn write_suggestion(&self, path: &Path, detector: &DetectorConfig, dataset: &Dataset) -> Result<String> {
        let ids = dataset.ids("train").or_else(|_| dataset.all_ids())?;
        let boxes = LabelledBoxes::read(dataset, &ids, usize::MAX, detector.ground.as_ref())?;
        let name = path.file_stem().map_or(detector.name.clone(), |stem| stem.to_string_lossy().into_owned());
        let mut suggestion =
            suggest(detector, &boxes).map_err(|message| anyhow!("{}: {message}", dataset.config.root.display()))?;
        suggestion.detector.name = name;
        let text = suggestion.to_toml(&detector.name, &dataset.config.name)?;
        data::write_atomic(path, text.as_bytes())?;
        let mut out = format!("{} fitted to {} frames: {}\n", detector.name, boxes.frames.len(), path.display());
        for Change { key, was, is, why } in &suggestion.changes {
            out += &format!("  {key}: {was} -> {is}\n    {why}\n");
        }
        if suggestion.changes.is_empty() {
            out += "  nothing had to be changed\n";
        }
        if let Some([before, after]) = suggestion.assignment {
            let [forced, then] = [before, after].map(|a| format!("{:.1} %", 100.0 * a.forced));
            out += &format!("  boxes with nothing but a forced match: {forced} -> {then}\n");
            out += &format!("  positive anchors a box: {:.2} -> {:.2}\n", before.positives, after.positives);
        }
        Ok(out)
    }
}

/// Classes, range and anchors of a detector.
fn facts(detector: &DetectorConfig) -> DetectorFacts {
    // Converted through decimal text, so that an f32 of 3.9 is not printed as 3.9000000953674316.
    let number = |v: f32| v.to_string().parse::<f64>().unwrap_or(v.into());
    let anchors = detector.network.anchors().iter().map(|anchor| AnchorFacts {
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

    fn args(dataset: PathBuf, json: JsonArgs) -> DoctorArgs {
        DoctorArgs { dataset, detector: Some("pointpillars".into()), suggest: None, json }
    }

    #[test]
    fn an_unsound_data_set_is_reported_in_json_too() {
        let folder = tempfile::tempdir().unwrap();
        write_bin(&folder.path().join("velodyne/000000.bin"), &Cloud { values: vec![1.0; 40], channels: 4 }).unwrap();
        write_atomic(&folder.path().join("label_2/000000.txt"), b"").unwrap();
        let json = folder.path().join("doctor.json");
        assert!(!args(folder.path().into(), JsonArgs::file(&json)).run().unwrap());
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
        assert_eq!(report["schema"], "lidarshift/doctor/1");
        assert_eq!(report["sound"], false);
        assert_eq!(report["findings"][0]["severity"], "problem");
    }

    #[test]
    fn a_folder_without_a_data_set_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let error = args(folder.path().into(), JsonArgs::default()).run().unwrap_err().to_string();
        assert!(error.contains("neither dataset.toml nor velodyne/"), "{error}");
    }

    #[test]
    fn real_scans_fit_the_published_network() {
        let root = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti/training"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        assert!(args(root, JsonArgs::default()).run().unwrap());
    }
}
