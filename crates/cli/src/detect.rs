//! `lidarshift detect`: detects objects in one point cloud or in all frames of a split.

use crate::device::DeviceArgs;
use crate::errors::InFile;
use crate::json::JsonArgs;
use crate::{errln, outln};
use anyhow::{Context, Result, bail};
use clap::{Args, ValueEnum};
use data::Presence as _;
use data::toml_text::parse_toml;
use data::{
    Cloud, DataError, Dataset, Detection, FolderLock, Frame, KittiLine, KittiText, LabelBox, PointColumns, read_cloud,
    read_kitti_text, write_atomic,
};
use indicatif::{ProgressBar, ProgressStyle};
use models::checkpoint::read_checkpoint;
use models::config::DetectorConfig;
use models::{Detector, Preparer, find_detector, inference_samples, predict_frames, predict_samples};
use report::{BirdsEyeOptions, Style, birds_eye_png};
use schemars::JsonSchema;
use serde::Serialize;
use std::path::{Path, PathBuf};
use train::verify_weights;

/// Detect objects in a point cloud or in all frames of a split. For a point cloud, boxes are printed as KITTI text in
/// the frame of the cloud, and a bird's eye view is written.
///
/// Examples:
///   lidarshift detect 000007.bin --checkpoint runs/my-run/checkpoint/last.safetensors
///   lidarshift detect my-data --split test --checkpoint last.safetensors --out detections
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct DetectArgs {
    /// Point cloud (.bin or .pcd), or a data set (folder or TOML)
    input: PathBuf,
    /// Weights: safetensors of a run, or a .pth of OpenPCDet
    #[arg(long, value_name = "FILE")]
    checkpoint: PathBuf,
    /// Detector of the weights: a name or a TOML [default: from config.toml of the run that wrote the weights]
    #[arg(long, value_name = "NAME|TOML")]
    detector: Option<String>,
    /// Columns of a .bin cloud [default: from the detector and the file size]
    #[arg(long, value_enum)]
    points: Option<Points>,
    /// Split of the data set [default: all frames]
    #[arg(long, requires = "out")]
    split: Option<String>,
    /// Folder for the results; required for a data set [default for a point cloud: current folder]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Ground truth to draw into the picture of a point cloud: KITTI text in the label frame "lidar"
    #[arg(long, value_name = "FILE")]
    labels: Option<PathBuf>,
    #[command(flatten)]
    json: JsonArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum Points {
    Xyz,
    Xyzi,
}

/// Version of the JSON of a point cloud.
pub(crate) const DETECTIONS_SCHEMA: &str = "lidarshift/detections/1";

/// Version of the JSON of a data set.
pub(crate) const SET_DETECTIONS_SCHEMA: &str = "lidarshift/set-detections/1";

/// Boxes found in one point cloud.
#[derive(Serialize, JsonSchema)]
#[schemars(title = "Detections")]
pub(crate) struct Found<'a> {
    /// `lidarshift/detections/1`.
    schema: &'static str,
    /// Name of the cloud, or id of the frame.
    frame: &'a str,
    /// The boxes, in the frame of the cloud.
    detections: &'a [Detection],
}

/// Boxes found in the frames of a data set.
#[derive(Serialize, JsonSchema)]
#[schemars(title = "SetDetections")]
pub(crate) struct FoundInSet {
    /// `lidarshift/set-detections/1`.
    schema: &'static str,
    /// Name of the data set.
    dataset: String,
    /// The split; null for all frames.
    split: Option<String>,
    /// The frames in their order.
    frames: Vec<FoundInFrame>,
}

/// Boxes found in one frame.
#[derive(Serialize, JsonSchema)]
pub(crate) struct FoundInFrame {
    /// Its id.
    frame: String,
    /// The boxes, in the frame of its cloud.
    detections: Vec<Detection>,
}

impl DetectArgs {
    /// Detects, prints and draws the boxes.
    pub fn run(self) -> Result<()> {
        let device = self.device.open()?;
        let config = detector_of(&self.checkpoint, self.detector.as_deref())?;
        verify_weights(&self.checkpoint)?;
        let weights = read_checkpoint(&self.checkpoint)?;
        let detector = Detector::new(&config, 0, &device)
            .load_named(&weights)
            .with_context(|| InFile::new(&self.checkpoint, &format!(" does not fit the detector {}", config.name)))?;
        let ending = self.input.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
        match ending.as_str() {
            "bin" | "pcd" => self.cloud(&detector),
            _ => self.split(&detector),
        }
    }

