//! Configuration of a study: data sets, detectors, seeds and evaluation. It defines the runs, their folders, the cells
//! of the matrix, and which results a change of the TOML makes invalid.

mod changes;
mod frozen;
mod problem;

pub use changes::StudyChanges;
pub use frozen::{ELSEWHERE, FrozenDetector};

use crate::folder::Study;
use data::DataError;
use eval::analysis::AnalysisOptions;
use eval::distance::DistanceOptions;
use eval::features::TsneOptions;
use eval::matrix::{Between, MatrixOptions, MatrixPlan, Place, PlannedNetwork, RunId};
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
    /// Name of the study and of its folder.
    pub name: String,
    /// Description for the report, one string per paragraph: purpose of the study and what it scales down.
    pub about: Vec<String>,
    /// Data sets, in the order of the tables. Every run is tested on each of them.
    #[serde(rename = "dataset")]
    pub datasets: Vec<StudyDataset>,
    /// Detectors, in the order of the tables. Without any, nothing is trained: `frozen` detectors are evaluated, and
    /// the data sets are compared.
    #[serde(rename = "detector", default)]
    pub detectors: Vec<StudyDetector>,
    /// Detectors that were trained elsewhere and are only evaluated, after the others in the tables.
    #[serde(rename = "frozen", default, skip_serializing_if = "Vec::is_empty")]
    pub frozen: Vec<FrozenDetector>,
    /// Variants of the detectors to compare. Without variants, each detector is used unchanged.
    #[serde(rename = "variant", default)]
    pub variants: Vec<Variant>,
    /// Random seeds, one run each. A detector can override them. Not needed if nothing is trained.
    #[serde(default)]
    pub seeds: Vec<u64>,
    /// Number of epochs of every run. A detector can override it. Default: from the detector's TOML.
    #[serde(default)]
    pub epochs: Option<u64>,
    /// Names of the splits.
    #[serde(default)]
    pub splits: Splits,
    /// Options of the evaluation.
    #[serde(default)]
    pub evaluation: StudyEvaluation,
}

/// The splits that a study uses in every data set.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Splits {
    /// Split for training and for distances between data sets.
    pub train: String,
    /// Split for validation during training.
    pub val: String,
    /// Split for testing.
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
    /// Name of the data set and of its folders.
    pub name: String,
    /// Title in tables and figures. Default: the name.
    #[serde(default)]
    pub title: String,
    /// Data set of the paper that this one reproduces: Real, Sim, Sim Noise or Sim Downsampled. The paper's numbers are
    /// then shown for comparison.
    #[serde(default)]
    pub paper: Option<String>,
    /// Name of the data set whose scenes it shows, and of the one whose sensor it has. The test set then tells the
    /// sensor's part of a gap between the two from the scene's. Both or neither.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub scene_of: Option<String>,
    /// See `scene_of`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sensor_of: Option<String>,
    /// Source of the data set.
    pub source: Source,
}

/// Source of a data set. Paths are relative to the study's TOML.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum Source {
    /// An existing data set: folder or TOML.
    Path(PathBuf),
    /// Simulated as by `lidarshift simulate`.
    Simulate {
        /// Value of `simulate --config`: a file, or a name (`race_small`, `street`, ...).
        config: PathBuf,
        /// Name of one of its data sets. Not given for streets, which have a single data set.
        #[serde(default)]
        dataset: Option<String>,
        /// Number of frames.
        frames: usize,
        /// Random seed of the scenes.
        #[serde(default)]
        seed: u64,
    },
    /// An earlier data set of the study with additional sensor effects, as by `lidarshift resim`.
    Resim {
        /// Name of that data set.
        of: String,
        /// TOML with the effects, as for `resim --effects`.
        effects: PathBuf,
        /// TOML with the sensors, as for `resim --sensor`.
        #[serde(default, skip_serializing_if = "Option::is_none")]
        sensor: Option<PathBuf>,
    },
    /// The clouds of an earlier data set of the study with its true boxes as labels, in the place of labels that were
    /// made automatically.
    TrueLabels {
        /// Name of that data set.
        of: String,
    },
}

