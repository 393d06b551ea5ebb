//! Comparison with the reference evaluators on all golden sets (`tests/golden/evaluation/README.md` describes how they
//! were made).

use data::LabelFrame;
use lidarshift_eval::{
    Counts, Difficulty, EvalFrame, EvalOptions, EvalReport, Metric, RecallDefinition, Row, evaluate, read_frames,
    read_ids,
};
use serde_json::Value;
use std::path::{Path, PathBuf};

const METRICS: [(&str, Metric); 4] =
    [("bbox", Metric::Bbox), ("aos", Metric::Aos), ("bev", Metric::Bev), ("3d", Metric::ThreeD)];
const DIFFICULTIES: [(&str, Difficulty); 3] =
    [("easy", Difficulty::Easy), ("moderate", Difficulty::Moderate), ("hard", Difficulty::Hard)];
const TOLERANCE: f64 = 1e-9;

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/evaluation")
}

fn json(path: &Path) -> Value {
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn frames(folder: &Path) -> Vec<EvalFrame> {
    let ids = read_ids(&folder.join("ImageSets/val.txt")).unwrap();
    read_frames(&folder.join("label_2"), &folder.join("detections"), &ids).unwrap()
}

#[track_caller]
fn same(what: &str, got: Option<f64>, want: &Value) {
    let near = match (got, want.as_f64()) {
        (Some(got), Some(want)) => (got - want).abs() <= TOLERANCE,
        (None, None) => true,
        _ => false,
    };
    assert!(near, "{what}: {got:?} instead of {want}");
}

fn find<'a>(report: &'a EvalReport, class: &str, metric: Metric, overlap: f64, difficulty: Difficulty) -> &'a Row {
    report.row(class, metric, overlap, difficulty).unwrap_or_else(|| panic!("no row {class} {metric} {overlap}"))
}

fn triple(counts: &Counts) -> [i64; 3] {
    [counts.tp, counts.fp, counts.fn_]
}

/// Compares all values of one set; returns the number of curves.
fn check(name: &str, folder: &Path, expected: &Value) -> usize {
    let frames = frames(folder);
    let kitti = expected["kitti"].as_object().unwrap();
    let options = EvalOptions { classes: kitti.keys().cloned().collect(), ..EvalOptions::default() };
    let report = evaluate(&frames, &options);

    for (class, sets) in kitti {
        for (set, metrics) in sets.as_object().unwrap() {
            for (metric_name, metric) in METRICS {
                let want = &metrics[metric_name];
                let overlap =
                    metrics[if metric == Metric::Aos { "bbox" } else { metric_name }]["min_overlap"].as_f64().unwrap();
                for (i, (difficulty_name, difficulty)) in DIFFICULTIES.into_iter().enumerate() {
                    let what = format!("{name} {class} {set} {metric_name} {difficulty_name}");
                    let row = find(&report, class, metric, overlap, difficulty);
                    if want.is_null() {
                        assert!(row.ap40.is_none() && row.note.is_some(), "{what}: {row:?}");
                        continue;
                    }
                    same(&format!("{what} ap11"), row.ap11, &want["ap11"][i]);
                    same(&format!("{what} ap40"), row.ap40, &want["ap40"][i]);
                    assert!(row.ap11.is_some() || row.note.is_some(), "{what}: an undefined number needs a note");
                    if metric != Metric::Aos {
                        same(&format!("{what} area"), row.ap_area, &want["exact_area"][i]);
                        assert_eq!(row.n_gt, want["n_gt"][i].as_i64().unwrap(), "{what}");
                        let all = &want["no_score_limit"][i];
                        let all = ["tp", "fp", "fn"].map(|key| all[key].as_i64().unwrap());
                        assert_eq!([row.n_tp, row.n_fp, row.n_fn], all, "{what}");
                    }
                }
            }
            check_plain(name, class, set, &report, expected);
        }
    }
    let curves = expected["curves"].as_array().unwrap();
    for want in curves {
        check_curve(name, &report, kitti, want);
    }
    check_recall(name, &frames, expected);
    curves.len()
}

