//! KITTI's average precision.

use crate::arrays::boxes_of;
use crate::errors::{raised, with_place};
use data::{LabelBox, LabelFrame};
use eval::{EvalFrame, EvalOptions, EvalReport, evaluate, ids_of_folder, read_frames};
use pyo3::prelude::*;
use std::path::PathBuf;

/// Boxes (M x 7, LiDAR frame) as bytes, and classes.
type Labels = (Vec<u8>, Vec<String>);
/// Boxes, classes and scores.
type Detections = (Vec<u8>, Vec<String>, Vec<f32>);

/// Average precision of boxes in the LiDAR frame, as JSON.
#[pyfunction]
pub fn kitti_ap(
    py: Python<'_>,
    labels: Vec<Labels>,
    detections: Vec<Detections>,
    classes: Vec<String>,
    overlaps: Vec<f64>,
    max_range_m: Option<f64>,
) -> PyResult<String> {
    let wrong = |text: String| with_place(py, &text, None);
    if labels.len() != detections.len() {
        let text =
            format!("labels have {} frames, detections {}; give the same frames", labels.len(), detections.len());
        return Err(wrong(text));
    }
    let mut frames = Vec::with_capacity(labels.len());
    for (i, ((boxes, names), (found, found_names, scores))) in labels.iter().zip(&detections).enumerate() {
        let (boxes, found) = (boxes_of(py, boxes)?, boxes_of(py, found)?);
        if boxes.len() != names.len() || found.len() != found_names.len() || found.len() != scores.len() {
            return Err(wrong(format!(
                "frame {i}: boxes, classes and scores have unlike lengths; give one for each box"
            )));
        }
        if scores.iter().any(|score| !score.is_finite()) {
            return Err(wrong(format!("frame {i}: a score is not finite; remove that detection")));
        }
        let label = |(bbox, name): (&geometry::Box3, &String)| LabelBox::from_box(name, bbox, None);
        let detection =
            |((bbox, name), score): ((&geometry::Box3, &String), &f32)| LabelBox::from_box(name, bbox, Some(*score));
        frames.push(EvalFrame {
            id: format!("{i:06}"),
            labels: boxes.iter().zip(names).map(label).collect(),
            detections: found.iter().zip(found_names).zip(scores).map(detection).collect(),
        });
    }
    let options = EvalOptions { classes, label_frame: LabelFrame::Lidar, max_range_m, more_overlaps: overlaps };
    Ok(json(&py.detach(|| evaluate(&frames, &options))))
}

/// Average precision of KITTI text in two folders, as JSON.
#[pyfunction]
pub fn kitti_ap_of_folders(
    py: Python<'_>,
    labels: PathBuf,
    detections: PathBuf,
    camera: bool,
    classes: Vec<String>,
    overlaps: Vec<f64>,
    max_range_m: Option<f64>,
) -> PyResult<String> {
    let label_frame = if camera { LabelFrame::Camera } else { LabelFrame::Lidar };
    let options = EvalOptions { classes, label_frame, max_range_m, more_overlaps: overlaps };
    let report = py.detach(|| {
        let ids = ids_of_folder(&labels)?;
        let frames = read_frames(&labels, &detections, &ids)?;
        Ok(evaluate(&frames, &options))
    });
    Ok(json(&report.map_err(|e| raised(py, e))?))
}

fn json(report: &EvalReport) -> String {
    serde_json::to_string(report).expect("a report is plain data")
}
