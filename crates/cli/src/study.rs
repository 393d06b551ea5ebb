//! `lidarshift study`: runs a whole study: data sets, training runs, detections, evaluation, report. Existing results
//! are kept.

mod output;

pub use output::listener;

use crate::device::DeviceArgs;
use crate::json::JsonArgs;
use anyhow::{Result, bail};
use clap::{Args, Subcommand, ValueEnum};
use data::Presence as _;
use std::path::{Path, PathBuf};
use study::{FrozenState, Launcher, PlanReport, RunOptions, StatusReport, Step, Study, plan, status};

/// Run a study: generate the missing data sets, train the missing runs, detect on every test set, evaluate, and write a
/// report. The expected computing time is printed before training starts.
///
/// The study can be interrupted at any moment; run the same command again to resume it. Existing results are kept. Runs
/// that are invalid after a change of the study's TOML are listed; --replace repeats them.
///
/// Examples:
///   lidarshift study quick
///   lidarshift study quick --dry-run
///   lidarshift study status quick
///   lidarshift study plan cpu --pilot runs/quick
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
    /// Only these steps, separated by commas [default: all]
    #[arg(long, value_enum, value_delimiter = ',', value_name = "STEPS")]
    only: Vec<StepArg>,
    #[command(flatten)]
    scheduling: SchedulingArgs,
    #[command(flatten)]
    device: DeviceArgs,
    #[command(flatten)]
    json: JsonArgs,
}

#[derive(Subcommand, Debug)]
enum StudyCommand {
    /// State of each run and the remaining computing time
    Status {
        #[command(flatten)]
        selection: StudySelection,
        #[command(flatten)]
        json: JsonArgs,
    },
    /// The differences that a study will be able to see with 80 % power, and what it costs; nothing is run
    Plan {
        #[command(flatten)]
        selection: StudySelection,
        /// Folder of a study whose results say how much differences scatter [default: the study's own results, else
        /// stored values]
        #[arg(long, value_name = "DIR")]
        pilot: Option<PathBuf>,
        #[command(flatten)]
        json: JsonArgs,
    },
}

/// A study selected on the command line.
#[derive(Args, Clone, Debug)]
pub struct StudySelection {
    /// A name (quick, cpu, gain, paper), a TOML, or the folder of a study
    #[arg(value_name = "STUDY")]
    study: String,
    /// Folder of the study [default: runs/NAME]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

impl StudySelection {
    /// Opens the study.
    ///
    /// # Errors
    /// Neither a known name nor a file, or an invalid file.
    pub fn open(&self) -> Result<Study> {
        Ok(Study::open(&self.study, self.out.as_deref())?)
    }

    /// The given path if it is a folder that is not the folder of a study.
    pub fn folder_of_runs(&self) -> Option<&Path> {
        let folder = Path::new(&self.study);
        (folder.may_be_folder() && !Study::is_folder(folder)).then_some(folder)
    }
}

/// Options for executing the runs of a study.
#[derive(Args, Clone, Debug)]
pub struct SchedulingArgs {
    /// Where the runs of a study are executed: local (this machine), or slurm (as job arrays)
    #[arg(long, value_enum, default_value = "local", requires = "study")]
    launcher: LauncherArg,
    /// Print the missing runs and their expected computing time, then exit
    #[arg(long, requires = "study")]
    dry_run: bool,
    /// Number of parallel runs on this machine [default: from cores and memory]
    #[arg(long, value_name = "N", requires = "study")]
    jobs: Option<usize>,
    /// Remove and repeat runs whose settings differ from those of the study
    #[arg(long, requires = "study")]
    replace: bool,
    /// Options for sbatch, after --
    #[arg(last = true, value_name = "SBATCH", requires = "study")]
    sbatch: Vec<String>,
}

impl SchedulingArgs {
    /// The options to run these steps of a study on this device.
    pub fn options(self, steps: Vec<Step>, device: &DeviceArgs) -> RunOptions {
        let launcher = match self.launcher {
            LauncherArg::Local => Launcher::Local,
            LauncherArg::Slurm => Launcher::Slurm,
        };
        let SchedulingArgs { dry_run, jobs, replace, sbatch, .. } = self;
        RunOptions { steps, launcher, dry_run, jobs, replace, sbatch, device: device.arguments(), gpus: device.gpus() }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum LauncherArg {
    Local,
    Slurm,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum StepArg {
    /// Generate the data sets
    Data,
    /// Train the runs
    Train,
    /// Detect on the test sets
    Detect,
    /// Evaluate and write the report
    Report,
}

impl StepArg {
    fn step(self) -> Step {
        match self {
            StepArg::Data => Step::Data,
            StepArg::Train => Step::Train,
            StepArg::Detect => Step::Detect,
            StepArg::Report => Step::Report,
        }
    }
}

impl StudyArgs {
    /// Runs the study, or prints its status.
    ///
    /// # Errors
    /// A step that fails. Failed runs are reported after all other runs have ended.
    pub fn run(self) -> Result<()> {
        match self.command {
            Some(StudyCommand::Status { selection, json }) => {
                json.check([])?;
                let study = selection.open()?;
                let (runs, frozen) = (status(&study)?, FrozenState::read(&study)?);
                json.write(&StatusReport::new(&study, &runs, &frozen))?;
                output::print_status(&study, &runs);
                if !study.config.frozen.is_empty() {
                    output::print_frozen(&frozen);
                }
                return Ok(());
            }
            Some(StudyCommand::Plan { selection, pilot, json }) => {
                json.check([])?;
                let study = selection.open()?;
                let planned = plan(&study, pilot.as_deref())?;
                json.write(&PlanReport::new(&study, &planned))?;
                output::print_plan(&study, &planned, &status(&study)?);
                return Ok(());
            }
            None => {}
        }
        let Some(named) = self.study else { bail!("the study is missing; for example: `lidarshift study quick`") };
        let steps = match self.only.is_empty() {
            true => Step::ALL.to_vec(),
            false => self.only.iter().map(|step| step.step()).collect(),
        };
        if self.json.is_given() && (self.scheduling.dry_run || !steps.contains(&Step::Report)) {
            bail!("--json is for the matrix, which the step `report` makes; leave out --json, or --dry-run and --only");
        }
        self.json.check([])?;
        run_study(&Study::open(&named, self.out.as_deref())?, &self.scheduling.options(steps, &self.device), &self.json)
    }
}

/// Runs the steps of a study and prints its matrix and the path of its report; the matrix also goes to `json`.
///
/// # Errors
/// A step that fails. Failed runs are reported after all other runs have ended.
pub fn run_study(study: &Study, options: &RunOptions, json: &JsonArgs) -> Result<()> {
    let outcome = study::run_study(study, options, &listener())?;
    if let Some((matrix, files)) = &outcome.report {
        json.write(matrix)?;
        output::print_results(matrix, files);
    }
    if !outcome.failed.is_empty() {
        let names: Vec<String> = outcome.failed.iter().map(|(run, reason)| format!("{run}: {reason}")).collect();
        bail!("{} runs of the study have no result:\n  {}", outcome.failed.len(), names.join("\n  "));
    }
    Ok(())
}
