//! The time of an evaluation grows with the square of the boxes of a frame, not with their cube.

use data::{LabelBox, LabelFrame, stream};
use eval::{EvalFrame, EvalOptions, evaluate};
use geometry::Box3;
use rand::RngExt;
use std::time::{Duration, Instant};

#[test]
fn a_frame_of_two_thousand_boxes() {
    let mut rng = stream(1, "crowd", 0, 0);
    let (mut labels, mut detections) = (Vec::new(), Vec::new());
    for _ in 0..2000 {
        let at = [rng.random_range(-60.0..60.0), rng.random_range(-60.0..60.0), 0.0];
        let off = [rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4)];
        let car = |dx: f64, dy: f64| Box3::from_array([at[0] + dx, at[1] + dy, at[2], 3.9, 1.6, 1.5, 0.3]);
        // Without a camera all image boxes are the same: every label overlaps every detection.
        labels.push(LabelBox::from_box("Car", &car(0.0, 0.0), None));
        detections.push(LabelBox::from_box("Car", &car(off[0], off[1]), Some(rng.random())));
    }
    let begin = Instant::now();
    let options = EvalOptions { label_frame: LabelFrame::Lidar, ..EvalOptions::default() };
    let report = evaluate(&[EvalFrame { id: "crowd".into(), labels, detections }], &options);
    assert!(report.rows.iter().any(|row| row.n_gt == 2000 && row.n_tp > 500));
    // About a second in a release build, minutes if the matching began anew at every score.
    assert!(begin.elapsed() < Duration::from_secs(40), "{:?}", begin.elapsed());
}
