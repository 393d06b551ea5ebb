//! Runs the steps of a study in order. Existing results are kept.

use crate::config::StudyRun;
use crate::cost::{Costs, costs, duration, remaining};
use crate::data_sets::{absent_datasets, make_datasets};
use crate::error::{Result, StudyError};
use crate::folder::Study;
use crate::local::{LocalJobs, run_all};
use crate::present::write_report;
use crate::run_state::{RunLock, RunState, run_state};
use crate::slurm::submit;
use crate::work::RunPart;
use crate::{Event, Listener};
use data::FolderLock;
use eval::matrix::Matrix;
use report::ReportFiles;

/// A step of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Generating the data sets.
    Data,
    /// Training.
    Train,
    /// Detection on the test sets.
    Detect,
    /// Evaluation and report.
    Report,
}

impl Step {
    /// All steps in order.
    pub const ALL: [Step; 4] = [Step::Data, Step::Train, Step::Detect, Step::Report];
}

/// Where the runs of a study are executed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Launcher {
    /// This machine.
    #[default]
    Local,
    /// A Slurm cluster, as job arrays.
    Slurm,
}

/// Options for running a study.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunOptions {
    /// The steps to run.
    pub steps: Vec<Step>,
    /// Where the runs are executed.
    pub launcher: Launcher,
    /// Only report the missing runs and their expected computing time.
    pub dry_run: bool,
    /// Number of parallel runs on this machine; `None`: from cores and memory.
    pub jobs: Option<usize>,
    /// Remove and repeat runs whose settings differ from those of the study.
    pub replace: bool,
    /// Options for sbatch.
    pub sbatch: Vec<String>,
    /// Command line arguments of the device for the process of a run.
    pub device: Vec<String>,
    /// Names of this machine's GPUs for [`GPU_VARIABLE`](crate::GPU_VARIABLE), one run each; empty: one run at a time.
    pub gpus: Vec<String>,
}

impl RunOptions {
    /// All steps on this machine with as many parallel runs as fit; runs with other settings are replaced.
    pub fn here(device: Vec<String>) -> Self {
        RunOptions {
            steps: Step::ALL.to_vec(),
            launcher: Launcher::Local,
            dry_run: false,
            jobs: None,
            replace: true,
            sbatch: Vec::new(),
            device,
            gpus: Vec::new(),
        }
    }
}

/// Result of a study.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// The matrix and the files of the report, if it was written.
    pub report: Option<(Matrix, ReportFiles)>,
    /// Names of the runs without a result, with the reasons.
    pub failed: Vec<(String, String)>,
}

/// Runs the steps of a study.
///
/// # Errors
/// A step that fails. Failed runs are not an error; they are returned in [`Outcome::failed`].
pub fn run_study(study: &Study, options: &RunOptions, listener: Listener<'_>) -> Result<Outcome> {
    if options.dry_run {
        return dry_run(study, options, listener).map(|()| Outcome::default());
    }
    let RunOptions { steps, device, .. } = options;
    let _lock = FolderLock::acquire(&study.folder)?;
    for line in study.changes()? {
        listener(Event::Note(&format!("the study has changed: {line}")));
    }
    study.update_copy()?;
    if study.config.plan().networks.is_empty() {
        listener(Event::Note("the study has no detector; only its data sets are compared"));
    }
    if steps.contains(&Step::Data) {
        make_datasets(study, listener)?;
    }
    if steps.contains(&Step::Detect) {
        crate::frozen::prepare(study, device, listener)?;
    }
    let parts = parts_of(steps);
    let mut outcome = Outcome::default();
    if !parts.is_empty() && study.config.trains() {
        let invalid = invalid_runs(study, options.replace, listener)?;
        let missing = missing_runs(study, &parts)?;
        let (jobs, known) = note_expected(study, &missing, options, listener)?;
        if options.launcher == Launcher::Slurm {
            submit(study, &missing, options, listener)?;
            return Ok(outcome);
        }
        outcome.failed = invalid;
        outcome.failed.extend(run_all(study, &missing, &parts, &jobs, &known, listener)?);
    }
    if steps.contains(&Step::Report) {
        outcome.report = Some(write_report(study, listener)?);
    }
    Ok(outcome)
}

/// The parts of a run that these steps execute.
fn parts_of(steps: &[Step]) -> Vec<RunPart> {
    let wanted = |step, part| steps.contains(&step).then_some(part);
    [wanted(Step::Train, RunPart::Train), wanted(Step::Detect, RunPart::Detect)].into_iter().flatten().collect()
}

