//! Medians, quantiles, moments, and draws with replacement (the bootstrap). Pure: random numbers come from the caller's stream.
//!
//! Where two definitions differ in their numbers, the name says which one it is.

mod bootstrap;
mod moments;
mod quantile;

pub use bootstrap::{blocks_of, draw, draw_blocks, draw_runs};
pub use moments::{deviation, mean};
pub use quantile::{Number, interval_nearest, median_upper, median_upper_of_sorted, quantile_linear, weighted_median};
