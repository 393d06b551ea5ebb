//! Speed of the point operations at the sizes of the published PointRCNN, on a made-up scan of 16,384 points.

use criterion::{Criterion, criterion_group, criterion_main};
use lidarshift_geometry::{Box3, TieRule, ball_query, farthest_point_sampling, roi_points, three_nearest};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use std::hint::black_box;

/// Ground in rings, as a turning LiDAR sees it, and things that stand on it.
fn scan(points: usize) -> Vec<[f32; 3]> {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let point = |_| {
        let azimuth: f32 = rng.random_range(-0.75..0.75);
        let beam = rng.random_range(0..48);
        let stands = rng.random_range(0..10) < 4;
        let range_m = if stands { rng.random_range(5.0..70.0) } else { 1.73 / (0.025 + 0.008 * beam as f32) };
        let range_m: f32 = range_m + rng.random_range(-0.02..0.02);
        let z = if stands { rng.random_range(-1.7..1.0) } else { -1.73 };
        [range_m * azimuth.cos(), range_m * azimuth.sin(), z]
    };
    (0..points).map(point).collect()
}

fn point_operations(c: &mut Criterion) {
    let cloud = scan(16_384);
    let rule = TieRule::ReferenceKernel;
    c.bench_function("farthest point sampling, 4096 of 16384", |bench| {
        bench.iter(|| farthest_point_sampling(black_box(&cloud), 4096, rule))
    });
    let centers: Vec<[f32; 3]> =
        farthest_point_sampling(&cloud, 4096, rule).iter().map(|&i| cloud[i as usize]).collect();
    for radius_m in [0.1, 0.5] {
        c.bench_function(&format!("ball query, 4096 centres, radius {radius_m}, 32 samples"), |bench| {
            bench.iter(|| ball_query(black_box(&cloud), &centers, radius_m, 32))
        });
    }
    c.bench_function("three nearest of 4096 for 16384", |bench| {
        bench.iter(|| three_nearest(black_box(&cloud), &centers))
    });
    let in_a_roi = &cloud[..512];
    c.bench_function("farthest point sampling, 128 of 512", |bench| {
        bench.iter(|| farthest_point_sampling(black_box(in_a_roi), 128, rule))
    });
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    let mut near = |low: f64, high: f64| rng.random_range(low..high);
    let rois: Vec<Box3> = (0..128)
        .map(|_| Box3::from_array([near(5.0, 50.0), near(-20.0, 20.0), -0.9, 3.9, 1.6, 1.6, near(-3.0, 3.0)]))
        .collect();
    c.bench_function("512 points of 128 regions out of 16384", |bench| {
        bench.iter(|| roi_points(black_box(cloud.as_flattened()), 3, &rois, 512))
    });
}

criterion_group!(benches, point_operations);
criterion_main!(benches);
