//! Tests of the matrix: the paper's table from per-run values, and cells from detections.

use data::{LabelBox, LabelFrame, stream};
use lidarshift_eval::matrix::{
    Between, CellNumber, Matrix, MatrixOptions, MatrixPlan, Place, PlannedNetwork, Quantity, Reference, RunId,
    RunResult, RunScores, RunState, RunValue, TestSet, build, from_run_values, published,
};
use lidarshift_eval::{BootstrapOptions, Difficulty, EvalFrame, EvalOptions, Metric, RecallDefinition, evaluate};
use rand::RngExt;
use std::collections::BTreeMap;
use std::path::Path;

const SETS: [&str; 4] = ["Real", "Sim", "Sim Noise", "Sim Downsampled"];
const NETWORKS: [&str; 2] = ["PointRCNN", "PointPillars"];

fn place(title: &str) -> Place {
    Place { name: title.to_lowercase().replace(' ', "-"), title: title.into(), paper: Some(title.into()) }
}

fn paper_plan() -> MatrixPlan {
    let network = |title: &&str| PlannedNetwork {
        network: place(title),
        train_sets: SETS.iter().map(|set| place(set)).collect(),
        seeds: (1..=5).collect(),
    };
    MatrixPlan {
        networks: NETWORKS.iter().map(network).collect(),
        test_sets: SETS.iter().map(|set| place(set)).collect(),
        ..MatrixPlan::default()
    }
}

/// Five values with this mean and deviation (divisor n).
fn five(mean: f64, deviation: f64) -> [f64; 5] {
    [-2.0, -1.0, 0.0, 1.0, 2.0].map(|k: f64| mean + k * deviation / 2f64.sqrt())
}

/// Five numbers of the form k / 1000 whose mean and deviation round to the given values: possible recalls on 1,000
/// frames with one car each.
fn five_recalls(mean: f64, deviation: f64) -> Option<[f64; 5]> {
    let sum = (mean * 50.0).round() as i64;
    let center = sum / 5;
    let prints = |v: &[f64; 5]| {
        let m = v.iter().sum::<f64>() / 5.0;
        let d = (v.iter().map(|v| (v - m).powi(2)).sum::<f64>() / 5.0).sqrt();
        (d - deviation).abs() <= 0.005 + 1e-9 && (m - mean).abs() < 1e-9
    };
    let spread = (deviation * 30.0).ceil() as i64 + 2;
    let around = (-spread..=spread).map(|d| center + d);
    for a in around.clone() {
        for b in around.clone().filter(|b| *b >= a) {
            for c in around.clone().filter(|c| *c >= b) {
                for d in around.clone().filter(|d| *d >= c) {
                    let e = sum - a - b - c - d;
                    let values = [a, b, c, d, e].map(|k| k as f64 / 10.0);
                    if e >= d && e <= 1000 && prints(&values) {
                        return Some(values);
                    }
                }
            }
        }
    }
    None
}

/// The paper's table, from five values per entry.
fn paper_matrix() -> Matrix {
    let plan = paper_plan();
    let mut values = Vec::new();
    for planned in &plan.networks {
        for (train, test) in
            planned.train_sets.iter().flat_map(|train| plan.test_sets.iter().map(move |test| (train, test)))
        {
            for (quantity, overlap) in Quantity::PAPER.into_iter().flat_map(|q| [(q, 0.5), (q, 0.7)]) {
                let p = published(&planned.network.title, &train.title, &test.title, quantity, overlap).unwrap();
                let runs = match quantity {
                    Quantity::RecallAnyBox => {
                        five_recalls(p.mean, p.deviation).expect("five recalls give what is printed")
                    }
                    _ => five(p.mean, p.deviation),
                };
                for (seed, value) in (1..).zip(runs) {
                    let run = RunId { network: planned.network.name.clone(), train_set: train.name.clone(), seed };
                    let (test_set, class) = (test.name.clone(), "Car".into());
                    values.push(RunValue { run, test_set, class, quantity, overlap, value });
                }
            }
        }
    }
    from_run_values(&plan, &values, &MatrixOptions::default())
}

