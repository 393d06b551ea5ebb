//! Channels: sums over a pair of data sets from which causes are fitted.

pub mod brightness;
pub mod cells;
pub mod edges;
pub mod free_path;
pub mod groups;
pub mod halos;
pub mod heights;
pub mod hits;
pub mod intensity;
pub mod labels;
pub mod mask;
pub mod mean;
pub mod mirrors;
pub mod moments;
pub mod motion;
pub mod patch;
pub mod plumes;
pub mod range_ends;
pub mod range_laws;
pub mod range_mixture;
pub mod returns;
pub mod roughness;
pub mod row_patches;
pub mod spot;
pub mod tails;
pub mod together;
