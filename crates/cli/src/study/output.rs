//! Output of `lidarshift study`: results on stdout, progress on stderr.

use crate::console::escaped;
use crate::{errln, out, outln};
use eval::matrix::Matrix;
use indicatif::{ProgressBar, ProgressStyle};
use report::ReportFiles;
use std::collections::BTreeMap;
use std::sync::Mutex;
use study::{Event, FrozenState, Planned, RunState, RunStatus, ScatterFrom, Study, duration};

/// Prints the events of a study; the frames of a data set as a progress bar.
pub fn listener() -> impl Fn(Event<'_>) + Sync {
    let shown = Mutex::new(None::<ProgressBar>);
    move |event| match event {
        Event::Note(text) => errln!("{text}"),
        Event::Result(text) => outln!("{text}"),
        Event::Frames { dataset, done, total } => {
            let mut shown = shown.lock().expect("no panic happens while the lock is held");
            let bar = shown.get_or_insert_with(|| frames_bar(dataset));
            bar.set_length(total as u64);
            bar.set_position(done as u64);
        }
        Event::DatasetMade => {
            if let Some(bar) = shown.lock().expect("no panic happens while the lock is held").take() {
                bar.finish_and_clear();
            }
        }
    }
}

fn frames_bar(dataset: &str) -> ProgressBar {
    let style = ProgressStyle::with_template("{msg} {bar:30} {pos}/{len} frames, {eta} left");
    ProgressBar::new(0).with_style(style.expect("the template is valid")).with_message(escaped(dataset).into_owned())
}

/// Prints the matrix and the path of the report.
pub(super) fn print_results(matrix: &Matrix, files: &ReportFiles) {
    outln!("{}", matrix.to_markdown());
    outln!("report: {} ({:.1} MB)", files.page.display(), files.page_bytes as f64 / 1e6);
}

/// Prints what a study will be able to see, and its cost where it is known.
pub(super) fn print_plan(study: &Study, planned: &[Planned], runs: &[RunStatus]) {
    outln!("Smallest difference of 3D AP between two train sets that is seen in 80 of 100 repetitions of the study:");
    outln!("{:<28} {:<20} {:>7} {:>5} {:>6} {:>10}", "network", "tested on", "overlap", "seeds", "frames", "points");
    for p in planned {
        let stored = if p.from == ScatterFrom::Stored { "  *" } else { "" };
        outln!(
            "{:<28} {:<20} {:>7} {:>5} {:>6} {:>10.1}{stored}",
            p.network,
            p.test_set,
            p.overlap,
            p.seeds,
            p.frames,
            p.detectable
        );
    }
    if planned.iter().any(|p| p.from == ScatterFrom::Stored) {
        outln!("* with the stored scatter of the study quick; --pilot FOLDER takes that of a study with results");
    }
    let known: Vec<f64> = runs.iter().filter_map(|status| status.remaining_s).collect();
    match known.len() == runs.len() {
        true => outln!("{} runs, {} of computing time left", runs.len(), duration(known.iter().sum())),
        false => outln!(
            "{} runs; their cost is not known yet: `lidarshift study {} --dry-run` measures a step once the data exist",
            runs.len(),
            study.named
        ),
    }
}

/// Prints one line per run, the number of runs in each state, and the remaining computing time if it is known.
pub(super) fn print_status(study: &Study, runs: &[RunStatus]) {
    let width = runs.iter().map(|status| status.run.to_string().len()).max().unwrap_or(0);
    let (mut counts, mut remaining_s, mut unknown) = (BTreeMap::<&str, usize>::new(), 0.0, 0);
    outln!("{:<width$}  {:<8}  {:<10}  {:>9}", "run", "state", "step", "left");
    for status in runs {
        let (state, step, note) = state_texts(&status.run_state);
        *counts.entry(state).or_default() += 1;
        match status.remaining_s {
            Some(s) => remaining_s += s,
            None => unknown += 1,
        }
        let left = status.remaining_s.map_or("-".into(), |s| if s == 0.0 { String::new() } else { duration(s) });
        outln!("{:<width$}  {state:<8}  {step:<10}  {left:>9}  {note}", status.run.to_string());
    }
    let counts: Vec<String> = counts.iter().map(|(state, n)| format!("{n} {state}")).collect();
    out!("{} runs, each tested on {} data sets: {}", runs.len(), study.config.datasets.len(), counts.join(", "));
    match (remaining_s > 0.0, unknown) {
        (_, n) if n > 0 => outln!("; the computing time of {n} runs is not measured yet"),
        (true, _) => outln!("; remaining computing time about {}, without parallel runs", duration(remaining_s)),
        _ => outln!(),
    }
}

/// Prints one line for each frozen detector and data set.
pub(super) fn print_frozen(state: &FrozenState) {
    for (name, test_set, missing) in state.lines() {
        outln!("frozen {name} on {test_set}: {}", missing.unwrap_or("read"));
    }
}

/// State, step and note of a run.
fn state_texts(run_state: &RunState) -> (&'static str, String, String) {
    let of = |step: &u64, total: &u64| if *total > 0 { format!("{step}/{total}") } else { String::new() };
    match run_state {
        RunState::Done => ("done", String::new(), String::new()),
        RunState::Trained(tests) => ("trained", String::new(), format!("not tested on {}", tests.join(", "))),
        RunState::Running(step, total) => ("running", of(step, total), String::new()),
        RunState::Stopped(step, total) => ("stopped", of(step, total), String::new()),
        RunState::Failed(reason) => ("failed", String::new(), reason.clone()),
        RunState::Other(differences) => {
            ("invalid", String::new(), format!("made with other settings: {}", differences.join("; ")))
        }
        RunState::Missing => ("missing", String::new(), String::new()),
    }
}