#[test]
fn the_papers_table_comes_out_of_per_run_values() {
    let matrix = paper_matrix();
    let latex = matrix.to_latex();
    let rows = [
        r"Network & Train dataset & Test dataset & 3D AP (0.5) & 3D AP (0.7) & Recall (0.5) & Recall (0.7) \\ \midrule",
        r"\multirow{16}{*}{PointRCNN} & \multirow{4}{*}{Real} & Real & 74.33 (1.9) & 51.96 (1.21) & 92.12 (0.7) & 80.92 (1.21) \\",
        r"& & Sim Downsampled & 83.64 (0.72) & 58.17 (3.37) & 92.7 (0.5) & 84.62 (0.89) \\ \cmidrule(l){2-7}",
        r"& \multirow{4}{*}{Sim} & Real & 30.49 (0.02) & 13.36 (0.12) & 69.7 (0.0) & 39.9 (0.0) \\",
        r"& & Sim Downsampled & 95.93 (0.5) & 95.87 (0.54) & 99.02 (0.13) & 98.12 (0.19) \\ \midrule",
        r"& & Sim Downsampled & 98.31 (0.0) & 94.46 (0.0) & 99.6 (0.0) & 97.5 (0.0) \\ \bottomrule",
    ];
    for row in rows {
        assert!(latex.lines().any(|line| line == row), "{row}\n{latex}");
    }
    // Every value of the table is shown next to the published one.
    for cell in &matrix.cells {
        for n in &cell.numbers {
            let p = n.published.unwrap();
            assert!(
                (n.mean.unwrap() - p.mean).abs() < 1e-9 && (n.deviation.unwrap() - p.deviation).abs() <= 0.005 + 1e-9
            );
        }
    }
    // Independent runs do not give a deviation of 0.0 over five runs: one warning per PointPillars cell, none for
    // PointRCNN.
    let zero = |name: &str| matrix.warnings.iter().filter(|w| w.starts_with(name) && w.contains("exactly 0")).count();
    assert_eq!((zero("pointpillars"), zero("pointrcnn")), (16, 0));
}

/// Compares the whole table with the paper's source, if it is available.
#[test]
fn the_table_is_laid_out_as_in_the_papers_source() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/paper.tex");
    let Ok(source) = std::fs::read_to_string(&path) else {
        eprintln!("skipped: {} is not there", path.display());
        return;
    };
    let table = source.split_once(r"\label{tab:all_results}").unwrap().1;
    let (begin, end) = (r"\begin{tabular}", r"\end{tabular}");
    let table = &table[table.find(begin).unwrap()..table.find(end).unwrap() + end.len()];
    let plain = |text: &str| -> Vec<String> {
        text.lines().map(|line| line.split_whitespace().collect::<Vec<_>>().join(" ")).collect()
    };
    assert_eq!(plain(&paper_matrix().to_latex()), plain(table));
}

fn car(x: f64, y: f64, yaw: f64, score: Option<f64>) -> LabelBox {
    LabelBox {
        class: "Car".into(),
        truncation: 0.0,
        occlusion: 0.0,
        alpha: -10.0,
        image_box: [0.0, 0.0, 50.0, 50.0],
        size_hwl: [1.18, 1.9, 4.88],
        location: [x, y, 0.5],
        rotation_y: yaw,
        score,
        track: None,
    }
}

/// Frames with one or two cars, detected with this noise (m) and with false positives.
fn frames(seed: u64, noise: f64, n: usize) -> Vec<EvalFrame> {
    (0..n)
        .map(|i| {
            let mut world = stream(0, "matrix test world", 0, i as u64);
            let mut rng = stream(seed, "matrix test run", 0, i as u64);
            let mut frame = EvalFrame { id: format!("{i:06}"), labels: vec![], detections: vec![] };
            for _ in 0..world.random_range(1..3) {
                let (x, y, yaw) =
                    (world.random_range(-95.0..95.0), world.random_range(-20.0..20.0), world.random_range(-0.3..0.3));
                frame.labels.push(car(x, y, yaw, None));
                if rng.random_range(0.0..1.0) < 0.9 {
                    let mut moved = || rng.random_range(-noise..=noise);
                    let (dx, dy) = (2.0 * moved(), moved());
                    let score = (rng.random_range(0.0..1.0f64) * 100.0).round() / 100.0;
                    frame.detections.push(car(x + dx, y + dy, yaw, Some(score)));
                }
            }
            while rng.random_range(0.0..1.0) < 0.3 {
                let (x, y) = (rng.random_range(-120.0..120.0), rng.random_range(-20.0..20.0));
                frame.detections.push(car(x, y, 0.0, Some(rng.random_range(0.0..0.6))));
            }
            frame
        })
        .collect()
}

