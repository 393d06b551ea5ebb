//! What is looked at: each channel sums a pair of data sets up so that causes can be weighed.

pub mod cells;
pub mod groups;
pub mod hits;
pub mod labels;
pub mod mask;
pub mod mean;
pub mod motion;
pub mod patch;
pub mod returns;
pub mod roughness;
