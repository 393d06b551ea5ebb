//! Times of the stages of a run.

use crate::trainer::Step;
use crate::{EpochMetrics, RunState, StageSeconds, StepMetrics, ValidationMetrics};
use std::time::Instant;

/// Time by stage of an epoch, and of the steps since the last line of metrics.
pub(crate) struct Clock {
    stages: StageSeconds,
    losses: f64,
    steps: u64,
    line_began: Instant,
    line_frames: usize,
    line_wait: f64,
}

impl Default for Clock {
    fn default() -> Self {
        let stages = StageSeconds::default();
        Clock { stages, losses: 0.0, steps: 0, line_began: Instant::now(), line_frames: 0, line_wait: 0.0 }
    }
}

fn timed<T>(seconds: &mut f64, work: impl FnOnce() -> T) -> T {
    let begin = Instant::now();
    let result = work();
    *seconds += begin.elapsed().as_secs_f64();
    result
}

impl Clock {
    pub(crate) fn wait<T>(&mut self, work: impl FnOnce() -> T) -> T {
        let before = self.stages.data_wait;
        let result = timed(&mut self.stages.data_wait, work);
        self.line_wait += self.stages.data_wait - before;
        result
    }

    pub(crate) fn forward<T>(&mut self, work: impl FnOnce() -> T) -> T {
        timed(&mut self.stages.forward, work)
    }

    pub(crate) fn backward<T>(&mut self, work: impl FnOnce() -> T) -> T {
        timed(&mut self.stages.backward, work)
    }

    pub(crate) fn optimizer<T>(&mut self, work: impl FnOnce() -> T) -> T {
        timed(&mut self.stages.optimizer, work)
    }

    pub(crate) fn checkpoint<T>(&mut self, work: impl FnOnce() -> T) -> T {
        timed(&mut self.stages.checkpoint, work)
    }

    pub(crate) fn metrics(&mut self, state: &RunState, step: Step, frames: usize) -> StepMetrics {
        let (_, loss) = step.losses[0];
        self.losses += loss;
        self.steps += 1;
        self.line_frames += frames;
        let seconds = self.line_began.elapsed().as_secs_f64().max(1e-9);
        StepMetrics {
            step: state.step,
            epoch: state.epoch,
            loss,
            losses: step.losses[1..].iter().map(|(name, value)| (name.to_string(), *value)).collect(),
            lr: step.lr,
            beta1: step.beta1,
            gradient_norm: step.gradient_norm,
            samples_per_s: self.line_frames as f64 / seconds,
            data_wait_share: self.line_wait / seconds,
        }
    }

    pub(crate) fn begin_line(&mut self) {
        (self.line_began, self.line_frames, self.line_wait) = (Instant::now(), 0, 0.0);
    }

    pub(crate) fn epoch_metrics(&self, state: &RunState, validation: Option<ValidationMetrics>) -> EpochMetrics {
        EpochMetrics {
            step: state.step,
            epoch: state.epoch - 1,
            train_loss: self.losses / self.steps.max(1) as f64,
            seconds: self.stages,
            validation,
        }
    }
}
