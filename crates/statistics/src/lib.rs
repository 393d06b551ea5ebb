//! Medians, quantiles, moments and resampling for the bootstrap. Random numbers come from the caller's generator.
//!
//! Some quantities exist in several definitions with different results. The function names state the definition.

mod bootstrap;
mod moments;
mod quantile;

pub use bootstrap::{blocks_of, draw, draw_blocks, draw_runs};
pub use moments::{deviation, mean};
pub use quantile::{Number, interval_nearest, median_upper, median_upper_of_sorted, quantile_linear, weighted_median};

/// Median of the absolute values of normal noise, in standard deviations.
pub const MEDIAN_OF_NORMAL: f64 = 0.6745;

/// Lower quartile of the absolute values of normal noise, in standard deviations.
pub const QUARTILE_OF_NORMAL: f64 = 0.318_639;
