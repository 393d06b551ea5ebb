//! Truth of pairs with hidden differences, and the scoring of diagnoses against it.
//!
//! Both generators of such pairs (`tests/blind`, `tests/town`) write a [`Truth`]. [`score`] compares a `diagnosis.json`
//! with it, [`summarise`] and [`SwarmTable`] count over many cases, [`markdown`] writes the tables.

mod catalogue;
mod markdown;
mod outcome;
mod summary;
mod swarm;
mod truth;

pub use catalogue::{CATALOGUE, in_catalogue};
pub use markdown::markdown;
pub use outcome::{Outcome, ParameterScore, score};
pub use summary::{Summary, summarise};
pub use swarm::{GROUPS, SwarmRow, SwarmTable};
pub use truth::{Hidden, Level, Truth};
