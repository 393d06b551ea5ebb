//! Pairs that cannot be diagnosed as they are: the diagnosis must state what cannot be determined or return an error
//! with advice, and never panic.

use data::Dataset;
use diagnose::{Diagnosis, Options, Rig, Verdict, diagnose};
use lidarshift_blind::{Kind, draw_case, write_case};
use score::CaseSize;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// A pair without hidden effects.
struct Pair(TempDir);

impl Pair {
    fn new(seed: u64, frames: usize) -> Pair {
        let folder = tempfile::tempdir().unwrap();
        let size = CaseSize { frames, shots: 5_000 };
        write_case(&draw_case(seed, Kind::Null, size), folder.path()).unwrap();
        Pair(folder)
    }

    fn path(&self, of: &str) -> PathBuf {
        self.0.path().join(of)
    }

    /// Files of a folder, sorted by name.
    fn files(&self, of: &str) -> Vec<PathBuf> {
        let mut files: Vec<PathBuf> = fs_err::read_dir(self.path(of)).unwrap().map(|e| e.unwrap().path()).collect();
        files.sort();
        files
    }

    fn remove(&self, side: &str, file: &Path) {
        fs_err::remove_file(file).unwrap();
        let name = file.file_stem().unwrap().to_str().unwrap();
        fs_err::remove_file(self.path(side).join(format!("label_2/{name}.txt"))).unwrap();
    }

    /// Changes the points of every cloud of a side.
    fn change(&self, side: &str, change: impl Fn(usize, [f32; 3]) -> Option<[f32; 3]>) {
        for file in self.files(&format!("{side}/velodyne")) {
            let bytes = fs_err::read(&file).unwrap();
            let number = |b: &[u8]| f32::from_le_bytes([b[0], b[1], b[2], b[3]]);
            let points = bytes.chunks_exact(12).map(|b| [number(&b[..4]), number(&b[4..8]), number(&b[8..])]);
            let kept = points.enumerate().filter_map(|(i, p)| change(i, p));
            let out: Vec<u8> = kept.flatten().flat_map(f32::to_le_bytes).collect();
            fs_err::write(&file, out).unwrap();
        }
    }

    fn diagnosis(&self) -> Result<Diagnosis, String> {
        let open = |side: &str| Dataset::open(&self.path(side)).unwrap();
        let rig = Rig::read(&self.path("sensor.toml")).unwrap();
        let found = diagnose(&open("measured"), &open("simulated"), &rig, &Options::default(), &|_, _, _| ());
        let diagnosis = found.map_err(|e| e.to_string())?.diagnosis;
        // The diagnosis survives a JSON round trip: all numbers are finite.
        let text = serde_json::to_string(&diagnosis).unwrap();
        assert!(serde_json::from_str::<Diagnosis>(&text).is_ok(), "{text}");
        Ok(diagnosis)
    }
}

fn notes(d: &Diagnosis) -> String {
    d.notes.join("\n")
}

fn names(d: &Diagnosis) -> Vec<String> {
    d.findings.iter().map(|f| f.cause.map_or_else(|| format!("{:?}", f.candidates), |c| c.to_string())).collect()
}

#[test]
fn unequal_numbers_of_frames_and_empty_clouds_are_left_out_by_name() {
    let pair = Pair::new(1, 14);
    let measured = pair.files("measured/velodyne");
    pair.remove("measured", &measured[3]);
    let simulated = pair.files("simulated/velodyne");
    pair.remove("simulated", &simulated[0]);
    pair.remove("simulated", &simulated[13]);
    fs_err::write(&simulated[7], b"").unwrap();
    let d = pair.diagnosis().unwrap();
    let message = notes(&d);
    for expected in [
        "2 frames are only in the measured data set",
        "1 frames are only in the simulated data set",
        "the simulated cloud has no point",
    ] {
        assert!(message.contains(expected), "{expected}: {message}");
    }
    assert_eq!(d.frames.select.len() + d.frames.estimate.len() + d.frames.hold_out.len(), 10);
}

