//! What is there is taken only if it is what was written: frames, their sources, training data, weights, moved studies.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{data_set, must, output_text, run, small_study};
use std::fs;
use std::path::Path;

const STREET: &str = "[frames]\ntrain = 2\nval = 1\ntest = 1\n";

const TRAIN: &str = "train --dataset . --detector tiny.toml --epochs 2 --set run.checkpoint_every_steps=2 --out run";

/// Makes a street of four frames in the folder `street`.
fn street(folder: &Path) {
    fs::write(folder.join("street.toml"), STREET).unwrap();
    must(folder, "simulate --config street.toml --out street");
}

/// Runs the program, which must fail with each text of `wanted`.
fn refused(folder: &Path, arguments: &str, wanted: &[&str]) {
    let output = run(folder, arguments);
    let text = output_text(&output);
    assert_eq!(output.status.code(), Some(1), "{arguments}: {text}");
    for piece in wanted {
        assert!(text.contains(piece), "{arguments}: no {piece:?} in: {text}");
    }
}

fn change_a_byte(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    *bytes.last_mut().unwrap() ^= 1;
    fs::write(path, bytes).unwrap();
}

#[test]
fn damaged_frames_are_made_again() {
    let dir = tempfile::tempdir().unwrap();
    street(dir.path());
    let simulate = "simulate --config street.toml --out street";
    let verify = format!("{simulate} --verify");
    assert!(output_text(&must(dir.path(), &verify)).contains("4 frames are as they were written"));
    let cloud = dir.path().join("street/velodyne/train_000001.bin");
    let bytes = fs::read(&cloud).unwrap();
    for damaged in [vec![], bytes[..bytes.len() / 2].to_vec(), vec![0; bytes.len()]] {
        fs::write(&cloud, damaged).unwrap();
        refused(dir.path(), &verify, &["street", "1 files", "velodyne/train_000001.bin"]);
        must(dir.path(), simulate);
        assert!(fs::read(&cloud).unwrap() == bytes);
        must(dir.path(), &verify);
    }
}

#[test]
fn a_changed_source_is_applied_again() {
    let dir = tempfile::tempdir().unwrap();
    street(dir.path());
    fs::write(dir.path().join("e.toml"), "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n").unwrap();
    let resim = "resim --effects e.toml street --out noisy";
    must(dir.path(), resim);
    let [source, made, other] =
        ["street/velodyne/test_000000.bin", "noisy/velodyne/test_000000.bin", "noisy/velodyne/val_000000.bin"]
            .map(|name| dir.path().join(name));
    let (before, beside) = (fs::read(&made).unwrap(), fs::metadata(&other).unwrap().modified().unwrap());
    let bytes = fs::read(&source).unwrap();
    fs::write(&source, &bytes[..bytes.len() - 1600]).unwrap();
    must(dir.path(), resim);
    assert_eq!(fs::read(&made).unwrap().len(), before.len() - 1600);
    assert_eq!(fs::metadata(&other).unwrap().modified().unwrap(), beside, "other frames are kept");
    must(dir.path(), &format!("{resim} --verify"));
    fs::write(&made, "").unwrap();
    refused(dir.path(), &format!("{resim} --verify"), &["velodyne/test_000000.bin"]);
    fs::write(&source, bytes).unwrap();
    must(dir.path(), resim);
    assert!(fs::read(&made).unwrap() == before);
}

#[test]
fn training_data_that_changed_are_noticed() {
    let changes: [&dyn Fn(&Path); 2] = [&|f| change_a_byte(&f.join("velodyne/000001.bin")), &|f| {
        fs::write(f.join("label_2/000001.txt"), "Car 0 0 0 0 0 0 0 1.5 1.6 3.9 5 0 -1 0\n").unwrap()
    }];
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), TRAIN);
    let resume = format!("{TRAIN} --resume");
    must(dir.path(), &resume);
    for change in changes {
        change(dir.path());
        refused(dir.path(), &resume, &["labels or clouds", "have changed", "--allow-changed-data"]);
    }
    let text = output_text(&must(dir.path(), &format!("{resume} --allow-changed-data")));
    assert!(text.contains("have changed since the last checkpoint"), "{text}");
}

