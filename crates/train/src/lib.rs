//! One run: optimiser, schedule, run folder, checkpoints, resume, metrics.

mod adam;
mod clock;
mod error;
mod frames;
mod json_forms;
pub mod memory;
mod metrics;
mod one_cycle;
mod order;
mod provenance;
mod run_config;
mod run_folder;
mod state_file;
mod trainer;
mod validation;

pub use adam::{Adam, GradientNorm, NameOf};
pub use error::TrainError;
pub use frames::{TrainingFrames, samples};
pub use json_forms::json_forms;
pub use metrics::{EpochMetrics, StageSeconds, StepMetrics, ValidationMetrics};
pub use one_cycle::OneCycle;
pub use provenance::{DatasetProvenance, PROVENANCE_SCHEMA, Provenance, SessionProvenance};
pub use run_config::{RunConfig, RunOptions, set_key};
pub use run_folder::{Checkpoint, RunFolder};
pub use state_file::{Best, RunState, STATE_SCHEMA, read_run_state, verify_weights};
pub use trainer::{Event, Session, Trained, train};
pub use validation::{Evaluation, evaluate_detector};
