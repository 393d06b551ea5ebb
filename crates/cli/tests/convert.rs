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
    for to in ["pcd", "open_pcdet", "carla", "kitti", "mcap"] {
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
