//! Sizes of PointPillars.

use crate::config::{AnchorConfig, DetectorConfig};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

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

/// Size and number of the pillars.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PillarsConfig {
    /// Extent of a pillar along x, y and z, m.
    pub size_m: [f32; 3],
    /// Largest number of points of a pillar; the first points in the order of the cloud are kept.
    pub max_points: usize,
    /// Largest number of pillars of a training frame.
    pub max_train: usize,
    /// Largest number of pillars of other frames.
    pub max_test: usize,
}

impl Default for PillarsConfig {
    fn default() -> Self {
        PillarsConfig { size_m: [0.16, 0.16, 4.0], max_points: 32, max_train: 16_000, max_test: 40_000 }
    }
}

/// Blocks of convolutions on the BEV canvas, and transposed convolutions that upsample their outputs to a common
/// resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BackboneConfig {
    /// Convolutions of a block after its first.
    pub layers: Vec<usize>,
    /// Stride of a block's first convolution.
    pub strides: Vec<usize>,
    /// Channels of a block.
    pub filters: Vec<usize>,
    /// Stride and kernel size of the transposed convolution after each block.
    pub upsample_strides: Vec<usize>,
    /// Channels of the transposed convolutions.
    pub upsample_filters: Vec<usize>,
}

impl Default for BackboneConfig {
    fn default() -> Self {
        BackboneConfig {
            layers: vec![3, 5, 5],
            strides: vec![2, 2, 2],
            filters: vec![64, 128, 256],
            upsample_strides: vec![1, 2, 4],
            upsample_filters: vec![128, 128, 128],
        }
    }
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
        let b = &net.backbone;
        let blocks = b.layers.len();
        if blocks == 0
            || [b.strides.len(), b.filters.len(), b.upsample_strides.len(), b.upsample_filters.len()]
                .iter()
                .any(|&n| n != blocks)
        {
            return fail("network.backbone: layers, strides, filters, upsample_strides and upsample_filters need one entry a block".into());
        }
        if b.strides.iter().chain(&b.filters).chain(&b.upsample_strides).chain(&b.upsample_filters).any(|&n| n == 0) {
            return fail("network.backbone: strides and filters must be above 0".into());
        }
        let mut scale = 1;
        let mut scales = Vec::new();
        for (stride, up) in b.strides.iter().zip(&b.upsample_strides) {
            scale *= stride;
            scales.push((scale, *up));
        }
        if scales.iter().any(|(scale, up)| scale % up != 0 || scale / up != scales[0].0 / scales[0].1) {
            return fail(
                "network.backbone: strides and upsample_strides give the blocks different output sizes".into(),
            );
        }
        let p = &net.pillars;
        if p.size_m.iter().any(|&s| !(s > 0.0 && s.is_finite()))
            || p.max_points == 0
            || p.max_train == 0
            || p.max_test == 0
        {
            return fail("network.pillars: sizes and limits must be above 0".into());
        }
        let [nx, ny, nz] = self.grid_size(detector);
        if nz != 1 {
            return fail(format!(
                "network.pillars.size_m: {nz} pillars along z; the pillar must span the whole z range"
            ));
        }
        if nx % scale != 0 || ny % scale != 0 || nx == 0 || ny == 0 {
            return fail(format!(
                "range_m and network.pillars.size_m give {nx} x {ny} pillars; both must be multiples of {scale}, the product of the strides"
            ));
        }
        if net.vfe_filters == 0 || net.head.dir_bins < 2 {
            return fail("network.vfe_filters must be above 0, network.head.dir_bins at least 2".into());
        }
        Ok(())
    }

    /// Pillars along x, y and z.
    pub fn grid_size(&self, detector: &DetectorConfig) -> [usize; 3] {
        let range = detector.range_m;
        [0, 1, 2].map(|i| ((range[i + 3] - range[i]) as f64 / self.pillars.size_m[i] as f64).round() as usize)
    }
}
