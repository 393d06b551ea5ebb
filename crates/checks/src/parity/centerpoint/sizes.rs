//! Converts OpenPCDet's configuration of a CenterPoint with pillars.

use super::super::bev;
use super::super::manifest::{Manifest, array, float, floats, list, names};
use anyhow::{Context, Result, ensure};
use models::centerpoint::{
    BranchLayersConfig, CenterDetectionConfig, CenterHeadConfig, CenterLossConfig, CenterPointConfig,
    CenterTargetsConfig,
};
use models::config::NetworkConfig;
use serde_json::Value;

/// Branches of the box code and their channels, in the order of the targets.
const CODE: [(&str, f32); 4] = [("center", 2.0), ("center_z", 1.0), ("dim", 3.0), ("rot", 2.0)];

/// The configuration of the network in the manifest.
pub fn config(manifest: &Manifest) -> Result<NetworkConfig> {
    let head = &manifest.model_cfg["DENSE_HEAD"];
    let order = names(&head["SEPARATE_HEAD_CFG"]["HEAD_ORDER"])?;
    let wanted: Vec<&str> = CODE.iter().map(|(name, _)| *name).collect();
    ensure!(order == wanted, "manifest.json: HEAD_ORDER is {order:?}, {wanted:?} is supported");
    let branches = &head["SEPARATE_HEAD_CFG"]["HEAD_DICT"];
    let layers = |name: &str| -> Result<usize> {
        let (_, channels) = CODE.iter().find(|(known, _)| *known == name).context("a branch of the box code")?;
        let given = float(&branches[name]["out_channels"])?;
        ensure!(given == *channels, "manifest.json: {name} has {given} channels, {channels} are supported");
        Ok(float(&branches[name]["num_conv"])? as usize)
    };
    // OpenPCDet drops the classes of a head that the network does not have.
    let known = |classes: &Value| -> Result<Vec<String>> {
        Ok(names(classes)?.into_iter().filter(|class| manifest.classes.contains(class)).collect())
    };
    let (targets, weights) = (&head["TARGET_ASSIGNER_CONFIG"], &head["LOSS_CONFIG"]["LOSS_WEIGHTS"]);
    let (found, nms) = (&head["POST_PROCESSING"], &head["POST_PROCESSING"]["NMS_CONFIG"]);
    let kind = nms["NMS_TYPE"].as_str().unwrap_or_default();
    ensure!(kind == "nms_gpu", "manifest.json: NMS_TYPE is {kind}, nms_gpu is supported");
    let backbone = bev::backbone(manifest)?;
    let stride = float(&targets["FEATURE_MAP_STRIDE"])? as usize;
    ensure!(
        stride == backbone.output_stride(),
        "manifest.json: FEATURE_MAP_STRIDE is {stride}, the backbone's output has {}",
        backbone.output_stride()
    );
    Ok(NetworkConfig::CenterPoint(CenterPointConfig {
        pillars: bev::pillar_sizes(manifest)?,
        vfe_filters: bev::vfe_filters(manifest)?,
        backbone,
        head: CenterHeadConfig {
            classes: list(&head["CLASS_NAMES_EACH_HEAD"])?.iter().map(known).collect::<Result<_>>()?,
            filters: float(&head["SHARED_CONV_CHANNEL"])? as usize,
            bias_before_norm: head["USE_BIAS_BEFORE_NORM"].as_bool().unwrap_or(false),
            layers: BranchLayersConfig {
                hm: float(&head["NUM_HM_CONV"])? as usize,
                center: layers("center")?,
                center_z: layers("center_z")?,
                dim: layers("dim")?,
                rot: layers("rot")?,
            },
        },
        targets: CenterTargetsConfig {
            gaussian_overlap: float(&targets["GAUSSIAN_OVERLAP"])?,
            min_radius: float(&targets["MIN_RADIUS"])? as usize,
            max_boxes: float(&targets["NUM_MAX_OBJS"])? as usize,
        },
        loss: CenterLossConfig {
            heat_map_weight: float(&weights["cls_weight"])?,
            box_weight: float(&weights["loc_weight"])?,
            code_weights: array(&floats(&weights["code_weights"])?)?,
        },
        detection: CenterDetectionConfig {
            max_boxes: float(&found["MAX_OBJ_PER_SAMPLE"])? as usize,
            score_threshold: float(&found["SCORE_THRESH"])?,
            center_range_m: Some(array(&floats(&found["POST_CENTER_LIMIT_RANGE"])?)?),
            nms_iou: float(&nms["NMS_THRESH"])?,
            nms_pre: float(&nms["NMS_PRE_MAXSIZE"])? as usize,
            nms_post: float(&nms["NMS_POST_MAXSIZE"])? as usize,
        },
    }))
}
