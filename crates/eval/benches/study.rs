//! The evaluation work of a study besides training: t-SNE, Chamfer and earth mover's distance, and a matrix of 16
//! cells.
//!
//! `cargo bench -p lidarshift-eval --bench study [-- FOLDER]`: if a folder is given, the inputs are written there for
//! `study.py`, which times scikit-learn, openTSNE, SciPy, POT and Open3D on the same inputs.

#![expect(clippy::print_stdout, reason = "times go to stdout")]

use data::{LabelBox, LabelFrame, stream};
use geometry::Box3;
use lidarshift_eval::EvalFrame;
use lidarshift_eval::distance::{Point, chamfer, emd};
use lidarshift_eval::features::{Features, TsneMethod, TsneOptions, tsne};
use lidarshift_eval::matrix::{MatrixOptions, MatrixPlan, Place, PlannedNetwork, RunId, RunScores, build};
use rand::RngExt;
use std::collections::BTreeMap;
use std::f32::consts::PI;
use std::hint::black_box;
use std::path::PathBuf;
use std::time::Instant;

const CLOUD_POINTS: usize = 75_000;
const EMD_POINTS: usize = 1024;
const VECTORS: usize = 10_000;
const DIM: usize = 128;

fn main() {
    let folder = std::env::args().skip(1).find(|arg| !arg.starts_with('-')).map(PathBuf::from);
    let keep = |name: &str, values: &[f32]| {
        if let Some(folder) = &folder {
            let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
            std::fs::write(folder.join(name), bytes).expect("the folder can be written");
        }
    };
    let [a, b] = [0, 1].map(|seed| cloud(seed, CLOUD_POINTS));
    keep("a.f32", a.as_flattened());
    keep("b.f32", b.as_flattened());
    let found = time("Chamfer, 75,000 points, trees included", 15, || chamfer(&a, &b).expect("finite"));
    println!("  sum {:.4} m2", found.sum_m2);
    let found = time("EMD, 1,024 points", 7, || emd(&a[..EMD_POINTS], &b[..EMD_POINTS]).expect("finite"));
    println!("  {found:.6} m");
    time("matrix of 16 cells, 1,000 frames each, 1,000 draws", 1, matrix);
    let vectors = vectors();
    keep("vectors.f32", &vectors);
    let features = Features::new(DIM, vectors).expect("whole vectors");
    for method in [TsneOptions::default().method, TsneMethod::Interpolated] {
        let options = TsneOptions { method, ..TsneOptions::default() };
        let what = format!("t-SNE, 10,000 x 128, {method:?}");
        let (places, divergence) = time(&what, 1, || tsne(&features, &options).expect("fits"));
        let places: Vec<f32> = places.as_flattened().iter().map(|v| *v as f32).collect();
        keep(if method == TsneMethod::Interpolated { "interpolated.f32" } else { "barnes_hut.f32" }, &places);
        println!("  Kullback-Leibler divergence {divergence:.4}");
    }
}

/// Prints the median and returns the last result.
fn time<T>(what: &str, repetitions: usize, mut work: impl FnMut() -> T) -> T {
    let mut seconds = Vec::new();
    loop {
        let begin = Instant::now();
        let result = black_box(work());
        seconds.push(begin.elapsed().as_secs_f64());
        if seconds.len() == repetitions {
            seconds.sort_by(f64::total_cmp);
            println!("{what}: {:.4} s, median of {repetitions}", seconds[repetitions / 2]);
            return result;
        }
    }
}

/// Ground and walls, denser near the sensor.
fn cloud(seed: u64, n: usize) -> Vec<Point> {
    let mut random = stream(seed, "study bench", 0, 0);
    let mut point = || {
        let (range, azimuth) = (100.0 * random.random::<f32>().powi(2), random.random_range(-PI..PI));
        let up =
            if random.random::<f32>() < 0.3 { random.random_range(0.0..4.0) } else { random.random_range(0.0..0.1) };
        [range * azimuth.cos(), range * azimuth.sin(), up]
    };
    (0..n).map(|_| point()).collect()
}

/// Ten clusters.
fn vectors() -> Vec<f32> {
    let mut random = stream(2, "study bench", 0, 0);
    let centers: Vec<f32> = (0..10 * DIM).map(|_| random.random_range(-2.0..2.0)).collect();
    let value = |i: usize| centers[(i / DIM % 10) * DIM + i % DIM] + random.random_range(-2.0..2.0f32);
    (0..VECTORS * DIM).map(value).collect()
}

/// Four train sets times four test sets, one run each.
fn matrix() -> usize {
    let places: Vec<Place> = (0..4).map(|i| Place::new(&format!("set {i}"))).collect();
    let network = PlannedNetwork { network: Place::new("network"), train_sets: places.clone(), seeds: vec![1] };
    let plan = MatrixPlan { networks: vec![network], test_sets: places.clone(), ..MatrixPlan::default() };
    let options = MatrixOptions::default();
    let mut results = BTreeMap::new();
    for (i, train) in places.iter().enumerate() {
        for (j, test) in places.iter().enumerate() {
            let run = RunId { network: "network".into(), train_set: train.name.clone(), seed: 1 };
            let frames: Vec<EvalFrame> = (0..1000).map(|k| frame(k, (4 * i + j) as u64)).collect();
            results.insert((run, test.name.clone()), Ok(RunScores::new(&frames, None, LabelFrame::Lidar, &options)));
        }
    }
    build(&plan, &results, &options).cells.len()
}

/// Three cars detected with box errors, and two false positives.
fn frame(k: u64, run: u64) -> EvalFrame {
    let mut random = stream(run, "study bench frames", 0, k);
    let mut frame = EvalFrame { id: k.to_string(), labels: Vec::new(), detections: Vec::new() };
    for i in 0..5u64 {
        let mut places = stream(0, "study bench places", i, k);
        let mut car = [places.random_range(-90.0..90.0), places.random_range(-30.0..30.0), 0.0, 4.9, 1.9, 1.2, 0.1];
        if i < 3 {
            frame.labels.push(LabelBox::from_box("Car", &Box3::from_array(car), None));
        }
        car[0] += random.random_range(-0.6..0.6);
        car[1] += random.random_range(-0.2..0.2);
        frame.detections.push(LabelBox::from_box("Car", &Box3::from_array(car), Some(random.random())));
    }
    frame
}
