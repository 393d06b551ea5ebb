//! `--json -`: the JSON of a result alone on stdout, and the same as in a file.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, output_text, run, small_study};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

/// Stdout of a command with `--json -`, which has to be one JSON document; the text has to be on stderr.
fn of_stdout(folder: &Path, arguments: &str, text: &str) -> Value {
    let output = must(folder, &format!("{arguments} --json -"));
    let stdout = String::from_utf8(output.stdout).unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(stderr.contains(text), "{arguments}: no {text:?} in {stderr}");
    serde_json::from_str(&stdout).unwrap_or_else(|e| panic!("{arguments}: {e}: {stdout}"))
}

/// The same as in a file, with the text on stdout; `out` is a folder that both write.
fn same_as_file(folder: &Path, arguments: &str, text: &str, out: Option<&str>) -> Value {
    let found = of_stdout(folder, arguments, text);
    if let Some(out) = out {
        fs::remove_dir_all(folder.join(out)).unwrap();
    }
    let output = must(folder, &format!("{arguments} --json file.json"));
    assert!(String::from_utf8_lossy(&output.stdout).contains(text), "{arguments}");
    let of_file: Value = serde_json::from_slice(&fs::read(folder.join("file.json")).unwrap()).unwrap();
    assert_eq!(found, of_file, "{arguments}");
    found
}

#[test]
fn commands_on_data_sets() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let write = |path: &str, text: &str| fs::write(dir.path().join(path), text).unwrap();
    write("noise.toml", "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n");
    fs::create_dir(dir.path().join("found")).unwrap();
    for i in 0..7 {
        let text = fs::read_to_string(dir.path().join(format!("label_2/{i:06}.txt"))).unwrap();
        let scored: String = text.lines().map(|line| format!("{line} 0.9\n")).collect();
        write(&format!("found/{i:06}.txt"), &scored);
    }
    for (arguments, text, out, schema) in [
        ("eval ap --labels label_2 --label-frame lidar --detections found", "Car", None, eval::SCHEMA),
        ("eval statistics . .", "", None, "lidarshift.eval_statistics/1"),
        ("eval distances . . --frames 2", "Chamfer", None, "lidarshift.distances/2"),
        ("convert . --to pcd --out made", "7 frames", Some("made"), "lidarshift/converted-dataset/1"),
        ("resim . --effects noise.toml --out noisy", "7 frames", Some("noisy"), "lidarshift/resim-dataset/1"),
        ("export noise.toml --to carla --out carla", "range_noise", Some("carla"), "lidarshift/not-expressed/1"),
        ("compare . . --split val --out compared", "frames)", Some("compared"), "lidarshift/comparison/1"),
    ] {
        let found = same_as_file(dir.path(), arguments, text, out);
        assert_eq!(found["schema"], schema, "{arguments}");
    }
    let road = of_stdout(dir.path(), "simulate --config street --frames 3 --out road", "points per frame");
    let manifest: Value = serde_json::from_slice(&fs::read(dir.path().join("road/manifest.json")).unwrap()).unwrap();
    assert_eq!(road, manifest);
    let targets = of_stdout(dir.path(), "eval targets .", "targets");
    assert_eq!(targets[0]["schema"], "lidarshift.targets/1");
    // A check that finds something wrong writes its result as well.
    let output = run(dir.path(), "doctor . --detector pointpillars --json -");
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["schema"], "lidarshift/doctor/1");
    assert_eq!(report["sound"], output.status.success());
    // An error leaves stdout empty.
    let output = run(dir.path(), "doctor nowhere --json -");
    assert!(!output.status.success() && output.stdout.is_empty());
    let output = run(dir.path(), "resim . --effects noise.toml --out noisy --verify --json -");
    assert_eq!(output.status.code(), Some(2), "{}", output_text(&output));
    // Never over an input.
    let output = run(dir.path(), "export noise.toml --to carla --out carla --json noise.toml");
    assert!(output_text(&output).contains("noise.toml: is a file that is read"), "{}", output_text(&output));
}

