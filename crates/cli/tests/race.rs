//! Simulation of a race through the program: the same bytes with any number of threads and after a kill; errors of
//! invalid input.

mod forms;
#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{must, output_text, program, run};
use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

/// A race of 18 frames with a reduced resolution.
const RACE: &str = r#"
name = "tiny"
seed = 4
rig = "rig.toml"
resolution = 0.08
label_points = 1
frames = 18
race = { frames = 4000 }
[[dataset]]
name = "measured"
effects = "measured.toml"
hidden = true
auto_label = {}
[[dataset]]
name = "sim"
effects = "sim.toml"
[[dataset]]
name = "sim_noise"
from = "sim"
effects = "sim_noise.toml"
"#;

fn race(folder: &Path) {
    let configs = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs");
    for name in ["measured", "sim", "sim_noise"] {
        fs::copy(configs.join(format!("simulate/{name}.toml")), folder.join(format!("{name}.toml"))).unwrap();
    }
    fs::copy(configs.join("sensors/av21.toml"), folder.join("rig.toml")).unwrap();
    fs::write(folder.join("race.toml"), RACE).unwrap();
}

/// Path and content of every file below a folder.
fn content(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut open = vec![folder.to_path_buf()];
    while let Some(next) = open.pop() {
        for entry in fs::read_dir(next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_str().unwrap().to_string();
                files.insert(name, fs::read(&path).unwrap());
            }
        }
    }
    files
}

#[test]
fn threads_and_kills_change_no_byte() {
    let dir = tempfile::tempdir().unwrap();
    race(dir.path());
    must(dir.path(), "simulate --config race.toml --out whole");
    let whole = content(&dir.path().join("whole"));
    let clouds = |set: &str| whole.keys().filter(|name| name.starts_with(&format!("{set}/velodyne/"))).count();
    assert_eq!(["measured", "sim", "sim_noise"].map(clouds), [18; 3]);

    let arguments = "simulate --config race.toml --out killed";
    let mut kills = 0;
    for frames in [1, 14, 30] {
        let mut child = program(dir.path(), arguments)
            .env("RAYON_NUM_THREADS", "1")
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        let there = || {
            let folder =
                |set: &str| fs::read_dir(dir.path().join(format!("killed/{set}/velodyne"))).map_or(0, Iterator::count);
            ["measured", "sim", "sim_noise"].map(folder).iter().sum::<usize>()
        };
        while there() < frames && child.try_wait().unwrap().is_none() {
            std::thread::sleep(Duration::from_millis(1));
        }
        kills += u32::from(child.try_wait().unwrap().is_none());
        child.kill().unwrap();
        child.wait().unwrap();
    }
    assert!(kills >= 2, "only {kills} runs were killed before their end");
    must(dir.path(), arguments);
    let killed = content(&dir.path().join("killed"));
    assert_eq!(whole.keys().collect::<Vec<_>>(), killed.keys().collect::<Vec<_>>());
    let other: Vec<_> = whole.iter().filter(|(name, bytes)| killed[*name] != **bytes).map(|(name, _)| name).collect();
    assert!(other.is_empty(), "{other:?} differ");

    must(dir.path(), arguments);
    assert!(content(&dir.path().join("killed")) == killed, "a run without missing frames changes files");
}

#[test]
fn pairs_are_compared_and_effects_applied_to_an_existing_data_set() {
    let dir = tempfile::tempdir().unwrap();
    race(dir.path());
    must(dir.path(), "simulate --config race.toml --out race --dataset measured,sim --json race/made.json");
    let found = forms::check_files(&dir.path().join("race"), &[]);
    assert!(["race-dataset", "race-manifests"].iter().all(|form| found.contains(*form)), "{found:?}");
    let table = output_text(&must(dir.path(), "eval statistics race/measured race/sim --json table.json"));
    assert!(table.contains("points a cloud, mean") && dir.path().join("table.json").is_file(), "{table}");

    must(dir.path(), "resim --effects sim_noise.toml race/sim --out noisy");
    let (before, after) = (content(&dir.path().join("race/sim")), content(&dir.path().join("noisy")));
    let cloud = before.keys().find(|name| name.starts_with("velodyne/")).unwrap();
    assert!(before[cloud].len() == after[cloud].len() && before[cloud] != after[cloud]);
    let label = before.keys().find(|name| name.starts_with("label_2/")).unwrap();
    assert_eq!(before[label], after[label]);
}

#[test]
fn bad_input_is_named_by_file_and_line() {
    let dir = tempfile::tempdir().unwrap();
    race(dir.path());
    let edited = |name: &str, from: &str, to: &str| {
        let text = fs::read_to_string(dir.path().join(name)).unwrap();
        assert!(text.contains(from), "{name} has no {from}");
        text.replacen(from, to, 1)
    };
    let cases = [
        (
            "race.toml",
            edited("race.toml", "frames = 18", "frames = 18\nfrmaes = 18"),
            "race.toml:8: unknown field `frmaes`",
        ),
        ("race.toml", edited("race.toml", "rig.toml", "rigg.toml"), "rigg.toml"),
        ("race.toml", edited("race.toml", "race = { frames = 4000 }", "[[run]]\nego = \"ego.csv\"\n"), "ego.csv"),
        ("sim_noise.toml", edited("sim_noise.toml", "std_m = 0.02", "std_m = -0.02"), "sim_noise.toml:"),
        ("sim.toml", edited("sim.toml", "missing_objects", "missing_things"), "sim.toml:"),
        ("rig.toml", "".into(), "rig.toml"),
    ];
    for (i, (name, text, want)) in cases.into_iter().enumerate() {
        race(dir.path());
        fs::write(dir.path().join(name), text).unwrap();
        let output = run(dir.path(), &format!("simulate --config race.toml --out out{i}"));
        let said = output_text(&output);
        assert!(!output.status.success() && said.contains(want) && !said.contains("panicked"), "{want}: {said}");
    }
    race(dir.path());
    must(dir.path(), "simulate --config race.toml --out race --dataset sim");
    let other = run(dir.path(), "simulate --config race.toml --out race --dataset sim --seed 5");
    assert!(
        !other.status.success() && output_text(&other).contains("another configuration"),
        "{}",
        output_text(&other)
    );
}
