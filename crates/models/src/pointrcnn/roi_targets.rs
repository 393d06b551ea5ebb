//! Sampling of training regions and their targets (OpenPCDet: `ProposalTargetLayer`). Runs on the host.

use super::config::RoiSamplingConfig;
use super::proposals::Proposals;
use crate::pointpillars::box_coder::encode;
use data::Stream;
use geometry::{Box3, iou_3d};
use rand::RngExt;
use rand::seq::index;
use std::f32::consts::{FRAC_PI_2, PI, TAU};

/// Regions and their targets, one entry each.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RoiTargets {
    /// The regions, `[x, y, z, dx, dy, dz, yaw]`.
    pub rois: Vec<[f32; 7]>,
    /// 3D overlap with the ground truth.
    pub iou: Vec<f32>,
    /// The ground-truth box, `[x, y, z, dx, dy, dz, yaw, class]`; zeros in a frame without any.
    pub truth: Vec<[f32; 8]>,
    /// The same in the region frame, with the heading wrapped to [-pi/2, pi/2].
    pub truth_canonical: Vec<[f32; 8]>,
    /// 1 for an object, 0 for background, -1 for ignored regions.
    pub labels: Vec<i32>,
    /// Whether the box is regressed.
    pub box_counts: Vec<bool>,
    /// Residuals of the box.
    pub residuals: Vec<[f32; 7]>,
}

/// Highest IoU of each region with the ground truth of its class, and the index of this box (the first of equal ones).
/// Without a box of the class the result is 0 and the first box.
///
/// `truth` is `[x, y, z, dx, dy, dz, yaw, class]`, regions and ground truth with classes from 1.
pub fn overlaps(rois: &[[f32; 7]], labels: &[i32], truth: &[[f32; 8]]) -> (Vec<f32>, Vec<usize>) {
    let solid: Vec<Box3> = truth.iter().map(|t| Box3::from_array(std::array::from_fn(|i| f64::from(t[i])))).collect();
    let best = |roi: &[f32; 7], label: i32| {
        let roi = Box3::from_array(roi.map(f64::from));
        let mut best: Option<(f32, usize)> = None;
        for t in (0..truth.len()).filter(|&t| truth[t][7] as i32 == label) {
            let iou = iou_3d(&roi, &solid[t]) as f32;
            if best.is_none_or(|(most, _)| iou > most) {
                best = Some((iou, t));
            }
        }
        best.unwrap_or((0.0, 0))
    };
    rois.iter().zip(labels).map(|(roi, &label)| best(roi, label)).unzip()
}

/// The category of a region by its overlap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// Can be sampled as foreground.
    pub foreground: bool,
    /// Easy background.
    pub easy: bool,
    /// Hard background.
    pub hard: bool,
    /// Label: 1, 0 or -1.
    pub label: i32,
    /// Whether the box is regressed.
    pub box_counts: bool,
}

/// The category by the thresholds, compared in f32 as in the reference.
pub fn kind(iou: f32, config: &RoiSamplingConfig) -> Kind {
    let unsure = iou > config.class_background && iou < config.class_foreground;
    Kind {
        foreground: iou >= config.box_foreground.min(config.class_foreground),
        easy: iou < config.easy_background,
        hard: iou < config.box_foreground && iou >= config.easy_background,
        label: if unsure { -1 } else { i32::from(iou > config.class_foreground) },
        box_counts: iou > config.box_foreground,
    }
}

