//! Detections in another frame than the labels are refused.

use super::evaluated_classes;
use crate::config::FrozenDetector;
use crate::error::{Result, refused};
use crate::folder::Study;
use eval::matrix::TestSet;
use eval::{EvalFrame, TRANSFORM_OVERLAP, TransformFit};

/// Refuses detections that overlap the labels much better after a flip, a turn or an exchange of axes.
pub(super) fn check_axes(
    study: &Study,
    frozen: &FrozenDetector,
    test_set: &str,
    labels: &TestSet,
    frames: &[EvalFrame],
) -> Result<()> {
    let fit = TransformFit::of(frames, labels.label_frame, &evaluated_classes(study));
    if !fit.is_wrong() {
        return Ok(());
    }
    let path = frozen.detections.get(test_set).map_or_else(|| frozen.folder(study), |path| study.path(path));
    let (transform, count) = fit.best;
    Err(refused(format!(
        "{}: the boxes of frozen {} are not in the frame of the labels of data set {test_set}: as given, they overlap {} \
         of {} labels in {} frames (3D IoU above {TRANSFORM_OVERLAP}); after {transform}, {count}. Correct the boxes and \
         run this again",
        path.display(),
        frozen.name,
        fit.as_given,
        fit.labels,
        fit.frames
    )))
}
