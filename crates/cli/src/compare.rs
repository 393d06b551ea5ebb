//! `lidarshift compare`: several simulations of the same recordings, ranked by how far they are from measured data.

use crate::device::DeviceArgs;
use crate::json::JsonArgs;
use crate::study::listener;
use crate::{errln, outln};
use anyhow::{Result, bail};
use clap::Args;
use data::{Dataset, write_json};
use diagnose::{OnClouds, Options, Rig, diagnose_with};
use eval::BootstrapOptions;
use eval::comparison::{Comparison, Criterion, CriterionKind, SimulationFindings};
use eval::matrix::MatrixOptions;
use report::{ComparisonReport, finding_name};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use study::compare::{CompareInput, compare, names, study_of};
use study::{FrozenDetector, StudyEvaluation};

/// Rank several simulations of the same recordings by how far they are from the measured data: by the gap of detectors
/// that were trained elsewhere, by distances between the clouds, and with --diagnose by what a diagnosis finds. All
/// simulations are compared on the same frames. Nothing is trained. Writes comparison.html and comparison.json.
///
/// Examples:
///   lidarshift compare datasets/measured datasets/sim-a datasets/sim-b --split test
///   lidarshift compare real sim-a sim-b --detections ours=dets/real,dets/a/result.pkl,dets/b/result.pkl
///   lidarshift compare real sim-a sim-b --checkpoint model.pth --detector pointpillars_kitti --diagnose
#[derive(Args, Debug)]
#[command(verbatim_doc_comment)]
pub struct CompareArgs {
    /// Measured data set: folder or TOML
    #[arg(value_name = "MEASURED")]
    measured: PathBuf,
    /// Simulated data sets with the same frame ids and their own labels
    #[arg(value_name = "SIM", required = true)]
    simulations: Vec<PathBuf>,
    /// Split whose frames are compared
    #[arg(long, value_name = "NAME", default_value = "test")]
    split: String,
    /// Detections of a detector: a folder of KITTI text or a result.pkl for each data set, in the order of the data
    /// sets; may be repeated
    #[arg(long, value_name = "NAME=PATH,PATH,...")]
    detections: Vec<String>,
    /// Weights of a detector: a .pth of OpenPCDet or safetensors
    #[arg(long, value_name = "FILE", requires = "detector")]
    checkpoint: Option<PathBuf>,
    /// Detector of the weights: a name or a TOML
    #[arg(long, value_name = "NAME|TOML", requires = "checkpoint")]
    detector: Option<PathBuf>,
    /// Classes that are scored, separated by commas
    #[arg(long, value_name = "NAMES", value_delimiter = ',', default_value = "Car")]
    classes: Vec<String>,
    /// 3D IoU thresholds, separated by commas
    #[arg(long, value_name = "NUMBERS", value_delimiter = ',', default_values = ["0.5", "0.7"])]
    overlaps: Vec<f64>,
    /// Bootstrap: frames are drawn in blocks of this many consecutive frames
    #[arg(long, value_name = "N", default_value_t = 1)]
    block_frames: usize,
    /// Number of frames for distances, spread evenly; 0: no distances
    #[arg(long, value_name = "N", default_value_t = 50)]
    distance_frames: usize,
    /// Also diagnose each simulation on the frames of the split, which takes longer
    #[arg(long)]
    diagnose: bool,
    /// TOML with the poses of the sensors for --diagnose [default: from the TOML of each simulated data set, else one
    /// sensor at the origin of the clouds]
    #[arg(long, value_name = "TOML", requires = "diagnose")]
    sensor: Option<PathBuf>,
    /// Folder for the results
    #[arg(long, value_name = "DIR", default_value = "runs/compare")]
    out: PathBuf,
    #[command(flatten)]
    json: JsonArgs,
    #[command(flatten)]
    device: DeviceArgs,
}

