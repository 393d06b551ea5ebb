//! Errors of the detected boxes per component, in the frame of the ground-truth box.

use super::AnalysisOptions;
use super::pairs::{BoxPair, pairs};
use crate::{EvalFrame, RangeSection};
use geometry::limit_period;
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statistics::{deviation, mean, quantile_linear};
use std::f64::consts::{FRAC_PI_2, PI};

/// Error of one component: predicted minus true.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ComponentError {
    /// `along_m`, `across_m`, `up_m`: the centre, in the frame of the ground-truth box (forward, left, up). `yaw_deg`:
    /// modulo 180 degrees. `length_m`, `width_m`, `height_m`: the extents.
    pub component: String,
    /// Mean error (bias).
    pub mean: f64,
    /// Standard deviation, divisor n.
    pub deviation: f64,
    /// Median of the absolute errors.
    pub median_abs: f64,
    /// 90th percentile of the absolute errors.
    pub p90_abs: f64,
}

/// Errors in one range section.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorSection {
    /// `None`: all distances.
    pub section: Option<RangeSection>,
    /// Pairs of a ground truth and a detection.
    pub n: usize,
    /// Fraction of pairs whose predicted heading is closer to the opposite of the true heading, 0 to 1.
    pub turned: f64,
    /// In a fixed order; empty if there are no pairs.
    pub components: Vec<ComponentError>,
}

/// Errors of all pairs and per range section.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BoxErrors {
    /// All distances first, then the sections.
    pub sections: Vec<ErrorSection>,
}

const COMPONENTS: [&str; 7] = ["along_m", "across_m", "up_m", "yaw_deg", "length_m", "width_m", "height_m"];

/// Errors of the detections that are paired with a ground truth by centre distance.
pub fn box_errors(frames: &[EvalFrame], options: &AnalysisOptions) -> BoxErrors {
    let of_frame = |frame: &EvalFrame| -> Vec<(f64, bool, [f64; 7])> {
        let found = pairs(frame, options, options.least_score);
        found.iter().map(|pair| (pair.range_m, is_turned(pair), errors(pair))).collect()
    };
    let all: Vec<(f64, bool, [f64; 7])> =
        frames.par_iter().map(of_frame).collect::<Vec<_>>().into_iter().flatten().collect();
    let sections = std::iter::once(None).chain(options.sections.iter().copied().map(Some));
    let of_section = |section: Option<RangeSection>| {
        let inside: Vec<_> = all.iter().filter(|(range_m, ..)| section.is_none_or(|s| s.contains(*range_m))).collect();
        let turned = inside.iter().filter(|(_, turned, _)| *turned).count();
        let component = |(k, name): (usize, &&str)| {
            let values: Vec<f64> = inside.iter().map(|(_, _, errors)| errors[k]).collect();
            let mut sizes: Vec<f64> = values.iter().map(|v| v.abs()).collect();
            sizes.sort_by(f64::total_cmp);
            ComponentError {
                component: (*name).into(),
                mean: mean(&values),
                deviation: deviation(&values),
                median_abs: quantile_linear(&sizes, 0.5),
                p90_abs: quantile_linear(&sizes, 0.9),
            }
        };
        let any = !inside.is_empty();
        ErrorSection {
            section,
            n: inside.len(),
            turned: if any { turned as f64 / inside.len() as f64 } else { 0.0 },
            components: if any { COMPONENTS.iter().enumerate().map(component).collect() } else { Vec::new() },
        }
    };
    BoxErrors { sections: sections.map(of_section).collect() }
}

fn errors(pair: &BoxPair) -> [f64; 7] {
    let [along, across, up] = pair.truth.to_local(pair.found.center);
    let yaw = limit_period(pair.found.yaw_rad - pair.truth.yaw_rad, 0.5, PI).to_degrees();
    let [length, width, height] = [0, 1, 2].map(|k| pair.found.size[k] - pair.truth.size[k]);
    [along, across, up, yaw, length, width, height]
}

fn is_turned(pair: &BoxPair) -> bool {
    limit_period(pair.found.yaw_rad - pair.truth.yaw_rad, 0.5, 2.0 * PI).abs() > FRAC_PI_2
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::{LabelBox, LabelFrame};
    use geometry::Box3;

    /// Errors are expressed in the frame of the ground-truth box, whatever the label frame.
    #[test]
    fn errors_are_along_across_and_up() {
        let truth = Box3::from_array([20.0, 10.0, 0.0, 4.0, 2.0, 1.5, 0.5]);
        let mut found = truth;
        found.center = truth.from_local([0.3, -0.2, 0.1]);
        found.size = [4.2, 1.9, 1.5];
        found.yaw_rad = 0.5 + PI + 0.02;
        for label_frame in [LabelFrame::Lidar, LabelFrame::Camera] {
            let line = |b: &Box3, score| {
                crate::overlaps::with_upright_box(&LabelBox::from_box("Car", b, score), b, label_frame)
            };
            let frame = EvalFrame {
                id: "0".into(),
                labels: vec![line(&truth, None)],
                detections: vec![line(&found, Some(0.9)), line(&truth, Some(0.05))],
            };
            let options = AnalysisOptions { label_frame, ..AnalysisOptions::default() };
            let result = box_errors(&[frame], &options);
            let all = &result.sections[0];
            assert_eq!((all.n, all.turned), (1, 1.0));
            let want = [0.3, -0.2, 0.1, 0.02f64.to_degrees(), 0.2, -0.1, 0.0];
            for (c, want) in all.components.iter().zip(want) {
                assert!((c.mean - want).abs() < 1e-9 && (c.median_abs - want.abs()).abs() < 1e-9, "{c:?} {want}");
            }
            assert_eq!(result.sections.iter().map(|s| s.n).collect::<Vec<_>>(), [1, 1, 0, 0]);
        }
    }
}
