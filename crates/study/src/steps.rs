//! The steps of a study, in their order. What is there already is kept.

use crate::config::StudyRun;
use crate::cost::{Costs, costs, duration, left};
use crate::data_sets::make_datasets;
use crate::error::{Result, refused};
use crate::folder::Study;
use crate::local::{LocalJobs, work_on};
use crate::present::write_report;
use crate::slurm::submit;
use crate::standing::{AtWork, Standing, standing};
use crate::work::RunPart;
use crate::{Event, Listener};
use eval::matrix::Matrix;
use report::ReportFiles;

/// A step of a study.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// Data sets.
    Data,
    /// Training.
    Train,
    /// Detections of the test sets.
    Detect,
    /// Numbers, figures and the page.
    Report,
}

impl Step {
    /// All of them, in their order.
    pub const ALL: [Step; 4] = [Step::Data, Step::Train, Step::Detect, Step::Report];
}

/// Who starts the runs of a study.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Launcher {
    /// This machine.
    #[default]
    Local,
    /// Slurm, as job arrays.
    Slurm,
}

/// How a study is worked on.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunOptions {
    /// The steps to take.
    pub steps: Vec<Step>,
    /// Who starts the runs.
    pub launcher: Launcher,
    /// Say what is missing and what it will cost, and stop.
    pub dry_run: bool,
    /// Runs at once on this machine; `None`: by cores and memory.
    pub jobs: Option<usize>,
    /// Remove runs that were made with other settings than the study's, and make them anew.
    pub replace: bool,
    /// Words for sbatch.
    pub sbatch: Vec<String>,
    /// Words that name the device to the process of a run.
    pub device: Vec<String>,
}

impl RunOptions {
    /// All steps on this machine, as many runs at once as fit; runs with other settings are replaced.
    pub fn here(device: Vec<String>) -> Self {
        RunOptions {
            steps: Step::ALL.to_vec(),
            launcher: Launcher::Local,
            dry_run: false,
            jobs: None,
            replace: true,
            sbatch: Vec::new(),
            device,
        }
    }
}

/// What came of a study.
#[derive(Clone, Debug, Default)]
pub struct Outcome {
    /// The matrix and the files of the report, where one was written.
    pub report: Option<(Matrix, ReportFiles)>,
    /// Runs without a result, each with the reason.
    pub failed: Vec<(String, String)>,
}

/// Takes the steps of a study.
///
/// # Errors
/// What cannot be made. Runs that fail are no error: they stand in [`Outcome::failed`].
pub fn run_study(study: &Study, options: &RunOptions, listener: Listener<'_>) -> Result<Outcome> {
    let RunOptions { steps, device, .. } = options;
    for line in study.note_changes()? {
        listener(Event::Note(&format!("the study's file changed: {line}")));
    }
    if steps.contains(&Step::Data) {
        make_datasets(study, listener)?;
    }
    let wanted = |step, part| steps.contains(&step).then_some(part);
    let parts: Vec<RunPart> =
        [wanted(Step::Train, RunPart::Train), wanted(Step::Detect, RunPart::Detect)].into_iter().flatten().collect();
    let mut outcome = Outcome::default();
    if !parts.is_empty() {
        let invalid = invalid_runs(study, options.replace && !options.dry_run, listener)?;
        let missing = missing_runs(study, &parts)?;
        let jobs = LocalJobs::by_cores(missing.len(), options.jobs, device);
        let known = costs(study, &missing, jobs.threads, device, listener)?;
        let jobs = if options.jobs.is_some() { jobs } else { jobs.within_memory(&known) };
        note_costs(study, &missing, &known, &jobs, listener)?;
        if options.dry_run {
            return Ok(outcome);
        }
        if options.launcher == Launcher::Slurm {
            submit(study, &missing, options, listener)?;
            return Ok(outcome);
        }
        outcome.failed = invalid;
        outcome.failed.extend(work_on(study, &missing, &parts, &jobs, &known, listener)?);
    }
    if steps.contains(&Step::Report) && !options.dry_run {
        outcome.report = Some(write_report(study, listener)?);
    }
    Ok(outcome)
}

/// Runs whose folders hold other settings; removed, when they are to be replaced.
fn invalid_runs(study: &Study, replace: bool, listener: Listener<'_>) -> Result<Vec<(String, String)>> {
    let note = |text: String| listener(Event::Note(&text));
    let mut invalid = Vec::new();
    for run in study.config.runs() {
        let folder = run.folder(&study.folder);
        let Standing::Other(differences) = standing(study, &run)? else { continue };
        let differences = differences.join("; ");
        if !replace {
            note(format!("{run} was made with other settings ({differences}); --replace makes it anew"));
            invalid
                .push((run.to_string(), format!("made with other settings ({differences}); --replace makes it anew")));
            continue;
        }
        let Some(_at_work) = AtWork::take(&folder)? else {
            return Err(refused(format!("another process is working on {run}; wait for it")));
        };
        note(format!("{run} was made with other settings ({differences}): removed"));
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
        let lefts = of_network.iter().map(|run| left(study, run, costs)).collect::<Result<Vec<_>>>()?;
        let (steps, frames) = lefts.iter().fold((0, 0), |(s, f), left| (s + left.steps, f + left.frames));
        let seconds: f64 = lefts.iter().filter_map(|left| left.seconds).sum();
        if of_network.is_empty() {
            continue;
        }
        note(&format!(
            "{network}: {} runs, {steps} steps of {:.3} s and {frames} frames to detect of {:.3} s: {} on one process \
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
        _ if unknown > 0 => note(&format!("what {unknown} runs will take is not known")),
        n => {
            let all = duration(total_s / jobs.at_once.min(n) as f64);
            note(&format!("{n} runs, {} at once: about {all}", jobs.at_once));
        }
    }
    Ok(())
}
