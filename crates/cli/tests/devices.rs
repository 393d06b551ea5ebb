//! Training and detection on every device of this build and this machine. `crates/checks/tests/devices.rs` compares the
//! devices with the reference numbers.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, output_text, run};
use std::path::Path;

/// The devices that can be used; prints the reason for the others. `folder` contains a data set.
fn available_devices(folder: &Path) -> Vec<&'static str> {
    let mut found = Vec::new();
    for device in ["flex", "ndarray", "wgpu", "cuda"] {
        let arguments =
            format!("train --dataset . --detector tiny.toml --epochs 1 --device {device} --out present-{device}");
        let output = run(folder, &arguments);
        let text = output_text(&output);
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
    let devices = available_devices(dir.path());
    assert!(devices.starts_with(&["flex", "ndarray"]), "{devices:?}");
    for detector in ["tiny", "tiny_pointrcnn", "tiny_centerpoint"] {
        let mut losses = Vec::new();
        for device in &devices {
            let out = format!("{detector}-{device}");
            let arguments =
                format!("train --dataset . --detector {detector}.toml --epochs 1 --device {device} --out {out}");
            must(dir.path(), &format!("{arguments} --set run.log_every_steps=1"));
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

/// On devices with half precision, training losses differ by less than 5 % from single precision; other devices reject
/// it.
#[test]
fn half_precision() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let refused = run(dir.path(), "train --dataset . --detector tiny.toml --epochs 1 --precision f16 --out refused");
    assert_eq!(refused.status.code(), Some(1));
    assert!(output_text(&refused).contains("--precision f16 is for GPUs"), "{}", output_text(&refused));
    for detector in ["tiny", "tiny_pointrcnn", "tiny_centerpoint"] {
        let mut losses = Vec::new();
        for precision in ["f16", "f32"] {
            let out = format!("{detector}-{precision}");
            let arguments =
                format!("train --dataset . --detector {detector}.toml --epochs 1 --device wgpu --out {out}");
            let output = run(dir.path(), &format!("{arguments} --precision {precision} --set run.log_every_steps=1"));
            let text = output_text(&output);
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
        // The second stage selects regions by score; half precision changes a few of them.
        for (half, single) in half.iter().zip(single) {
            assert!((half / single - 1.0).abs() < 0.05, "{detector}: {half} in half precision, {single} in single");
        }
    }
}

/// Kernels that a training of each network runs on the device wgpu, by name: rows are gathered in both directions, and
/// nothing is added or scattered row by row.
#[test]
fn a_training_on_a_gpu_gathers_only() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    for detector in ["tiny", "tiny_pointrcnn", "tiny_centerpoint"] {
        let log = format!("{detector}.log");
        let config = format!("[profiling.logger]\nlevel = \"minimal\"\nfile = \"{log}\"\n");
        std::fs::write(dir.path().join("cubecl.toml"), config).unwrap();
        let output = run(
            dir.path(),
            &format!("train --dataset . --detector {detector}.toml --epochs 2 --device wgpu --out {detector}"),
        );
        let text = output_text(&output);
        if ["was built without the feature", "no adapter"].iter().any(|reason| text.contains(reason)) {
            eprintln!("not tested: {}", text.trim());
            return;
        }
        assert!(output.status.success(), "{text}");
        let kernels = std::fs::read_to_string(dir.path().join(&log)).unwrap();
        let count = |name: &str| kernels.lines().filter(|line| line.contains(name)).count();
        let gathers = count("SelectKernel_") + count("Place_");
        assert!(gathers > 10, "{detector}: the log has no gathers");
        for kernel in ["SelectAssign", "Scatter"] {
            assert_eq!(count(kernel), 0, "{detector}: {kernel}");
        }
        eprintln!("{detector}: {} kernels", kernels.lines().count());
    }
}
