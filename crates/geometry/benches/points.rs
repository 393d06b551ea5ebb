//! Speed of the point operations at the sizes of the published PointRCNN, on a synthetic scan of 16,384 points.

use criterion::{Criterion, criterion_group, criterion_main};
use lidarshift_geometry::{Box3, TieRule, ball_query, farthest_point_sampling, roi_points, three_nearest};
use rand::RngExt;
use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use std::hint::black_box;
use std::process::Command;
use std::time::{Duration, Instant};

/// Rings on the ground, as of a spinning LiDAR, and objects on it.
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

/// The same three operations in PyTorch on the same points, if `LIDARSHIFT_PYTHON` names a Python that has it. Prints
/// both times and the number of equal indices.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn beside_torch(_: &mut Criterion) {
    let Ok(python) = std::env::var("LIDARSHIFT_PYTHON") else { return };
    let folder = tempfile::tempdir().unwrap();
    let cloud = scan(16_384);
    let bytes: Vec<u8> = cloud.as_flattened().iter().flat_map(|v| v.to_le_bytes()).collect();
    std::fs::write(folder.path().join("points.f32"), bytes).unwrap();
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/benches/points_torch.py");
    let ours = || {
        let start = Instant::now();
        let picks = farthest_point_sampling(&cloud, 4096, TieRule::LowestIndex);
        let centers: Vec<[f32; 3]> = picks.iter().map(|&i| cloud[i as usize]).collect();
        let sampled = start.elapsed();
        let start = Instant::now();
        let balls = ball_query(&cloud, &centers, 0.5, 32);
        let queried = start.elapsed();
        let start = Instant::now();
        let three = three_nearest(&cloud, &centers).index.concat();
        ([sampled, queried, start.elapsed()], [picks, balls, three])
    };
    let times: Vec<[Duration; 3]> = (0..9).map(|_| ours().0).collect();
    assert!(Command::new(&python).arg(script).arg(folder.path()).status().unwrap().success(), "{python} {script}");
    for (i, name) in ["sampling", "ball query", "three nearest"].into_iter().enumerate() {
        let mut sorted: Vec<Duration> = times.iter().map(|t| t[i]).collect();
        sorted.sort();
        let bytes = std::fs::read(folder.path().join(format!("{i}.i64"))).unwrap();
        let theirs = bytes.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b));
        let mine = &ours().1[i];
        let equal = theirs.zip(mine).filter(|(a, b)| *a == i64::from(**b)).count();
        println!("{name}: here {:.2} ms, {equal} of {} indices equal", sorted[4].as_secs_f64() * 1e3, mine.len());
    }
}

criterion_group!(benches, point_operations, beside_torch);
criterion_main!(benches);
