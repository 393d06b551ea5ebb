//! Sizes of CenterPoint.

use crate::bev::{BackboneConfig, EncoderConfig, PillarsConfig};
use crate::config::DetectorConfig;
use crate::limits::{MOST_FILTERS, MOST_LAYERS, MOST_NETWORK_BOXES, MOST_SAMPLES, at_most};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of CenterPoint with pillars; the defaults of layers, losses and detections are those of OpenPCDet's
/// `centerpoint_pillar_1x`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CenterPointConfig {
    /// Size and number of the pillars.
    #[serde(default)]
    pub pillars: PillarsConfig,
    /// Channels of the layers of the pillar feature net. All layers but the last compute half of their channels; the
    /// pillar's maximum over them is the other half.
    #[serde(default = "default_vfe_filters")]
    pub vfe_filters: Vec<usize>,
    /// The 2D backbone.
    #[serde(default = "default_backbone")]
    pub backbone: BackboneConfig,
    /// The heads.
    #[serde(default)]
    pub head: CenterHeadConfig,
    /// The peaks of the heat maps, and the number of boxes.
    #[serde(default)]
    pub targets: CenterTargetsConfig,
    /// Weights of the losses.
    #[serde(default)]
    pub loss: CenterLossConfig,
    /// Score threshold, limits and NMS.
    #[serde(default)]
    pub detection: CenterDetectionConfig,
}

fn default_vfe_filters() -> Vec<usize> {
    vec![64, 64]
}

fn default_backbone() -> BackboneConfig {
    BackboneConfig { strides: vec![1, 2, 2], ..BackboneConfig::default() }
}

/// Channels and layers of the heads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CenterHeadConfig {
    /// Classes of each head. Empty: one head for all classes of the detector.
    pub classes: Vec<Vec<String>>,
    /// Channels of the shared convolution and of the hidden layers of each branch.
    pub filters: usize,
    /// Whether convolutions in front of a batch norm have a bias.
    pub bias_before_norm: bool,
    /// Convolutions of each branch, its output layer included.
    pub layers: BranchLayersConfig,
}

impl Default for CenterHeadConfig {
    fn default() -> Self {
        let layers = BranchLayersConfig::default();
        CenterHeadConfig { classes: Vec::new(), filters: 64, bias_before_norm: true, layers }
    }
}

/// Convolutions of each branch of a head, its output layer included.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BranchLayersConfig {
    /// Heat map of each class.
    pub hm: usize,
    /// Offset of the centre from the corner of its cell, along x and y.
    pub center: usize,
    /// Height of the centre.
    pub center_z: usize,
    /// Logarithms of the sizes.
    pub dim: usize,
    /// Cosine and sine of the heading.
    pub rot: usize,
}

impl Default for BranchLayersConfig {
    fn default() -> Self {
        BranchLayersConfig { hm: 2, center: 2, center_z: 2, dim: 2, rot: 2 }
    }
}

/// Targets of the heads.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CenterTargetsConfig {
    /// Smallest overlap with its box of a box whose centre is shifted by the radius of the peak. It defines the radius.
    pub gaussian_overlap: f32,
    /// Smallest radius of a peak, cells.
    pub min_radius: usize,
    /// Largest number of boxes of a head in a frame; further boxes are no targets.
    pub max_boxes: usize,
}

impl Default for CenterTargetsConfig {
    fn default() -> Self {
        CenterTargetsConfig { gaussian_overlap: 0.1, min_radius: 2, max_boxes: 500 }
    }
}

/// Weights of the two losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CenterLossConfig {
    /// Weight of the focal loss of the heat maps.
    pub heat_map_weight: f32,
    /// Weight of the L1 loss of the boxes.
    pub box_weight: f32,
    /// Weights of the box code: offset x, y, then z, logarithms of length, width, height, then cosine and sine of the
    /// heading.
    pub code_weights: [f32; 8],
}

impl Default for CenterLossConfig {
    fn default() -> Self {
        CenterLossConfig { heat_map_weight: 1.0, box_weight: 2.0, code_weights: [1.0; 8] }
    }
}

