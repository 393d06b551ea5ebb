//! Sizes of PointRCNN.

use crate::config::DetectorConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Sizes of PointRCNN; the defaults are the published KITTI network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PointRcnnConfig {
    /// Number and selection of the input points.
    #[serde(default)]
    pub sampling: SamplingConfig,
    /// Set abstraction, finest level first.
    #[serde(default = "default_levels")]
    pub levels: Vec<LevelConfig>,
    /// Channels of the feature propagation layers, one list a level, finest first.
    #[serde(default = "default_propagation")]
    pub propagation: Vec<Vec<usize>>,
    /// The head of the first stage.
    pub point_head: PointHeadConfig,
    /// From point predictions to regions of interest.
    #[serde(default)]
    pub proposals: ProposalsConfig,
    /// The second stage.
    #[serde(default)]
    pub roi_head: RoiHeadConfig,
    /// Sampling of the regions that the second stage is trained on.
    #[serde(default)]
    pub roi_sampling: RoiSamplingConfig,
    /// Weights of the losses.
    #[serde(default)]
    pub loss: PointRcnnLossConfig,
    /// Score threshold and NMS of the second stage.
    #[serde(default)]
    pub detection: RcnnDetectionConfig,
}

/// Selection of the input points.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SamplingConfig {
    /// Number of points; points of a smaller cloud are repeated.
    pub points: usize,
    /// All points at least this far from the sensor are kept and nearer ones are sampled, m. If there are too many far
    /// points, all points are sampled.
    pub far_m: f32,
}

impl Default for SamplingConfig {
    fn default() -> Self {
        SamplingConfig { points: 16_384, far_m: 40.0 }
    }
}

/// One level of set abstraction with multi-scale grouping.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct LevelConfig {
    /// Points kept by farthest point sampling.
    pub centers: usize,
    /// Groupings around each of these centres.
    pub scales: Vec<ScaleConfig>,
}

/// One grouping.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ScaleConfig {
    /// Radius of the ball query, m.
    pub radius_m: f32,
    /// Largest number of neighbours.
    pub samples: usize,
    /// Channels of the layers.
    pub filters: Vec<usize>,
}

fn level(centers: usize, scales: [(f32, usize, [usize; 3]); 2]) -> LevelConfig {
    let scale = |(radius_m, samples, filters): (f32, usize, [usize; 3])| ScaleConfig {
        radius_m,
        samples,
        filters: filters.to_vec(),
    };
    LevelConfig { centers, scales: scales.map(scale).to_vec() }
}

fn default_levels() -> Vec<LevelConfig> {
    vec![
        level(4096, [(0.1, 16, [16, 16, 32]), (0.5, 32, [32, 32, 64])]),
        level(1024, [(0.5, 16, [64, 64, 128]), (1.0, 32, [64, 96, 128])]),
        level(256, [(1.0, 16, [128, 196, 256]), (2.0, 32, [128, 196, 256])]),
        level(64, [(2.0, 16, [256, 256, 512]), (4.0, 32, [256, 384, 512])]),
    ]
}

fn default_propagation() -> Vec<Vec<usize>> {
    vec![vec![128, 128], vec![256, 256], vec![512, 512], vec![512, 512]]
}

/// The head of the first stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct PointHeadConfig {
    /// Mean sizes, one entry a class, in the order of `classes`.
    pub mean_sizes: Vec<MeanSizeConfig>,
    /// Channels of the hidden layers of the class branch.
    #[serde(default = "default_hidden")]
    pub class_filters: [usize; 2],
    /// Channels of the hidden layers of the box branch.
    #[serde(default = "default_hidden")]
    pub box_filters: [usize; 2],
    /// Points outside a box but inside the box enlarged by this in total are ignored, m.
    #[serde(default = "default_extra_width")]
    pub extra_width_m: [f32; 3],
}

fn default_hidden() -> [usize; 2] {
    [256, 256]
}

fn default_extra_width() -> [f32; 3] {
    [0.2; 3]
}

/// The mean size of one class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MeanSizeConfig {
    /// The class.
    pub class: String,
    /// Length, width, height, m.
    pub size_m: [f32; 3],
}

/// NMS of the boxes of the first stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ProposalsConfig {
    /// NMS in training.
    pub train: SuppressionConfig,
    /// NMS otherwise.
    pub test: SuppressionConfig,
}

