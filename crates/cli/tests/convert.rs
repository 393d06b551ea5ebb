//! `convert`, `completions` and `man` through the program.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use data::Dataset;
use program::{data_set, must, output_text, run};
use std::fs;

#[test]
fn a_data_set_goes_through_all_formats_and_comes_back() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    let source = Dataset::open(dir.path()).unwrap();
    let mut from = ".".to_owned();
    for to in ["pcd", "open_pcdet", "shards", "carla", "kitti", "mcap"] {
        let output = must(dir.path(), &format!("convert {from} --to {to} --out as-{to}"));
        assert!(String::from_utf8(output.stdout).unwrap().starts_with("7 frames, "), "{to}");
        must(dir.path(), &format!("convert {from} --to {to} --out as-{to} --verify"));
        from = format!("as-{to}");
    }
    let made = Dataset::open(&dir.path().join("as-mcap")).unwrap();
    assert_eq!(made.ids("train").unwrap(), source.ids("train").unwrap());
    for id in source.all_ids().unwrap() {
        let (a, b) = (source.load(&id).unwrap(), made.load(&id).unwrap());
        assert_eq!(a.cloud, b.cloud);
        assert!(a.objects.iter().map(|o| (&o.class, o.bbox)).eq(b.objects.iter().map(|o| (&o.class, o.bbox))));
    }
    // Commands read the file with its labels.
    must(dir.path(), "doctor as-mcap");
    for (arguments, wanted) in [
        ("convert . --to pcd --out as-mcap", "in another format"),
        ("convert . --to pcd --out label_2", "label_2"),
        ("convert as-pcd --to pcd --out as-pcd", "as-pcd"),
        ("convert nowhere --to pcd --out made", "nowhere"),
    ] {
        let output = run(dir.path(), arguments);
        let text = output_text(&output);
        assert_eq!(output.status.code(), Some(1), "{arguments}: {text}");
        assert!(text.contains(wanted) && !text.contains("panicked"), "{arguments}: no {wanted:?} in: {text}");
    }
    assert_eq!(run(dir.path(), "convert . --to rrd --out made").status.code(), Some(2));
}

/// The commands that read a data set read shards, and find in them what they find in single files.
#[test]
fn commands_read_shards_as_they_read_files() {
    let dir = tempfile::tempdir().unwrap();
    data_set(dir.path());
    fs::write(dir.path().join("noise.toml"), "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n").unwrap();
    must(dir.path(), "convert . --to shards --shard-frames 3 --out shards");
    let names = ["shard-000000.tar", "shard-000001.tar", "shard-000002.tar", "index.jsonl"];
    for name in names {
        assert!(dir.path().join("shards/shards").join(name).is_file(), "{name}");
    }
    let same = |command: &str, files: &[&str]| {
        for (from, to) in [(".", "of-files"), ("shards", "of-shards")] {
            must(dir.path(), &command.replace("FROM", from).replace("TO", to));
        }
        for file in files {
            let [a, b] = ["of-files", "of-shards"].map(|to| dir.path().join(file.replace("TO", to)));
            assert!(fs::read(&a).unwrap() == fs::read(&b).unwrap(), "{command}: {file}");
        }
    };
    let train = "train --dataset FROM --detector tiny.toml --epochs 2 --out TO/run";
    same(train, &["TO/run/checkpoint/last.safetensors"]);
    let detect = "detect FROM --split val --checkpoint of-files/run/checkpoint/last.safetensors --out TO/found";
    same(detect, &["TO/found/000005.txt"]);
    same("eval ap --dataset FROM --split val --detections of-files/found --json TO/ap.json", &["TO/ap.json"]);
    same("eval targets FROM --split val --out TO/targets", &["TO/targets/tables/targets-aggregated.csv"]);
    same(
        "resim FROM --effects noise.toml --out TO/noisy",
        &["TO/noisy/velodyne/000005.bin", "TO/noisy/label_2/000005.txt"],
    );
    let text = output_text(&must(dir.path(), "eval statistics . shards --split val"));
    assert!(!text.contains("differ"), "{text}");
    must(dir.path(), "doctor shards");
    must(dir.path(), "diagnose --measured . --simulated shards --out diagnosis");
    must(dir.path(), "convert shards --to kitti --out back");
    assert!(
        fs::read(dir.path().join("back/velodyne/000003.bin")).unwrap()
            == fs::read(dir.path().join("velodyne/000003.bin")).unwrap()
    );
    // A byte of a shard, and a shard of an earlier conversion.
    let shard = dir.path().join("shards/shards/shard-000001.tar");
    let whole = fs::read(&shard).unwrap();
    let mut bytes = whole.clone();
    bytes[600] ^= 1;
    fs::write(&shard, bytes).unwrap();
    fs::copy(&shard, shard.with_file_name("shard-000007.tar")).unwrap();
    let output = run(dir.path(), "convert . --to shards --shard-frames 3 --out shards --verify");
    assert_eq!(output.status.code(), Some(1));
    assert!(output_text(&output).contains("shards/shard-000001.tar"), "{}", output_text(&output));
    must(dir.path(), "convert . --to shards --shard-frames 3 --out shards");
    assert!(fs::read(&shard).unwrap() == whole && !shard.with_file_name("shard-000007.tar").exists());
    let output = run(dir.path(), "convert . --to shards --shard-frames 4 --out shards");
    assert!(output_text(&output).contains("in another format"), "{}", output_text(&output));
}

#[test]
fn completions_and_manual_have_every_command() {
    let dir = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let text = String::from_utf8(must(dir.path(), &format!("completions {shell}")).stdout).unwrap();
        assert!(text.contains("diagnose") && text.contains("convert"), "{shell}");
    }
    must(dir.path(), "man --out man");
    let mut pages: Vec<String> =
        fs::read_dir(dir.path().join("man")).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    pages.sort();
    for page in ["lidarshift.1", "lidarshift-convert.1", "lidarshift-eval-ap.1"] {
        assert!(pages.iter().any(|p| p == page), "{page}: {pages:?}");
    }
    let text = fs::read_to_string(dir.path().join("man/lidarshift-convert.1")).unwrap();
    assert!(text.contains("open_pcdet") && text.contains(".TH"), "{text}");
}