    fn cloud(&self, detector: &Detector) -> Result<()> {
        self.json.check([&*self.input].into_iter().chain(self.labels.as_deref()))?;
        let columns = match self.points {
            Some(Points::Xyz) => PointColumns::Xyz,
            Some(Points::Xyzi) => PointColumns::Xyzi,
            None if detector.config().channels == 3 && self.is_xyz_size()? => PointColumns::Xyz,
            None => PointColumns::Xyzi,
        };
        let cloud = read_cloud(&self.input, columns)?;
        let id = self.input.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let frame = Frame { id: id.clone(), cloud, objects: Vec::new() };
        let sample = Preparer::new(detector.config()).inference(&frame)?;
        let detections = predict_samples(detector, &[sample])?.remove(0).detections;
        self.json.write(&Found { schema: DETECTIONS_SCHEMA, frame: &id, detections: &detections })?;
        let truth = match &self.labels {
            Some(path) => read_kitti_text(path, KittiText::Labels)?,
            None => Vec::new(),
        };
        let picture = self.out.clone().unwrap_or_else(|| ".".into()).join(format!("{id}.png"));
        let drawn = match draw(&frame.cloud, &truth, &detections) {
            Ok(bytes) => {
                write_atomic(&picture, &bytes)?;
                format!("bird's eye view in {}", picture.display())
            }
            Err(error) => format!("warning: no picture: {error}"),
        };
        for detection in &detections {
            let found = LabelBox::from_box(&detection.class, &detection.bbox, Some(detection.score));
            outln!("{}", KittiLine(&found));
        }
        errln!("{} boxes, {drawn}", detections.len());
        Ok(())
    }

    /// Whether the file size is a multiple of three f32 columns but not of four.
    fn is_xyz_size(&self) -> Result<bool> {
        let bytes = fs_err::metadata(&self.input)?.len();
        Ok(bytes % 12 == 0 && bytes % 16 != 0)
    }

    fn split(&self, detector: &Detector) -> Result<()> {
        let Some(out) = &self.out else { bail!("--out DIR is required to detect on a data set") };
        let dataset = Dataset::open(&self.input)?;
        dataset.refuse_frame_folder(out)?;
        self.json.check([])?;
        let _lock = FolderLock::acquire(out)?;
        let ids = match &self.split {
            Some(split) => dataset.ids(split)?,
            None => dataset.all_ids()?,
        };
        let progress = ProgressBar::new(ids.len() as u64)
            .with_style(ProgressStyle::with_template("{bar:30} {pos}/{len} frames, {per_sec}, {eta} left")?);
        let (mut boxes, mut frames) = (0, Vec::new());
        let samples = inference_samples(detector, &dataset, &ids, 1).zip(&ids).map(|(sample, id)| Ok((sample?, id)));
        predict_frames(detector, 1, samples, |batch| {
            for (id, found) in batch {
                boxes += found.detections.len();
                let labels = dataset.detection_boxes(id, &found.detections)?;
                data::write::write_kitti_text(&out.join(format!("{id}.txt")), &labels)?;
                if self.json.is_given() {
                    frames.push(FoundInFrame { frame: id.clone(), detections: found.detections });
                }
                progress.inc(1);
            }
            Ok::<(), anyhow::Error>(())
        })?;
        progress.finish_and_clear();
        let (dataset, split) = (dataset.config.name.clone(), self.split.clone());
        self.json.write(&FoundInSet { schema: SET_DETECTIONS_SCHEMA, dataset, split, frames })?;
        errln!("{boxes} boxes in {} frames, written to {}", ids.len(), out.display());
        Ok(())
    }
}

/// The detector of the weights: the one `named` on the command line, else the one in config.toml of the run folder that
/// contains them.
pub(crate) fn detector_of(checkpoint: &Path, named: Option<&str>) -> Result<DetectorConfig> {
    if let Some(name) = named {
        return Ok(find_detector(name)?);
    }
    for folder in checkpoint.ancestors().skip(1).take(3) {
        let path = folder.join("config.toml");
        if path.may_be_file() {
            let text = fs_err::read_to_string(&path)?;
            let run: toml::Table = parse_toml(&text, &path, |_| Ok(()))?;
            let Some(detector) = run.get("detector") else { continue };
            let config: DetectorConfig = detector.clone().try_into().with_context(|| InFile::new(&path, ""))?;
            return Ok(config);
        }
    }
    Err(DataError::file(checkpoint, "the detector of these weights is unknown; give it with --detector").into())
}

/// Draws points, ground truth and detections in a bird's eye view.
fn draw(cloud: &Cloud, truth: &[LabelBox], detections: &[Detection]) -> Result<Vec<u8>> {
    let mut boxes: Vec<_> = truth.iter().map(|label| (label.lidar_box(), Style::GroundTruth)).collect();
    boxes.extend(detections.iter().map(|d| (d.bbox, Style::Detection { score: d.score })));
    Ok(birds_eye_png(cloud, &boxes, &BirdsEyeOptions::default())?)
}
