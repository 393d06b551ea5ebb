//! A study as people write it: data sets, detectors, seeds, and what is evaluated. From it come the runs, their folders, the plan of the
//! matrix, and what a change of the file makes invalid.

mod changes;
mod problem;

pub use changes::StudyChanges;

use data::DataError;
use eval::analysis::AnalysisOptions;
use eval::distance::DistanceOptions;
use eval::features::TsneOptions;
use eval::matrix::{MatrixOptions, MatrixPlan, Place, PlannedNetwork, RunId};
use eval::targets::TargetOptions;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt;
use std::path::{Path, PathBuf};

/// A study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StudyConfig {
    /// Name of its folder.
    pub name: String,
    /// What it is and what it scales down, for every report; a paragraph each.
    pub about: Vec<String>,
    /// Data sets, in the order of the tables. Every run is tested on each of them.
    #[serde(rename = "dataset")]
    pub datasets: Vec<StudyDataset>,
    /// Detectors, in the order of the tables.
    #[serde(rename = "detector")]
    pub detectors: Vec<StudyDetector>,
    /// Settings to compare, each with every detector. Without any, the detectors are as they are.
    #[serde(rename = "variant", default)]
    pub variants: Vec<Variant>,
    /// One run for each, unless a detector says otherwise.
    pub seeds: Vec<u64>,
    /// Epochs of every run, unless a detector says otherwise. Default: as the detector's own file says.
    #[serde(default)]
    pub epochs: Option<u64>,
    /// Names of the splits.
    #[serde(default)]
    pub splits: Splits,
    /// What is evaluated and how.
    #[serde(default)]
    pub evaluation: StudyEvaluation,
}

/// The splits that a study uses, of every data set.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Splits {
    /// Trained on, and compared by distances.
    pub train: String,
    /// Watched during training.
    pub val: String,
    /// Tested on.
    pub test: String,
}

impl Default for Splits {
    fn default() -> Self {
        Splits { train: "train".into(), val: "val".into(), test: "test".into() }
    }
}

/// A data set of a study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StudyDataset {
    /// Name of its folders.
    pub name: String,
    /// As tables call it. Default: its name.
    #[serde(default)]
    pub title: String,
    /// Real, Sim, Sim Noise or Sim Downsampled where it is the paper's: the paper's numbers then stand beside.
    #[serde(default)]
    pub paper: Option<String>,
    /// Where it comes from.
    pub source: Source,
}

/// Where a data set comes from. Paths are relative to the study's file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Source {
    /// Its folder or its TOML.
    Path(PathBuf),
    /// Made by `simulate`.
    Simulate {
        /// What `simulate --config` takes: a file, or a name (`race_small`, `street`, ...).
        config: PathBuf,
        /// Which of its data sets; a street has but one.
        #[serde(default)]
        dataset: Option<String>,
        /// Number of frames.
        frames: usize,
        /// Seed of the scenes.
        #[serde(default)]
        seed: u64,
    },
    /// Another data set of the study, simulated again with other effects of the sensor: the same scenes.
    Resim {
        /// Name of that data set.
        of: String,
        /// The file of `resim --effects`.
        effects: PathBuf,
    },
}

/// A detector of a study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StudyDetector {
    /// Name of its file in configs/detectors, and of its folders.
    pub name: String,
    /// Its file, relative to the study's. Default: the one that comes with the program.
    #[serde(default)]
    pub config: Option<PathBuf>,
    /// As tables call it. Default: its name.
    #[serde(default)]
    pub title: String,
    /// PointRCNN or PointPillars where it is the paper's: the paper's numbers then stand beside.
    #[serde(default)]
    pub paper: Option<String>,
    /// Names of the data sets it is trained on. Default: all of them.
    #[serde(default)]
    pub train: Option<Vec<String>>,
    /// Its own seeds.
    #[serde(default)]
    pub seeds: Option<Vec<u64>>,
    /// Its own number of epochs.
    #[serde(default)]
    pub epochs: Option<u64>,
    /// Keys to set, as with `--set`: nested, or with points in the key.
    #[serde(default)]
    pub set: BTreeMap<String, Value>,
}