/// Reports what a study would do, without generating data sets or changing a run. Only the measured time of a step is
/// written into the folder of a study whose data sets exist.
fn dry_run(study: &Study, options: &RunOptions, listener: Listener<'_>) -> Result<()> {
    let note = |text: &str| listener(Event::Note(text));
    for line in study.changes()? {
        note(&format!("the study has changed: {line}"));
    }
    let parts = parts_of(&options.steps);
    let absent = absent_datasets(study);
    if !absent.is_empty() {
        note(&format!("data sets that would be generated: {}", absent.join(", ")));
    }
    if parts.is_empty() || !study.config.trains() {
        return Ok(());
    }
    if !absent.is_empty() {
        let missing = study.config.runs().len();
        note(&format!(
            "{missing} runs; their computing time is measured once the data sets exist: `lidarshift study {} --only data`",
            study.named
        ));
        return Ok(());
    }
    invalid_runs(study, false, listener)?;
    let missing = missing_runs(study, &parts)?;
    note_expected(study, &missing, options, listener)?;
    Ok(())
}

/// Measures and reports the expected computing time of the missing runs.
fn note_expected(
    study: &Study,
    missing: &[StudyRun],
    options: &RunOptions,
    listener: Listener<'_>,
) -> Result<(LocalJobs, Costs)> {
    let jobs = LocalJobs::by_cores(missing.len(), options.jobs, &options.device, &options.gpus);
    let known = costs(study, missing, jobs.threads, (&options.device, options.dry_run), listener)?;
    let jobs = if options.jobs.is_some() { jobs } else { jobs.within_memory(&known) };
    note_costs(study, missing, &known, &jobs, listener)?;
    Ok((jobs, known))
}

/// Runs with other settings than those of the study, with the reasons. If `replace` is set, their folders are removed
/// instead.
fn invalid_runs(study: &Study, replace: bool, listener: Listener<'_>) -> Result<Vec<(String, String)>> {
    let note = |text: String| listener(Event::Note(&text));
    let mut invalid = Vec::new();
    for run in study.config.runs() {
        let folder = run.folder(&study.folder);
        let RunState::Other(differences) = run_state(study, &run)? else { continue };
        let differences = differences.join("; ");
        if !replace {
            note(format!("{run} has other settings ({differences}); repeat it with --replace"));
            invalid.push((run.to_string(), format!("it has other settings ({differences}); repeat it with --replace")));
            continue;
        }
        let Some(_lock) = RunLock::acquire(&folder)? else {
            return Err(StudyError::InUse(run.to_string()));
        };
        note(format!("{run} had other settings ({differences}) and was removed"));
        fs_err::remove_dir_all(&folder)?;
    }
    Ok(invalid)
}

/// Runs of which one of these parts is not finished.
fn missing_runs(study: &Study, parts: &[RunPart]) -> Result<Vec<StudyRun>> {
    let mut missing = Vec::new();
    for run in study.config.runs() {
        let unfinished = match run_state(study, &run)? {
            RunState::Done | RunState::Other(_) => false,
            RunState::Trained(_) => parts.contains(&RunPart::Detect),
            _ => true,
        };
        missing.extend(unfinished.then_some(run));
    }
    Ok(missing)
}

fn note_costs(
    study: &Study,
    missing: &[StudyRun],
    costs: &Costs,
    jobs: &LocalJobs,
    listener: Listener<'_>,
) -> Result<()> {
    let note = |text: &str| listener(Event::Note(text));
    let mut total_s = 0.0;
    let unknown = missing.iter().filter(|run| !costs.contains_key(&run.id.network)).count();
    for (network, cost) in costs {
        let of_network: Vec<_> = missing.iter().filter(|run| run.id.network == *network).collect();
        let work = of_network.iter().map(|run| remaining(study, run, costs)).collect::<Result<Vec<_>>>()?;
        let (steps, frames) = work.iter().fold((0, 0), |(s, f), run| (s + run.steps, f + run.frames));
        let seconds: f64 = work.iter().filter_map(|run| run.seconds).sum();
        if of_network.is_empty() {
            continue;
        }
        note(&format!(
            "{network}: {} runs with {steps} steps of {:.3} s and {frames} test frames of {:.3} s take {} in one process \
             ({} threads, {} MiB)",
            of_network.len(),
            cost.step_s,
            cost.detection_s,
            duration(seconds),
            cost.threads,
            cost.peak_mib
        ));
        total_s += seconds;
    }
    match missing.len() {
        0 => note("no run is missing"),
        _ if unknown > 0 => note(&format!("the computing time of {unknown} runs is unknown")),
        n => {
            let all = duration(total_s / jobs.at_once.min(n) as f64);
            note(&format!("{n} runs, {} in parallel: about {all}", jobs.at_once));
        }
    }
    Ok(())
}
