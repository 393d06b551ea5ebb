//! Runs the diagnosis on many pairs that a generator draws, and scores its answers. The benchmarks of both generators
//! (`tests/blind`, `tests/town`) call it; the generators themselves do not know it.

use data::Dataset;
use diagnose::{DiagnoseError, OnClouds, Options, Outcome as Found, Rig, diagnose, diagnose_unpaired};
use score::{CaseSize, Outcome, Summary, Truth, score, summarise};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Which pairs are drawn and where the results go.
#[derive(Clone, Debug)]
pub struct Trials {
    /// Wanted kinds, in turn; empty where the kind is drawn.
    pub kinds: Vec<String>,
    /// First seed.
    pub first: u64,
    /// Number of cases.
    pub cases: u64,
    /// Frames and shots of each case.
    pub size: CaseSize,
    /// Folder of the results.
    pub out: PathBuf,
    /// Folder in which the pairs are kept.
    pub keep: Option<PathBuf>,
    /// Whether the sides show different scenes.
    pub unpaired: bool,
    /// Whether pairs are drawn without a diagnosis.
    pub draw_only: bool,
}

impl Trials {
    /// So many cases of the usual size from seed 1 on.
    pub fn new(cases: u64, out: &str) -> Trials {
        let (kinds, size) = (vec![], CaseSize::USUAL);
        Trials { kinds, first: 1, cases, size, out: out.into(), keep: None, unpaired: false, draw_only: false }
    }

    /// With the options of the command line; `None` if help is wanted.
    ///
    /// # Panics
    /// With an unknown option, or one without its value.
    pub fn with_arguments(mut self) -> Option<Trials> {
        let mut args = std::env::args().skip(1);
        while let Some(arg) = args.next() {
            let mut value = || args.next().unwrap_or_else(|| panic!("{arg} needs a value"));
            match arg.as_str() {
                "--kind" => self.kinds.push(value()),
                "--first" => self.first = value().parse().expect("a seed"),
                "--cases" => self.cases = value().parse().expect("a number of cases"),
                "--frames" => self.size.frames = value().parse().expect("a number of frames"),
                "--shots" => self.size.shots = value().parse().expect("a number of shots"),
                "--out" => self.out = value().into(),
                "--keep" => self.keep = Some(value().into()),
                "--unpaired" => self.unpaired = true,
                "--draw-only" => self.draw_only = true,
                "--bench" => {}
                "--help" | "-h" => return None,
                other => panic!("unknown argument {other}"),
            }
        }
        Some(self)
    }

    /// The wanted kind of a seed; `None` where it is drawn.
    pub fn kind_of(&self, seed: u64) -> Option<&str> {
        let n = self.kinds.len() as u64;
        (n > 0).then(|| self.kinds[(seed % n) as usize].as_str())
    }

    /// Diagnoses the pairs that `draw` writes into a folder, prints the `line` of each, and writes the summary. Results
    /// that are there are kept. `None` where pairs are drawn alone.
    ///
    /// # Panics
    /// Where a file cannot be written.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(&self, draw: impl Fn(u64, &Path) -> Truth, line: impl Fn(&Outcome) -> String) -> Option<Summary> {
        let mut outcomes = Vec::new();
        for seed in self.first..self.first + self.cases {
            let temporary = tempfile::tempdir().expect("a temporary folder");
            let folder = self.keep.as_deref().unwrap_or(temporary.path()).join(seed.to_string());
            if self.draw_only {
                let begin = Instant::now();
                let truth = drawn(seed, &folder, &draw);
                println!("{seed}: {} ({}) {:.1} s", truth.kind, truth.setting, begin.elapsed().as_secs_f64());
                continue;
            }
            let path = self.out.join(format!("case-{seed}.json"));
            let done = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Outcome>(&bytes).ok());
            let outcome = done.unwrap_or_else(|| {
                let (outcome, diagnosis) = scored(&drawn(seed, &folder, &draw), &folder, self.unpaired);
                data::write_json(&self.out.join(format!("diagnosis-{seed}.json")), &diagnosis).expect("a diagnosis");
                data::write_json(&path, &outcome).expect("a result");
                outcome
            });
            println!("{}", line(&outcome));
            outcomes.push(outcome);
        }
        if self.draw_only {
            return None;
        }
        let summary = summarise(&outcomes);
        data::write_json(&self.out.join("summary.json"), &summary).expect("a summary");
        Some(summary)
    }
}

