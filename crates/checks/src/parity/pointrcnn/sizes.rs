//! Converts OpenPCDet's configuration of a PointRCNN.

use super::super::manifest::{Manifest, array, float, floats, list, pair, usizes};
use anyhow::{Context, Result};
use models::config::NetworkConfig;
use models::pointrcnn::{
    LevelConfig, MeanSizeConfig, PointHeadConfig, PointRcnnConfig, PointRcnnLossConfig, ProposalsConfig,
    RcnnDetectionConfig, RoiHeadConfig, RoiLevelConfig, RoiSamplingConfig, SamplingConfig, ScaleConfig,
    SuppressionConfig,
};
use serde_json::Value;

/// The configuration of the network in the manifest.
pub fn config(manifest: &Manifest) -> Result<NetworkConfig> {
    let cfg = &manifest.model_cfg;
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
    Ok(NetworkConfig::PointRcnn(PointRcnnConfig {
        sampling: SamplingConfig { points: manifest.num_points, ..SamplingConfig::default() },
        levels,
        propagation: list(&backbone["FP_MLPS"])?.iter().map(usizes).collect::<Result<_>>()?,
        point_head: PointHeadConfig {
            mean_sizes: manifest.classes.iter().zip(sizes).map(mean_size).collect::<Result<_>>()?,
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
    }))
}
