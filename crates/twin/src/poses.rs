//! Checks of the poses and stamps of a recording, before a map is made of it.
//!
//! [`check_moments`] needs no clouds: stamps in another unit, frames out of order or twice, gaps, jumps, a standing
//! vehicle. [`find_convention`] puts scans together under several conventions of poses and says under which of them
//! their surfaces coincide. [`mend`] puts right what can be put right without the clouds: units, order, frames without
//! a pose.

mod convention;
mod findings;
mod mending;
mod overlap;

pub use convention::{Candidate, Convention, ConventionReport, Verdict, compared, find_convention};
pub use findings::{PoseFinding, check_moments, in_order};
pub use mending::{Found, mend, most_said};