/// A detector of a study.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StudyDetector {
    /// Name of its TOML in configs/detectors, and of its folders.
    pub name: String,
    /// Its TOML, relative to the study's TOML. Default: the built-in one with this name.
    #[serde(default)]
    pub config: Option<PathBuf>,
    /// Title in tables and figures. Default: the name.
    #[serde(default)]
    pub title: String,
    /// Detector of the paper that this one reproduces: PointRCNN or PointPillars. The paper's numbers are then shown
    /// for comparison.
    #[serde(default)]
    pub paper: Option<String>,
    /// Names of the data sets for training. Default: all.
    #[serde(default)]
    pub train: Option<Vec<String>>,
    /// Overrides the seeds of the study.
    #[serde(default)]
    pub seeds: Option<Vec<u64>>,
    /// Overrides the number of epochs of the study.
    #[serde(default)]
    pub epochs: Option<u64>,
    /// Keys of the detector's TOML to override, as with `train --set`: nested tables or dotted keys.
    #[serde(default)]
    pub set: BTreeMap<String, Value>,
}

/// A variant of detectors. The paper varied the pillar size, the number of sampled points and the filters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Variant {
    /// Name; appended to the detector's name in folders and tables.
    pub name: String,
    /// Names of the detectors that have this variant. Default: all.
    #[serde(default)]
    pub detectors: Option<Vec<String>>,
    /// Keys of the detector's TOML to override, as with `train --set`: nested tables or dotted keys. Empty: the
    /// unchanged detector.
    #[serde(default)]
    pub set: BTreeMap<String, Value>,
}

/// Options of the evaluation.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct StudyEvaluation {
    /// Matrix of train sets and test sets.
    pub matrix: MatrixOptions,
    /// Error analysis of single runs.
    pub analysis: AnalysisOptions,
    /// t-SNE of the features.
    pub tsne: TsneOptions,
    /// Number of test clouds for features; 500 in the paper. Default: all.
    pub tsne_frames: Option<usize>,
    /// Data set whose test clouds are used for features. Default: the first of the study.
    pub tsne_dataset: Option<String>,
    /// Distances between the data sets.
    pub distances: DistanceOptions,
    /// Number of frames for distances. Default: all of the train split.
    pub distance_frames: Option<usize>,
    /// Statistics of the targets.
    pub targets: TargetOptions,
}

/// One run of a study.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct StudyRun {
    /// Network (`DETECTOR` or `DETECTOR+VARIANT`), train set and seed.
    pub id: RunId,
    /// Name of the detector.
    pub detector: String,
    /// TOML of the detector, if it is not a built-in one.
    pub config: Option<PathBuf>,
    /// Number of epochs; `None`: from the detector's TOML.
    pub epochs: Option<u64>,
    /// Overridden keys as `key=value`, in the order of the keys; those of the variant after those of the detector.
    pub set: Vec<String>,
    /// Source of the train set.
    pub source: Source,
}

impl fmt::Display for StudyRun {
    /// The run folder, relative to the folder of the study.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}/seed-{}", self.id.network, self.id.train_set, self.id.seed)
    }
}

impl StudyRun {
    /// The run folder.
    pub fn folder(&self, study: &Path) -> PathBuf {
        study.join(self.to_string())
    }

    /// Folder of the detections on a test set: `detections.parquet`, or one KITTI text file per frame.
    pub fn detections(&self, study: &Path, test_set: &str) -> PathBuf {
        self.folder(study).join("detections").join(test_set)
    }

    /// Folder of all refined regions of a two-stage network on a test set, with files as those of the detections.
    pub fn regions(&self, study: &Path, test_set: &str) -> PathBuf {
        self.folder(study).join("regions").join(test_set)
    }

    /// Folders of the detections and of the regions on a test set.
    pub(crate) fn cell(&self, study: &Study, test_set: &str) -> [PathBuf; 2] {
        [self.detections(&study.folder, test_set), self.regions(&study.folder, test_set)]
    }
}