#[test]
fn a_diagnosis_is_written_once() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let found = of_stdout(dir.path(), "diagnose --measured . --simulated . --out out", "verdict: ");
    let of_file: Value = serde_json::from_slice(&fs::read(dir.path().join("out/diagnosis.json")).unwrap()).unwrap();
    assert_eq!(found, of_file);
}

/// Two streets are refused as a pair, with what to give; given, what cannot be identified is in the result.
#[test]
fn streets_that_are_not_the_same() {
    let dir = tempfile::tempdir().unwrap();
    for (name, seed) in [("real", 1), ("sim", 2)] {
        let made = format!("simulate --config street --frames 8 --seed {seed} --out {name}");
        assert!(run(dir.path(), &made).status.success());
    }
    let output = run(dir.path(), "diagnose --measured real --simulated sim --out pair");
    assert_eq!(output.status.code(), Some(3));
    assert!(output_text(&output).contains("give --unpaired"), "{}", output_text(&output));
    let unpaired = "diagnose --unpaired --measured real --simulated sim --out out";
    let found = of_stdout(dir.path(), unpaired, "these data cannot identify:");
    assert_eq!(found["verdict"], "nothing_found");
    let bias = |n: &Value| n["cause"] == "range_bias" && n["tell_by"].as_str().is_some_and(|by| !by.is_empty());
    assert!(found["not_identifiable"].as_array().unwrap().iter().any(bias), "{found}");
    let page = fs::read_to_string(dir.path().join("out/report.html")).unwrap();
    assert!(page.contains("What these data cannot tell"));
    assert_eq!(run(dir.path(), "diagnose --unpaired --scans real").status.code(), Some(2));
}

#[test]
fn training_detection_and_studies() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let train = "train --dataset . --detector tiny.toml --epochs 1 --out run";
    let ap = of_stdout(dir.path(), train, "run folder: run");
    let of_file: Value = serde_json::from_slice(&fs::read(dir.path().join("run/eval.json")).unwrap()).unwrap();
    assert_eq!(ap, of_file);
    let weights = "--checkpoint run/checkpoint/last.safetensors";
    let cloud = of_stdout(dir.path(), &format!("detect velodyne/000001.bin {weights}"), "boxes");
    assert_eq!((&cloud["schema"], &cloud["frame"]), (&json!("lidarshift/detections/1"), &json!("000001")));
    let set = of_stdout(dir.path(), &format!("detect . --split val {weights} --out found"), "written to found");
    assert_eq!((&set["schema"], &set["split"]), (&json!("lidarshift/set-detections/1"), &json!("val")));
    let frames = set["frames"].as_array().unwrap();
    assert_eq!(frames.iter().map(|f| f["frame"].as_str().unwrap()).collect::<Vec<_>>(), ["000005", "000006"]);
    for frame in frames {
        let path = dir.path().join(format!("found/{}.txt", frame["frame"].as_str().unwrap()));
        let lines = fs::read_to_string(path).unwrap().lines().count();
        assert_eq!(frame["detections"].as_array().unwrap().len(), lines);
    }
    small_study(dir.path(), "[[effect]]\nkind = \"random_dropout\"\nshare = 0.3\n");
    let status = |wanted: &str| {
        let found = of_stdout(dir.path(), "study status study.toml", "runs, each tested on 2 data sets");
        assert_eq!((&found["schema"], &found["study"]), (&json!("lidarshift/study-status/1"), &json!("small")));
        let runs = found["runs"].as_array().unwrap();
        assert!(runs.len() == 2 && runs.iter().all(|run| run["state"] == wanted), "{found}");
    };
    status("missing");
    let output = run(dir.path(), "study study.toml --only data --json -");
    assert!(!output.status.success() && output_text(&output).contains("--json is for the matrix"));
    let matrix = of_stdout(dir.path(), "study study.toml", "report: ");
    assert_eq!(matrix["schema"], "lidarshift.matrix/1");
    assert_eq!(matrix, of_stdout(dir.path(), "eval matrix study.toml", "|"));
    status("done");
    let plan = of_stdout(dir.path(), "study plan study.toml", "Smallest difference");
    assert_eq!(plan["schema"], "lidarshift/study-plan/1");
    assert!(plan["planned"].as_array().unwrap().iter().all(|p| p["detectable"].as_f64().unwrap() > 0.0));
}