fn check_curve(name: &str, report: &EvalReport, kitti: &serde_json::Map<String, Value>, want: &Value) {
    let text = |key: &str| want[key].as_str().unwrap();
    let metric = METRICS.iter().find(|(name, _)| *name == text("metric")).unwrap().1;
    let difficulty = DIFFICULTIES.iter().find(|(name, _)| *name == text("difficulty")).unwrap().1;
    let overlap = kitti[text("class")][text("overlaps")][text("metric")]["min_overlap"].as_f64().unwrap();
    let what = format!("{name} {} {} {} {}", text("class"), text("overlaps"), text("metric"), text("difficulty"));
    let row = find(report, text("class"), metric, overlap, difficulty);
    assert_eq!(row.n_gt, want["n_gt"].as_i64().unwrap(), "{what}");
    let thresholds: Vec<f64> = want["thresholds"].as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    assert_eq!(row.curve.thresholds, thresholds, "{what}");
    for (i, counts) in want["tp_fp_fn"].as_array().unwrap().iter().enumerate() {
        let counts: Vec<i64> = counts.as_array().unwrap().iter().map(|v| v.as_i64().unwrap()).collect();
        assert_eq!(triple(&row.curve.counts[i])[..], counts, "{what}, score limit {i}");
        let recall = row.curve.counts[i].tp as f64 / row.n_gt as f64;
        same(&format!("{what} recall {i}"), Some(recall).filter(|v| v.is_finite()), &want["recall"][i]);
    }
    let defined = |v: f64| Some(v).filter(|v| !v.is_nan());
    for (i, precision) in want["precision"].as_array().unwrap().iter().enumerate() {
        same(&format!("{what} precision {i}"), defined(row.curve.precision[i]), precision);
    }
    if let Some(similarity) = want["aos"].as_array() {
        let row = find(report, text("class"), Metric::Aos, overlap, difficulty);
        for (i, similarity) in similarity.iter().enumerate() {
            same(&format!("{what} aos {i}"), defined(row.curve.precision[i]), similarity);
        }
    }
}

/// Difficulty `all` is KITTI's matching without filters. On these sets it agrees with the plain definition (COCO's),
/// in which a detection takes the best free ground truth and equal scores are grouped.
fn check_plain(name: &str, class: &str, set: &str, report: &EvalReport, expected: &Value) {
    for (metric_name, metric) in METRICS {
        let want = &expected["plain"][class][set][metric_name];
        if want.is_null() {
            continue;
        }
        let overlap = expected["kitti"][class][set][metric_name]["min_overlap"].as_f64().unwrap();
        let row = find(report, class, metric, overlap, Difficulty::All);
        let coco = &want["coco"];
        let counts = ["n_gt", "tp", "fp", "fn"].map(|key| coco[key].as_i64().unwrap());
        let what = format!("{name} {class} {set} {metric_name} all");
        assert_eq!([row.n_gt, row.n_tp, row.n_fp, row.n_fn], counts, "{what}");
        same(&what, row.ap_area, &coco["ap_ties_grouped"]);
    }
}

fn check_recall(name: &str, frames: &[EvalFrame], expected: &Value) {
    let want = &expected["recall"]["exact_f64"];
    if want.is_null() {
        return;
    }
    let classes = ["Car", "Pedestrian", "Cyclist"].map(String::from).to_vec();
    let report = evaluate(frames, &EvalOptions { classes, ..EvalOptions::default() });
    let mut compared = 0;
    for recall in report.recall.iter().filter(|r| r.definition == RecallDefinition::AnyBox) {
        let at = &want["rcnn"][recall.overlap.to_string()];
        assert_eq!(recall.n_gt, want["n_gt"].as_i64().unwrap(), "{name}");
        assert_eq!(recall.hits, at["count"].as_i64().unwrap(), "{name} {}", recall.overlap);
        same(name, recall.recall, &at["recall"]);
        compared += 1;
    }
    assert_eq!(compared, 3);
}

#[test]
fn small() {
    assert_eq!(check("small", &golden().join("small"), &json(&golden().join("small/expected.json"))), 54);
}

#[test]
fn single() {
    check("single", &golden().join("single"), &json(&golden().join("single/expected.json")));
}

#[test]
fn edge_cases() {
    let expected = json(&golden().join("edge/expected.json"));
    let cases = expected["cases"].as_object().unwrap();
    assert_eq!(cases.len(), 32);
    for (name, case) in cases {
        check(name, &golden().join("edge").join(name), case);
    }
}