/// Settings to compare: the paper tried the size of pillars, the number of sampled points and the filters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Stands in folders and tables behind the detector's name.
    pub name: String,
    /// The detectors it is for. Default: all.
    #[serde(default)]
    pub detectors: Option<Vec<String>>,
    /// Keys to set, as with `--set`: nested, or with points in the key. Empty: the detector as it is.
    #[serde(default)]
    pub set: BTreeMap<String, Value>,
}

/// What is evaluated and how.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StudyEvaluation {
    /// The matrix.
    pub matrix: MatrixOptions,
    /// What is behind the average precision.
    pub analysis: AnalysisOptions,
    /// The picture of features.
    pub tsne: TsneOptions,
    /// Test clouds for features; the paper takes 500.
    pub tsne_frames: Option<usize>,
    /// The data set whose test clouds they are. Default: the first of the study.
    pub tsne_dataset: Option<String>,
    /// Distances between the data sets.
    pub distances: DistanceOptions,
    /// Frames for distances. Default: all of the train split.
    pub distance_frames: Option<usize>,
    /// The targets.
    pub targets: TargetOptions,
}

/// One run of a study.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StudyRun {
    /// Network (the detector, and behind a plus sign its variant), train set and seed.
    pub id: RunId,
    /// Name of the detector.
    pub detector: String,
    /// Its own file.
    pub config: Option<PathBuf>,
    /// Epochs; `None`: as the detector's file says.
    pub epochs: Option<u64>,
    /// What to set, `key=value` each, in the order of the keys; the variant's behind the detector's.
    pub set: Vec<String>,
    /// Where the train set comes from.
    pub source: Source,
}

impl fmt::Display for StudyRun {
    /// Its folder below that of the study.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/seed-{}", self.id.network, self.id.train_set, self.id.seed)
    }
}

impl StudyRun {
    /// The folder of the run below that of the study.
    pub fn folder(&self, study: &Path) -> PathBuf {
        study.join(self.to_string())
    }

    /// Where its detections on a test set lie, a text a frame.
    pub fn detections(&self, study: &Path, test_set: &str) -> PathBuf {
        self.folder(study).join("detections").join(test_set)
    }

    /// Where all refined regions of a two-stage network on a test set lie, likewise.
    pub fn regions(&self, study: &Path, test_set: &str) -> PathBuf {
        self.folder(study).join("regions").join(test_set)
    }
}

