//! The JSON that commands write has the forms that are published in `docs/src/reference/schemas`.

mod forms;
#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use forms::{check_files, check_value};
use program::{data_set, must, run, small_study};
use serde_json::Value;
use std::fs;

#[test]
fn what_commands_write_is_published() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::write(dir.path().join("noise.toml"), "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n").unwrap();
    small_study(dir.path(), "[[effect]]\nkind = \"random_dropout\"\nshare = 0.3\n");
    fs::create_dir(dir.path().join("found")).unwrap();
    for i in 0..7 {
        let text = fs::read_to_string(dir.path().join(format!("label_2/{i:06}.txt"))).unwrap();
        let scored: String = text.lines().map(|line| format!("{line} 0.9\n")).collect();
        fs::write(dir.path().join(format!("found/{i:06}.txt")), scored).unwrap();
    }
    let weights = "--checkpoint run/checkpoint/last.safetensors";
    for (i, arguments) in [
        "train --dataset . --detector tiny.toml --epochs 2 --out run",
        &format!("detect velodyne/000001.bin {weights}"),
        &format!("detect . --split val {weights} --out boxes"),
        "export run --to onnx --out onnx",
        "export noise.toml --to carla --out carla",
        "convert . --to pcd --out made/pcd",
        "resim . --effects noise.toml --out made/noisy",
        "simulate --config street --frames 3 --out made/road",
        "eval ap --labels label_2 --label-frame lidar --detections found",
        "eval statistics . .",
        "eval distances . . --frames 1",
        "eval targets .",
        "diagnose --measured . --simulated . --out diagnosis",
        "study study.toml",
        "eval tsne study.toml",
        "study status study.toml",
        "study plan study.toml",
    ]
    .into_iter()
    .enumerate()
    {
        must(dir.path(), &format!("{arguments} --json out-{i}.json"));
    }
    must(dir.path(), "compare . . --split val --out compared --detections ours=found,found");
    run(dir.path(), "doctor . --json doctor.json");
    // The gain of a list of effects alone.
    must(dir.path(), "simulate --config street --frames 8 --out made/street");
    must(dir.path(), "resim made/street --effects noise.toml --out made/street_noisy");
    let pair = "--measured made/street_noisy --simulated made/street";
    must(dir.path(), &format!("diagnose {pair} --verify noise.toml --out verified --json verified.json"));
    // A run that fails: the loss is not finite with this learning rate.
    let study = fs::read_to_string(dir.path().join("study.toml")).unwrap();
    let wild = study.replace("name = \"small\"", "name = \"wild\"").replace("epochs = 1", "epochs = 2");
    let wild = wild.replace("\"tiny.toml\"", "\"tiny.toml\"\nset = { optimization.lr_max = 1e30 }");
    fs::write(dir.path().join("wild.toml"), wild).unwrap();
    assert!(!run(dir.path(), "study wild.toml").status.success());
    let mut found = check_files(dir.path(), &["carla/carla", "carla/sensor", "carla/attributes"]);
    for arguments in ["doctor nowhere", "docter", "resim . --effects tiny.toml --out x"] {
        let stderr = run(dir.path(), &format!("{arguments} --errors json")).stderr;
        let last = String::from_utf8(stderr).unwrap().lines().last().unwrap().to_owned();
        found.insert(check_value(&serde_json::from_str::<Value>(&last).unwrap(), arguments));
    }
    for form in [
        "analyses",
        "comparison",
        "converted-dataset",
        "detection-cell",
        "detections",
        "diagnosis",
        "distances",
        "doctor",
        "error",
        "eval-ap",
        "failed-run",
        "features",
        "frame-record",
        "frozen-cell",
        "matrix",
        "metrics",
        "not-expressed",
        "onnx-detector",
        "provenance",
        "resim-dataset",
        "run-features",
        "run-state",
        "set-detections",
        "simulated-dataset",
        "statistics",
        "study-costs",
        "study-origin",
        "study-plan",
        "study-status",
        "targets",
        "verification",
    ] {
        assert!(found.contains(form), "no {form} among {found:?}");
    }
}
