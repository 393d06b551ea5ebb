//! Pairs of detections and ground truths by centre distance.

use super::AnalysisOptions;
use crate::EvalFrame;
use crate::overlaps::upright_box;
use geometry::Box3;

/// A ground truth and the detection assigned to it.
pub(super) struct BoxPair {
    pub detection: usize,
    pub truth: Box3,
    pub found: Box3,
    /// Ground-plane distance of the ground truth, m.
    pub range_m: f64,
}

/// In order of descending score, each detection takes the nearest free ground truth of the class within
/// [`AnalysisOptions::pair_distance_m`].
pub(super) fn pairs(frame: &EvalFrame, options: &AnalysisOptions, least_score: f64) -> Vec<BoxPair> {
    let is_class = |class: &str| class.eq_ignore_ascii_case(&options.class);
    let truths: Vec<Box3> = frame
        .labels
        .iter()
        .filter(|line| is_class(&line.class))
        .map(|line| upright_box(line, options.label_frame))
        .filter(|b| b.center[0].hypot(b.center[1]) <= options.max_range_m)
        .collect();
    let mut order: Vec<usize> = (0..frame.detections.len()).collect();
    let score = |j: usize| frame.detections[j].score.unwrap_or(0.0);
    order.sort_by(|a, b| score(*b).total_cmp(&score(*a)));
    let mut taken = vec![false; truths.len()];
    let mut pairs = Vec::new();
    for j in order.into_iter().filter(|j| is_class(&frame.detections[*j].class) && score(*j) >= least_score) {
        let found = upright_box(&frame.detections[j], options.label_frame);
        let apart = |b: &Box3| (b.center[0] - found.center[0]).hypot(b.center[1] - found.center[1]);
        let free = (0..truths.len()).filter(|i| !taken[*i]);
        let nearest = free.min_by(|a, b| apart(&truths[*a]).total_cmp(&apart(&truths[*b])));
        if let Some(i) = nearest.filter(|i| apart(&truths[*i]) <= options.pair_distance_m) {
            taken[i] = true;
            let range_m = truths[i].center[0].hypot(truths[i].center[1]);
            pairs.push(BoxPair { detection: j, truth: truths[i], found, range_m });
        }
    }
    pairs
}
