//! `lidarshift eval ap`: average precision and recall of detections in KITTI text, of a study, or of OpenPCDet.

use crate::json::JsonArgs;
use crate::{errln, out};
use anyhow::{Result, bail};
use clap::Args;
use data::{Dataset, LabelFrame, detections_file, frames_of_detections};
use eval::{EvalFrame, EvalOptions, default_classes, evaluate, ids_of_folder, read_detections, read_frames, read_ids};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Average precision and recall of detections in KITTI text, of a study, or of OpenPCDet.
///
/// Label lines have 15 values. Detection lines have 16; the last one is the score. A frame without objects has an empty
/// file. Boxes are compared in the frame in which the files give them. A study writes the detections on a test set to
/// one file, `detections.parquet`. OpenPCDet's `result.pkl` needs --dataset: its boxes are in the LiDAR frame.
///
/// Examples:
///   lidarshift eval ap --labels data/label_2 --detections runs/mine/detections
///   lidarshift eval ap --dataset datasets/road --split test --detections detections --json ap.json
///   lidarshift eval ap --dataset datasets/road --split val --detections output/result.pkl
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct EvalApArgs {
    /// Folder of label files
    #[arg(long, value_name = "DIR", required_unless_present = "dataset", conflicts_with = "dataset")]
    labels: Option<PathBuf>,
    /// Folder of detection files with the same names as the label files, `detections.parquet` or its folder, or
    /// OpenPCDet's `result.pkl`
    #[arg(long, value_name = "PATH")]
    detections: PathBuf,
    /// Frame of labels and detections: `camera` (as in KITTI) or `lidar` (location is the box centre, rotation the
    /// yaw). With --dataset, the data set defines it [default: camera]
    #[arg(long, value_name = "FRAME", value_parser = label_frame, conflicts_with = "dataset")]
    label_frame: Option<LabelFrame>,
    /// File with the frame ids, one per line [default: every label file]
    #[arg(long, value_name = "FILE", conflicts_with = "dataset")]
    ids: Option<PathBuf>,
    /// Data set (folder or TOML); replaces --labels, --label-frame and --ids
    #[arg(long, value_name = "DATASET")]
    dataset: Option<PathBuf>,
    /// Split of the data set
    #[arg(long, value_name = "NAME", default_value = "test", conflicts_with = "labels")]
    split: String,
    /// Classes, separated by commas [default: those of the data set or of the files, without the classes that KITTI
    /// does not evaluate]
    #[arg(long, value_name = "NAMES", value_delimiter = ',')]
    classes: Vec<String>,
    /// Additional IoU thresholds, separated by commas
    #[arg(long, value_name = "LIMITS", value_delimiter = ',', value_parser = overlap)]
    overlaps: Vec<f64>,
    /// Ignore ground truth and detections at a larger horizontal distance, m
    #[arg(long, value_name = "M", value_parser = range)]
    max_range: Option<f64>,
    #[command(flatten)]
    json: JsonArgs,
}

impl EvalApArgs {
    /// Reads the files, prints the table and writes the JSON.
    pub fn run(self) -> Result<()> {
        self.json.check([])?;
        let (frames, mut options) = match (&self.dataset, &self.labels) {
            (Some(dataset), _) => self.of_dataset(dataset)?,
            (None, Some(labels)) => self.of_folder(labels)?,
            (None, None) => bail!("the labels are missing: give --labels DIR or --dataset DATASET"),
        };
        options.max_range_m = self.max_range;
        options.more_overlaps = self.overlaps;
        if !self.classes.is_empty() {
            options.classes = self.classes;
        } else if options.classes.is_empty() && default_classes(&frames).is_empty() {
            bail!(
                "labels and detections contain no object of a class that KITTI evaluates; choose classes with --classes"
            );
        }
        let report = evaluate(&frames, &options);
        self.json.write(&report)?;
        out!("{report}");
        Ok(())
    }