impl Default for ProposalsConfig {
    fn default() -> Self {
        ProposalsConfig {
            train: SuppressionConfig { iou: 0.8, pre: 9000, post: 512 },
            test: SuppressionConfig { iou: 0.85, pre: 9000, post: 100 },
        }
    }
}

/// Rotated NMS.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct SuppressionConfig {
    /// BEV IoU above which the box with the lower score is suppressed, regardless of their classes.
    pub iou: f32,
    /// Boxes with the highest scores that enter the NMS.
    pub pre: usize,
    /// Largest number of boxes kept.
    pub post: usize,
}

/// The second stage, which refines regions of interest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RoiHeadConfig {
    /// Number of points sampled in a region; fewer points are repeated.
    pub points: usize,
    /// Regions are enlarged by this in total when their points are sampled, m.
    pub extra_width_m: [f32; 3],
    /// Distances from the sensor are divided by this, m.
    pub depth_normalizer_m: f32,
    /// Channels of the layers on position, score and distance of a point.
    pub xyz_filters: [usize; 2],
    /// Set abstraction inside a region, finest level first.
    pub levels: Vec<RoiLevelConfig>,
    /// Channels of the set abstraction over the whole region.
    pub global_filters: Vec<usize>,
    /// Channels of the hidden layers of the score branch.
    pub class_filters: [usize; 2],
    /// Channels of the hidden layers of the box branch.
    pub box_filters: [usize; 2],
}

impl Default for RoiHeadConfig {
    fn default() -> Self {
        RoiHeadConfig {
            points: 512,
            extra_width_m: [0.0; 3],
            depth_normalizer_m: 70.0,
            xyz_filters: [128, 128],
            levels: vec![
                RoiLevelConfig { centers: 128, radius_m: 0.2, samples: 16, filters: vec![128, 128, 128] },
                RoiLevelConfig { centers: 32, radius_m: 0.4, samples: 16, filters: vec![128, 128, 256] },
            ],
            global_filters: vec![256, 256, 512],
            class_filters: [256, 256],
            box_filters: [256, 256],
        }
    }
}

/// One level of set abstraction inside a region.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RoiLevelConfig {
    /// Points kept by farthest point sampling.
    pub centers: usize,
    /// Radius of the ball query, m.
    pub radius_m: f32,
    /// Largest number of neighbours.
    pub samples: usize,
    /// Channels of the layers.
    pub filters: Vec<usize>,
}

/// Sampling and labels of regions in training. Overlaps are 3D IoU with the ground truth of the region's class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RoiSamplingConfig {
    /// Number of regions a frame.
    pub regions: usize,
    /// Largest fraction of foreground regions.
    pub foreground_share: f32,
    /// Overlap above which a region is labelled foreground.
    pub class_foreground: f32,
    /// Overlap up to which it is labelled background; between the two thresholds it is ignored.
    pub class_background: f32,
    /// Overlap above which its box is regressed.
    pub box_foreground: f32,
    /// Overlap below which background is called easy.
    pub easy_background: f32,
    /// Fraction of hard regions in the background.
    pub hard_share: f32,
}

impl Default for RoiSamplingConfig {
    fn default() -> Self {
        RoiSamplingConfig {
            regions: 128,
            foreground_share: 0.5,
            class_foreground: 0.6,
            class_background: 0.45,
            box_foreground: 0.55,
            easy_background: 0.1,
            hard_share: 0.8,
        }
    }
}

/// Weights of the five losses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PointRcnnLossConfig {
    /// Weight of the focal loss of the points' classes.
    pub point_class_weight: f32,
    /// Weight of the smooth L1 loss of the points' boxes.
    pub point_box_weight: f32,
    /// Weights of the eight codes of a point.
    pub point_code_weights: [f32; 8],
    /// Weight of the cross entropy of the regions.
    pub roi_class_weight: f32,
    /// Weight of the smooth L1 loss of the regions' boxes.
    pub roi_box_weight: f32,
    /// Weights of the seven residuals of a region.
    pub roi_code_weights: [f32; 7],
    /// Weight of the corner loss; 0 disables it.
    pub corner_weight: f32,
}

impl Default for PointRcnnLossConfig {
    fn default() -> Self {
        PointRcnnLossConfig {
            point_class_weight: 1.0,
            point_box_weight: 1.0,
            point_code_weights: [1.0; 8],
            roi_class_weight: 1.0,
            roi_box_weight: 1.0,
            roi_code_weights: [1.0; 7],
            corner_weight: 1.0,
        }
    }
}

