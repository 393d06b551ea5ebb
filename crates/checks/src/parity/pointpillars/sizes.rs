//! Converts OpenPCDet's configuration of a PointPillars.

use super::super::bev;
use super::super::manifest::{Manifest, array, float, floats};
use anyhow::{Context, Result, bail};
use models::config::{AnchorConfig, NetworkConfig};
use models::pointpillars::{DetectionConfig, HeadConfig, LossConfig, PointPillarsConfig};
use serde_json::Value;

/// The configuration of the network in the manifest.
pub fn config(manifest: &Manifest) -> Result<NetworkConfig> {
    let cfg = &manifest.model_cfg;
    let head = &cfg["DENSE_HEAD"];
    let anchors =
        head["ANCHOR_GENERATOR_CONFIG"].as_array().context("DENSE_HEAD.ANCHOR_GENERATOR_CONFIG is missing")?;
    let anchors = anchors.iter().map(anchor).collect::<Result<Vec<_>>>()?;
    let weights = &head["LOSS_CONFIG"]["LOSS_WEIGHTS"];
    let nms = &cfg["POST_PROCESSING"]["NMS_CONFIG"];
    let filters = bev::vfe_filters(manifest)?;
    let [vfe_filters] = filters[..] else { bail!("VFE.NUM_FILTERS = {filters:?}: one layer is supported") };
    Ok(NetworkConfig::PointPillars(PointPillarsConfig {
        pillars: bev::pillar_sizes(manifest)?,
        vfe_filters,
        backbone: bev::backbone(manifest)?,
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
            score_threshold: manifest.score_thresh.context("score_thresh")?,
            nms_iou: float(&nms["NMS_THRESH"])?,
            nms_pre: float(&nms["NMS_PRE_MAXSIZE"])? as usize,
            nms_post: float(&nms["NMS_POST_MAXSIZE"])? as usize,
        },
    }))
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
