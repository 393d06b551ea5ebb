//! Report of the paper's grid: two networks, four data sets, five seeds; from values in memory to written files.
//!
//! `cargo bench -p lidarshift-report --bench paper_grid [-- FOLDER]`: the report is written to the folder, or to a
//! temporary one.

#![expect(clippy::print_stdout, reason = "times go to stdout")]

use data::{Cloud, Frame, LabelBox, LabelFrame, Object, stream};
use eval::EvalFrame;
use eval::analysis::{AnalysisOptions, RunAnalysis, analyse};
use eval::features::{CkaTable, Embedded, Embedding, TSNE_SCHEMA, TsneOptions};
use eval::matrix::{Matrix, MatrixOptions, MatrixPlan, Place, PlannedNetwork, RunId, RunScores, build};
use eval::targets::{TargetOptions, Targets, targets};
use geometry::Box3;
use lidarshift_report::{Layer, LayerContent, Scene, StudyReport, TrainingRun};
use rand::RngExt;
use rayon::prelude::*;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

const NETWORKS: [&str; 2] = ["PointPillars", "PointRCNN"];
const SETS: [&str; 4] = ["Real", "Sim", "Sim Noise", "Sim Downsampled"];
const SEEDS: u64 = 5;
const TEST_FRAMES: u64 = 1000;
const EPOCHS: u32 = 75;
const CLOUD_POINTS: usize = 75_000;
/// Test clouds per run in the feature figure, as in the paper.
const FEATURE_FRAMES: usize = 500;

fn main() {
    let kept = std::env::args().skip(1).find(|arg| !arg.starts_with('-')).map(PathBuf::from);
    let temporary = tempfile::tempdir().expect("a temporary folder");
    let folder = kept.unwrap_or_else(|| temporary.path().into());
    let scores = scores();
    let matrix = timed("matrix of 32 cells and 5 seeds, 1,000 draws", || matrix(&scores));
    let analyses = timed("analyses of 16 cells", analyses);
    let report = StudyReport {
        title: "The paper's grid, made up".into(),
        matrix: Some(matrix),
        analyses,
        embeddings: NETWORKS.iter().map(|network| embedding(network)).collect(),
        cka: (0..8).map(cka).collect(),
        targets: SETS.iter().map(|set| of_targets(set)).collect(),
        training: runs().iter().map(curve).collect(),
        scenes: (0..3).map(scene).collect(),
        ..StudyReport::default()
    };
    let files = timed("page, figures and tables", || report.write(&folder).expect("a folder to write into"));
    println!("page: {:.1} MB, and {} files beside it", files.page_bytes as f64 / 1e6, files.others.len());
}

fn timed<T>(what: &str, work: impl FnOnce() -> T) -> T {
    let begin = Instant::now();
    let result = work();
    println!("{what}: {:.2} s", begin.elapsed().as_secs_f64());
    result
}

fn places() -> Vec<Place> {
    SETS.iter().map(|set| Place::new(set)).collect()
}

fn runs() -> Vec<RunId> {
    let of = |network: &str, set: &str, seed| RunId { network: network.into(), train_set: set.into(), seed };
    let of_network = |network: &&str| {
        SETS.iter()
            .flat_map(|set| (1..=SEEDS).map(|seed| of(network, set, seed)).collect::<Vec<_>>())
            .collect::<Vec<_>>()
    };
    NETWORKS.iter().flat_map(of_network).collect()
}

type Scores = BTreeMap<(RunId, String), Result<RunScores, String>>;

fn scores() -> Scores {
    let of_run = |(k, run): (usize, RunId)| {
        let of_test = |(j, test): (usize, &&str)| {
            let frames: Vec<EvalFrame> = (0..TEST_FRAMES).map(|id| frame(id, (4 * k + j) as u64)).collect();
            let scores = RunScores::new(&frames, None, LabelFrame::Lidar, &MatrixOptions::default());
            ((run.clone(), test.to_string()), Ok(scores))
        };
        SETS.iter().enumerate().map(of_test).collect::<Vec<_>>()
    };
    runs().into_par_iter().enumerate().flat_map_iter(of_run).collect()
}

fn matrix(scores: &Scores) -> Matrix {
    let network =
        |name: &&str| PlannedNetwork { network: Place::new(name), train_sets: places(), seeds: (1..=SEEDS).collect() };
    let plan =
        MatrixPlan { networks: NETWORKS.iter().map(network).collect(), test_sets: places(), ..MatrixPlan::default() };
    build(&plan, scores, &MatrixOptions::default())
}

