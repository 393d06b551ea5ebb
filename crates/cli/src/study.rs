//! `lidarshift study`: everything about one study file: data sets, runs, detections, numbers, report. Whatever is there already is kept.

pub mod clouds;
pub mod cost;
pub mod features;
pub mod folder;
pub mod numbers;
pub mod present;
pub mod work;

mod cache;
mod data_sets;
mod detections;
mod local;
mod slurm;
mod standing;
mod status;

use crate::device::DeviceArgs;
use anyhow::{Result, bail};
use clap::{Args, Subcommand, ValueEnum};
use cost::{Costs, costs, duration, left};
use eval::matrix::Matrix;
use eval::study::StudyRun;
use folder::Study;
use local::{LocalJobs, work_on};
use standing::{AtWork, Standing, standing};
use std::path::{Path, PathBuf};
use work::RunPart;

/// A whole study: makes the data sets that are missing, trains the runs that are missing, detects every test set, compares, and writes one
/// report. Before the first step it says what all will cost.
///
/// It can be stopped at any moment, and goes on where it was when it is started again with the same words. What is there already is kept;
/// what a change of the study's file makes invalid is said, and made anew with --replace.
///
/// Examples:
///   lidarshift study quick
///   lidarshift study quick --dry-run
///   lidarshift study status quick
///   lidarshift study my-study.toml --out runs/mine --only data,train
///   lidarshift study paper --launcher slurm -- --gres=gpu:1 --time=24:00:00
#[derive(Args, Debug)]
#[command(verbatim_doc_comment, args_conflicts_with_subcommands = true)]
pub struct StudyArgs {
    #[command(subcommand)]
    command: Option<StudyCommand>,
    /// A name (quick, cpu, gain, paper), a TOML, or the folder of a study
    #[arg(value_name = "STUDY")]
    study: Option<String>,
    /// Folder of the study [default: runs/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Only these steps, with commas between them [default: all]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "STEPS")]
    only: Vec<Step>,
    #[command(flatten)]
    how: HowToRun,
    #[command(flatten)]
    device: DeviceArgs,
}

#[derive(Subcommand, Debug)]
enum StudyCommand {
    /// Where the runs of a study stand, and how long the rest will take
    Status(StudyPlace),
}

/// Which study.
#[derive(Args, Clone, Debug)]
pub struct StudyPlace {
    /// A name (quick, cpu, gain, paper), a TOML, or the folder of a study
    #[arg(value_name = "STUDY")]
    study: String,
    /// Folder of the study [default: runs/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

impl StudyPlace {
    /// The study.
    ///
    /// # Errors
    /// Neither a name nor a file, or a file that is wrong.
    pub fn open(&self) -> Result<Study> {
        Study::open(&self.study, self.out.as_deref())
    }