impl StudyConfig {
    /// Reads a study's TOML.
    ///
    /// # Errors
    /// Invalid TOML, an unknown key, or invalid values.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        Self::parse(&data::limits::read_text(path)?, path)
    }

    /// Parses a study. `path` is used in error messages.
    ///
    /// # Errors
    /// As [`StudyConfig::read`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, DataError> {
        let mut study: StudyConfig = data::toml_text::parse_toml(text, path, |_| Ok(()))?;
        for (name, title) in study.datasets.iter_mut().map(|d| (&d.name, &mut d.title)) {
            if title.is_empty() {
                title.clone_from(name);
            }
        }
        let detectors = study.detectors.iter_mut().map(|d| (&d.name, &mut d.title));
        for (name, title) in detectors.chain(study.frozen.iter_mut().map(|f| (&f.name, &mut f.title))) {
            if title.is_empty() {
                title.clone_from(name);
            }
        }
        match study.problem() {
            Some(problem) => Err(DataError::file(path, problem)),
            None => Ok(study),
        }
    }

    /// All detectors in all their variants: name and title of the network, the detector, and the overridden keys.
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

    /// All runs, ordered by network, train set and seed.
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

    /// All cells of the matrix.
    pub fn plan(&self) -> MatrixPlan {
        let place = |d: &StudyDataset| Place { name: d.name.clone(), title: d.title.clone(), paper: d.paper.clone() };
        let between = |d: &StudyDataset| {
            let (scene_of, sensor_of) = (d.scene_of.clone()?, d.sensor_of.clone()?);
            Some(Between { test_set: d.name.clone(), scene_of, sensor_of })
        };
        let network = |(name, title, detector, _): (String, String, &StudyDetector, Vec<String>)| PlannedNetwork {
            network: Place { name, title, paper: detector.paper.clone() },
            train_sets: self.train_sets(detector).into_iter().map(place).collect(),
            seeds: detector.seeds.clone().unwrap_or_else(|| self.seeds.clone()),
        };
        MatrixPlan {
            networks: self
                .networks()
                .into_iter()
                .map(network)
                .chain(self.frozen.iter().map(FrozenDetector::planned))
                .collect(),
            test_sets: self.datasets.iter().map(place).collect(),
            between: self.datasets.iter().filter_map(between).collect(),
        }
    }
}

