//! Distances between clouds: Chamfer, earth mover's, sliced Wasserstein, each with its floor, by part of the cloud and by region.
//!
//! Clouds are lists of positions `[x, y, z]` in m. A cloud without a point, or with one that is not finite, is refused: a kd-tree
//! answers such questions with infinity and without a word.

mod chamfer;
mod compare;
mod emd;
mod nearest;
mod regions;
mod sinkhorn;
mod sliced;

pub use chamfer::{Chamfer, chamfer};
pub use compare::{
    Compared, DISTANCES_SCHEMA, DistanceOptions, Distances, Measure, MeasureRow, Part, compare, paired_ids,
};
pub use emd::emd;
pub use nearest::{Nearest, nearest};
pub use regions::{RegionRow, Regions};
pub use sinkhorn::sinkhorn;
pub use sliced::sliced_wasserstein;

use data::DataError;

/// Position of a point, m.
pub type Point = [f32; 3];

/// Why two clouds cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum DistanceError {
    /// One of them has no point.
    #[error("a cloud without a point has no distance to another")]
    Empty,
    /// A position is not a number.
    #[error("point {index} of {of} is {point:?}: a distance needs finite positions")]
    NotFinite {
        /// Which point.
        index: usize,
        /// Of how many.
        of: usize,
        /// Its position, m.
        point: Point,
    },
    /// The tree could not be built.
    #[error("the kd-tree of {n} points could not be built: {message}")]
    Tree {
        /// Number of points.
        n: usize,
        /// What the library says.
        message: String,
    },
    /// Two sub-samples are not of one size.
    #[error("an assignment needs two clouds of one size, not {a} and {b} points")]
    Sizes {
        /// Points of the first.
        a: usize,
        /// Points of the second.
        b: usize,
    },
    /// Two data sets do not show the same frames.
    #[error("the two data sets do not pair: {0}")]
    Pairing(String),
    /// A frame could not be read.
    #[error(transparent)]
    Data(#[from] DataError),
}

/// Refuses clouds that have no distance.
pub(crate) fn check(points: &[Point]) -> Result<(), DistanceError> {
    if points.is_empty() {
        return Err(DistanceError::Empty);
    }
    match points.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        Some(index) => Err(DistanceError::NotFinite { index, of: points.len(), point: points[index] }),
        None => Ok(()),
    }
}

/// Distance of two points, m.
pub(crate) fn apart_m(a: &Point, b: &Point) -> f64 {
    (0..3).map(|k| f64::from(a[k]) - f64::from(b[k])).map(|d| d * d).sum::<f64>().sqrt()
}
