//! Progress of a training on stderr: a progress bar on a terminal, plain lines elsewhere.

use crate::errln;
use anyhow::Result;
use indicatif::{ProgressBar, ProgressStyle};
use std::io::IsTerminal;
use std::time::{Duration, Instant};
use train::{EpochMetrics, Event};

/// Minimum time between plain lines.
const PLAIN_EVERY: Duration = Duration::from_secs(5);

/// A progress bar; hidden if stderr is not a terminal.
pub(super) fn bar(template: &str, length: usize) -> Result<ProgressBar> {
    Ok(ProgressBar::new(length as u64).with_style(ProgressStyle::with_template(template)?))
}

/// Shows the events of a training.
#[derive(Default)]
pub(super) struct Progress {
    bar: Option<ProgressBar>,
    epochs: u64,
    total_steps: u64,
    last_line: Option<Instant>,
}

impl Progress {
    pub fn show(&mut self, event: &Event<'_>) {
        match event {
            Event::Begin { state, epochs, frames, validation_frames } => {
                (self.epochs, self.total_steps) = (*epochs, state.total_steps);
                errln!(
                    "{frames} training frames, {validation_frames} validation frames, {epochs} epochs, {} steps",
                    state.total_steps
                );
                if state.step > 0 {
                    errln!("resuming at step {} in epoch {}", state.step, state.epoch + 1);
                }
                if std::io::stderr().is_terminal() && state.step < state.total_steps {
                    let style = ProgressStyle::with_template("{bar:30} step {pos}/{len}, {msg}, {eta} left");
                    let bar = ProgressBar::new(state.total_steps).with_position(state.step);
                    bar.reset_eta();
                    self.bar = Some(bar.with_style(style.expect("the template is valid")));
                }
            }
            Event::Warning(text) => errln!("warning: {text}"),
            Event::Step { metrics, logged } => {
                let message = format!("loss {:.4}, {:.1} samples/s", metrics.loss, metrics.samples_per_s);
                if let Some(bar) = &self.bar {
                    bar.set_position(metrics.step);
                    if *logged {
                        bar.set_message(message);
                    }
                } else if *logged && self.last_line.is_none_or(|at| at.elapsed() >= PLAIN_EVERY) {
                    let wait = 100.0 * metrics.data_wait_share;
                    errln!(
                        "step {}/{}: {message}, {wait:.1} % of the time waiting for data",
                        metrics.step,
                        self.total_steps
                    );
                    self.last_line = Some(Instant::now());
                }
            }
            Event::Epoch(metrics) => {
                let line = epoch_line(metrics, self.epochs);
                match &self.bar {
                    Some(bar) => bar.println(line),
                    None => errln!("{line}"),
                }
            }
        }
    }

    pub fn finish(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

fn epoch_line(metrics: &EpochMetrics, epochs: u64) -> String {
    let s = &metrics.seconds;
    let wait_share = 100.0 * s.data_wait / (s.data_wait + s.forward + s.backward + s.optimizer).max(1e-9);
    let mut line = format!(
        "epoch {}/{epochs}: loss {:.4}; forward {:.1} s, backward {:.1} s, optimiser {:.1} s, waiting for data {:.2} s ({wait_share:.1} %)",
        metrics.epoch + 1,
        metrics.train_loss,
        s.forward,
        s.backward,
        s.optimizer,
        s.data_wait,
    );
    if let Some(v) = &metrics.validation {
        let percent = |ap: Option<f64>| ap.map_or("undefined".into(), |ap| format!("{ap:.1}"));
        let (ap, loose) = (percent(v.ap), percent(v.ap_loose));
        line += &format!("; validation {:.1} s: loss {:.4}, AP {ap}, AP at loose overlaps {loose}", v.seconds, v.loss);
    }
    line
}