/// Score threshold, limits and NMS.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct CenterDetectionConfig {
    /// Cells with the highest scores over all classes of a head that become boxes.
    pub max_boxes: usize,
    /// A detection's score is above this.
    pub score_threshold: f32,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]`, m, LiDAR frame. Boxes whose centre lies outside are dropped.
    /// Without it the range of the detector.
    pub center_range_m: Option<[f32; 6]>,
    /// BEV IoU above which the box with the lower score is suppressed, regardless of their classes.
    pub nms_iou: f32,
    /// Boxes with the highest scores that enter the NMS.
    pub nms_pre: usize,
    /// Largest number of boxes kept.
    pub nms_post: usize,
}

impl Default for CenterDetectionConfig {
    fn default() -> Self {
        CenterDetectionConfig {
            max_boxes: 500,
            score_threshold: 0.1,
            center_range_m: None,
            nms_iou: 0.7,
            nms_pre: 4096,
            nms_post: 500,
        }
    }
}

impl CenterPointConfig {
    /// Whether the sizes fit together and to the detector's range and classes; the message names the key.
    pub fn check(&self, detector: &DetectorConfig) -> Result<(), String> {
        let fail = |message: String| Err(message);
        self.encoder().check(detector)?;
        let mut named: Vec<&String> = self.head.classes.iter().flatten().collect();
        named.sort();
        let mut classes: Vec<&String> = detector.classes.iter().collect();
        classes.sort();
        if !named.is_empty() && named != classes || self.head.classes.iter().any(Vec::is_empty) {
            return fail(format!(
                "network.head.classes are {:?}, classes are {:?}: each class must be in one head, and each head needs \
                 a class",
                self.head.classes, detector.classes
            ));
        }
        let BranchLayersConfig { hm, center, center_z, dim, rot } = self.head.layers;
        if self.head.filters == 0 || [hm, center, center_z, dim, rot].contains(&0) {
            return fail("network.head: filters and layers must be above 0".into());
        }
        if !(self.targets.gaussian_overlap > 0.0 && self.targets.gaussian_overlap < 1.0) {
            return fail(format!(
                "network.targets.gaussian_overlap = {}: it must be above 0 and below 1",
                self.targets.gaussian_overlap
            ));
        }
        let layers = [hm, center, center_z, dim, rot];
        at_most(MOST_FILTERS, &[("network.head.filters", &[self.head.filters])])?;
        at_most(MOST_LAYERS, &[("network.head.layers", &layers)])?;
        let (targets, found) = (&self.targets, &self.detection);
        let boxes = [
            ("network.targets.max_boxes", &[targets.max_boxes][..]),
            ("network.detection.max_boxes", &[found.max_boxes]),
            ("network.detection.nms_pre", &[found.nms_pre]),
            ("network.detection.nms_post", &[found.nms_post]),
        ];
        at_most(MOST_NETWORK_BOXES, &boxes)?;
        at_most(MOST_SAMPLES, &[("network.targets.min_radius", &[targets.min_radius])])?;
        if self.targets.max_boxes == 0 {
            return fail("network.targets.max_boxes must be above 0".into());
        }
        let weights = [self.loss.heat_map_weight, self.loss.box_weight].into_iter().chain(self.loss.code_weights);
        if weights.into_iter().any(|weight| !(weight >= 0.0 && weight.is_finite())) {
            return fail("network.loss: weights must be finite and not negative".into());
        }
        let found = &self.detection;
        if found.max_boxes == 0 || !(0.0..1.0).contains(&found.score_threshold) || !(0.0..=1.0).contains(&found.nms_iou)
        {
            return fail(
                "network.detection: max_boxes must be above 0, score_threshold in [0, 1), nms_iou in [0, 1]".into(),
            );
        }
        if let Some(range) = found.center_range_m
            && (0..3).any(|i| !(range[i] < range[i + 3]))
        {
            return fail(format!(
                "network.detection.center_range_m = {range:?}: each minimum must be below its maximum"
            ));
        }
        Ok(())
    }

    /// The sizes of the network in front of the heads.
    pub fn encoder(&self) -> EncoderConfig<'_> {
        EncoderConfig { pillars: &self.pillars, vfe_filters: &self.vfe_filters, backbone: &self.backbone }
    }

    /// For each head the detector's classes that it finds, counted from 0, in its order.
    pub fn heads(&self, detector: &DetectorConfig) -> Vec<Vec<usize>> {
        if self.head.classes.is_empty() {
            return vec![(0..detector.classes.len()).collect()];
        }
        let index = |class: &String| detector.classes.iter().position(|c| c == class);
        self.head.classes.iter().map(|head| head.iter().filter_map(index).collect()).collect()
    }
}