fn options() -> MatrixOptions {
    MatrixOptions { bootstrap: BootstrapOptions { replicates: 60, ..Default::default() }, ..Default::default() }
}

fn scores(frames: &[EvalFrame]) -> RunScores {
    RunScores::new(frames, None, LabelFrame::Lidar, &options())
}

fn plan(seeds: &[u64]) -> MatrixPlan {
    let sets = ["real", "sim"].map(Place::new).to_vec();
    let network = PlannedNetwork { network: Place::new("pp"), train_sets: sets.clone(), seeds: seeds.into() };
    MatrixPlan { networks: vec![network], test_sets: sets, ..MatrixPlan::default() }
}

fn key(train: &str, seed: u64, test: &str) -> (RunId, String) {
    (RunId { network: "pp".into(), train_set: train.into(), seed }, test.into())
}

/// All results except those in `but`.
fn results(but: &[(&str, u64, &str)]) -> BTreeMap<(RunId, String), RunResult> {
    let mut results = BTreeMap::new();
    for (train, test) in [("real", "real"), ("real", "sim"), ("sim", "real"), ("sim", "sim")] {
        let noise = if train == test { 0.25 } else { 0.8 };
        for seed in [1, 2].into_iter().filter(|seed| !but.contains(&(train, *seed, test))) {
            results.insert(key(train, seed, test), Ok(scores(&frames(seed, noise, 120))));
        }
    }
    results
}

#[test]
fn numbers_of_a_run_are_those_of_eval_ap() {
    let frames = frames(3, 0.4, 150);
    let mut results = BTreeMap::new();
    results.insert(key("sim", 1, "real"), Ok(scores(&frames)));
    let matrix = build(&plan(&[1]), &results, &options());
    let cell = matrix.cell("pp", "sim", "real").unwrap();
    let eval = EvalOptions { label_frame: LabelFrame::Lidar, max_range_m: Some(100.0), ..EvalOptions::default() };
    let report = evaluate(&frames, &eval);
    for overlap in [0.5, 0.7] {
        let row = report.row("Car", Metric::ThreeD, overlap, Difficulty::All).unwrap();
        let number = |quantity| cell.number("Car", None, quantity, overlap).unwrap();
        assert_eq!(number(Quantity::Ap40).n_gt, Some(row.n_gt));
        let recall = |definition| {
            let found = report.recall.iter().find(|r| r.definition == definition && r.overlap == overlap);
            found.unwrap().recall.map(|r| 100.0 * r)
        };
        for (quantity, want) in [
            (Quantity::Ap40, row.ap40),
            (Quantity::ApArea, row.ap_area),
            (Quantity::RecallAnyBox, recall(RecallDefinition::AnyBox)),
            (Quantity::RecallMatched, recall(RecallDefinition::Matched)),
        ] {
            let (got, want) = (number(quantity).mean.unwrap(), want.unwrap());
            assert!((got - want).abs() < 1e-9 && got > 5.0, "{quantity} {overlap}: {got} instead of {want}");
        }
    }
    // A single run has no deviation, and the interval is over frames only.
    let ap = cell.number("Car", None, Quantity::Ap40, 0.5).unwrap();
    assert!(ap.deviation.is_none() && ap.interval.unwrap().low < ap.mean.unwrap());
}

