//! Measured against simulated: what differs, why, and what is gained by mending it.

mod error;
pub mod pairing;
mod rig;

pub use error::DiagnoseError;
pub use rig::{SensorMount, SensorRig, wrapped};