/// Nested keys as `a.b=c`, in the order of the keys, with values in TOML syntax.
fn assignments(set: &BTreeMap<String, Value>) -> Vec<String> {
    fn collect(prefix: &str, value: &Value, out: &mut Vec<String>) {
        match value {
            Value::Object(below) => {
                for (key, value) in below {
                    collect(&format!("{prefix}.{key}"), value, out);
                }
            }
            // JSON arrays, numbers, strings and booleans are valid TOML.
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
    fn invalid_studies_are_refused() {
        for (from, to, message) in [
            ("epochs = 10", "epoch = 10", "small.toml:5: unknown field `epoch`"),
            ("epochs = 10", "epochs = 0", "epochs have to be 1 or more"),
            ("seeds = [1, 2]", "seeds = [1, 1]", "[1, 1] have to be distinct"),
            (
                "train = [\"measured\", \"sim\"]",
                "train = [\"real\"]",
                "train contains \"real\", which is not in the study",
            ),
            ("of = \"sim\"", "of = \"other\"", "resim.of is \"other\""),
            (
                "{ resim = { of = \"sim\", effects = \"noise.toml\" } }",
                "{ true_labels = { of = \"x\" } }",
                "true_labels.of is \"x\"",
            ),
            ("name = \"sim-noise\"", "name = \"sim-noise\"\nscene_of = \"sim\"", "scene_of and sensor_of"),
            (
                "name = \"sim-noise\"",
                "name = \"sim-noise\"\nscene_of = \"sim\"\nsensor_of = \"real\"",
                "dataset sim-noise: sensor_of contains \"real\"",
            ),
            ("frames = 100", "frames = 0", "frames is 0"),
            ("name = \"sim\"", "name = \"measured\"", "dataset \"measured\" exists twice"),
            ("name = \"small\"", "name = \"../small\"", "has to be a file name"),
            ("path = \"measured\"", "folder = \"measured\"", "unknown variant `folder`"),
            ("seeds = [7]", "seeds = []", "detector pointrcnn_race_small: seeds [] have to be distinct"),
            ("[[variant]]", "[[frozen]]\nname = \"a\"\n[[variant]]", "frozen a has neither detections"),
            (
                "[[variant]]",
                "[[frozen]]\nname = \"a\"\ndetections = { real = \"d\" }\n[[variant]]",
                "frozen a: detections contains \"real\", which is not a data set of the study",
            ),
            (
                "[[variant]]",
                "[[frozen]]\nname = \"a\"\ncheckpoint = \"a.pth\"\n[[variant]]",
                "frozen a has a checkpoint without detector",
            ),
            (
                "[[variant]]",
                "[[frozen]]\nname = \"pointrcnn_race_small\"\ndetections = { sim = \"d\" }\n[[variant]]",
                "has the name of a trained detector",
            ),
            (
                "[[variant]]",
                "[[frozen]]\nname = \"a\"\ndetections = { sim = \"d\" }\nclasses = { b = \"Car\" }\nignored_classes = [\"b\"]\n[[variant]]",
                "class \"b\" is renamed by classes and left out",
            ),
        ] {
            assert!(STUDY.contains(from), "{from}");
            let error = parse(&STUDY.replacen(from, to, 1)).unwrap_err().to_string();
            assert!(error.contains(message), "{to}: {error}");
        }
    }

    #[test]
    fn a_study_of_frozen_detectors_trains_nothing() {
        let text = "name = \"f\"\nabout = []\n[[dataset]]\nname = \"real\"\nsource = { path = \"r\" }\n\
                    [[frozen]]\nname = \"ours\"\ndetections = { real = \"d\" }\n";
        let study = parse(text).unwrap();
        assert!(study.runs().is_empty() && !study.trains() && study.compared_split() == "test");
        let plan = study.plan();
        let planned = &plan.networks[0];
        assert_eq!((planned.network.title.as_str(), planned.train_sets[0].name.as_str()), ("ours", ELSEWHERE));
        let alone = text.split("[[frozen]]").next().unwrap();
        assert!(parse(alone).unwrap_err().to_string().contains("nor a second [[dataset]]"));
        let loader = format!("{text}[evaluation]\ndistances = {{ compared = \"loader\" }}\n");
        assert!(parse(&loader).unwrap_err().to_string().contains("needs a [[detector]]"));
    }

    #[test]
    fn a_change_makes_runs_invalid() {
        let before = parse(STUDY).unwrap();
        assert_eq!(before.changes_since(&before), StudyChanges::default());
        let after = |from: &str, to: &str| parse(&STUDY.replacen(from, to, 1)).unwrap().changes_since(&before);
        let changes = after("seeds = [7]", "seeds = [7, 8]");
        assert_eq!((changes.added.len(), changes.removed.len(), changes.invalid.len()), (2, 0, 0));
        let changes = after("epochs = 10", "epochs = 11");
        assert_eq!(changes.invalid.len(), 12);
        assert_eq!(changes.invalid[0].1, ["epochs was 10, is 11"]);
        // More simulated frames: all runs trained on sim or on a data set derived from it, and both as test sets.
        let changes = after("frames = 100", "frames = 200");
        assert_eq!(
            (changes.invalid.len(), changes.tests.clone()),
            (2 * 2 * 2 + 1, vec!["sim".into(), "sim-noise".into()])
        );
        assert_eq!(after("pillar-0.4", "pillar-0.5").removed.len(), 6);
    }

    #[test]
    fn the_built_in_studies_are_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/studies");
        let paper = StudyConfig::read(&folder.join("paper.toml")).unwrap();
        assert_eq!((paper.runs().len(), paper.epochs), (2 * 4 * 5, Some(75)));
        let known = paper
            .plan()
            .networks
            .iter()
            .flat_map(|n| std::iter::once(&n.network).chain(&n.train_sets))
            .all(|p| p.paper.is_some());
        assert!(known, "every cell has the paper's numbers");
        let quick = StudyConfig::read(&folder.join("quick.toml")).unwrap();
        assert_eq!(quick.runs().len(), 2 * 4);
        let twin = StudyConfig::read(&folder.join("twin.toml")).unwrap();
        let names: Vec<&str> = twin.datasets.iter().map(|d| d.name.as_str()).collect();
        assert_eq!((twin.runs().len(), &names[..]), (3 * 3, &["measured", "twin", "twin-sensor"][..]));
        assert!(!StudyConfig::read(&folder.join("cpu.toml")).unwrap().about.is_empty());
    }
}
