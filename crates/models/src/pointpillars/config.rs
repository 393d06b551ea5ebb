//! Sizes of PointPillars.

use crate::bev::{BackboneConfig, EncoderConfig, PillarsConfig};
use crate::config::{AnchorConfig, DetectorConfig};
use crate::limits::{MOST_CLASSES, MOST_NETWORK_BOXES, at_most};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::slice;

/// Sizes of PointPillars; the defaults are the published KITTI network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PointPillarsConfig {
    /// Size and number of the pillars.
    #[serde(default)]
    pub pillars: PillarsConfig,
    /// Channels of the single layer of the pillar feature net.
    #[serde(default = "default_vfe_filters")]
    pub vfe_filters: usize,
    /// The 2D backbone.
    #[serde(default)]
    pub backbone: BackboneConfig,
    /// Anchors, one entry a class, in the order of `classes`.
    pub anchors: Vec<AnchorConfig>,
    /// Head and direction classifier.
    #[serde(default)]
    pub head: HeadConfig,
    /// Weights of the losses.
    #[serde(default)]
    pub loss: LossConfig,
    /// Score threshold and NMS.
    #[serde(default)]
    pub detection: DetectionConfig,
}

fn default_vfe_filters() -> usize {
    64
}

/// Constants of the direction classifier.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct HeadConfig {
    /// Start of the first direction bin, rad.
    pub dir_offset_rad: f32,
    /// Offset of the period into which the regressed heading is wrapped.
    pub dir_limit_offset: f32,
    /// Number of direction bins.
    pub dir_bins: usize,
}

impl Default for HeadConfig {
    #[expect(clippy::approx_constant, reason = "rounded as in the reference")]
    fn default() -> Self {
        HeadConfig { dir_offset_rad: 0.78539, dir_limit_offset: 0.0, dir_bins: 2 }
    }
}

/// Weights of the three losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct LossConfig {
    /// Weight of the focal loss of the classes.
    pub class_weight: f32,
    /// Weight of the smooth L1 loss of the box residuals.
    pub box_weight: f32,
    /// Weights of the seven box residuals.
    pub code_weights: [f32; 7],
    /// Weight of the cross entropy of the direction bins.
    pub direction_weight: f32,
}

impl Default for LossConfig {
    fn default() -> Self {
        LossConfig { class_weight: 1.0, box_weight: 2.0, code_weights: [1.0; 7], direction_weight: 0.2 }
    }
}

/// Score threshold and NMS.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DetectionConfig {
    /// Lowest score of a detection.
    pub score_threshold: f32,
    /// BEV IoU above which the box with the lower score is suppressed, regardless of their classes.
    pub nms_iou: f32,
    /// Boxes with the highest scores that enter the NMS.
    pub nms_pre: usize,
    /// Largest number of boxes kept.
    pub nms_post: usize,
}

impl Default for DetectionConfig {
    fn default() -> Self {
        DetectionConfig { score_threshold: 0.1, nms_iou: 0.01, nms_pre: 4096, nms_post: 500 }
    }
}

impl PointPillarsConfig {
    /// Whether the sizes fit together and to the detector's range and classes; the message names the key.
    pub fn check(&self, detector: &DetectorConfig) -> Result<(), String> {
        let (net, fail) = (self, |message: String| Err(message));
        let named: Vec<&String> = net.anchors.iter().map(|a| &a.class).collect();
        if named != detector.classes.iter().collect::<Vec<_>>() {
            return fail(format!(
                "network.anchors name {named:?}, classes are {:?}: one entry a class in this order is needed",
                detector.classes
            ));
        }
        for a in &net.anchors {
            if a.size_m.iter().any(|&s| !(s > 0.0 && s.is_finite())) || a.rotations_rad.is_empty() {
                return fail(format!(
                    "network.anchors of {}: sizes must be above 0 and at least one rotation is needed",
                    a.class
                ));
            }
            if !(a.unmatched > 0.0 && a.unmatched <= a.matched && a.matched <= 1.0) {
                return fail(format!("network.anchors of {}: 0 < unmatched <= matched <= 1", a.class));
            }
            if a.rotations_rad.len() != net.anchors[0].rotations_rad.len() {
                return fail("network.anchors: every class needs the same number of rotations".into());
            }
        }
        net.encoder().check(detector)?;
        if net.head.dir_bins < 2 {
            return fail("network.head.dir_bins must be at least 2".into());
        }
        let rotations: Vec<usize> = net.anchors.iter().map(|a| a.rotations_rad.len()).collect();
        let headings = [
            ("network.head.dir_bins", &[net.head.dir_bins][..]),
            ("the number of network.anchors.rotations_rad", &rotations),
        ];
        at_most(MOST_CLASSES, &headings)?;
        let found = &net.detection;
        let boxes =
            [("network.detection.nms_pre", &[found.nms_pre][..]), ("network.detection.nms_post", &[found.nms_post])];
        at_most(MOST_NETWORK_BOXES, &boxes)?;
        Ok(())
    }

    /// The sizes of the network in front of the head.
    pub fn encoder(&self) -> EncoderConfig<'_> {
        let vfe_filters = slice::from_ref(&self.vfe_filters);
        EncoderConfig { pillars: &self.pillars, vfe_filters, backbone: &self.backbone }
    }
}