    fn of_folder(&self, labels: &Path) -> Result<(Vec<EvalFrame>, EvalOptions)> {
        if self.is_pickle() {
            let path = self.detections.display();
            bail!(
                "{path}: is a file; give --dataset for OpenPCDet's result.pkl, or a folder of KITTI text, or a Parquet \
                 file of detections (.parquet)"
            );
        }
        let ids = match &self.ids {
            Some(list) => read_ids(list)?,
            None => ids_of_folder(labels)?,
        };
        let frames = read_frames(labels, &self.detections, &ids)?;
        if self.ids.is_none() {
            self.warn_of_detections_without_labels(&ids);
        }
        let label_frame = self.label_frame.unwrap_or(LabelFrame::Camera);
        Ok((frames, EvalOptions { label_frame, ..EvalOptions::default() }))
    }

    fn of_dataset(&self, dataset: &Path) -> Result<(Vec<EvalFrame>, EvalOptions)> {
        let dataset = Dataset::open(dataset)?;
        let ids = dataset.ids(&self.split)?;
        let frames = if self.is_pickle() {
            study::read_result_frames(&self.detections, &dataset, &ids)?
        } else {
            read_detections(|id| dataset.labels(id), &self.detections, &ids)?
        };
        let config = dataset.config;
        Ok((frames, EvalOptions { label_frame: config.label_frame, classes: config.classes, ..EvalOptions::default() }))
    }

    fn is_pickle(&self) -> bool {
        self.detections.is_file() && detections_file(&self.detections).is_none()
    }

    /// Without --ids the label files define the frames. Warns about detections of other frames, which are ignored.
    fn warn_of_detections_without_labels(&self, ids: &[String]) {
        let known: BTreeSet<&String> = ids.iter().collect();
        let (what, ending, detected) = match detections_file(&self.detections) {
            Some(file) => ("frames with detections", "", frames_of_detections(&file).unwrap_or_default()),
            None => {
                let files = ids_of_folder(&self.detections).unwrap_or_default();
                ("detection files", ".txt", files.into_iter().collect())
            }
        };
        let mut others = detected.iter().filter(|id| !known.contains(id));
        if let Some(first) = others.next() {
            let n = 1 + others.count();
            errln!(
                "warning: {n} {what} have no label file and are ignored (first: {first}{ending}); choose frames with \
                 --ids"
            );
        }
    }
}

fn label_frame(text: &str) -> Result<LabelFrame, String> {
    match text {
        "camera" => Ok(LabelFrame::Camera),
        "lidar" => Ok(LabelFrame::Lidar),
        _ => Err("must be camera or lidar".into()),
    }
}

fn overlap(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|v| (0.0..1.0).contains(v)).ok_or("must be a number from 0 to below 1".into())
}

