//! The same small suite on every device that this build has and this machine offers: reference numbers, training, detection.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, run, said};
use std::path::Path;

/// Devices that answer; of the others, why not.
fn present() -> Vec<&'static str> {
    let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/synthetic/pointpillars_tiny");
    let mut found = Vec::new();
    for device in ["flex", "ndarray", "wgpu", "cuda"] {
        let output = run(&golden, &format!("parity . --device {device}"));
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
fn reference_numbers_training_and_detection() {
    let devices = present();
    assert!(devices.starts_with(&["flex", "ndarray"]), "{devices:?}");
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let mut losses = Vec::new();
    for device in devices {
        let words = format!("train --dataset . --detector tiny.toml --epochs 1 --device {device} --out {device}");
        must(dir.path(), &format!("{words} --set run.log_every_steps=1"));
        let metrics = std::fs::read_to_string(dir.path().join(device).join("metrics.jsonl")).unwrap();
        let first: serde_json::Value = serde_json::from_str(metrics.lines().next().unwrap()).unwrap();
        losses.push((device, first["loss"].as_f64().unwrap()));
        let checkpoint = format!("{device}/checkpoint/last.safetensors");
        must(dir.path(), &format!("detect velodyne/000005.bin --checkpoint {checkpoint} --device {device}"));
    }
    let (_, first) = losses[0];
    for (device, loss) in losses {
        assert!((loss / first - 1.0).abs() < 1e-4, "the first loss on {device} is {loss}, on flex {first}");
    }
}
