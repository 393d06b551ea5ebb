//! Distances between point clouds: Chamfer, earth mover's and sliced Wasserstein distance, each with its noise floor,
//! by part of the cloud and by region.
//!
//! Clouds are slices of positions `[x, y, z]` in m. Empty clouds and non-finite positions are errors: the kd-tree
//! would silently return infinite distances for them.

mod chamfer;
mod compare;
mod emd;
mod frames;
mod nearest;
mod part;
mod regions;
mod sinkhorn;
mod sliced;

pub use chamfer::{Chamfer, chamfer};
pub use compare::{
    Compared, DISTANCES_SCHEMA, DistanceOptions, Distances, Measure, MeasureRow, compare, compare_by_frame, paired_ids,
};
pub use emd::emd;
pub use frames::FrameDistances;
pub use nearest::{Nearest, nearest};
pub use part::Part;
pub use regions::{RegionRow, Regions};
pub use sinkhorn::sinkhorn;
pub use sliced::sliced_wasserstein;

use data::{DataError, ErrorKind, Located, Place};

/// Position of a point, m.
pub type Point = [f32; 3];

/// Why two clouds cannot be compared.
#[derive(Debug, thiserror::Error)]
pub enum DistanceError {
    /// A cloud has no points.
    #[error("a cloud without a point has no distance to another")]
    Empty,
    /// A position is not finite.
    #[error("point {index} of {of} is {point:?}: a distance needs finite positions")]
    NotFinite {
        /// Index of the point.
        index: usize,
        /// Number of points.
        of: usize,
        /// Its position, m.
        point: Point,
    },
    /// The kd-tree could not be built.
    #[error("the kd-tree of {n} points could not be built: {message}")]
    Tree {
        /// Number of points.
        n: usize,
        /// Message of the kd-tree library.
        message: String,
    },
    /// Two subsamples have different sizes.
    #[error("an assignment needs two clouds of one size, not {a} and {b} points")]
    Sizes {
        /// Points of the first.
        a: usize,
        /// Points of the second.
        b: usize,
    },
    /// Two data sets do not hold the same frames.
    #[error("the two data sets do not pair: {0}")]
    Pairing(String),
    /// A frame could not be read.
    #[error(transparent)]
    Data(#[from] DataError),
}

impl Located for DistanceError {
    fn place(&self) -> Place {
        match self {
            DistanceError::Data(error) => error.place(),
            _ => Place::of_kind(ErrorKind::Invalid),
        }
    }
}

/// Checks that a cloud is not empty and all positions are finite.
pub(crate) fn check(points: &[Point]) -> Result<(), DistanceError> {
    if points.is_empty() {
        return Err(DistanceError::Empty);
    }
    match points.iter().position(|p| p.iter().any(|v| !v.is_finite())) {
        Some(index) => Err(DistanceError::NotFinite { index, of: points.len(), point: points[index] }),
        None => Ok(()),
    }
}

/// Euclidean distance of two points, m.
pub(crate) fn apart_m(a: &Point, b: &Point) -> f64 {
    (0..3).map(|k| f64::from(a[k]) - f64::from(b[k])).map(|d| d * d).sum::<f64>().sqrt()
}