/// Score threshold and NMS of the second stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct RcnnDetectionConfig {
    /// Lowest score of a detection.
    pub score_threshold: f32,
    /// NMS of the refined boxes.
    pub suppression: SuppressionConfig,
}

impl Default for RcnnDetectionConfig {
    fn default() -> Self {
        let suppression = SuppressionConfig { iou: 0.1, pre: 4096, post: 500 };
        RcnnDetectionConfig { score_threshold: 0.1, suppression }
    }
}

impl PointRcnnConfig {
    /// Whether the sizes fit together and to the detector's classes; the message names the key.
    pub fn check(&self, detector: &DetectorConfig) -> Result<(), String> {
        let named: Vec<&String> = self.point_head.mean_sizes.iter().map(|m| &m.class).collect();
        if named != detector.classes.iter().collect::<Vec<_>>() {
            return Err(format!(
                "network.point_head.mean_sizes name {named:?}, classes are {:?}: one entry a class in this order is needed",
                detector.classes
            ));
        }
        self.check_limits()?;
        let positive = |values: &[f32]| values.iter().all(|&v| v > 0.0 && v.is_finite());
        let not_negative = |values: &[f32]| values.iter().all(|&v| v >= 0.0 && v.is_finite());
        let some = |values: &[usize]| !values.is_empty() && values.iter().all(|&v| v > 0);
        let suppression = |s: &SuppressionConfig| s.pre > 0 && s.post > 0 && not_negative(&[s.iou]);
        let shares = [self.roi_sampling.foreground_share, self.roi_sampling.hard_share];
        let (levels, head, sampler) = (&self.levels, &self.roi_head, &self.roi_sampling);
        let mut above = self.sampling.points;
        for (i, level) in levels.iter().enumerate() {
            if level.centers == 0 || level.centers > above {
                return Err(format!(
                    "network.levels[{i}].centers must be above 0 and at most {above}, the number of points of the level before"
                ));
            }
            above = level.centers;
            let sound = |s: &ScaleConfig| positive(&[s.radius_m]) && s.samples > 0 && some(&s.filters);
            if level.scales.is_empty() || !level.scales.iter().all(sound) {
                return Err(format!("network.levels[{i}].scales: radii, samples and filters must be above 0"));
            }
        }
        let roi_level = |l: &RoiLevelConfig| {
            l.centers > 0 && l.centers <= head.points && positive(&[l.radius_m]) && l.samples > 0 && some(&l.filters)
        };
        let hidden = [self.point_head.class_filters, self.point_head.box_filters, head.class_filters, head.box_filters];
        let sound = [
            (self.sampling.points > 0, "sampling.points must be above 0"),
            (not_negative(&[self.sampling.far_m]), "sampling.far_m must not be negative"),
            (!levels.is_empty() && self.propagation.len() == levels.len(), "propagation needs one list a level"),
            (self.propagation.iter().all(|f| some(f)), "propagation: channels must be above 0"),
            (self.point_head.mean_sizes.iter().all(|m| positive(&m.size_m)), "point_head.mean_sizes must be above 0"),
            (not_negative(&self.point_head.extra_width_m), "point_head.extra_width_m must not be negative"),
            (hidden.iter().all(|f| some(f)) && some(&head.xyz_filters), "class_, box_ and xyz_filters must be above 0"),
            (
                suppression(&self.proposals.train) && suppression(&self.proposals.test),
                "proposals: pre and post must be above 0",
            ),
            (suppression(&self.detection.suppression), "detection.suppression: pre and post must be above 0"),
            (
                head.points > 0 && positive(&[head.depth_normalizer_m]),
                "roi_head: points and depth_normalizer_m must be above 0",
            ),
            (not_negative(&head.extra_width_m), "roi_head.extra_width_m must not be negative"),
            (
                head.levels.iter().all(roi_level),
                "roi_head.levels: centers (at most `points`), radii, samples and filters must be above 0",
            ),
            (some(&head.global_filters), "roi_head.global_filters must be above 0"),
            (sampler.regions > 0, "roi_sampling.regions must be above 0"),
            (shares.iter().all(|s| (0.0..=1.0).contains(s)), "roi_sampling: fractions must be between 0 and 1"),
        ];
        sound.into_iter().find(|(sound, _)| !sound).map_or(Ok(()), |(_, message)| Err(format!("network.{message}")))
    }
}