#[test]
fn recall_of_regions_stands_beside_that_of_final_boxes() {
    let found = frames(3, 1.2, 80);
    let mut regions = frames(3, 0.1, 80);
    for (regions, found) in regions.iter_mut().zip(&found) {
        regions.detections.extend(found.detections.iter().cloned());
    }
    let matrix_of = |regions: Option<&[EvalFrame]>| {
        let scores = RunScores::new(&found, regions, LabelFrame::Lidar, &options());
        build(&plan(&[1]), &BTreeMap::from([(key("sim", 1, "real"), Ok(scores))]), &options())
    };
    let (one_stage, two_stage) = (matrix_of(None), matrix_of(Some(&regions)));
    let mean = |m: &Matrix, q| m.cell("pp", "sim", "real").unwrap().number("Car", None, q, 0.7).unwrap().mean.unwrap();
    let of_final = mean(&one_stage, Quantity::RecallFinalBoxes);
    assert_eq!(mean(&one_stage, Quantity::RecallAnyBox), of_final);
    assert_eq!(mean(&two_stage, Quantity::RecallFinalBoxes), of_final);
    assert!(mean(&two_stage, Quantity::RecallAnyBox) > of_final + 10.0);
    assert_eq!(mean(&two_stage, Quantity::Ap40), mean(&one_stage, Quantity::Ap40));
    assert_eq!((one_stage.columns().len(), two_stage.columns().len()), (6, 8));
    assert!(two_stage.to_markdown().contains("Recall, final boxes (0.7)"));
    assert!(!two_stage.to_latex().contains("final boxes"), "the paper's table has its own columns");
}

#[test]
fn sections_share_out_the_ground_truths() {
    let mut results = BTreeMap::new();
    results.insert(key("sim", 1, "real"), Ok(scores(&frames(5, 0.4, 60))));
    let matrix = build(&plan(&[1]), &results, &options());
    let cell = matrix.cell("pp", "sim", "real").unwrap();
    let n_gt = |section| cell.number("Car", section, Quantity::Ap40, 0.7).unwrap().n_gt.unwrap();
    assert_eq!(options().sections.iter().map(|s| n_gt(Some(*s))).sum::<i64>(), n_gt(None));
    // With fewer than 41 ground truths AP40 is capped, and the report says so.
    let few = options().sections.iter().filter(|s| n_gt(Some(**s)) < 41).count();
    assert_eq!(matrix.warnings.iter().filter(|w| w.contains("AP40 cannot exceed")).count(), few);
}

#[test]
fn cells_without_runs_stay_visible_and_say_why() {
    let mut results = results(&[("real", 2, "sim"), ("sim", 1, "real"), ("sim", 2, "real")]);
    results.insert(key("sim", 1, "real"), Err("checkpoint/last.safetensors is of another configuration".into()));
    results.insert(key("real", 1, "real"), Ok(scores(&frames(1, 0.3, 50))));
    let matrix = build(&plan(&[1, 2]), &results, &options());
    assert_eq!(matrix.cells.len(), 4);
    let cell = matrix.cell("pp", "sim", "real").unwrap();
    assert!(matches!(&cell.runs[0].state, RunState::Failed(reason) if reason.contains("another configuration")));
    assert_eq!((cell.runs[1].state.clone(), cell.numbers.len()), (RunState::Missing, 0));
    assert_eq!(matrix.cell("pp", "real", "sim").unwrap().n_done(), 1);
    // Runs over different frames are not averaged.
    let cell = matrix.cell("pp", "real", "real").unwrap();
    assert!(matches!(&cell.runs[1].state, RunState::Failed(reason) if reason.contains("120 test frames")), "{cell:?}");
    for text in [matrix.to_markdown(), matrix.warnings.join("\n")] {
        assert!(text.contains("another configuration") && text.contains("seed 2 is missing"), "{text}");
    }
    assert!(matrix.to_markdown().contains("| 0 of 2, 1 failed, 1 missing |"));
    assert!(matrix.to_csv().contains("pp,sim,real,\"0 of 2, 1 failed, 1 missing\",,,"));
    let latex = matrix.to_latex();
    assert!(latex.contains("& \\multirow{2}{*}{sim} & real & - & - & - & - \\\\"), "{latex}");
}

