//! Speed of the overlap (pairs a second on one core), of NMS over 4,096 boxes and of 120,000 points against 20 boxes.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lidarshift_geometry::{Box3, iou_3d, points_in_boxes, rotated_nms};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use std::hint::black_box;

fn car(rng: &mut ChaCha8Rng, x: f64, y: f64, spread: f64) -> Box3 {
    let mut near = |v: f64, by: f64| v + rng.random_range(-by..by);
    let center = [near(x, spread), near(y, spread), near(-1.0, 0.2)];
    Box3 { center, size: [near(4.0, 0.5), near(1.7, 0.2), near(1.5, 0.2)], yaw_rad: near(0.0, 3.2) }
}

fn overlap(c: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let pairs: Vec<(Box3, Box3)> =
        (0..4096).map(|_| (car(&mut rng, 20.0, 3.0, 0.5), car(&mut rng, 20.0, 3.0, 0.5))).collect();
    assert!(pairs.iter().all(|(a, b)| iou_3d(a, b) > 0.0), "each pair is clipped");
    let mut group = c.benchmark_group("overlap");
    group.throughput(Throughput::Elements(pairs.len() as u64));
    group.bench_function("iou_3d of overlapping pairs", |bench| {
        bench.iter(|| black_box(&pairs).iter().map(|(a, b)| iou_3d(a, b)).sum::<f64>())
    });
    group.finish();
}

fn nms(c: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(2);
    let spread: Vec<Box3> = (0..4096).map(|_| car(&mut rng, 35.0, 0.0, 35.0)).collect();
    let clustered: Vec<Box3> = (0..4096).map(|i| car(&mut rng, 3.5 * f64::from(i % 20), 0.0, 0.5)).collect();
    let scores: Vec<f32> = (0..4096).map(|_| rng.random_range(0.0..1.0)).collect();
    for (name, boxes) in [("spread over 70 m", &spread), ("clustered on 20 cars", &clustered)] {
        for threshold in [0.01, 0.8] {
            c.bench_function(&format!("nms of 4096 boxes {name}, threshold {threshold}"), |bench| {
                bench.iter(|| rotated_nms(black_box(boxes), &scores, threshold))
            });
        }
    }
}

fn points(c: &mut Criterion) {
    let mut rng = ChaCha8Rng::seed_from_u64(3);
    let boxes: Vec<Box3> = (0..20).map(|_| car(&mut rng, 0.0, 0.0, 40.0)).collect();
    let mut cloud = Vec::new();
    for _ in 0..120_000 {
        let range_m: f32 = rng.random_range(2.0..80.0);
        let azimuth: f32 = rng.random_range(-3.2..3.2);
        cloud.extend([range_m * azimuth.cos(), range_m * azimuth.sin(), rng.random_range(-2.0..1.0), 0.5]);
    }
    c.bench_function("120000 points in 20 boxes", |bench| {
        bench.iter(|| points_in_boxes(black_box(&cloud), 4, &boxes, 0.0))
    });
}

criterion_group!(benches, overlap, nms, points);
criterion_main!(benches);
