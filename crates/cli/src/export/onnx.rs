//! `lidarshift export --to onnx`: a trained detector as ONNX graphs.

use crate::detect::detector_of;
use crate::errors::InFile;
use crate::json::JsonArgs;
use crate::{errln, outln};
use anyhow::{Context, Result};
use burn::tensor::Device;
use data::{DataError, Frame, PointColumns, read_cloud, write_atomic, write_json};
use models::checkpoint::{read_checkpoint, write_safetensors};
use models::config::{DetectorConfig, NetworkConfig};
use models::onnx::{onnx_check, to_onnx};
use models::{Detector, Preparer};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use train::verify_weights;

/// The example beside the graphs.
const SCRIPT: &str = include_str!("run_onnx.py");

/// What is exported.
pub(super) struct OnnxExport {
    /// Weights, or the folder of a run.
    pub weights: PathBuf,
    /// A name or a TOML.
    pub detector: Option<String>,
    /// A cloud whose inputs and outputs are written as well.
    pub check: Option<PathBuf>,
    /// Folder for the files.
    pub out: PathBuf,
    /// Where the description of the detector also goes.
    pub json: JsonArgs,
}

impl OnnxExport {
    /// Writes the graphs and what is needed to run them.
    pub fn run(&self) -> Result<()> {
        let weights = match self.weights.join("checkpoint/last.safetensors") {
            last if self.weights.is_dir() => last,
            _ => self.weights.clone(),
        };
        self.json.check([])?;
        let config = detector_of(&weights, self.detector.as_deref())?;
        verify_weights(&weights)?;
        let named = read_checkpoint(&weights)?;
        let detector = Detector::new(&config, 0, &Device::flex())
            .load_named(&named)
            .with_context(|| InFile::new(&weights, &format!(" does not fit the detector {}", config.name)))?;
        let graphs = to_onnx(&detector).with_context(|| InFile::new(&weights, ""))?;
        write_atomic(&self.out.join("pillar_net.onnx"), &graphs.pillar_net)?;
        write_atomic(&self.out.join("backbone_head.onnx"), &graphs.backbone_head)?;
        let description = description(&config);
        write_json(&self.out.join("detector.json"), &description)?;
        write_atomic(&self.out.join("run_onnx.py"), SCRIPT.as_bytes())?;
        if let Some(cloud) = &self.check {
            self.write_check(&detector, cloud)?;
        }
        self.json.write(&description)?;
        outln!("{}: {}", config.name, config.classes.join(", "));
        errln!("written to {}: pillar_net.onnx, backbone_head.onnx, detector.json, run_onnx.py", self.out.display());
        Ok(())
    }

    fn write_check(&self, detector: &Detector, path: &Path) -> Result<()> {
        let columns = if detector.config().channels == 3 { PointColumns::Xyz } else { PointColumns::Xyzi };
        let cloud = read_cloud(path, columns)?;
        let frame = Frame { id: "check".into(), cloud, objects: Vec::new() };
        let sample = Preparer::new(detector.config()).inference(&frame)?;
        if sample.is_empty() {
            let message = "no point is within the range of the detector; give another cloud";
            return Err(DataError::file(path, message).into());
        }
        let tensors = onnx_check(detector, &sample)?;
        Ok(write_safetensors(&self.out.join("check.safetensors"), &tensors, &BTreeMap::new())?)
    }
}

/// Version of `detector.json`.
pub(crate) const ONNX_SCHEMA: &str = "lidarshift/onnx-detector/1";

/// The content of `detector.json`: what has to be known to make inputs and to read outputs.
#[derive(Serialize, JsonSchema)]
pub(crate) struct OnnxDescription<'a> {
    /// `lidarshift/onnx-detector/1`.
    schema: &'static str,
    /// Name of the detector.
    name: &'a str,
    /// `pointpillars` or `centerpoint`.
    network: &'static str,
    /// Its classes.
    classes: &'a [String],
    /// Values of a point that it reads.
    channels: usize,
    /// Range: least x, y, z and largest x, y, z, m.
    range_m: [f32; 6],
    /// Whether heights count from the ground.
    ground: bool,
    /// Size of a pillar, m.
    pillar_size_m: Option<[f32; 3]>,
    /// Number of pillars along x, y, z.
    grid_size: Option<[usize; 3]>,
    /// Largest number of points of a pillar.
    max_points: Option<usize>,
    /// Largest number of pillars.
    max_pillars: Option<usize>,
    /// The whole configuration.
    config: &'a DetectorConfig,
}

fn description(config: &DetectorConfig) -> OnnxDescription<'_> {
    let (pillars, network) = match &config.network {
        NetworkConfig::PointPillars(net) => (Some(&net.pillars), "pointpillars"),
        NetworkConfig::CenterPoint(net) => (Some(&net.pillars), "centerpoint"),
        NetworkConfig::PointRcnn(_) => (None, "pointrcnn"),
    };
    OnnxDescription {
        schema: ONNX_SCHEMA,
        name: &config.name,
        network,
        classes: &config.classes,
        channels: config.channels,
        range_m: config.range_m,
        ground: config.ground.is_some(),
        pillar_size_m: pillars.map(|p| p.size_m),
        grid_size: pillars.map(|p| p.grid_size(config)),
        max_points: pillars.map(|p| p.max_points),
        max_pillars: pillars.map(|p| p.max_test),
        config,
    }
}