#[test]
fn equal_seeds_and_poor_training_are_reported() {
    let mut results = results(&[]);
    let copy = results[&key("sim", 1, "sim")].clone();
    results.insert(key("sim", 2, "sim"), copy);
    results.insert(key("real", 1, "real"), Ok(scores(&frames(1, 2.0, 120))));
    results.insert(key("real", 2, "real"), Ok(scores(&frames(2, 2.0, 120))));
    let matrix = build(&plan(&[1, 2]), &results, &options());
    let warned = |parts: &[&str]| matrix.warnings.iter().any(|w| parts.iter().all(|part| w.contains(part)));
    assert!(warned(&["pp, sim to sim", "do the same on every frame"]), "{:#?}", matrix.warnings);
    assert!(warned(&["pp, sim to sim", "exactly 0"]));
    assert!(warned(&["pp, real to real: undertrained"]));
    assert!(!warned(&["real to sim", "exactly 0"]));
    assert!(build(&plan(&[1, 1]), &results, &options()).warnings.iter().any(|w| w.contains("seed 1 is there twice")));
}

#[test]
fn a_foreign_train_set_costs_what_the_cells_differ() {
    let matrix = build(&plan(&[1, 2]), &results(&[]), &options());
    let mean = |train| matrix.cell("pp", train, "real").unwrap().number("Car", None, Quantity::Ap40, 0.7).unwrap().mean;
    let gap = matrix
        .gaps
        .iter()
        .find(|g| g.test_set == "real" && g.quantity == Quantity::Ap40 && g.overlap == 0.7 && g.section.is_none());
    let gap = gap.unwrap();
    assert!((gap.gap - (mean("real").unwrap() - mean("sim").unwrap())).abs() < 1e-9 && gap.gap > 5.0);
    let interval = gap.interval.unwrap();
    assert!(interval.low < gap.gap && gap.gap < interval.high && interval.low > 0.0, "{gap:?}");
}

#[test]
fn the_same_bits_for_any_number_of_threads_and_back_from_json() {
    let results = results(&[]);
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| build(&plan(&[1, 2]), &results, &options()).to_json())
    };
    let text = with(1);
    assert!(text == with(3), "another number of threads gives other numbers");
    let matrix: Matrix = serde_json::from_str(&text).unwrap();
    assert_eq!((matrix.schema.as_str(), matrix.cells.len()), ("lidarshift.matrix/1", 4));
    assert_eq!(matrix.to_markdown(), build(&plan(&[1, 2]), &results, &options()).to_markdown());
}

fn labels_of(frames: &[EvalFrame]) -> Vec<Vec<LabelBox>> {
    frames.iter().map(|frame| frame.labels.clone()).collect()
}

/// Frames whose labels are shifted along by `shift_m`, with the true boxes as the other reference.
fn mislabelled(seed: u64, noise: f64, shift_m: f64) -> RunScores {
    let truth = frames(seed, noise, 120);
    let mut labelled = truth.clone();
    for label in labelled.iter_mut().flat_map(|frame| &mut frame.labels) {
        let mut bbox = label.lidar_box();
        bbox.center[0] += shift_m;
        *label = LabelBox::from_box(&label.class, &bbox, None);
    }
    let set = TestSet::new(LabelFrame::Lidar, labelled.clone());
    set.with_beside(Reference::TrueBoxes, vec![labels_of(&truth)]).scores(&labelled, None, &options())
}

