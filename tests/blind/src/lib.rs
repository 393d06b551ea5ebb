//! Pairs of data sets with a hidden difference, to try the diagnosis on.
//!
//! A small race simulator of its own. It shares no code and no formula with the diagnosis or the project's simulator: surfaces are
//! analytic, effects have other functional forms than the diagnosis fits, and nuisances are always on (noise and losses on both sides,
//! other shooting directions, pose noise, label noise, walls and cars that are a little wrong). What is hidden is written beside the
//! data, not into them.

mod car;
mod case;
mod effect;
mod rig;
mod scan;
pub mod score;
mod solid;
mod track;
mod world;
mod write;

pub use case::{CAUSES, Case, CaseSize, Kind, OFF_CATALOGUE, draw_case};
pub use effect::{Clock, Effect, Hidden, Truth};
pub use write::write_case;