/// The truth of a pair, which is drawn unless it is there. The file of the truth is next to the folder, not in it.
fn drawn(seed: u64, folder: &Path, draw: impl Fn(u64, &Path) -> Truth) -> Truth {
    let path = folder.with_extension("truth.json");
    let there = std::fs::read(&path).ok().and_then(|bytes| serde_json::from_slice::<Truth>(&bytes).ok());
    there.unwrap_or_else(|| {
        let truth = draw(seed, folder);
        data::write_json(&path, &truth).expect("the truth");
        truth
    })
}

/// The diagnosis of a pair in a folder: of `measured` against the side of a name, with `sensor.toml`.
///
/// # Errors
/// Those of the diagnosis.
///
/// # Panics
/// Where a side or the rig cannot be read.
pub fn diagnosed(folder: &Path, simulated: &str) -> Result<Found, DiagnoseError> {
    let (measured, simulated, rig) = sides(folder, simulated);
    diagnose(&measured, &simulated, &rig, &Options::default(), &|_, _, _| ())
}

/// The same of two sides that show different scenes.
fn diagnosed_unpaired(folder: &Path) -> Result<Found, DiagnoseError> {
    let (measured, simulated, rig) = sides(folder, "simulated");
    let remake = OnClouds { simulated: &simulated, rig: &rig };
    diagnose_unpaired(&measured, &simulated, &rig, &Options::default(), &remake, &|_, _, _| ())
}

/// Both sides of a pair, and its sensors.
fn sides(folder: &Path, simulated: &str) -> (Dataset, Dataset, Rig) {
    let open = |side: &str| Dataset::open(&folder.join(side)).expect("a data set");
    (open("measured"), open(simulated), Rig::read(&folder.join("sensor.toml")).expect("a rig"))
}

/// The score of the diagnosis of a pair, and the diagnosis as JSON.
///
/// # Panics
/// Where a side or the rig cannot be read.
pub fn scored(truth: &Truth, folder: &Path, unpaired: bool) -> (Outcome, serde_json::Value) {
    let begin = Instant::now();
    let found = if unpaired { diagnosed_unpaired(folder) } else { diagnosed(folder, "simulated") };
    let value = match found {
        Ok(found) => serde_json::to_value(&found.diagnosis).expect("JSON"),
        Err(e) => serde_json::json!({ "verdict": format!("error: {e}") }),
    };
    (score(truth, &value, begin.elapsed().as_secs_f64()), value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wanted_kinds_come_in_turn() {
        let mut trials = Trials::new(3, "out");
        assert_eq!(trials.kind_of(7), None);
        trials.kinds = vec!["null".into(), "swarm".into()];
        assert_eq!([8, 9, 10].map(|seed| trials.kind_of(seed)), [Some("null"), Some("swarm"), Some("null")]);
    }

    #[test]
    fn a_pair_is_drawn_once() {
        let folder = tempfile::tempdir().unwrap();
        let (count, pair) = (std::cell::Cell::new(0), folder.path().join("5"));
        let draw = |seed: u64, _: &Path| {
            count.set(count.get() + 1);
            Truth { seed, kind: "null".into(), setting: String::new(), hidden: vec![] }
        };
        let truths = [drawn(5, &pair, draw), drawn(5, &pair, draw)];
        assert_eq!(truths[0], truths[1]);
        assert_eq!(count.get(), 1);
    }
}