#[test]
fn a_gap_that_labels_make_is_distinguished_from_one_of_the_sensor() {
    let with = |shift_m: f64| {
        let mut results = results(&[("sim", 1, "real"), ("sim", 2, "real")]);
        for seed in [1, 2] {
            results.insert(key("sim", seed, "real"), Ok(mislabelled(seed, 0.3, shift_m)));
        }
        build(&plan(&[1, 2]), &results, &options())
    };
    let split = |m: &Matrix| {
        let found = m.splits.iter().find(|s| s.is_shown("Car") && s.test_set == "real" && s.overlap == 0.7);
        found.unwrap().clone()
    };
    let shifted = split(&with(0.8));
    let label = shifted.label.unwrap();
    assert!(label.points > 5.0 && label.interval.unwrap().low > 0.0, "{shifted:?}");
    let sum = label.points + shifted.sensor_and_scene.points;
    assert!((sum - shifted.total.points).abs() < 1e-9 && shifted.same_frames, "{shifted:?}");
    // Exact labels take nothing, and the sensor's part is the same.
    let exact = split(&with(0.0));
    assert_eq!(exact.label.unwrap().points, 0.0);
    assert!((exact.sensor_and_scene.points - shifted.sensor_and_scene.points).abs() < 1e-9);
    // Without the truth there is no part of the labels.
    let unknown = split(&build(&plan(&[1, 2]), &results(&[]), &options()));
    assert!(unknown.label.is_none() && unknown.sensor.is_none());
    let text = with(0.8).to_markdown();
    assert!(text.contains("| pp | sim | real, true boxes |") && text.contains("sensor and scene"), "{text}");
}

/// Labels that are shifted along and were repaired: the estimate is right, its ends are off by `off_m`.
#[test]
fn repaired_labels_are_a_reference_whose_uncertainty_is_in_the_intervals() {
    let shifted = |frames: &[EvalFrame], by_m: f64| {
        let mut frames = frames.to_vec();
        for label in frames.iter_mut().flat_map(|frame| &mut frame.labels) {
            let mut bbox = label.lidar_box();
            bbox.center[0] += by_m;
            *label = LabelBox::from_box(&label.class, &bbox, None);
        }
        frames
    };
    let cell = |off_m: f64| {
        let mut results = results(&[("sim", 1, "real"), ("sim", 2, "real")]);
        for seed in [1, 2] {
            let truth = frames(seed, 0.3, 120);
            let labelled = shifted(&truth, 0.8);
            let versions = [0.0, -off_m, off_m].map(|by_m| labels_of(&shifted(&truth, by_m)));
            let set = TestSet::new(LabelFrame::Lidar, labelled.clone());
            let set = set.with_beside(Reference::RepairedLabels, versions.into());
            results.insert(key("sim", seed, "real"), Ok(set.scores(&labelled, None, &options())));
        }
        let matrix = build(&plan(&[1, 2]), &results, &options());
        let of = |reference| {
            let cell = matrix.cell("pp", "sim", "real").unwrap();
            cell.number_of(reference, "Car", None, Quantity::Ap40, 0.7).unwrap().clone()
        };
        let split = matrix.splits.iter().find(|s| s.is_shown("Car") && s.test_set == "real" && s.overlap == 0.7);
        assert!(split.unwrap().label.unwrap().points > 5.0);
        assert!(matrix.to_markdown().contains("| pp | sim | real, repaired labels |"));
        (of(Reference::Labels), of(Reference::RepairedLabels))
    };
    let width = |n: &CellNumber| n.interval.map(|i| i.high - i.low).unwrap();
    let ((labels, exact), (_, unsure)) = (cell(0.0), cell(1.2));
    assert!(exact.mean.unwrap() > labels.mean.unwrap() + 5.0 && exact.mean == unsure.mean, "{labels:?} {exact:?}");
    assert!(width(&unsure) > 1.5 * width(&exact), "{unsure:?} {exact:?}");
}

#[test]
fn a_test_set_between_two_tells_sensor_from_scene() {
    let mut plan = plan(&[1, 2]);
    plan.test_sets.push(Place::new("middle"));
    plan.between.push(Between { test_set: "middle".into(), scene_of: "sim".into(), sensor_of: "real".into() });
    let mut results = results(&[]);
    for seed in [1, 2] {
        results.insert(key("sim", seed, "middle"), Ok(scores(&frames(seed, 0.5, 120))));
    }
    let matrix = build(&plan, &results, &options());
    let split = matrix.splits.iter().find(|s| s.is_shown("Car") && s.test_set == "real" && s.train_set == "sim");
    let split = split.unwrap();
    let (sensor, scene) = (split.sensor.unwrap().points, split.scene.unwrap().points);
    assert!(sensor > 0.0 && scene > 0.0 && (sensor + scene - split.sensor_and_scene.points).abs() < 1e-9, "{split:?}");
}