#[test]
fn results_name_the_build() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let printed = String::from_utf8(must(dir.path(), "--version").stdout).unwrap();
    assert_eq!(printed, String::from_utf8(must(dir.path(), "-V").stdout).unwrap());
    let build = printed.trim().strip_prefix("lidarshift ").unwrap();
    let (version, built_from) = build.split_once('+').unwrap();
    assert_eq!(version, env!("CARGO_PKG_VERSION"));
    // A commit, or the hash of the program.
    let digits = built_from.trim_start_matches("program-").trim_end_matches("-dirty");
    assert!(digits.len() == 12 && digits.chars().all(|c| c.is_ascii_hexdigit()), "{built_from}");

    let json = |name: &str| -> serde_json::Value {
        serde_json::from_slice(&fs::read(dir.path().join(name)).unwrap()).unwrap()
    };
    must(dir.path(), "simulate --config street --frames 3 --out street");
    assert_eq!(json("street/manifest.json")["builds"], serde_json::json!([build]));
    must(dir.path(), "diagnose --measured street --simulated street --out diagnosis");
    assert_eq!(json("diagnosis/diagnosis.json")["build"], build);
    let page = fs::read_to_string(dir.path().join("diagnosis/report.html")).unwrap();
    assert!(page.contains(&format!("(lidarshift {build})").replace('+', "&#43;")) || page.contains(build));
    must(dir.path(), TRAIN);
    assert_eq!(json("run/provenance.json")["sessions"][0]["version"], build);
}

#[test]
fn a_run_records_the_features_of_the_program() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), TRAIN);
    let text = fs::read(dir.path().join("run/provenance.json")).unwrap();
    let provenance: serde_json::Value = serde_json::from_slice(&text).unwrap();
    let built = [
        ("wgpu", cfg!(feature = "wgpu")),
        ("vulkan", cfg!(feature = "vulkan")),
        ("cuda", cfg!(feature = "cuda")),
        ("fusion", cfg!(feature = "fusion")),
        ("autotune", cfg!(feature = "autotune")),
    ];
    let built: Vec<&str> = built.into_iter().filter(|(_, is_built)| *is_built).map(|(name, _)| name).collect();
    assert_eq!(provenance["sessions"][0]["features"], serde_json::json!(built));
    for device in ["wgpu", "cuda"] {
        let output = run(dir.path(), &format!("{TRAIN}-{device} --device {device}"));
        let is_absent = output_text(&output).contains(&format!("was built without the feature `{device}`"));
        assert_eq!(is_absent, !built.contains(&device), "{}", output_text(&output));
    }
}

#[test]
fn a_damaged_checkpoint_is_replaced_by_the_one_before_it() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    must(dir.path(), TRAIN);
    let checkpoints = dir.path().join("run/checkpoint");
    let last = checkpoints.join("last.safetensors");
    let whole = fs::read(&last).unwrap();
    let detect = "detect . --split val --out found --checkpoint run/checkpoint/last.safetensors";
    must(dir.path(), detect);
    change_a_byte(&last);
    refused(dir.path(), detect, &["last.safetensors", "was changed after the run wrote it"]);
    for damage in ["weights", "state"] {
        if damage == "state" {
            fs::write(checkpoints.join("state.json"), "").unwrap();
        }
        let text = output_text(&must(dir.path(), &format!("{TRAIN} --resume")));
        assert!(text.contains("goes on from the checkpoint before it"), "{damage}: {text}");
        assert!(fs::read(&last).unwrap() == whole, "{damage}: the run ends with other weights");
        must(dir.path(), detect);
    }
}

#[test]
fn a_study_that_was_moved_is_still_done() {
    let dir = tempfile::tempdir().unwrap();
    let home = dir.path().join("home");
    fs::create_dir(&home).unwrap();
    data_set(&home);
    small_study(&home, "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n");
    must(&home, "study study.toml --out runs/small --only data,train,detect");
    let is_done = |folder: &Path, named: &str| {
        let text = output_text(&must(folder, &format!("study status {named}")));
        assert!(text.contains("2 runs, each tested on 2 data sets: 2 done"), "{named}: {text}");
    };
    is_done(&home, "runs/small");
    is_done(&home.join("runs"), "../runs/small");
    #[cfg(unix)]
    {
        std::os::unix::fs::symlink(home.join("runs"), dir.path().join("link")).unwrap();
        is_done(dir.path(), "link/small");
    }
    fs::rename(home.join("runs/small"), dir.path().join("moved")).unwrap();
    is_done(dir.path(), "moved");
    // Nothing is trained again, and nothing is lost.
    let weights = dir.path().join("moved/tiny/changed/seed-1/checkpoint/last.safetensors");
    let written = fs::metadata(&weights).unwrap().modified().unwrap();
    must(dir.path(), "study moved --only data,train,detect");
    assert_eq!(fs::metadata(&weights).unwrap().modified().unwrap(), written);
}
