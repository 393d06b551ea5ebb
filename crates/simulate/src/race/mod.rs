//! A race on an oval and its data sets: `measured`, which replaces road data where there is none, and simulations of
//! the same race.

mod config;
mod dataset;
mod files;
mod frames;
mod simulator;

pub use config::{RaceConfig, SetConfig, SplitKind, TrackConfig};
pub use dataset::{RACE_MANIFEST_SCHEMA, RaceManifest, make_race_datasets};
pub use files::ConfigFiles;
pub use frames::{FrameKey, SPLITS};
pub use simulator::{PreparedSet, SimulatedFrame, Simulator};