#[test]
fn a_side_without_a_point_says_nothing() {
    let pair = Pair::new(2, 6);
    pair.change("measured", |_, _| None);
    let d = pair.diagnosis().unwrap();
    assert!(d.findings.is_empty() && notes(&d).contains("the measured cloud has no point"), "{:?}", d.notes);
}

#[test]
fn ids_without_overlap_are_an_error() {
    let pair = Pair::new(3, 5);
    for (i, file) in pair.files("measured/velodyne").iter().enumerate() {
        let name = file.file_stem().unwrap().to_str().unwrap();
        let label = pair.path("measured").join(format!("label_2/{name}.txt"));
        fs_err::rename(&label, label.with_file_name(format!("9{i:05}.txt"))).unwrap();
        fs_err::rename(file, file.with_file_name(format!("9{i:05}.bin"))).unwrap();
    }
    let error = pair.diagnosis().unwrap_err();
    assert!(error.contains("no frame id is in both data sets"), "{error}");
}

#[test]
fn one_frame_is_too_few() {
    let d = Pair::new(4, 1).diagnosis().unwrap();
    assert_eq!(d.verdict, Verdict::TooFewFrames);
    assert!(notes(&d).contains("1 frames can be used; with fewer than 5"), "{:?}", d.notes);
}

#[test]
fn clouds_cut_at_different_ranges_are_reported() {
    let near = |limit: f32| move |_: usize, p: [f32; 3]| (p[0].hypot(p[1]) < limit).then_some(p);
    let pair = Pair::new(5, 20);
    pair.change("simulated", near(25.0));
    let d = pair.diagnosis().unwrap();
    assert!(notes(&d).contains("where the simulation ends"), "{:?}", d.notes);
    let pair = Pair::new(5, 20);
    pair.change("measured", near(25.0));
    let d = pair.diagnosis().unwrap();
    assert_eq!(names(&d), ["range_cut"], "{:?}", d.findings);
}

#[test]
fn points_that_are_no_numbers_are_an_error_that_names_the_file() {
    let pair = Pair::new(6, 5);
    pair.change("measured", |i, p| Some(if i == 40 { [f32::NAN, p[1], p[2]] } else { p }));
    let error = pair.diagnosis().unwrap_err();
    assert!(error.contains("measured") && error.contains("000000.bin"), "{error}");
}

#[test]
fn labels_in_another_frame_are_reported() {
    let pair = Pair::new(7, 14);
    for file in pair.files("measured/label_2") {
        let text = fs_err::read_to_string(&file).unwrap();
        let turned = text.lines().map(|line| {
            let mut fields: Vec<&str> = line.split_whitespace().collect();
            fields.swap(11, 12);
            fields.join(" ") + "\n"
        });
        let turned: String = turned.collect();
        fs_err::write(&file, turned).unwrap();
    }
    let message = pair.diagnosis().map_or_else(|e| e, |d| notes(&d));
    assert!(message.contains("written in the same frame") || message.contains("not scenario-identical"), "{message}");
}

#[test]
fn copies_of_one_frame_are_one_frame() {
    let pair = Pair::new(8, 10);
    for side in ["measured", "simulated"] {
        for folder in ["velodyne", "label_2"] {
            let files = pair.files(&format!("{side}/{folder}"));
            for file in &files[1..] {
                fs_err::copy(&files[0], file).unwrap();
            }
        }
    }
    let d = pair.diagnosis().unwrap();
    assert!(notes(&d).contains("9 frames are copies of others"), "{:?}", d.notes);
    assert!(d.findings.is_empty() && d.verdict == Verdict::TooFewFrames, "{:?}", d.findings);
}

#[test]
fn another_sensor_is_no_panic() {
    // The simulation with every other return removed and rotated by 0.2 degrees.
    let pair = Pair::new(9, 14);
    let (s, c) = 0.0035f32.sin_cos();
    pair.change("simulated", |i, [x, y, z]| i.is_multiple_of(2).then_some([c * x - s * y, s * x + c * y, z]));
    let d = pair.diagnosis().unwrap();
    assert!(names(&d).iter().any(|n| n == "random_dropout"), "{:?}", names(&d));
}
