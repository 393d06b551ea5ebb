//! Studies: from the study TOML through data sets, training runs and detections to the evaluation and the report.
//!
//! Every run is a separate process: the current program with its hidden command `study-run`, started on this machine
//! ([`Launcher::Local`]) or by Slurm. The processes communicate through the run folders only. This crate prints
//! nothing; it passes events to a [`Listener`].

mod cache;
pub mod clouds;
pub mod compare;
pub mod config;
mod cost;
mod data_sets;
mod detections;
mod error;
mod event;
pub mod features;
mod folder;
mod frozen;
mod json_forms;
mod local;
pub mod numbers;
mod plan;
mod present;
mod run_state;
mod slurm;
mod status;
mod steps;
mod work;
mod written;

pub use config::{FrozenDetector, Source, StudyConfig, StudyDataset, StudyEvaluation, StudyRun};
pub use cost::{NetworkCost, duration, measure};
pub use error::StudyError;
pub use event::{Event, Listener};
pub use folder::Study;
pub use frozen::{FrozenState, detect_frozen, read_result_frames};
pub use json_forms::json_forms;
pub use local::{GPU_VARIABLE, free_mib, set_program};
pub use plan::{PlanReport, Planned, ScatterFrom, plan};
pub use present::write_report;
pub use run_state::RunState;
pub use status::{FrozenReport, RunReport, RunStateName, RunStatus, StatusReport, status};
pub use steps::{Launcher, Outcome, RunOptions, Step, run_study};
pub use work::{RunPart, RunWork, execute_run};