/// Samples `config.regions` regions by their overlaps: foreground without replacement up to its fraction, the rest
/// background with replacement, hard and easy by their fractions. If one category is missing, the others replace it.
pub fn draw(iou: &[f32], config: &RoiSamplingConfig, stream: &mut Stream) -> Vec<usize> {
    let of = |wanted: fn(&Kind) -> bool| -> Vec<usize> {
        (0..iou.len()).filter(|&i| wanted(&kind(iou[i], config))).collect()
    };
    let (foreground, easy, hard) = (of(|k| k.foreground), of(|k| k.easy), of(|k| k.hard));
    let mut again = |from: &[usize], count: usize| -> Vec<usize> {
        (0..count).map(|_| from[stream.random_range(0..from.len())]).collect()
    };
    if easy.is_empty() && hard.is_empty() {
        return if foreground.is_empty() { Vec::new() } else { again(&foreground, config.regions) };
    }
    let most = (config.foreground_share * config.regions as f32).round_ties_even() as usize;
    let background = config.regions - most.min(foreground.len());
    let from_hard = match () {
        () if easy.is_empty() => background,
        () => ((background as f32 * config.hard_share) as usize).min(hard.len()),
    };
    let (hard, easy) = (again(&hard, from_hard), again(&easy, background - from_hard));
    let mut drawn: Vec<usize> =
        index::sample(stream, foreground.len(), config.regions - background).iter().map(|i| foreground[i]).collect();
    drawn.extend(hard);
    drawn.extend(easy);
    drawn
}

/// Samples regions from the proposals and computes their targets.
pub fn sample(
    proposals: &Proposals,
    truth: &[[f32; 8]],
    config: &RoiSamplingConfig,
    stream: &mut Stream,
) -> RoiTargets {
    let (iou, of) = overlaps(&proposals.boxes, &proposals.labels, truth);
    let mut targets = RoiTargets::default();
    for i in draw(&iou, config, stream) {
        let truth = truth.get(of[i]).copied().unwrap_or([0.0; 8]);
        targets.push(proposals.boxes[i], iou[i], truth, config);
    }
    targets
}

impl RoiTargets {
    /// Appends a region with its ground truth.
    pub fn push(&mut self, roi: [f32; 7], iou: f32, truth: [f32; 8], config: &RoiSamplingConfig) {
        let kind = kind(iou, config);
        let canonical = seen_from(roi, truth);
        let anchor = [0.0, 0.0, 0.0, roi[3], roi[4], roi[5], 0.0];
        self.rois.push(roi);
        self.iou.push(iou);
        self.truth.push(truth);
        self.residuals.push(encode(std::array::from_fn(|i| canonical[i]), anchor));
        self.truth_canonical.push(canonical);
        self.labels.push(kind.label);
        self.box_counts.push(kind.box_counts);
    }

    /// Appends those of another frame.
    pub fn append(&mut self, other: &RoiTargets) {
        self.rois.extend_from_slice(&other.rois);
        self.iou.extend_from_slice(&other.iou);
        self.truth.extend_from_slice(&other.truth);
        self.truth_canonical.extend_from_slice(&other.truth_canonical);
        self.labels.extend_from_slice(&other.labels);
        self.box_counts.extend_from_slice(&other.box_counts);
        self.residuals.extend_from_slice(&other.residuals);
    }
}

