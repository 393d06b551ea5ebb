//! A study from its file to its report: data sets, runs, detections, matrix, features, distances, targets.
//!
//! Every run is a process of its own: the program that runs, started again with its hidden command `study-run`, by this machine
//! ([`Launcher::Local`]) or by Slurm. The processes know of each other only what lies in the run folders. Nothing here prints: what happens
//! is handed to a [`Listener`].

mod cache;
pub mod clouds;
pub mod config;
mod cost;
mod data_sets;
mod detections;
mod error;
mod event;
pub mod features;
mod folder;
mod local;
pub mod numbers;
mod present;
mod slurm;
mod standing;
mod status;
mod steps;
mod work;

pub use config::{Source, StudyConfig, StudyDataset, StudyRun};
pub use cost::{NetworkCost, duration, measure};
pub use error::StudyError;
pub use event::{Event, Listener};
pub use folder::Study;
pub use present::write_report;
pub use standing::Standing;
pub use status::{RunStatus, status};
pub use steps::{Launcher, Outcome, RunOptions, Step, run_study};
pub use work::{RunPart, RunWork, work_on_run};
