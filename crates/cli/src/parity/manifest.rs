//! The manifest of a folder of reference numbers, and the detector that it describes.

use anyhow::{Context, Result, bail};
use models::config::{
    AnchorConfig, BackboneConfig, DetectionConfig, DetectorConfig, HeadConfig, LossConfig, NetworkConfig,
    PillarsConfig, PointPillarsConfig,
};
use serde::Deserialize;
use serde_json::Value;
use std::collections::BTreeMap;
use std::path::Path;

/// What `manifest.json` says that a comparison needs.
#[derive(Debug, Deserialize)]
pub struct Manifest {
    /// Seed of the weight recipe.
    pub seed: u64,
    /// Class names, in the head's order.
    pub classes: Vec<String>,
    /// Values a point.
    pub point_dims: usize,
    /// OpenPCDet's model configuration.
    pub model_cfg: Value,
    /// Range, m.
    pub range: Vec<f64>,
    /// Pillar size, m.
    #[serde(default)]
    pub voxel_size: Vec<f64>,
    /// Points a pillar.
    #[serde(default = "default_points")]
    pub max_points_per_pillar: usize,
    /// Score threshold of `det`.
    pub score_thresh: f32,
    /// Score threshold of `det2`.
    pub score_thresh_2: Option<f32>,
    /// Natural differences.
    #[serde(default)]
    pub f32_minus_f64: BTreeMap<String, Natural>,
}

fn default_points() -> usize {
    32
}

/// The reference's own difference between single and double precision.
#[derive(Clone, Copy, Debug, Deserialize)]
pub struct Natural {
    /// Relative L2 of the whole tensor.
    pub rel_l2: Option<f64>,
}

impl Manifest {
    /// Reads `manifest.json` of a folder.
    pub fn read(folder: &Path) -> Result<Self> {
        let path = folder.join("manifest.json");
        let text = fs_err::read_to_string(&path)?;
        serde_json::from_str(&text)
            .with_context(|| format!("{}: not the manifest of a network's reference numbers", path.display()))
    }

    /// Ten times the reference's own rounding for a tensor, at most `limit`.
    pub fn tolerance(&self, key: &str, limit: f64) -> f64 {
        let natural = self.f32_minus_f64.get(key).and_then(|n| n.rel_l2);
        natural.map_or(limit, |rel| (10.0 * rel).min(limit))
    }

    /// Our configuration of the same network.
    pub fn detector(&self) -> Result<DetectorConfig> {
        let cfg = &self.model_cfg;
        let kind = cfg["NAME"].as_str().unwrap_or_default();
        if kind != "PointPillar" {
            bail!("the folder holds numbers of {kind}; this build knows PointPillar");
        }
        let (backbone, head) = (&cfg["BACKBONE_2D"], &cfg["DENSE_HEAD"]);
        let anchors =
            head["ANCHOR_GENERATOR_CONFIG"].as_array().context("DENSE_HEAD.ANCHOR_GENERATOR_CONFIG is missing")?;
        let anchors = anchors.iter().map(anchor).collect::<Result<Vec<_>>>()?;
        let weights = &head["LOSS_CONFIG"]["LOSS_WEIGHTS"];
        let nms = &cfg["POST_PROCESSING"]["NMS_CONFIG"];
        let filters = usizes(&cfg["VFE"]["NUM_FILTERS"])?;
        let [vfe_filters] = filters[..] else { bail!("VFE.NUM_FILTERS = {filters:?}: one layer is supported") };
        let config = DetectorConfig {
            name: "reference".into(),
            classes: self.classes.clone(),
            channels: self.point_dims,
            range_m: array(&self.range)?,
            network: NetworkConfig::PointPillars(PointPillarsConfig {
                pillars: PillarsConfig {
                    size_m: array(&self.voxel_size)?,
                    max_points: self.max_points_per_pillar,
                    ..PillarsConfig::default()
                },
                vfe_filters,
                backbone: BackboneConfig {
                    layers: usizes(&backbone["LAYER_NUMS"])?,
                    strides: usizes(&backbone["LAYER_STRIDES"])?,
                    filters: usizes(&backbone["NUM_FILTERS"])?,
                    upsample_strides: usizes(&backbone["UPSAMPLE_STRIDES"])?,
                    upsample_filters: usizes(&backbone["NUM_UPSAMPLE_FILTERS"])?,
                },
                anchors,
                head: HeadConfig {
                    dir_offset_rad: float(&head["DIR_OFFSET"])?,
                    dir_limit_offset: float(&head["DIR_LIMIT_OFFSET"])?,
                    dir_bins: head["NUM_DIR_BINS"].as_u64().context("DENSE_HEAD.NUM_DIR_BINS")? as usize,
                },
                loss: LossConfig {
                    class_weight: float(&weights["cls_weight"])?,
                    box_weight: float(&weights["loc_weight"])?,
                    code_weights: array(&floats(&weights["code_weights"])?)?,
                    direction_weight: float(&weights["dir_weight"])?,
                },
                detection: DetectionConfig {
                    score_threshold: self.score_thresh,
                    nms_iou: float(&nms["NMS_THRESH"])?,
                    nms_pre: float(&nms["NMS_PRE_MAXSIZE"])? as usize,
                    nms_post: float(&nms["NMS_POST_MAXSIZE"])? as usize,
                },
            }),
            optimization: Default::default(),
            augmentation: Default::default(),
        };
        config.check().map_err(anyhow::Error::msg)?;
        Ok(config)
    }
}

fn anchor(value: &Value) -> Result<AnchorConfig> {
    let sizes = value["anchor_sizes"].as_array().context("anchor_sizes")?;
    let [size] = &sizes[..] else { bail!("anchor_sizes: one size a class is supported") };
    Ok(AnchorConfig {
        class: value["class_name"].as_str().context("class_name")?.into(),
        size_m: array(&floats(size)?)?,
        bottom_m: floats(&value["anchor_bottom_heights"])?.first().copied().context("anchor_bottom_heights")? as f32,
        rotations_rad: floats(&value["anchor_rotations"])?.iter().map(|&v| v as f32).collect(),
        matched: float(&value["matched_threshold"])?,
        unmatched: float(&value["unmatched_threshold"])?,
    })
}

fn float(value: &Value) -> Result<f32> {
    Ok(value.as_f64().with_context(|| format!("manifest.json: a number is needed, not {value}"))? as f32)
}

fn floats(value: &Value) -> Result<Vec<f64>> {
    let list = value.as_array().with_context(|| format!("manifest.json: a list of numbers is needed, not {value}"))?;
    list.iter().map(|v| v.as_f64().with_context(|| format!("manifest.json: a number is needed, not {v}"))).collect()
}

fn usizes(value: &Value) -> Result<Vec<usize>> {
    Ok(floats(value)?.into_iter().map(|v| v as usize).collect())
}

fn array<const N: usize>(values: &[f64]) -> Result<[f32; N]> {
    let narrow: Vec<f32> = values.iter().map(|&v| v as f32).collect();
    narrow.try_into().map_err(|_| anyhow::anyhow!("manifest.json: {N} numbers are needed, not {values:?}"))
}
