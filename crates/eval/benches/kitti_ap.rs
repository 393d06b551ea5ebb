//! KITTI AP of a validation set: 3,769 frames with ten detections each, on one core.

use criterion::{Criterion, criterion_group, criterion_main};
use data::{LabelBox, LabelFrame, stream};
use geometry::Box3;
use lidarshift_eval::{EvalFrame, EvalOptions, evaluate};
use rand::RngExt;

fn frames() -> Vec<EvalFrame> {
    let mut rng = stream(1, "bench", 0, 0);
    let mut frame = |i: usize| {
        let labels: Vec<LabelBox> = (0..8)
            .map(|k| {
                let class = ["Car", "Car", "Car", "Pedestrian", "Cyclist", "Van", "Car", "Car"][k];
                let top = rng.random_range(100.0..200.0);
                LabelBox {
                    class: class.into(),
                    truncation: 0.0,
                    occlusion: f64::from(k as u32 % 3),
                    alpha: 0.3,
                    image_box: [100.0 * k as f64, top, 100.0 * k as f64 + 90.0, top + rng.random_range(20.0..80.0)],
                    size_hwl: [1.5, 1.7, 4.0],
                    location: [4.0 * k as f64, 1.7, rng.random_range(5.0..60.0)],
                    rotation_y: rng.random_range(-3.0..3.0),
                    score: None,
                    track: None,
                }
            })
            .collect();
        let detections = (0..10)
            .map(|k| {
                let mut line = labels[k % 8].clone();
                line.location = line.location.map(|v| v + rng.random_range(-0.3..0.3));
                line.rotation_y += rng.random_range(-0.1..0.1);
                line.image_box = line.image_box.map(|v| v + rng.random_range(-3.0..3.0));
                line.score = Some(rng.random_range(0.0..1.0));
                line
            })
            .collect();
        EvalFrame { id: format!("{i:06}"), labels, detections }
    };
    (0..3769).map(&mut frame).collect()
}

fn kitti_ap(c: &mut Criterion) {
    let frames = frames();
    let one_core = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool of one thread");
    let mut group = c.benchmark_group("kitti_ap");
    group.sample_size(10);
    group.bench_function("3769 frames x 10 detections, three classes, all metrics, one core", |bench| {
        bench.iter(|| one_core.install(|| evaluate(&frames, &EvalOptions::default())))
    });
    group.finish();
}

/// One frame with two thousand labels and detections. Without a camera all image boxes are the same, so that every
/// label overlaps every detection.
fn crowd(c: &mut Criterion) {
    let mut rng = stream(1, "crowd", 0, 0);
    let (mut labels, mut detections) = (Vec::new(), Vec::new());
    for _ in 0..2000 {
        let at = [rng.random_range(-60.0..60.0), rng.random_range(-60.0..60.0)];
        let off = [rng.random_range(-0.4..0.4), rng.random_range(-0.4..0.4)];
        let car = |dx: f64, dy: f64| Box3::from_array([at[0] + dx, at[1] + dy, 0.0, 3.9, 1.6, 1.5, 0.3]);
        labels.push(LabelBox::from_box("Car", &car(0.0, 0.0), None));
        detections.push(LabelBox::from_box("Car", &car(off[0], off[1]), Some(rng.random())));
    }
    let frames = [EvalFrame { id: "crowd".into(), labels, detections }];
    let options = EvalOptions { label_frame: LabelFrame::Lidar, ..EvalOptions::default() };
    let mut group = c.benchmark_group("kitti AP");
    group.sample_size(10);
    group.bench_function("one frame x 2000 detections, all cores", |bench| {
        bench.iter(|| evaluate(&frames, &options));
    });
    group.finish();
}

criterion_group!(benches, kitti_ap, crowd);
criterion_main!(benches);
