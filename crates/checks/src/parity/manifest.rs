//! The manifest of a folder of reference numbers, and the detector that it describes.

use anyhow::{Context, Result, bail};
use models::config::{
    AnchorConfig, BackboneConfig, DetectionConfig, DetectorConfig, HeadConfig, LevelConfig, LossConfig, MeanSizeConfig,
    NetworkConfig, PillarsConfig, PointHeadConfig, PointPillarsConfig, PointRcnnConfig, PointRcnnLossConfig,
    ProposalsConfig, RcnnDetectionConfig, RoiHeadConfig, RoiLevelConfig, RoiSamplingConfig, SamplingConfig,
    ScaleConfig, SuppressionConfig,
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
    /// Score threshold of PointPillars' `det`.
    pub score_thresh: Option<f32>,
    /// Score threshold of `det2`.
    pub score_thresh_2: Option<f32>,
    /// The losses in single and in double precision.
    #[serde(default)]
    losses_f32: BTreeMap<String, f64>,
    #[serde(default)]
    losses_f64: BTreeMap<String, f64>,
    /// Points that PointRCNN reads.
    #[serde(default)]
    num_points: usize,
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

    /// Ten times the reference's own rounding of the losses, within reason.
    pub fn loss_tolerance(&self) -> f64 {
        let natural = |(name, single): (&String, &f64)| {
            let double = self.losses_f64.get(name)?;
            (*double != 0.0).then(|| (single / double - 1.0).abs())
        };
        let natural = self.losses_f32.iter().filter_map(natural).fold(0.0, f64::max);
        (10.0 * natural).clamp(1e-5, 1e-3)
    }

    /// Our configuration of the same network.
    pub fn detector(&self) -> Result<DetectorConfig> {
        let network = match self.model_cfg["NAME"].as_str().unwrap_or_default() {
            "PointPillar" => NetworkConfig::PointPillars(self.pointpillars()?),
            "PointRCNN" => NetworkConfig::PointRcnn(self.pointrcnn()?),
            kind => bail!("the folder holds numbers of {kind}; this program knows PointPillar and PointRCNN"),
        };
        let config = DetectorConfig {
            name: "reference".into(),
            classes: self.classes.clone(),
            channels: self.point_dims,
            range_m: array(&self.range)?,
            network,
            optimization: Default::default(),
            augmentation: Default::default(),
        };
        config.check().map_err(anyhow::Error::msg)?;
        Ok(config)
    }

    fn pointpillars(&self) -> Result<PointPillarsConfig> {
        let cfg = &self.model_cfg;
        let (backbone, head) = (&cfg["BACKBONE_2D"], &cfg["DENSE_HEAD"]);
        let anchors =
            head["ANCHOR_GENERATOR_CONFIG"].as_array().context("DENSE_HEAD.ANCHOR_GENERATOR_CONFIG is missing")?;
        let anchors = anchors.iter().map(anchor).collect::<Result<Vec<_>>>()?;
        let weights = &head["LOSS_CONFIG"]["LOSS_WEIGHTS"];
        let nms = &cfg["POST_PROCESSING"]["NMS_CONFIG"];
        let filters = usizes(&cfg["VFE"]["NUM_FILTERS"])?;
        let [vfe_filters] = filters[..] else { bail!("VFE.NUM_FILTERS = {filters:?}: one layer is supported") };
        Ok(PointPillarsConfig {
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
                score_threshold: self.score_thresh.context("score_thresh")?,
                nms_iou: float(&nms["NMS_THRESH"])?,
                nms_pre: float(&nms["NMS_PRE_MAXSIZE"])? as usize,
                nms_post: float(&nms["NMS_POST_MAXSIZE"])? as usize,
            },
        })
    }

    fn pointrcnn(&self) -> Result<PointRcnnConfig> {
        let cfg = &self.model_cfg;
        let (backbone, head, roi) = (&cfg["BACKBONE_3D"], &cfg["POINT_HEAD"], &cfg["ROI_HEAD"]);
        let sa = &backbone["SA_CONFIG"];
        let mut levels = Vec::new();
        for (i, centers) in usizes(&sa["NPOINTS"])?.into_iter().enumerate() {
            let (radii, samples) = (floats(&sa["RADIUS"][i])?, usizes(&sa["NSAMPLE"][i])?);
            let scale = |g: usize| -> Result<ScaleConfig> {
                let filters = usizes(&sa["MLPS"][i][g])?;
                Ok(ScaleConfig { radius_m: radii[g] as f32, samples: samples[g], filters })
            };
            levels.push(LevelConfig { centers, scales: (0..radii.len()).map(scale).collect::<Result<_>>()? });
        }
        let sizes = list(&head["TARGET_CONFIG"]["BOX_CODER_CONFIG"]["mean_size"])?;
        let mean_size = |(class, size): (&String, &Value)| -> Result<MeanSizeConfig> {
            Ok(MeanSizeConfig { class: class.clone(), size_m: array(&floats(size)?)? })
        };
        let suppression = |value: &Value| -> Result<SuppressionConfig> {
            let [pre, post] = [&value["NMS_PRE_MAXSIZE"], &value["NMS_POST_MAXSIZE"]].map(float);
            Ok(SuppressionConfig { iou: float(&value["NMS_THRESH"])?, pre: pre? as usize, post: post? as usize })
        };
        let sa = &roi["SA_CONFIG"];
        let (radii, samples) = (floats(&sa["RADIUS"])?, usizes(&sa["NSAMPLE"])?);
        let filters = list(&sa["MLPS"])?.iter().map(usizes).collect::<Result<Vec<_>>>()?;
        let inner = floats(&sa["NPOINTS"])?.into_iter().enumerate().filter(|(_, centers)| *centers > 0.0);
        let inner = inner.map(|(i, centers)| RoiLevelConfig {
            centers: centers as usize,
            radius_m: radii[i] as f32,
            samples: samples[i],
            filters: filters[i].clone(),
        });
        let (pool, target) = (&roi["ROI_POINT_POOL"], &roi["TARGET_CONFIG"]);
        let (point, rcnn) = (&head["LOSS_CONFIG"]["LOSS_WEIGHTS"], &roi["LOSS_CONFIG"]["LOSS_WEIGHTS"]);
        Ok(PointRcnnConfig {
            sampling: SamplingConfig { points: self.num_points, ..SamplingConfig::default() },
            levels,
            propagation: list(&backbone["FP_MLPS"])?.iter().map(usizes).collect::<Result<_>>()?,
            point_head: PointHeadConfig {
                mean_sizes: self.classes.iter().zip(sizes).map(mean_size).collect::<Result<_>>()?,
                class_filters: pair(&head["CLS_FC"])?,
                box_filters: pair(&head["REG_FC"])?,
                extra_width_m: array(&floats(&head["TARGET_CONFIG"]["GT_EXTRA_WIDTH"])?)?,
            },
            proposals: ProposalsConfig {
                train: suppression(&roi["NMS_CONFIG"]["TRAIN"])?,
                test: suppression(&roi["NMS_CONFIG"]["TEST"])?,
            },
            roi_head: RoiHeadConfig {
                points: float(&pool["NUM_SAMPLED_POINTS"])? as usize,
                extra_width_m: array(&floats(&pool["POOL_EXTRA_WIDTH"])?)?,
                depth_normalizer_m: float(&pool["DEPTH_NORMALIZER"])?,
                xyz_filters: pair(&roi["XYZ_UP_LAYER"])?,
                levels: inner.collect(),
                global_filters: filters.last().cloned().context("ROI_HEAD.SA_CONFIG.MLPS")?,
                class_filters: pair(&roi["CLS_FC"])?,
                box_filters: pair(&roi["REG_FC"])?,
            },
            roi_sampling: RoiSamplingConfig {
                regions: float(&target["ROI_PER_IMAGE"])? as usize,
                foreground_share: float(&target["FG_RATIO"])?,
                class_foreground: float(&target["CLS_FG_THRESH"])?,
                class_background: float(&target["CLS_BG_THRESH"])?,
                box_foreground: float(&target["REG_FG_THRESH"])?,
                easy_background: float(&target["CLS_BG_THRESH_LO"])?,
                hard_share: float(&target["HARD_BG_RATIO"])?,
            },
            loss: PointRcnnLossConfig {
                point_class_weight: float(&point["point_cls_weight"])?,
                point_box_weight: float(&point["point_box_weight"])?,
                point_code_weights: array(&floats(&point["code_weights"])?)?,
                roi_class_weight: float(&rcnn["rcnn_cls_weight"])?,
                roi_box_weight: float(&rcnn["rcnn_reg_weight"])?,
                roi_code_weights: array(&floats(&rcnn["code_weights"])?)?,
                corner_weight: float(&rcnn["rcnn_corner_weight"])?,
            },
            detection: RcnnDetectionConfig {
                score_threshold: float(&cfg["POST_PROCESSING"]["SCORE_THRESH"])?,
                suppression: suppression(&cfg["POST_PROCESSING"]["NMS_CONFIG"])?,
            },
        })
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

fn list(value: &Value) -> Result<&Vec<Value>> {
    value.as_array().with_context(|| format!("manifest.json: a list is needed, not {value}"))
}

fn floats(value: &Value) -> Result<Vec<f64>> {
    list(value)?
        .iter()
        .map(|v| v.as_f64().with_context(|| format!("manifest.json: a number is needed, not {v}")))
        .collect()
}

fn usizes(value: &Value) -> Result<Vec<usize>> {
    Ok(floats(value)?.into_iter().map(|v| v as usize).collect())
}

fn pair(value: &Value) -> Result<[usize; 2]> {
    let values = usizes(value)?;
    values.try_into().map_err(|v| anyhow::anyhow!("manifest.json: two hidden layers are supported, not {v:?}"))
}

fn array<const N: usize>(values: &[f64]) -> Result<[f32; N]> {
    let narrow: Vec<f32> = values.iter().map(|&v| v as f32).collect();
    narrow.try_into().map_err(|_| anyhow::anyhow!("manifest.json: {N} numbers are needed, not {values:?}"))
}
