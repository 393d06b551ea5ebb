//! Operations of PointNet++ on tensors: grouping, the maximum over a group, interpolation.
//!
//! Neighbours depend on coordinates alone, which no network changes. The crate `geometry` therefore finds the indices
//! on the host, mostly on loader threads. The device only runs gathers, sums and maxima ([`crate::row_ops`]), with
//! gradients, on every backend.

mod groups;
mod interpolate;

pub use groups::{GroupTensors, Groups, group_max};
pub use interpolate::{Interpolation, InterpolationTensors, interpolate};
