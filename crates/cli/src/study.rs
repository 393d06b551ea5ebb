//! `lidarshift study`: everything about one study file: data sets, runs, detections, numbers, report. Whatever is there already is kept.

mod output;

pub use output::listener;

use crate::device::DeviceArgs;
use anyhow::{Result, bail};
use clap::{Args, Subcommand, ValueEnum};
use std::path::{Path, PathBuf};
use study::{Launcher, RunOptions, Step, Study, status};

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
    only: Vec<StepWord>,
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
        Ok(Study::open(&self.study, self.out.as_deref())?)
    }

    /// The folder that was named, if it is one and no study's.
    pub fn runs_alone(&self) -> Option<&Path> {
        let folder = Path::new(&self.study);
        (folder.is_dir() && !Study::is_folder(folder)).then_some(folder)
    }
}

/// How the runs of a study are worked on.
#[derive(Args, Clone, Debug)]
pub struct HowToRun {
    /// Who starts the runs of a study: this machine, or Slurm as job arrays
    #[arg(long, value_enum, default_value = "local", requires = "study")]
    launcher: LauncherWord,
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
    /// The options of a study that takes these steps on this device.
    pub fn options(self, steps: Vec<Step>, device: &DeviceArgs) -> RunOptions {
        let launcher = match self.launcher {
            LauncherWord::Local => Launcher::Local,
            LauncherWord::Slurm => Launcher::Slurm,
        };
        let HowToRun { dry_run, jobs, replace, sbatch, .. } = self;
        RunOptions { steps, launcher, dry_run, jobs, replace, sbatch, device: device.words() }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum LauncherWord {
    Local,
    Slurm,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum StepWord {
    /// Data sets
    Data,
    /// Training
    Train,
    /// Detections of the test sets
    Detect,
    /// Numbers, figures and the page
    Report,
}

impl StepWord {
    fn step(self) -> Step {
        match self {
            StepWord::Data => Step::Data,
            StepWord::Train => Step::Train,
            StepWord::Detect => Step::Detect,
            StepWord::Report => Step::Report,
        }
    }
}

impl StudyArgs {
    /// Works on the study to its end, or says where it stands.
    ///
    /// # Errors
    /// What cannot be made; runs that failed, behind everything else.
    pub fn run(self) -> Result<()> {
        if let Some(StudyCommand::Status(place)) = self.command {
            let study = place.open()?;
            output::print_status(&study, &status(&study)?);
            return Ok(());
        }
        let Some(named) = self.study else { bail!("which study? `lidarshift study quick`, for one") };
        let steps = match self.only.is_empty() {
            true => Step::ALL.to_vec(),
            false => self.only.iter().map(|word| word.step()).collect(),
        };
        run_study(&Study::open(&named, self.out.as_deref())?, &self.how.options(steps, &self.device))
    }
}

/// Takes the steps of a study and prints its matrix and where its report lies.
///
/// # Errors
/// What cannot be made; runs that failed, behind everything else.
pub fn run_study(study: &Study, options: &RunOptions) -> Result<()> {
    let outcome = study::run_study(study, options, &listener())?;
    if let Some((matrix, files)) = &outcome.report {
        output::print_results(matrix, files);
    }
    if !outcome.failed.is_empty() {
        let names: Vec<String> = outcome.failed.iter().map(|(run, reason)| format!("{run}: {reason}")).collect();
        bail!("{} runs of the study have no result:\n  {}", outcome.failed.len(), names.join("\n  "));
    }
    Ok(())
}
