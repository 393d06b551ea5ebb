//! `lidarshift study status`: where the runs of a study stand.

use super::cost::{duration, known, left};
use super::folder::Study;
use super::standing::{Standing, standing};
use anyhow::Result;
use std::collections::BTreeMap;

/// Prints a line a run, how many stand how, and how long the rest will take where that is known.
///
/// # Errors
/// A study that does not make sense.
#[expect(clippy::print_stdout, reason = "results go to stdout")]
pub fn print_status(study: &Study) -> Result<()> {
    let runs = study.config.runs();
    let width = runs.iter().map(|run| run.to_string().len()).max().unwrap_or(0);
    let costs = known(study);
    let (mut counts, mut left_s, mut unknown) = (BTreeMap::<&str, usize>::new(), 0.0, 0);
    println!("{:<width$}  {:<8}  {:<10}  {:>9}", "run", "state", "step", "left");
    for run in &runs {
        let standing = standing(study, run)?;
        let (word, step, note) = words(&standing);
        *counts.entry(word).or_default() += 1;
        // What cannot be known yet, as without data sets, is a dash.
        let seconds = match &standing {
            Standing::Done => Some(0.0),
            _ => left(study, run, &costs).ok().and_then(|left| left.seconds),
        };
        match seconds {
            Some(s) => left_s += s,
            None => unknown += 1,
        }
        let left = seconds.map_or("-".into(), |s| if s == 0.0 { String::new() } else { duration(s) });
        println!("{:<width$}  {word:<8}  {step:<10}  {left:>9}  {note}", run.to_string());
    }
    let counts: Vec<String> = counts.iter().map(|(word, n)| format!("{n} {word}")).collect();
    print!("{} runs, each tested on {} data sets: {}", runs.len(), study.config.datasets.len(), counts.join(", "));
    match (left_s > 0.0, unknown) {
        (_, n) if n > 0 => println!("; what {n} of them take is not known before their steps are measured"),
        (true, _) => println!("; about {} of computing left, one run after the other", duration(left_s)),
        _ => println!(),
    }
    Ok(())
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
