//! Which box component costs average precision: each component is replaced by the ground truth in turn.

use super::pairs::pairs;
use super::strata::whole;
use super::{AnalysisOptions, Stratum};
use crate::EvalFrame;
use crate::overlaps::with_upright_box;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A box component that is replaced by the ground truth.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Component {
    /// Nothing: the boxes as predicted.
    None,
    /// Centre position along the true heading.
    Along,
    /// Centre position across the true heading.
    Across,
    /// Height of the centre.
    Up,
    /// The heading.
    Yaw,
    /// All three extents.
    Size,
    /// All three centre coordinates.
    Center,
    /// Everything. The remaining loss is due to missed ground truths and false positives.
    All,
}

impl Component {
    /// In report order.
    pub const ALL: [Component; 8] = [
        Component::None,
        Component::Along,
        Component::Across,
        Component::Up,
        Component::Yaw,
        Component::Size,
        Component::Center,
        Component::All,
    ];
}

/// AP after replacing one component.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Repair {
    /// The replaced component.
    pub component: Component,
    /// AP and recall after the replacement.
    pub then: Stratum,
    /// AP40 gained, percentage points; `None` where undefined.
    pub gained: Option<f64>,
}

/// AP with each component of the detections replaced by that of the paired ground truth. Pairs are formed by centre
/// distance, with no score limit; detections without a pair stay unchanged.
pub fn oracle(frames: &[EvalFrame], options: &AnalysisOptions) -> Vec<Repair> {
    let mut before = None;
    let repair = |component| {
        let repaired: Vec<EvalFrame> = frames.par_iter().map(|frame| with_truth(frame, component, options)).collect();
        let then = whole(&repaired, options);
        let before = *before.get_or_insert(then.ap40);
        Repair { component, gained: then.ap40.zip(before).map(|(now, before)| now - before), then }
    };
    Component::ALL.map(repair).into()
}

fn with_truth(frame: &EvalFrame, component: Component, options: &AnalysisOptions) -> EvalFrame {
    let mut out = frame.clone();
    for pair in pairs(frame, options, f64::NEG_INFINITY) {
        let [along, across, up] = pair.truth.to_local(pair.found.center);
        let (mut b, truth) = (pair.found, pair.truth);
        match component {
            Component::None => {}
            Component::Along => b.center = truth.from_local([0.0, across, up]),
            Component::Across => b.center = truth.from_local([along, 0.0, up]),
            Component::Up => b.center[2] = truth.center[2],
            Component::Yaw => b.yaw_rad = truth.yaw_rad,
            Component::Size => b.size = truth.size,
            Component::Center => b.center = truth.center,
            Component::All => b = truth,
        }
        out.detections[pair.detection] = with_upright_box(&frame.detections[pair.detection], &b, options.label_frame);
    }
    out
}

#[cfg(test)]
mod tests {
    use super::super::analyse;
    use super::*;
    use data::{LabelBox, stream};
    use geometry::Box3;
    use rand::RngExt;

    /// A detector with only a yaw error: replacing the yaw restores the AP, replacing anything else does not.
    #[test]
    fn the_faulty_component_repairs_the_precision() {
        for fault in [Component::Along, Component::Up, Component::Yaw, Component::Size] {
            let mut rng = stream(1, "oracle test", 0, 0);
            let frames: Vec<EvalFrame> = (0..60)
                .map(|i| {
                    let truth = Box3::from_array([rng.random_range(-90.0..90.0), 5.0, 0.0, 4.88, 1.9, 1.18, 0.4]);
                    let mut found = truth;
                    match fault {
                        Component::Along => found.center = truth.from_local([1.5, 0.0, 0.0]),
                        Component::Up => found.center[2] += 0.5,
                        Component::Yaw => found.yaw_rad += 0.4,
                        _ => found.size = [3.5, 1.4, 1.18],
                    }
                    let line = |b: &Box3, score| LabelBox::from_box("Car", b, score);
                    let detections = vec![line(&found, Some(rng.random_range(0.2..1.0)))];
                    EvalFrame { id: format!("{i}"), labels: vec![line(&truth, None)], detections }
                })
                .collect();
            let result = analyse(&frames, None, &AnalysisOptions::default());
            for repair in &result.oracle {
                let repairs = repair.component == fault
                    || repair.component == Component::All
                    || (repair.component == Component::Center && matches!(fault, Component::Along | Component::Up));
                let want = if repairs { 100.0 } else { 0.0 };
                assert_eq!(repair.then.ap40, Some(want), "{fault:?} {:?}", repair.component);
            }
            let hits: i64 = result.by_distance.iter().map(|s| s.n_gt).sum();
            assert_eq!((hits, result.by_heading.iter().map(|s| s.n_gt).sum()), (60, 60));
            assert!(result.by_overlap[2].ap40 > Some(90.0) && result.by_overlap[18].ap40 == Some(0.0));
            // All detections are false positives, so the calibration error is the mean score.
            let mean = frames.iter().map(|f| f.detections[0].score.unwrap()).sum::<f64>() / 60.0;
            assert!((result.calibration.expected_error.unwrap() - mean).abs() < 1e-9);
        }
    }
}
