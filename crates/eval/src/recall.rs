//! Recall in two definitions.

use crate::overlaps::{FrameOverlaps, range_m};
use crate::{EvalFrame, EvalOptions};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Overlap limits of OpenPCDet's recall.
pub const RECALL_OVERLAPS: [f64; 3] = [0.3, 0.5, 0.7];

/// Definition of recall.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum RecallDefinition {
    /// OpenPCDet's `recall_rcnn`: ground truths whose highest 3D IoU with any detection, of any class and score,
    /// exceeds the limit. One detection may cover several.
    AnyBox,
    /// True positives of KITTI's 3D matching with difficulty `all`, divided by ground truths: each detection matches
    /// one ground truth of its class.
    Matched,
}

/// A recall value.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Recall {
    /// Its definition.
    pub definition: RecallDefinition,
    /// `None`: all evaluated classes.
    pub class: Option<String>,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Number of ground truths of any difficulty.
    pub n_gt: i64,
    /// Number of detected ground truths.
    pub hits: i64,
    /// Recall, 0 to 1; `None` without ground truth.
    pub recall: Option<f64>,
}

/// OpenPCDet's recall over all evaluated classes.
pub(crate) fn any_box_recall(
    frames: &[(&EvalFrame, FrameOverlaps)],
    classes: &[String],
    options: &EvalOptions,
) -> Vec<Recall> {
    let mut highest = Vec::new(); // per ground truth
    for (frame, overlaps) in frames {
        let mut best = vec![0.0f64; frame.labels.len()];
        for pair in &overlaps.three_d {
            best[pair.label] = best[pair.label].max(pair.overlap);
        }
        let counts = |line: &data::LabelBox| {
            classes.iter().any(|class| class.eq_ignore_ascii_case(&line.class))
                && options.max_range_m.is_none_or(|most| range_m(line, options.label_frame) <= most)
        };
        highest.extend(frame.labels.iter().zip(best).filter(|(line, _)| counts(line)).map(|(_, best)| best));
    }
    let recall = |overlap: f64| {
        let hits = highest.iter().filter(|best| **best > overlap).count() as i64;
        Recall::new(RecallDefinition::AnyBox, None, overlap, highest.len() as i64, hits)
    };
    RECALL_OVERLAPS.map(recall).into()
}

impl Recall {
    pub(crate) fn new(definition: RecallDefinition, class: Option<String>, overlap: f64, n_gt: i64, hits: i64) -> Self {
        let recall = (n_gt > 0).then(|| hits as f64 / n_gt as f64);
        Recall { definition, class, overlap, n_gt, hits, recall }
    }
}