    /// The folder that was named, if it is one and no study's.
    pub fn runs_alone(&self) -> Option<&Path> {
        let folder = Path::new(&self.study);
        (folder.is_dir() && !folder.join(folder::COPY).is_file()).then_some(folder)
    }
}

/// How the runs of a study are worked on.
#[derive(Args, Clone, Debug)]
pub struct HowToRun {
    /// Who starts the runs of a study: this machine, or Slurm as job arrays
    #[arg(long, value_enum, default_value = "local", requires = "study")]
    launcher: Launcher,
    /// Say what is missing and what it will cost, and stop
    #[arg(long, requires = "study")]
    dry_run: bool,
    /// Runs at once on this machine [default: by cores and memory]
    #[arg(long, value_name = "N", requires = "study")]
    jobs: Option<usize>,
    /// Remove runs that were made with other settings than the study's, and make them anew
    #[arg(long, requires = "study")]
    replace: bool,
    /// Words for sbatch, behind --
    #[arg(last = true, value_name = "SBATCH", requires = "study")]
    sbatch: Vec<String>,
}

impl HowToRun {
    /// On this machine, as many at once as fit.
    pub fn here() -> Self {
        HowToRun { launcher: Launcher::Local, dry_run: false, jobs: None, replace: true, sbatch: Vec::new() }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Launcher {
    Local,
    Slurm,
}

/// A step of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Step {
    /// Data sets
    Data,
    /// Training
    Train,
    /// Detections of the test sets
    Detect,
    /// Numbers, figures and the page
    Report,
}

impl StudyArgs {
    /// Works on the study to its end, or says where it stands.
    ///
    /// # Errors
    /// What cannot be made; runs that failed, behind everything else.
    pub fn run(self) -> Result<()> {
        if let Some(StudyCommand::Status(place)) = self.command {
            return status::print_status(&place.open()?);
        }
        let Some(named) = self.study else { bail!("which study? `lidarshift study quick`, for one") };
        let steps = if self.only.is_empty() { Step::value_variants().to_vec() } else { self.only };
        run_study(&Study::open(&named, self.out.as_deref())?, &steps, &self.how, &self.device)
    }
}

/// The steps of a study, in their order.
///
/// # Errors
/// As [`StudyArgs::run`].
pub fn run_study(study: &Study, steps: &[Step], how: &HowToRun, device: &DeviceArgs) -> Result<()> {
    for line in study.note_changes()? {
        eprintln!("the study's file changed: {line}");
    }
    if steps.contains(&Step::Data) {
        data_sets::make_datasets(study)?;
    }
    let device = device.words();
    let wanted = |step, part| steps.contains(&step).then_some(part);
    let parts: Vec<RunPart> =
        [wanted(Step::Train, RunPart::Train), wanted(Step::Detect, RunPart::Detect)].into_iter().flatten().collect();
    let mut failed = Vec::new();
    if !parts.is_empty() {
        let invalid = invalid_runs(study, how.replace && !how.dry_run)?;
        let missing = missing_runs(study, &parts)?;
        let jobs = LocalJobs::by_cores(missing.len(), how.jobs, &device);
        let known = costs(study, &missing, jobs.threads, &device)?;
        let jobs = if how.jobs.is_some() { jobs } else { jobs.within_memory(&known) };
        say_costs(study, &missing, &known, &jobs)?;
        if how.dry_run {
            return Ok(());
        }
        if how.launcher == Launcher::Slurm {
            return slurm::submit(study, &missing, steps, &device, &how.sbatch);
        }
        failed = invalid;
        failed.extend(work_on(study, &missing, &parts, &jobs, &known)?);
    }
    if steps.contains(&Step::Report) && !how.dry_run {
        let (matrix, files) = present::write_report(study)?;
        say_results(&matrix, &files);
    }
    if !failed.is_empty() {
        let names: Vec<String> = failed.iter().map(|(run, reason)| format!("{run}: {reason}")).collect();
        bail!("{} runs of the study have no result:\n  {}", failed.len(), names.join("\n  "));
    }
    Ok(())
}

/// Runs whose folders hold other settings; removed, when they are to be replaced.
fn invalid_runs(study: &Study, replace: bool) -> Result<Vec<(String, String)>> {
    let mut invalid = Vec::new();
    for run in study.config.runs() {
        let folder = run.folder(&study.folder);
        let Standing::Other(differences) = standing(study, &run)? else { continue };
        let differences = differences.join("; ");
        if !replace {
            eprintln!("{run} was made with other settings ({differences}); --replace makes it anew");
            invalid
                .push((run.to_string(), format!("made with other settings ({differences}); --replace makes it anew")));
            continue;
        }
        let Some(_at_work) = AtWork::take(&folder)? else { bail!("another process is working on {run}; wait for it") };
        eprintln!("{run} was made with other settings ({differences}): removed");
        fs_err::remove_dir_all(&folder)?;
    }
    Ok(invalid)
}

/// Runs that have something left of these parts.
fn missing_runs(study: &Study, parts: &[RunPart]) -> Result<Vec<StudyRun>> {
    let mut missing = Vec::new();
    for run in study.config.runs() {
        let left = match standing(study, &run)? {
            Standing::Done | Standing::Other(_) => false,
            Standing::Trained(_) => parts.contains(&RunPart::Detect),
            _ => true,
        };
        missing.extend(left.then_some(run));
    }
    Ok(missing)
}

fn say_costs(study: &Study, missing: &[StudyRun], costs: &Costs, jobs: &LocalJobs) -> Result<()> {
    let mut total_s = 0.0;
    let unknown = missing.iter().filter(|run| !costs.contains_key(&run.id.network)).count();
    for (network, cost) in costs {
        let of_network: Vec<_> = missing.iter().filter(|run| run.id.network == *network).collect();
        let lefts = of_network.iter().map(|run| left(study, run, costs)).collect::<Result<Vec<_>>>()?;
        let (steps, frames) = lefts.iter().fold((0, 0), |(s, f), left| (s + left.steps, f + left.frames));
        let seconds: f64 = lefts.iter().filter_map(|left| left.seconds).sum();
        if of_network.is_empty() {
            continue;
        }
        eprintln!(
            "{network}: {} runs, {steps} steps of {:.3} s and {frames} frames to detect of {:.3} s: {} on one process ({} threads, {} MiB)",
            of_network.len(),
            cost.step_s,
            cost.detection_s,
            duration(seconds),
            cost.threads,
            cost.peak_mib
        );
        total_s += seconds;
    }
    match missing.len() {
        0 => eprintln!("no run is missing"),
        _ if unknown > 0 => eprintln!("what {unknown} runs will take is not known"),
        n => eprintln!("{n} runs, {} at once: about {}", jobs.at_once, duration(total_s / jobs.at_once.min(n) as f64)),
    }
    Ok(())
}

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn say_results(matrix: &Matrix, files: &report::ReportFiles) {
    println!("{}", matrix.to_markdown());
    println!("report: {} ({:.1} MB)", files.page.display(), files.page_bytes as f64 / 1e6);
}
