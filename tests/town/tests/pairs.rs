//! Pairs as a whole: the same bytes for any number of threads, nothing of the truth in them, and readable.

use diagnose::Verdict;
use lidarshift_town::{CAUSES, Kind, OFF_CATALOGUE, draw_case, write_case};
use score::{CATALOGUE, CaseSize};
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use trials::diagnosed;

const SMALL: CaseSize = CaseSize { frames: 3, shots: 3_000 };

fn single(cause: &str) -> Kind {
    Kind::Single(CAUSES.iter().position(|c| *c == cause).unwrap())
}

/// All files of a folder by their relative paths.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let (mut open, mut found) = (vec![folder.to_owned()], BTreeMap::new());
    while let Some(next) = open.pop() {
        for entry in fs_err::read_dir(&next).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                open.push(path);
            } else {
                let name = path.strip_prefix(folder).unwrap().to_string_lossy().into_owned();
                found.insert(name, fs_err::read(&path).unwrap());
            }
        }
    }
    found
}

#[test]
fn the_bytes_depend_on_the_seed_alone() {
    let write = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let truth = pool.install(|| write_case(&draw_case(seed, Kind::Swarm(6), SMALL), folder.path()).unwrap());
        (files(folder.path()), serde_json::to_string(&truth).unwrap())
    };
    let (one, two, other) = (write(1, 5), write(3, 5), write(1, 6));
    assert_eq!(one.0.len(), 2 * (3 + 3 + 1) + 1, "{:?}", one.0.keys());
    assert!(one == two && one.0["sensor.toml"] != other.0["sensor.toml"]);
}

#[test]
fn nothing_of_the_truth_is_in_the_data() {
    let folder = tempfile::tempdir().unwrap();
    let truth = write_case(&draw_case(7, Kind::Swarm(8), SMALL), folder.path()).unwrap();
    assert_eq!(truth.hidden.len(), 8);
    for (name, bytes) in files(folder.path()) {
        for hidden in &truth.hidden {
            assert!(!name.contains(&hidden.cause), "{name}");
            let found = bytes.windows(hidden.cause.len()).any(|w| w == hidden.cause.as_bytes());
            assert!(!found, "{} in {name}", hidden.cause);
        }
    }
}

#[test]
fn no_point_is_the_same_on_both_sides() {
    for seed in 1..4 {
        let folder = tempfile::tempdir().unwrap();
        write_case(&draw_case(seed, Kind::Null, SMALL), folder.path()).unwrap();
        let files = files(folder.path());
        let channels = if String::from_utf8_lossy(&files["measured/dataset.toml"]).contains("xyzi") { 16 } else { 12 };
        let points = |side: &str| -> BTreeSet<Vec<u8>> {
            let of_side = files.iter().filter(|(name, _)| name.starts_with(side) && name.ends_with(".bin"));
            of_side.flat_map(|(_, bytes)| bytes.chunks_exact(channels).map(|p| p[..12].to_vec())).collect()
        };
        let (measured, simulated) = (points("measured"), points("simulated"));
        assert!(measured.len() > 2_000 && measured.intersection(&simulated).count() == 0, "{seed}: {}", measured.len());
    }
}

#[test]
fn the_catalogue_is_that_of_the_diagnosis() {
    let names: Vec<&str> = diagnose::Cause::ALL.iter().map(|c| c.name()).filter(|n| *n != "unexplained").collect();
    assert_eq!(names, CATALOGUE);
    let known: BTreeSet<&str> = sensor::Effect::CATALOGUE.iter().map(|(kind, _)| *kind).collect();
    for cause in CAUSES {
        assert!(CATALOGUE.contains(&cause) || known.contains(cause), "{cause}");
    }
    assert!(OFF_CATALOGUE.iter().all(|cause| !CATALOGUE.contains(cause)));
}

#[test]
fn a_pair_can_be_diagnosed() {
    let folder = tempfile::tempdir().unwrap();
    let size = CaseSize { frames: 16, shots: 10_000 };
    let case = draw_case(11, single("range_bias"), size);
    let truth = write_case(&case, folder.path()).unwrap();
    let found = diagnosed(folder.path(), "simulated").unwrap();
    let outcome = score::score(&truth, &serde_json::to_value(&found.diagnosis).unwrap(), 0.0);
    assert!(outcome.verdict != "not_scenario_identical", "{:?}", found.diagnosis.notes);
    assert_ne!(found.diagnosis.verdict, Verdict::TooFewFrames);
}
