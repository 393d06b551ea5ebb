//! Generator of data set pairs with a hidden difference, to test the diagnosis.
//!
//! A small independent race simulator. It shares no code and no formula with the diagnosis or the project's simulator:
//! surfaces are analytic, effects have other functional forms than those the diagnosis fits, and nuisances are always
//! present (noise and losses on both sides, different shot directions, pose noise, label noise, slightly wrong walls
//! and cars). The truth is written next to the data, not into them.

mod car;
mod case;
mod cell;
mod detection;
mod effect;
mod rig;
mod scan;
mod solid;
mod strength;
mod track;
mod variant;
mod world;
mod write;

pub use case::{CAUSES, Case, Kind, OFF_CATALOGUE, draw_case, draw_strong_case};
pub use cell::{FIRST_NULL_SEED, FIRST_SEED, loop_cell};
pub use effect::{Clock, Effect};
pub use variant::{Intensity, Variant};
pub use write::write_case;