/// A car, detected with an error, and a false positive.
fn frame(id: u64, run: u64) -> EvalFrame {
    let (mut places, mut random) = (stream(0, "grid places", 0, id), stream(run, "grid detections", 0, id));
    let mut car = [places.random_range(-90.0..90.0), places.random_range(-30.0..30.0), 0.0, 4.9, 1.9, 1.2, 0.1];
    let line = |at: [f64; 7], score| LabelBox::from_box("Car", &Box3::from_array(at), score);
    let labels = vec![line(car, None)];
    car[0] += random.random_range(-0.9..0.9);
    car[1] += random.random_range(-0.3..0.3);
    let mut detections = vec![line(car, Some(random.random()))];
    car[1] += 20.0;
    detections.push(line(car, Some(random.random_range(0.0..0.5))));
    EvalFrame { id: format!("{id:06}"), labels, detections }
}

fn analyses() -> Vec<(String, RunAnalysis)> {
    let of = |k: u64| {
        let frames: Vec<EvalFrame> = (0..TEST_FRAMES).map(|id| frame(id, 1000 + k)).collect();
        (format!("cell {k}"), analyse(&frames, None, &AnalysisOptions::default()))
    };
    (0..16).into_par_iter().map(of).collect()
}

fn embedding(network: &str) -> Embedding {
    let mut random = stream(1, "grid features", 0, 0);
    let mut points = Vec::new();
    for (i, set) in SETS.iter().enumerate() {
        for k in 0..SEEDS as usize * FEATURE_FRAMES {
            let seed = (k / FEATURE_FRAMES) as u64 + 1;
            let at = [i as f64 * 20.0, seed as f64 * 9.0].map(|v| v + random.random_range(-6.0..6.0));
            points.push(Embedded { train_set: set.to_string(), seed, frame: (k % FEATURE_FRAMES).to_string(), at });
        }
    }
    Embedding {
        schema: TSNE_SCHEMA.into(),
        network: network.into(),
        layer: "neck".into(),
        test_set: SETS[0].into(),
        options: TsneOptions::default(),
        kl_divergence: 1.0,
        points,
    }
}

fn cka(k: usize) -> (String, CkaTable) {
    let layers: Vec<String> = (0..8).map(|i| format!("layer {i}")).collect();
    let values = (0..8).map(|i| (0..8).map(|j| Some(1.0 / f64::from(1 + i32::abs(i - j)))).collect()).collect();
    (format!("pair {k}"), CkaTable { layers_a: layers.clone(), layers_b: layers, values })
}

fn cloud(id: u64, points: usize) -> Frame {
    let mut random = stream(id, "grid cloud", 0, 0);
    let car =
        Box3::from_array([random.random_range(-80.0..80.0), random.random_range(-8.0..8.0), 0.6, 4.9, 1.9, 1.2, 0.1]);
    let mut cloud = Cloud::new(3);
    for k in 0..points {
        let at = match k % 300 {
            0 => car.from_local([4.9, 1.9, 1.2].map(|side| random.random_range(-0.5..0.5) * side)),
            _ => [random.random_range(-100.0..100.0), random.random_range(-50.0..50.0), random.random_range(0.0..0.1)],
        };
        cloud.values.extend(at.map(|v| v as f32));
    }
    let object = Object { class: "Car".into(), bbox: car, truncation: None, occlusion: None, image_box: None };
    Frame { id: format!("{id:06}"), cloud, objects: vec![object] }
}

fn of_targets(set: &str) -> Targets {
    let ids: Vec<String> = (0..5000).map(|id| id.to_string()).collect();
    let load = |id: &str| Ok(cloud(id.parse().expect("a number"), 3000));
    targets(set, &ids, load, &TargetOptions::default()).expect("frames that are there")
}

fn curve(run: &RunId) -> TrainingRun {
    let mut random = stream(run.seed, "grid curves", 0, 0);
    let mut point = |epoch: u32| [f64::from(epoch) * 1500.0, 3.0 / f64::from(epoch) + random.random_range(0.0..0.1)];
    TrainingRun {
        name: format!("{}, {}, seed {}", run.network, run.train_set, run.seed),
        loss: (1..=EPOCHS).map(&mut point).collect(),
        validation_ap: (1..=EPOCHS / 5).map(&mut point).collect(),
    }
}

fn scene(id: u64) -> Scene {
    let layer = |name: &str, color: &str, content| Layer { name: name.into(), color: color.into(), content };
    let [measured, simulated] = [cloud(id, CLOUD_POINTS), cloud(id + 10, CLOUD_POINTS)];
    let boxes: Vec<Box3> = measured.objects.iter().map(|object| object.bbox).collect();
    let mut layers = vec![
        layer("measured", "#0072b2", LayerContent::Cloud(measured.cloud)),
        layer("simulated", "#d55e00", LayerContent::Cloud(simulated.cloud)),
    ];
    layers.extend((0..9).map(|k| layer(&format!("boxes {k}"), "#009e73", LayerContent::Boxes(boxes.clone()))));
    Scene { name: format!("frame {id}"), layers, focus_m: Some(boxes[0].center), ..Scene::default() }
}
