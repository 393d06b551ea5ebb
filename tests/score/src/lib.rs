//! Truth of pairs with hidden differences, and the scoring of diagnoses against it.
//!
//! Both generators of such pairs (`tests/blind`, `tests/town`) write a [`Truth`]. [`score`] compares a `diagnosis.json`
//! with it, [`summarise`] and [`SwarmTable`] count over many cases, [`markdown`] writes the tables. [`Oracle`] works
//! out how strong a hidden effect is, from sums that a generator makes.

mod catalogue;
mod evidence;
mod markdown;
mod oracle;
mod outcome;
mod summary;
mod swarm;
mod truth;

pub use catalogue::{CATALOGUE, in_catalogue};
pub use evidence::{Covariance, Model, Row, bernoulli_divergence, poisson_squared_errors};
pub use markdown::markdown;
pub use oracle::{Counts, FrameEvidence, FrameStds, Oracle, Verdicts};
pub use outcome::{Outcome, ParameterScore, score};
pub use summary::{Summary, summarise};
pub use swarm::{GROUPS, SwarmRow, SwarmTable};
pub use truth::{CaseSize, Hidden, Level, Truth};
