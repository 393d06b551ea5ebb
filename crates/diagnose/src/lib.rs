//! Diagnosis of measured against simulated data: differences, their causes with intervals, and the gain of an
//! extended sensor model.
//!
//! `pairing` pairs two data sets return by return, `channels` sums covariates and residuals, `inference` fits and
//! chooses causes, `search` searches each channel, `engine` runs all of it. `catalogue` holds the identifiers of
//! causes, channels, covariates and parameters.

#![warn(clippy::too_many_lines)]

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
mod unpaired;

pub use catalogue::{Cause, Channel, Covariate, Family, Kind, ParameterId, Quantity, Unit};
pub use curve::{Curve, CurvePoint};
pub use diagnosis::{
    Considered, DetectorGain, Diagnosis, Finding, FindingGain, Gain, Minimum, Parameter, SCHEMA, Status,
    Unidentifiable, Verdict, Verification, json_forms,
};
pub use engine::{
    Discrepancy, OnClouds, Options, Outcome, Progress, RemadeFrames, Remake, SEEDS, Stage, Switch, View, ViewState,
    diagnose, diagnose_with, verify,
};
pub use error::DiagnoseError;
pub use extended::{extended_toml, what_to_change};
pub use scans::diagnose_scans;
pub use sensor::Rig;
pub use unpaired::diagnose_unpaired;