impl CompareArgs {
    /// Compares, writes the page and the JSON, and prints the ranks.
    ///
    /// # Errors
    /// Data sets without shared frames, detections that do not fit, files that cannot be read.
    pub fn run(self) -> Result<()> {
        let datasets: Vec<PathBuf> = std::iter::once(&self.measured).chain(&self.simulations).cloned().collect();
        if let Some(bad) = self.overlaps.iter().find(|o| !(0.0..1.0).contains(*o)) {
            bail!("--overlaps {bad}: has to be in [0, 1)");
        }
        let names = names(&datasets);
        let bootstrap = BootstrapOptions { block_frames: self.block_frames, ..BootstrapOptions::default() };
        let matrix = MatrixOptions {
            classes: self.classes.clone(),
            overlaps: self.overlaps.clone(),
            bootstrap: bootstrap.clone(),
            ..MatrixOptions::default()
        };
        let mut evaluation = StudyEvaluation { matrix, ..StudyEvaluation::default() };
        evaluation.distances.bootstrap = bootstrap;
        evaluation.analysis.class.clone_from(self.classes.first().unwrap_or(&"Car".into()));
        let input = CompareInput {
            frozen: self.frozen(&names)?,
            datasets,
            split: self.split.clone(),
            distance_frames: self.distance_frames,
            evaluation,
        };
        if input.frozen.is_empty() && self.distance_frames == 0 && !self.diagnose {
            bail!(
                "there is nothing to compare by: give --detections or --checkpoint, --distance-frames, or --diagnose"
            );
        }
        let study = study_of(&input, &self.out)?;
        self.check_outputs(&input.datasets)?;
        let mut comparison = compare(&study, &self.device.arguments(), &listener())?;
        if self.diagnose {
            self.diagnose(&mut comparison)?;
        }
        write_json(&self.out.join("comparison.json"), &comparison)?;
        self.json.write(&comparison)?;
        let report =
            ComparisonReport { comparison: &comparison, command: crate::commands::called(), facts: self.facts(&names) };
        report.write(&self.out)?;
        print_ranks(&comparison, &self.out);
        Ok(())
    }

    /// Refuses outputs that would overwrite a data set, and those that cannot be written, before the work begins.
    fn check_outputs(&self, datasets: &[PathBuf]) -> Result<()> {
        for path in datasets {
            Dataset::open(path)?.refuse_own_folder(&self.out)?;
        }
        Ok(self.json.check([])?)
    }

    fn frozen(&self, names: &[String]) -> Result<Vec<FrozenDetector>> {
        let mut frozen = Vec::new();
        for given in &self.detections {
            let Some((name, paths)) = given.split_once('=') else {
                bail!("--detections {given}: has to be NAME=PATH,PATH,... with a path for each data set");
            };
            let paths: Vec<PathBuf> = paths.split(',').map(PathBuf::from).collect();
            if paths.len() != names.len() {
                bail!(
                    "--detections {name}: has {} paths for {} data sets ({}); give one for each, in their order",
                    paths.len(),
                    names.len(),
                    names.join(", ")
                );
            }
            let detections: BTreeMap<String, PathBuf> = names.iter().cloned().zip(paths).collect();
            frozen.push(FrozenDetector { name: name.into(), detections, ..FrozenDetector::default() });
        }
        if let (Some(checkpoint), Some(detector)) = (&self.checkpoint, &self.detector) {
            let stem = checkpoint.file_stem().unwrap_or_default().to_string_lossy();
            let plain = |c: char| if c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.') { c } else { '_' };
            frozen.push(FrozenDetector {
                name: stem.chars().map(plain).collect(),
                checkpoint: Some(checkpoint.clone()),
                detector: Some(detector.clone()),
                ..FrozenDetector::default()
            });
        }
        Ok(frozen)
    }

