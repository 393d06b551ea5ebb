//! Operations of PointNet++ on tensors: grouping, the maximum over a group, interpolation.
//!
//! Who is whose neighbour depends on coordinates alone, which no network changes. So indices are found on the host, by `geometry`, and mostly
//! ahead on loader threads; on the device there are only gathers, sums and maxima, with gradients, on every backend.

mod groups;
mod interpolate;

pub use groups::{GroupTensors, Groups, group_max};
pub use interpolate::{Interpolation, InterpolationTensors, interpolate};
