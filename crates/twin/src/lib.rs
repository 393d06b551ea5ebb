//! A simulated twin of recorded scenes: the static world as a map made of all scans, moving objects, the sensor's
//! pattern, and the same moments shot again.
//!
//! [`Recording`] reads the scans and finds their poses; [`plan`] says which frames a map is made of, so that no frame
//! is held against itself; [`World`] is the map and the objects of a part of the drive; [`pair`] writes the result.

mod agreement;
mod baked_in;
mod error;
pub mod map;
pub mod objects;
pub mod odometry;
pub mod pair;
mod pattern;
pub mod plan;
pub mod poses;
pub mod recording;
mod world;

pub use agreement::AgreementNumbers;
pub use baked_in::{BakedIn, baked_in};
pub use error::TwinError;
pub use pair::{TwinConfig, TwinReport, json_forms};
pub use plan::Leave;
pub use recording::{PoseOptions, PoseSource, RecordedScan, Recording};
pub use world::{FrameShots, Shown, World};