impl StudyConfig {
    /// Reads a study's file.
    ///
    /// # Errors
    /// A file that is no TOML, an unknown key, or a study without sense.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        Self::parse(&fs_err::read_to_string(path)?, path)
    }

    /// Parses a study. `path` is for messages.
    ///
    /// # Errors
    /// As [`StudyConfig::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, DataError> {
        let mut study: StudyConfig = toml::from_str(text).map_err(|e| {
            let line = e.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
            DataError::line(path, line, e.message().to_string())
        })?;
        for (name, title) in study.datasets.iter_mut().map(|d| (&d.name, &mut d.title)) {
            if title.is_empty() {
                title.clone_from(name);
            }
        }
        for (name, title) in study.detectors.iter_mut().map(|d| (&d.name, &mut d.title)) {
            if title.is_empty() {
                title.clone_from(name);
            }
        }
        match study.problem() {
            Some(problem) => Err(DataError::file(path, problem)),
            None => Ok(study),
        }
    }

    /// The detector in each of its variants: the network's name, its title, the detector, and what to set.
    fn networks(&self) -> Vec<(String, String, &StudyDetector, Vec<String>)> {
        let mut networks = Vec::new();
        for detector in &self.detectors {
            let own = assignments(&detector.set);
            let is_for = |v: &&Variant| v.detectors.as_ref().is_none_or(|names| names.contains(&detector.name));
            let mut variants = self.variants.iter().filter(is_for).peekable();
            if variants.peek().is_none() {
                networks.push((detector.name.clone(), detector.title.clone(), detector, own));
                continue;
            }
            for variant in variants {
                let set = own.iter().cloned().chain(assignments(&variant.set)).collect();
                let name = format!("{}+{}", detector.name, variant.name);
                networks.push((name, format!("{}, {}", detector.title, variant.name), detector, set));
            }
        }
        networks
    }

    fn train_sets(&self, detector: &StudyDetector) -> Vec<&StudyDataset> {
        let is_for = |d: &&StudyDataset| detector.train.as_ref().is_none_or(|names| names.contains(&d.name));
        self.datasets.iter().filter(is_for).collect()
    }

    /// All runs, by network, train set, seed.
    pub fn runs(&self) -> Vec<StudyRun> {
        let mut runs = Vec::new();
        for (network, _, detector, set) in self.networks() {
            for dataset in self.train_sets(detector) {
                for &seed in detector.seeds.as_ref().unwrap_or(&self.seeds) {
                    runs.push(StudyRun {
                        id: RunId { network: network.clone(), train_set: dataset.name.clone(), seed },
                        detector: detector.name.clone(),
                        config: detector.config.clone(),
                        epochs: detector.epochs.or(self.epochs),
                        set: set.clone(),
                        source: dataset.source.clone(),
                    });
                }
            }
        }
        runs
    }

    /// The cells that there should be.
    pub fn plan(&self) -> MatrixPlan {
        let place = |d: &StudyDataset| Place { name: d.name.clone(), title: d.title.clone(), paper: d.paper.clone() };
        let network = |(name, title, detector, _): (String, String, &StudyDetector, Vec<String>)| PlannedNetwork {
            network: Place { name, title, paper: detector.paper.clone() },
            train_sets: self.train_sets(detector).into_iter().map(place).collect(),
            seeds: detector.seeds.clone().unwrap_or_else(|| self.seeds.clone()),
        };
        MatrixPlan {
            networks: self.networks().into_iter().map(network).collect(),
            test_sets: self.datasets.iter().map(place).collect(),
        }
    }
}