/// A box in the frame of a region: origin at its centre, x along its heading. The box's heading is wrapped to [-pi/2,
/// pi/2], because the region may point backwards.
fn seen_from(roi: [f32; 7], truth: [f32; 8]) -> [f32; 8] {
    let turn = roi[6].rem_euclid(TAU);
    let (sin, cos) = turn.sin_cos();
    let [x, y, z] = [0, 1, 2].map(|i| truth[i] - roi[i]);
    let mut yaw = (truth[6] - turn).rem_euclid(TAU);
    if yaw > FRAC_PI_2 && yaw < 1.5 * PI {
        yaw = (yaw + PI).rem_euclid(TAU);
    }
    if yaw > PI {
        yaw -= TAU;
    }
    let yaw = yaw.clamp(-FRAC_PI_2, FRAC_PI_2);
    [x * cos + y * sin, y * cos - x * sin, z, truth[3], truth[4], truth[5], yaw, truth[7]]
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::stream;
    use proptest::prelude::*;

    fn config() -> RoiSamplingConfig {
        RoiSamplingConfig { regions: 10, ..RoiSamplingConfig::default() }
    }

    fn counts(iou: &[f32]) -> [usize; 3] {
        let drawn = draw(iou, &config(), &mut stream(1, "roi", 0, 0));
        assert!(drawn.len() == 10 || drawn.is_empty());
        let count = |wanted: fn(&Kind) -> bool| drawn.iter().filter(|&&i| wanted(&kind(iou[i], &config()))).count();
        [count(|k| k.foreground), count(|k| k.hard), count(|k| k.easy)]
    }

    #[test]
    fn shares_and_what_fills_up() {
        let [f, h, e] = [0.7f32, 0.3, 0.05];
        assert_eq!(counts(&[[f; 20].as_slice(), &[h; 20], &[e; 20]].concat()), [5, 4, 1]);
        assert_eq!(counts(&[[f; 2].as_slice(), &[h; 20], &[e; 20]].concat()), [2, 6, 2]);
        assert_eq!(counts(&[[f; 20].as_slice(), &[h; 2], &[e; 20]].concat()), [5, 2, 3]);
        assert_eq!(counts(&[[f; 20].as_slice(), &[e; 1]].concat()), [5, 0, 5]);
        assert_eq!(counts(&[[f; 20].as_slice(), &[h; 1]].concat()), [5, 5, 0]);
        assert_eq!(counts(&[f; 3]), [10, 0, 0]);
        assert_eq!(counts(&[e; 3]), [0, 0, 10]);
        assert_eq!(counts(&[]), [0, 0, 0]);
    }

    #[test]
    fn foreground_is_not_repeated_and_streams_decide() {
        let iou = [[0.9f32; 30].as_slice(), &[0.0; 30]].concat();
        let of = |seed| draw(&iou, &config(), &mut stream(seed, "roi", 0, 0));
        let mut foreground: Vec<usize> = of(3).into_iter().filter(|&i| i < 30).collect();
        foreground.sort_unstable();
        foreground.dedup();
        assert_eq!(foreground.len(), 5);
        assert_eq!(of(3), of(3));
        assert_ne!(of(3), of(4));
    }

    #[test]
    fn a_frame_without_ground_truth_is_background() {
        let proposals = Proposals { boxes: vec![[0.0; 7]; 4], scores: vec![0.0; 4], labels: vec![1; 4] };
        let targets = sample(&proposals, &[], &config(), &mut stream(1, "roi", 0, 0));
        assert!(targets.labels.iter().all(|&l| l == 0) && targets.box_counts.iter().all(|c| !c));
        assert!(targets.residuals.iter().flatten().all(|v| v.is_finite()));
    }

    proptest! {
        /// Transforming to the region frame and back gives the same box, up to a heading difference of pi.
        #[test]
        fn canonical_and_back(
            roi in (prop::array::uniform3(-50.0f32..50.0), -7.0f32..7.0),
            truth in (prop::array::uniform3(-50.0f32..50.0), -7.0f32..7.0),
        ) {
            let ([x, y, z], yaw) = roi;
            let roi = [x, y, z, 4.0, 2.0, 1.5, yaw];
            let ([x, y, z], yaw) = truth;
            let truth = [x, y, z, 4.0, 2.0, 1.5, yaw, 1.0];
            let seen = seen_from(roi, truth);
            prop_assert!(seen[6].abs() <= FRAC_PI_2);
            let (sin, cos) = roi[6].sin_cos();
            let back = [seen[0] * cos - seen[1] * sin + roi[0], seen[0] * sin + seen[1] * cos + roi[1], seen[2] + roi[2]];
            prop_assert!((0..3).all(|i| (back[i] - truth[i]).abs() < 1e-3), "{:?} {:?}", back, truth);
            let turn = (seen[6] + roi[6] - truth[6]) / PI;
            prop_assert!((turn - turn.round()).abs() < 1e-3, "{}", turn);
        }
    }
}