fn range(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|v: &f64| *v > 0.0).ok_or("must be a number of metres above 0".into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        args: EvalApArgs,
    }

    fn run(arguments: &[&str]) -> Result<()> {
        Program::try_parse_from(std::iter::once(&"ap").chain(arguments))?.args.run()
    }

    fn golden(path: &str) -> String {
        format!("{}/../../tests/golden/evaluation/{path}", env!("CARGO_MANIFEST_DIR"))
    }

    #[test]
    fn json_has_rows_and_recall() {
        let out = tempfile::tempdir().unwrap();
        let json = out.path().join("new/ap.json");
        let (labels, detections) = (golden("small/label_2"), golden("small/detections"));
        run(&["--labels", &labels, "--detections", &detections, "--json", json.to_str().unwrap()]).unwrap();
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
        assert_eq!(report["schema"], eval::SCHEMA);
        let car = report["rows"].as_array().unwrap().iter().find(|row| {
            row["class"] == "Car" && row["metric"] == "3d" && row["overlap"] == 0.7 && row["difficulty"] == "moderate"
        });
        let car = car.unwrap();
        assert!((car["ap40"].as_f64().unwrap() - 30.760652386177807).abs() < 1e-9, "{car}");
        assert_eq!((car["n_gt"].as_i64(), car["n_tp"].as_i64(), car["n_fp"].as_i64()), (Some(43), Some(23), Some(60)));
        assert!(report["recall"].as_array().unwrap().len() > 3);
    }

    #[test]
    fn wrong_arguments_are_refused() {
        let (labels, detections) = (golden("small/label_2"), golden("small/detections"));
        let with = |more: &[&str]| {
            let arguments = [&["--labels", &labels, "--detections", &detections], more].concat();
            run(&arguments).unwrap_err().to_string()
        };
        assert!(with(&["--label-frame", "world"]).contains("must be camera or lidar"));
        assert!(with(&["--overlaps", "0.5,1"]).contains("from 0 to below 1"));
        assert!(with(&["--max-range", "nan"]).contains("above 0"));
        assert!(with(&["--dataset", "x"]).contains("cannot be used with"));
        assert!(with(&["--ids", "/nowhere/val.txt"]).contains("/nowhere/val.txt"));
        assert!(run(&["--detections", &detections]).unwrap_err().to_string().contains("--labels"));
        let error = run(&["--labels", &labels, "--detections", "/nowhere"]).unwrap_err().to_string();
        assert!(error.contains("/nowhere: is not a folder"), "{error}");
    }
    /// The file has two cars and a pedestrian in 000000, nothing in 000001, a car in 000007.
    #[test]
    fn detections_of_openpcdet_are_read() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, content: &[u8]| {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, content).unwrap();
        };
        let car = |x: f64, y: f64, yaw: f64| format!("Car 0 0 0 0 0 50 50 1.5 1.75 4 {x} {y} -0.75 {yaw}\n");
        let point: Vec<u8> = [5.0f32, 0.0, 0.0, 0.5].iter().flat_map(|v| v.to_le_bytes()).collect();
        let labels = [("000000", car(10.0, 0.0, 0.0) + &car(30.0, -3.0, 0.5)), ("000001", String::new())];
        for (id, text) in labels.iter().chain(&[("000007", car(20.0, 0.0, 0.0))]) {
            write(&format!("velodyne/{id}.bin"), &point);
            write(&format!("label_2/{id}.txt"), text.as_bytes());
        }
        write("dataset.toml", b"root = \".\"\nlayout = \"kitti\"\nlabel_frame = \"lidar\"\n");
        write("ImageSets/val.txt", b"000000\n000001\n000007\n");
        let dataset = folder.path().to_str().unwrap();
        let json = folder.path().join("ap.json");
        let file = format!("{}/../../tests/golden/results/numpy2_protocol5.pkl", env!("CARGO_MANIFEST_DIR"));
        let arguments = ["--dataset", dataset, "--split", "val", "--detections", &file, "--classes", "Car"];
        run(&[&arguments[..], &["--json", json.to_str().unwrap()]].concat()).unwrap();
        let report: serde_json::Value = serde_json::from_slice(&std::fs::read(json).unwrap()).unwrap();
        let rows = report["rows"].as_array().unwrap();
        let found = rows.iter().find(|row| row["metric"] == "3d" && row["overlap"] == 0.7).unwrap();
        let counts = ["n_gt", "n_tp", "n_fp"].map(|name| found[name].as_i64().unwrap());
        assert_eq!(counts, [3, 3, 0]);
        write("velodyne/000009.bin", &point);
        write("label_2/000009.txt", b"");
        write("ImageSets/val.txt", b"000000\n000009\n");
        let error = run(&arguments).unwrap_err().to_string();
        assert!(error.contains("numpy2_protocol5.pkl: has no frame 000009; 1 of 2 frames have no entry"), "{error}");
        let error = run(&["--labels", dataset, "--detections", &file]).unwrap_err().to_string();
        assert!(error.contains("numpy2_protocol5.pkl: is a file; give --dataset"), "{error}");
    }
}
