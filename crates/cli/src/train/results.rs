//! Results of a finished run: the AP table, detections, pictures and the training curve.

use crate::{errln, outln};
use anyhow::Result;
use data::Presence as _;
use data::write::write_kitti_text;
use data::{Dataset, write_atomic, write_json};
use eval::{Difficulty, Metric};
use report::{BirdsEyeOptions, CurveOptions, Series, Style, birds_eye_png, curve_svg};
use std::path::Path;
use train::Evaluation;

/// Number of frames for which a picture is written.
const PICTURES: usize = 3;

/// Prints the 3D AP for difficulty "all"; the whole table is in `eval.json`.
pub(super) fn show(found: &Evaluation, what: &str) {
    outln!("3D AP in percent, all difficulties, on {what} ({} frames)", found.frames.len());
    outln!("class        overlap  exact area    AP40   n_gt    TP    FP");
    for row in found.report.rows.iter().filter(|r| r.metric == Metric::ThreeD && r.difficulty == Difficulty::All) {
        let percent = |ap: Option<f64>| ap.map_or("undef.".into(), |ap| format!("{ap:.2}"));
        outln!(
            "{:<12} {:>7} {:>11} {:>7} {:>6} {:>5} {:>5}",
            row.class,
            row.overlap,
            percent(row.ap_area),
            percent(row.ap40),
            row.n_gt,
            row.n_tp,
            row.n_fp
        );
    }
}

/// Writes `eval.json`, `detections/` and `pictures/` into the run folder.
pub(super) fn write(found: &Evaluation, set: &Dataset, out: &Path) -> Result<()> {
    write_json(&out.join("eval.json"), &found.report)?;
    for frame in &found.frames {
        write_kitti_text(&out.join(format!("detections/{}.txt", frame.id)), &frame.detections)?;
    }
    let with_objects = found.frames.iter().zip(&found.detections).filter(|(frame, _)| !frame.labels.is_empty());
    for (frame, detections) in with_objects.take(PICTURES) {
        let seen = set.load(&frame.id)?;
        let mut boxes: Vec<_> = seen.objects.iter().map(|o| (o.bbox, Style::GroundTruth)).collect();
        boxes.extend(detections.iter().map(|d| (d.bbox, Style::Detection { score: d.score })));
        match birds_eye_png(&seen.cloud, &boxes, &BirdsEyeOptions::default()) {
            Ok(picture) => write_atomic(&out.join(format!("pictures/{}.png", frame.id)), &picture)?,
            Err(error) => errln!("warning: no picture of frame {}: {error}", frame.id),
        }
    }
    Ok(())
}

/// Writes the training curve and lists the result files of the run. A temporary run folder is not listed.
pub(super) fn write_curve_and_list(out: &Path, keep: bool) -> Result<()> {
    write_atomic(&out.join("curve.svg"), curve(&fs_err::read_to_string(out.join("metrics.jsonl"))?).as_bytes())?;
    if !keep {
        return Ok(());
    }
    outln!("run folder: {}", out.display());
    for (file, what) in [
        ("checkpoint/last.safetensors", "weights, with OpenPCDet's parameter names"),
        ("checkpoint/best.safetensors", "weights with the best AP on the validation split"),
        ("eval.json", "all metrics"),
        ("detections", "detected boxes as KITTI text"),
        ("pictures", "bird's eye views of some frames"),
        ("curve.svg", "loss and AP over the steps"),
    ] {
        if out.join(file).may_exist() {
            outln!("  {file:<28} {what}");
        }
    }
    Ok(())
}

/// Training loss, validation loss and validation AP / 10 over the steps.
fn curve(metrics: &str) -> String {
    let lines: Vec<serde_json::Value> = metrics.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    let series = |name: &str, kind: &str, pointer: &str, factor: f64| {
        let of_kind = lines.iter().filter(|line| line["kind"] == kind);
        let point =
            |line: &serde_json::Value| Some([line["step"].as_f64()?, line.pointer(pointer)?.as_f64()? * factor]);
        Series { name: name.into(), points: of_kind.filter_map(point).collect() }
    };
    let all = [
        series("loss of a step", "step", "/loss", 1.0),
        series("loss, validation", "epoch", "/validation/loss", 1.0),
        series("AP / 10, validation", "epoch", "/validation/ap", 0.1),
        series("AP / 10, loose overlaps", "epoch", "/validation/ap_loose", 0.1),
    ];
    let shown: Vec<Series> = all.into_iter().filter(|s| !s.points.is_empty()).collect();
    let options =
        CurveOptions { title: "training".into(), x_label: "step".into(), y_label: String::new(), log_y: false };
    curve_svg(&shown, &options)
}
