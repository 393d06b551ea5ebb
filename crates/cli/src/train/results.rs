//! What a finished run leaves for people: a table, texts, pictures, a curve.

use anyhow::Result;
use data::write::write_kitti_text;
use data::{Dataset, write_atomic, write_json};
use eval::{Difficulty, Metric};
use report::{BirdsEyeOptions, CurveOptions, Series, Style, birds_eye_png, curve_svg};
use std::path::Path;
use train::Evaluation;

/// Frames that are drawn.
const PICTURES: usize = 3;

/// The lines in space without a filter for difficulty; the whole table is in `eval.json`.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub(super) fn show(found: &Evaluation, what: &str) -> Result<()> {
    println!("AP in percent, 3d, all difficulties, on {what} ({} frames)", found.frames.len());
    println!("class        overlap  exact area    AP40   n_gt    TP    FP");
    for row in found.report.rows.iter().filter(|r| r.metric == Metric::ThreeD && r.difficulty == Difficulty::All) {
        let percent = |ap: Option<f64>| ap.map_or("undef.".into(), |ap| format!("{ap:.2}"));
        println!(
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
    Ok(())
}

/// `eval.json`, `detections/`, `pictures/` and `curve.svg` in the run folder.
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
        let picture = birds_eye_png(&seen.cloud, &boxes, &BirdsEyeOptions::default())?;
        write_atomic(&out.join(format!("pictures/{}.png", frame.id)), &picture)?;
    }
    Ok(())
}

/// The training curve, and the files of the run that are worth a look.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub(super) fn say_where(out: &Path, stays: bool) -> Result<()> {
    write_atomic(&out.join("curve.svg"), curve(&fs_err::read_to_string(out.join("metrics.jsonl"))?).as_bytes())?;
    if !stays {
        return Ok(());
    }
    println!("run folder: {}", out.display());
    for (file, what) in [
        ("checkpoint/last.safetensors", "the weights, under OpenPCDet's names"),
        ("checkpoint/best.safetensors", "the weights with the best AP on the validation split"),
        ("eval.json", "all numbers"),
        ("detections", "the boxes, as KITTI text"),
        ("pictures", "some frames from above"),
        ("curve.svg", "loss and AP over the steps"),
    ] {
        if out.join(file).exists() {
            println!("  {file:<28} {what}");
        }
    }
    Ok(())
}

/// Loss of the steps and of the validation, and its AP in tenths, over the steps.
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
