//! Measured against simulated: what differs, why, and what is gained by mending it.
//!
//! `pairing` brings two data sets together return by return, `channels` sums up what is looked at, `inference` weighs causes, `search`
//! goes through the channels, `engine` is the whole way. Nothing here knows a simulator: clouds, labels and the places of the sensors do.

#![warn(clippy::too_many_lines)]

mod angle;
pub mod catalogue;
pub mod channels;
mod curve;
pub mod diagnosis;
mod effects;
mod engine;
mod error;
mod extended;
pub mod inference;
pub mod pairing;
mod scans;
pub mod search;

pub use catalogue::{Cause, Channel, Covariate, Family, ParameterId, Quantity, Unit};
pub use curve::{Curve, CurvePoint};
pub use diagnosis::{DetectorGain, Diagnosis, Finding, FindingGain, SCHEMA, Status, Verdict};
pub use engine::{Options, Outcome, Progress, Stage, diagnose};
pub use error::DiagnoseError;
pub use extended::extended_toml;
pub use scans::diagnose_scans;
pub use sensor::Rig;
