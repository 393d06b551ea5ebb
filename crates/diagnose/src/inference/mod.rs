//! Fits of causes and the choice between them.

pub mod choice;
pub mod comb;
pub mod counts;
pub mod grouped;
pub mod law;
pub mod linear;
pub mod losses;
pub mod noise;
pub mod roles;
pub mod simplex;

/// Median of some values, the upper one of the two in the middle; 0 of none.
pub fn median(values: Vec<f64>) -> f64 {
    statistics::median_upper(values).unwrap_or(0.0)
}
