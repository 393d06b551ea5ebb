//! Training and detection on every device that this build has and this machine offers; `crates/checks/tests/devices.rs` compares the
//! reference numbers on them.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, run, said};
use std::path::Path;

/// Devices that answer; of the others, why not. `folder` has a data set.
fn present(folder: &Path) -> Vec<&'static str> {
    let mut found = Vec::new();
    for device in ["flex", "ndarray", "wgpu", "cuda"] {
        let words =
            format!("train --dataset . --detector tiny.toml --epochs 1 --device {device} --out present-{device}");
        let output = run(folder, &words);
        let text = said(&output);
        if output.status.success() {
            found.push(device);
        } else {
            let absent = ["was built without the feature", "no adapter"].iter().any(|reason| text.contains(reason));
            assert!(absent, "{device}: {text}");
            eprintln!("not tested: {}", text.trim());
        }
    }
    found
}

#[test]
fn training_and_detection() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let devices = present(dir.path());
    assert!(devices.starts_with(&["flex", "ndarray"]), "{devices:?}");
    for detector in ["tiny", "tiny_pointrcnn"] {
        let mut losses = Vec::new();
        for device in &devices {
            let out = format!("{detector}-{device}");
            let words =
                format!("train --dataset . --detector {detector}.toml --epochs 1 --device {device} --out {out}");
            must(dir.path(), &format!("{words} --set run.log_every_steps=1"));
            let metrics = std::fs::read_to_string(dir.path().join(&out).join("metrics.jsonl")).unwrap();
            let first: serde_json::Value = serde_json::from_str(metrics.lines().next().unwrap()).unwrap();
            losses.push((device, first["loss"].as_f64().unwrap()));
            let checkpoint = format!("{out}/checkpoint/last.safetensors");
            must(dir.path(), &format!("detect velodyne/000005.bin --checkpoint {checkpoint} --device {device}"));
        }
        let (_, first) = losses[0];
        for (device, loss) in losses {
            assert!(
                (loss / first - 1.0).abs() < 1e-4,
                "{detector}: the first loss on {device} is {loss}, on flex {first}"
            );
        }
    }
}

/// Half precision keeps the losses of a training within a few hundredths where a device computes in it, and is refused elsewhere.
#[test]
fn half_precision() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let refused = run(dir.path(), "train --dataset . --detector tiny.toml --epochs 1 --precision f16 --out refused");
    assert_eq!(refused.status.code(), Some(1));
    assert!(said(&refused).contains("--precision f16 is for GPUs"), "{}", said(&refused));
    for detector in ["tiny", "tiny_pointrcnn"] {
        let mut losses = Vec::new();
        for precision in ["f16", "f32"] {
            let out = format!("{detector}-{precision}");
            let words = format!("train --dataset . --detector {detector}.toml --epochs 1 --device wgpu --out {out}");
            let output = run(dir.path(), &format!("{words} --precision {precision} --set run.log_every_steps=1"));
            let text = said(&output);
            let absent = ["was built without the feature", "no adapter", "does not compute in half precision"];
            if absent.iter().any(|reason| text.contains(reason)) {
                eprintln!("not tested: {}", text.trim());
                return;
            }
            assert!(output.status.success(), "{text}");
            let metrics = std::fs::read_to_string(dir.path().join(&out).join("metrics.jsonl")).unwrap();
            let lines = metrics.lines().map(|line| serde_json::from_str::<serde_json::Value>(line).unwrap());
            losses.push(lines.filter_map(|line| line["loss"].as_f64()).collect::<Vec<_>>());
        }
        eprintln!("{detector}, losses step by step, f16 and f32: {losses:?}");
        let (half, single) = (&losses[0], &losses[1]);
        assert!(half.len() == single.len() && half != single);
        // The regions of the second stage are chosen by scores: a few are others in half precision.
        for (half, single) in half.iter().zip(single) {
            assert!((half / single - 1.0).abs() < 0.05, "{detector}: {half} in half precision, {single} in single");
        }
    }
}
