//! What `lidarshift study` prints: results on stdout, progress on stderr.

use eval::matrix::Matrix;
use indicatif::{ProgressBar, ProgressStyle};
use report::ReportFiles;
use std::collections::BTreeMap;
use std::sync::Mutex;
use study::{Event, RunStatus, Standing, Study, duration};

/// Prints what a study says while it works; the frames of a data set as a bar.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub fn listener() -> impl Fn(Event<'_>) + Sync {
    let shown = Mutex::new(None::<ProgressBar>);
    move |event| match event {
        Event::Note(text) => eprintln!("{text}"),
        Event::Result(text) => println!("{text}"),
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
    ProgressBar::new(0).with_style(style.expect("the template is right")).with_message(dataset.to_string())
}

/// The matrix, and where the report lies.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub(super) fn print_results(matrix: &Matrix, files: &ReportFiles) {
    println!("{}", matrix.to_markdown());
    println!("report: {} ({:.1} MB)", files.page.display(), files.page_bytes as f64 / 1e6);
}

/// A line a run, how many stand how, and how long the rest will take where that is known.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub(super) fn print_status(study: &Study, runs: &[RunStatus]) {
    let width = runs.iter().map(|status| status.run.to_string().len()).max().unwrap_or(0);
    let (mut counts, mut left_s, mut unknown) = (BTreeMap::<&str, usize>::new(), 0.0, 0);
    println!("{:<width$}  {:<8}  {:<10}  {:>9}", "run", "state", "step", "left");
    for status in runs {
        let (word, step, note) = words(&status.standing);
        *counts.entry(word).or_default() += 1;
        match status.left_s {
            Some(s) => left_s += s,
            None => unknown += 1,
        }
        let left = status.left_s.map_or("-".into(), |s| if s == 0.0 { String::new() } else { duration(s) });
        println!("{:<width$}  {word:<8}  {step:<10}  {left:>9}  {note}", status.run.to_string());
    }
    let counts: Vec<String> = counts.iter().map(|(word, n)| format!("{n} {word}")).collect();
    print!("{} runs, each tested on {} data sets: {}", runs.len(), study.config.datasets.len(), counts.join(", "));
    match (left_s > 0.0, unknown) {
        (_, n) if n > 0 => println!("; what {n} of them take is not known before their steps are measured"),
        (true, _) => println!("; about {} of computing left, one run after the other", duration(left_s)),
        _ => println!(),
    }
}

/// State, step and note.
fn words(standing: &Standing) -> (&'static str, String, String) {
    let of = |step: &u64, total: &u64| if *total > 0 { format!("{step}/{total}") } else { String::new() };
    match standing {
        Standing::Done => ("done", String::new(), String::new()),
        Standing::Trained(tests) => ("trained", String::new(), format!("to be tested on {}", tests.join(", "))),
        Standing::Running(step, total) => ("running", of(step, total), String::new()),
        Standing::Stopped(step, total) => ("stopped", of(step, total), String::new()),
        Standing::Failed(reason) => ("failed", String::new(), reason.clone()),
        Standing::Other(differences) => {
            ("invalid", String::new(), format!("made with other settings: {}", differences.join("; ")))
        }
        Standing::Missing => ("missing", String::new(), String::new()),
    }
}