    /// Adds the findings of a diagnosis of each simulation, and the differences that it measures.
    fn diagnose(&self, comparison: &mut Comparison) -> Result<()> {
        let measured = Dataset::open(&self.measured)?;
        let options = Options { split: Some(self.split.clone()), ..Options::default() };
        let mut sizes = Vec::new();
        for (path, name) in self.simulations.iter().zip(&comparison.simulations) {
            errln!("diagnosing {name}");
            let simulated = Dataset::open(path)?;
            let rig = match (&self.sensor, &simulated.config.rig) {
                (Some(path), _) | (None, Some(path)) => Rig::read(path)?,
                (None, None) => Rig::single(),
            };
            let remake = OnClouds { simulated: &simulated, rig: &rig };
            let outcome = diagnose_with(&measured, &simulated, &rig, &options, &remake, &|_, _, _| {})?;
            let diagnosis = outcome.diagnosis;
            let verdict = serde_json::to_value(diagnosis.verdict)?;
            comparison.findings.push(SimulationFindings {
                simulation: name.clone(),
                verdict: verdict.as_str().unwrap_or_default().replace('_', " "),
                findings: diagnosis.findings.iter().map(|f| format!("{}: {}", finding_name(f), f.says)).collect(),
            });
            sizes.push(Some(diagnosis.gain.before).filter(|v| v.is_finite() && !diagnosis.findings.is_empty()));
        }
        // A simulation without findings has no measured difference.
        for (size, of) in sizes.iter_mut().zip(&comparison.findings) {
            if of.findings.is_empty() && of.verdict == "nothing found" {
                *size = Some(0.0);
            }
        }
        let frames = measured.ids(&self.split)?.len();
        comparison.criteria.push(Criterion::of_numbers(
            CriterionKind::Diagnosis,
            "difference of the returns by the diagnosis",
            "nats per ray",
            frames,
            &comparison.simulations,
            &sizes,
        ));
        Ok(())
    }

    fn facts(&self, names: &[String]) -> Vec<(String, String)> {
        let mut facts = vec![("program".to_string(), format!("lidarshift {}", data::build_id()))];
        let datasets = std::iter::once(&self.measured).chain(&self.simulations);
        for (i, (name, path)) in names.iter().zip(datasets).enumerate() {
            let what = if i == 0 { "measured data" } else { "simulation" };
            facts.push((format!("{what} {name}"), path.display().to_string()));
        }
        facts.push(("split".into(), self.split.clone()));
        facts.extend(self.detections.iter().map(|given| ("detections".into(), given.clone())));
        if let (Some(checkpoint), Some(detector)) = (&self.checkpoint, &self.detector) {
            facts.push(("checkpoint".into(), format!("{} of {}", checkpoint.display(), detector.display())));
        }
        let BootstrapOptions { replicates, seed, level, .. } = BootstrapOptions::default();
        let blocks = self.block_frames;
        let percent = 100.0 * level;
        let text = format!("{percent:.0} % of {replicates} draws of frames in blocks of {blocks}, seed {seed}");
        facts.push(("intervals".into(), text));
        facts
    }
}

fn print_ranks(comparison: &Comparison, out: &Path) {
    for warning in &comparison.warnings {
        errln!("note: {warning}");
    }
    let shown = |kind: CriterionKind| comparison.criteria.iter().find(move |c| c.kind == kind);
    for criterion in [CriterionKind::DetectorGap, CriterionKind::Distance, CriterionKind::Diagnosis].map(shown) {
        let Some(criterion) = criterion else { continue };
        outln!("{} ({} frames)", criterion.name, criterion.frames);
        let mut rows: Vec<_> = criterion.rows.iter().collect();
        rows.sort_by_key(|row| row.rank.unwrap_or(usize::MAX));
        for row in rows {
            let rank = row.rank.map_or("-".to_string(), |rank| rank.to_string());
            let size = row.size.map_or("undefined".to_string(), |v| format!("{v:.4}"));
            let interval = row.interval.map_or(String::new(), |i| format!(" [{:.4}, {:.4}]", i.low, i.high));
            let behind = match (row.behind_first, row.behind_interval) {
                (Some(v), Some(i)) => format!("; behind the first by {v:.4} [{:.4}, {:.4}]", i.low, i.high),
                (Some(v), None) => format!("; behind the first by {v:.4}"),
                (None, _) => String::new(),
            };
            outln!("  {rank}. {}: {size} {}{interval}{behind}", row.simulation, criterion.unit);
        }
    }
    outln!("page: {}", out.join("comparison.html").display());
}