/// Nested keys as `a.b=c`, in the order of the keys; values as TOML writes them.
fn assignments(set: &BTreeMap<String, Value>) -> Vec<String> {
    fn collect(prefix: &str, value: &Value, out: &mut Vec<String>) {
        match value {
            Value::Object(below) => {
                for (key, value) in below {
                    collect(&format!("{prefix}.{key}"), value, out);
                }
            }
            // JSON's lists, numbers, texts and truths are TOML's, too.
            value => out.push(format!("{prefix}={value}")),
        }
    }
    let mut out = Vec::new();
    set.iter().for_each(|(key, value)| collect(key, value, &mut out));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const STUDY: &str = r#"
name = "small"
about = ["A test."]
seeds = [1, 2]
epochs = 10

[[dataset]]
name = "measured"
title = "Measured"
paper = "Real"
source = { path = "measured" }

[[dataset]]
name = "sim"
source = { simulate = { config = "street", frames = 100 } }

[[dataset]]
name = "sim-noise"
source = { resim = { of = "sim", effects = "noise.toml" } }

[[detector]]
name = "pointpillars_race_small"
title = "PointPillars"
paper = "PointPillars"

[[detector]]
name = "pointrcnn_race_small"
train = ["measured", "sim"]
seeds = [7]
epochs = 4
set = { optimization.lr_max = 0.01 }

[[variant]]
name = "pillar-0.2"
detectors = ["pointpillars_race_small"]
set = { network.pillars.size_m = [0.2, 0.2, 8.0] }

[[variant]]
name = "pillar-0.4"
detectors = ["pointpillars_race_small"]
set = { "network.pillars.size_m" = [0.4, 0.4, 8.0] }
"#;

    fn parse(text: &str) -> Result<StudyConfig, DataError> {
        StudyConfig::parse(text, Path::new("studies/small.toml"))
    }

    #[test]
    fn runs_and_cells_come_from_the_file() {
        let study = parse(STUDY).unwrap();
        let runs = study.runs();
        assert_eq!(runs.len(), 2 * 3 * 2 + 2);
        assert_eq!(runs[0].set, ["network.pillars.size_m=[0.2,0.2,8.0]"]);
        assert_eq!(runs[6].set, ["network.pillars.size_m=[0.4,0.4,8.0]"]);
        assert_eq!(
            runs[0].detections(Path::new("runs/small"), "sim"),
            Path::new("runs/small/pointpillars_race_small+pillar-0.2/measured/seed-1/detections/sim")
        );
        let last = &runs[runs.len() - 1];
        assert_eq!(
            (last.id.seed, last.epochs, last.set.as_slice()),
            (7, Some(4), &["optimization.lr_max=0.01".to_string()][..])
        );
        let plan = study.plan();
        assert_eq!((plan.networks.len(), plan.test_sets.len()), (3, 3));
        assert_eq!(plan.networks[1].network.title, "PointPillars, pillar-0.4");
        assert_eq!(plan.test_sets[0].paper.as_deref(), Some("Real"));
    }

    #[test]
    fn mistakes_are_named() {
        for (from, to, message) in [
            ("epochs = 10", "epoch = 10", "small.toml:5: unknown field `epoch`"),
            ("epochs = 10", "epochs = 0", "epochs have to be 1 or more"),
            ("seeds = [1, 2]", "seeds = [1, 1]", "[1, 1] have to be distinct"),
            (
                "train = [\"measured\", \"sim\"]",
                "train = [\"real\"]",
                "train names \"real\", which the study does not have",
            ),
            ("of = \"sim\"", "of = \"other\"", "resim.of names \"other\""),
            ("frames = 100", "frames = 0", "frames is 0"),
            ("name = \"sim\"", "name = \"measured\"", "dataset \"measured\" is there twice"),
            ("name = \"small\"", "name = \"../small\"", "has to be a file name"),
            ("path = \"measured\"", "folder = \"measured\"", "unknown variant `folder`"),
        ] {
            assert!(STUDY.contains(from), "{from}");
            let error = parse(&STUDY.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(error.contains(message), "{to}: {error}");
        }
    }

    #[test]
    fn a_change_says_which_runs_it_makes_invalid() {
        let before = parse(STUDY).unwrap();
        assert_eq!(before.changes_since(&before), StudyChanges::default());
        let after = |from: &str, to: &str| parse(&STUDY.replacen(from, to, 1)).unwrap().changes_since(&before);
        let changes = after("seeds = [7]", "seeds = [7, 8]");
        assert_eq!((changes.added.len(), changes.removed.len(), changes.invalid.len()), (2, 0, 0));
        let changes = after("epochs = 10", "epochs = 11");
        assert_eq!(changes.invalid.len(), 12);
        assert_eq!(changes.invalid[0].1, ["epochs was 10, is 11"]);
        // More simulated frames: all that is trained on sim or on what is made of it, and both as test sets.
        let changes = after("frames = 100", "frames = 200");
        assert_eq!(
            (changes.invalid.len(), changes.tests.clone()),
            (2 * 2 * 2 + 1, vec!["sim".into(), "sim-noise".into()])
        );
        assert_eq!(after("pillar-0.4", "pillar-0.5").removed.len(), 6);
    }

    #[test]
    fn the_studies_of_the_project_are_sound() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/studies");
        let paper = StudyConfig::read(&folder.join("paper.toml")).unwrap();
        assert_eq!((paper.runs().len(), paper.epochs), (2 * 4 * 5, Some(75)));
        let known = paper
            .plan()
            .networks
            .iter()
            .flat_map(|n| std::iter::once(&n.network).chain(&n.train_sets))
            .all(|p| p.paper.is_some());
        assert!(known, "the paper's numbers stand beside every cell");
        let quick = StudyConfig::read(&folder.join("quick.toml")).unwrap();
        assert_eq!(quick.runs().len(), 3 * 2 + 2);
        assert!(!StudyConfig::read(&folder.join("cpu.toml")).unwrap().about.is_empty());
    }
}
