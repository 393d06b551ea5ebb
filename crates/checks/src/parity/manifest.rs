//! The manifest of a folder with reference values, and the detector that it describes.

use super::DETECTORS;
use super::network::DetectorChecks;
use anyhow::{Context, Result};
use models::config::DetectorConfig;
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// The parts of `manifest.json` that a comparison needs.
#[derive(Debug, Deserialize)]
pub struct Manifest {
    /// Seed of the weight recipe.
    pub seed: u64,
    /// Class names, in the head's order.
    pub classes: Vec<String>,
    /// Number of values per point.
    pub point_dims: usize,
    /// OpenPCDet's model configuration.
    pub model_cfg: Value,
    /// Range of the detector: minimum x, y, z, then maximum x, y, z, m.
    pub range: Vec<f64>,
    /// Pillar size, m.
    #[serde(default)]
    pub voxel_size: Vec<f64>,
    /// Maximum number of points per pillar.
    #[serde(default = "default_points")]
    pub max_points_per_pillar: usize,
    /// Maximum number of pillars, if the folder limits it.
    pub max_pillars: Option<usize>,
    /// Score threshold of PointPillars' `det`.
    pub score_thresh: Option<f32>,
    /// Score threshold of `det2`.
    pub score_thresh_2: Option<f32>,
    /// The losses in single and in double precision.
    #[serde(default)]
    losses_f32: BTreeMap<String, f64>,
    #[serde(default)]
    losses_f64: BTreeMap<String, f64>,
    /// Number of input points of PointRCNN.
    #[serde(default)]
    pub num_points: usize,
    /// Name and shape of every tensor of the network, if the folder lists them.
    #[serde(default)]
    pub names: BTreeMap<String, Vec<usize>>,
    /// Differences between single and double precision of the reference, by tensor.
    #[serde(default)]
    pub f32_minus_f64: BTreeMap<String, Natural>,
}

fn default_points() -> usize {
    32
}

/// Difference between single and double precision of the reference.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Natural {
    /// Relative L2 distance of the whole tensor.
    pub rel_l2: Option<f64>,
    /// Whether the tensor is zero in double precision, so that single precision gives rounding errors alone.
    #[serde(default)]
    pub zero: bool,
}

impl Manifest {
    /// Reads `manifest.json` of a folder.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join("manifest.json");
        let text = fs_err::read_to_string(&path)?;
        serde_json::from_str(&text)
            .with_context(|| format!("{}: not the manifest of reference values of a network", path.display()))
    }

    /// Ten times the rounding error of the reference for a tensor, at most `limit`.
    pub fn tolerance(&self, key: &str, limit: f64) -> f64 {
        let natural = self.f32_minus_f64.get(key).and_then(|n| n.rel_l2);
        natural.map_or(limit, |rel| (10.0 * rel).min(limit))
    }

    /// Ten times the rounding error of the losses of the reference, within fixed limits.
    pub fn loss_tolerance(&self) -> f64 {
        if let Some(rel) = self.f32_minus_f64.get("train/losses").and_then(|n| n.rel_l2) {
            return (10.0 * rel).clamp(1e-6, 1e-3);
        }
        let natural = |(name, single): (&String, &f64)| {
            let double = self.losses_f64.get(name)?;
            (*double != 0.0).then(|| (single / double - 1.0).abs())
        };
        let natural = self.losses_f32.iter().filter_map(natural).fold(0.0, f64::max);
        (10.0 * natural).clamp(1e-5, 1e-3)
    }

    /// The comparisons of the detector of the manifest.
    pub fn checks(&self) -> Result<&'static DetectorChecks> {
        let kind = self.model_cfg["NAME"].as_str().unwrap_or_default();
        let names: Vec<&str> = DETECTORS.iter().map(|checks| checks.name).collect();
        let found = DETECTORS.iter().find(|checks| checks.name == kind);
        found.with_context(|| {
            format!("the folder has reference values of {kind}; this program supports {}", names.join(" and "))
        })
    }

    /// The configuration of the detector of the manifest.
    pub fn detector(&self) -> Result<DetectorConfig> {
        let checks = self.checks()?;
        let config = DetectorConfig {
            name: "reference".into(),
            classes: self.classes.clone(),
            channels: self.point_dims,
            range_m: array(&self.range)?,
            ground: None,
            network: (checks.config)(self)?,
            optimization: Default::default(),
            augmentation: Default::default(),
        };
        config.check().map_err(anyhow::Error::msg)?;
        Ok(config)
    }
}

/// Reads a number.
pub fn float(value: &Value) -> Result<f32> {
    Ok(value.as_f64().with_context(|| format!("manifest.json: a number is needed, not {value}"))? as f32)
}

/// Reads a list.
pub fn list(value: &Value) -> Result<&Vec<Value>> {
    value.as_array().with_context(|| format!("manifest.json: a list is needed, not {value}"))
}

/// Reads a list of numbers.
pub fn floats(value: &Value) -> Result<Vec<f64>> {
    list(value)?
        .iter()
        .map(|v| v.as_f64().with_context(|| format!("manifest.json: a number is needed, not {v}")))
        .collect()
}

/// Reads a list of non-negative integers.
pub fn usizes(value: &Value) -> Result<Vec<usize>> {
    Ok(floats(value)?.into_iter().map(|v| v as usize).collect())
}

/// Reads a list of names.
pub fn names(value: &Value) -> Result<Vec<String>> {
    let name = |v: &Value| v.as_str().map(String::from);
    list(value)?.iter().map(|v| name(v).with_context(|| format!("manifest.json: a name is needed, not {v}"))).collect()
}

/// Reads the channels of two hidden layers.
pub fn pair(value: &Value) -> Result<[usize; 2]> {
    let values = usizes(value)?;
    values.try_into().map_err(|v| anyhow::anyhow!("manifest.json: two hidden layers are supported, not {v:?}"))
}

/// Converts exactly `N` numbers.
pub fn array<const N: usize>(values: &[f64]) -> Result<[f32; N]> {
    let narrow: Vec<f32> = values.iter().map(|&v| v as f32).collect();
    narrow.try_into().map_err(|_| anyhow::anyhow!("manifest.json: {N} numbers are needed, not {values:?}"))
}