/// Real labels, which may not be redistributed in the repository.
#[test]
fn kitti_real() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../../shared/golden/evaluation/kitti_real");
    if !folder.is_dir() {
        return eprintln!("skipped: {} is not there", folder.display());
    }
    check("kitti_real", &folder, &json(&folder.join("expected.json")));
}

/// Recall of unfiltered proposals: the same definition on other boxes.
#[test]
fn recall_of_proposals() {
    let folder = golden().join("single");
    let ids = read_ids(&folder.join("ImageSets/val.txt")).unwrap();
    let frames = read_frames(&folder.join("label_2"), &folder.join("rois"), &ids).unwrap();
    let report = evaluate(&frames, &EvalOptions::default());
    let want = &json(&folder.join("expected.json"))["recall"]["exact_f64"];
    for recall in report.recall.iter().filter(|r| r.definition == RecallDefinition::AnyBox) {
        assert_eq!(recall.hits, want["roi"][recall.overlap.to_string()]["count"].as_i64().unwrap());
    }
}

/// A range limit gives the same result as the range bins of the reference.
#[test]
fn range_limit() {
    let folder = golden().join("single");
    let frames = frames(&folder);
    let bins = &json(&folder.join("expected.json"))["range_bins"]["bins"];
    let mut compared = 0;
    for bin in bins.as_array().unwrap().iter().filter(|bin| bin["range_m"][0] == 0.0) {
        let options = EvalOptions { max_range_m: bin["range_m"][1].as_f64(), ..EvalOptions::default() };
        let report = evaluate(&frames, &options);
        let metric = METRICS.iter().find(|(name, _)| bin["metric"] == *name).unwrap().1;
        let row = find(&report, "Car", metric, bin["min_overlap"].as_f64().unwrap(), Difficulty::Moderate);
        assert_eq!(row.n_gt, bin["n_gt"].as_i64().unwrap());
        same("ap11", row.ap11, &bin["ap11"]);
        same("ap40", row.ap40, &bin["ap40"]);
        same("area", row.ap_area, &bin["area"]);
        let all = ["tp", "fp", "fn"].map(|key| bin["all"][key].as_i64().unwrap());
        assert_eq!([row.n_tp, row.n_fp, row.n_fn], all);
        compared += 1;
    }
    assert_eq!(compared, 4);
}

/// Race car boxes are not tilted between the frames, so their AP is the same in the LiDAR frame.
#[test]
fn lidar_frame() {
    let folder = golden().join("single");
    let camera = frames(&folder);
    let mut lidar = camera.clone();
    for line in lidar.iter_mut().flat_map(|f| f.labels.iter_mut().chain(&mut f.detections)) {
        let ([x, y, z], h) = (line.location, line.size_hwl[0]);
        line.location = [z, -x, -y + h / 2.0];
        line.rotation_y = -line.rotation_y - std::f64::consts::FRAC_PI_2;
    }
    let a = evaluate(&camera, &EvalOptions::default());
    let b = evaluate(&lidar, &EvalOptions { label_frame: LabelFrame::Lidar, ..EvalOptions::default() });
    assert_eq!(a.rows.len(), b.rows.len());
    for (a, b) in a.rows.iter().zip(&b.rows) {
        assert_eq!((a.n_gt, a.n_tp, a.n_fp, a.ap40, a.ap_area), (b.n_gt, b.n_tp, b.n_fp, b.ap40, b.ap_area));
    }
}

#[test]
fn the_same_with_any_number_of_threads() {
    let frames = frames(&golden().join("small"));
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let report = pool.install(|| evaluate(&frames, &EvalOptions::default()));
        (serde_json::to_string(&report).unwrap(), report.to_string())
    };
    assert_eq!(with(1), with(4));
}

#[test]
fn other_classes_and_overlaps() {
    let mut frames = frames(&golden().join("single"));
    for line in frames.iter_mut().flat_map(|f| f.labels.iter_mut().chain(&mut f.detections)) {
        line.class = "RaceCar".into();
    }
    let report = evaluate(&frames, &EvalOptions { more_overlaps: vec![0.6, 0.7], ..EvalOptions::default() });
    let area = |overlap: f64| find(&report, "RaceCar", Metric::Bev, overlap, Difficulty::All).ap_area.unwrap();
    assert!(area(0.5) >= area(0.6) && area(0.6) >= area(0.7) && area(0.7) > 50.0);
    let text = report.to_string();
    assert!(text.contains("RaceCar") && text.contains("same image box"), "{text}");
}
