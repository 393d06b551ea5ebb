//! Rays against triangle meshes: a two-level tree, traversed by packets of rays.
//!
//! The lower level holds one tree for everything that stands still and one for each shape that moves; the upper level is the list of
//! [`Instance`]s, few in a race, each a shape with a pose. Rays carry the time at which they are sent, and an instance moves along its
//! velocity within a frame, so that a scan that takes 50 ms sees it where it is.
//!
//! Coordinates are f32 and must be centred by the caller in f64 first: within 0.9 km of the origin ranges are right to about a
//! millimetre, at UTM coordinates they are useless.
//!
//! The nearest hit of a ray is the least `(range, triangle)` over all triangles, whatever rays travel with it: boxes of the tree are
//! padded by more than the rounding of a hit, equal ranges go to the lower triangle, and every instruction set does the same operations
//! with the same fused multiply-adds. So the bits of a hit depend neither on the number of threads nor on the width of the registers.

mod lanes;
mod scene;
mod traverse;
mod tree;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use scene::{Instance, InstructionSet, Scene};
pub use tree::Tree;

/// A ray in the scene's coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Where it starts, m.
    pub origin: [f32; 3],
    /// Unit vector.
    pub direction: [f32; 3],
    /// When it is sent, s, relative to the time at which the instances have their poses.
    pub time_s: f32,
}

/// The nearest surface along a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance, m; infinite when nothing is hit.
    pub range_m: f32,
    /// Triangle, counted in the mesh that is hit.
    pub triangle: u32,
    /// 0: what stands still; k: instance k - 1.
    pub object: u32,
    /// Unit normal in the scene's coordinates, on the side of the ray's origin.
    pub normal: [f32; 3],
}

impl Hit {
    /// Nothing is hit.
    pub const MISS: Hit = Hit { range_m: f32::INFINITY, triangle: u32::MAX, object: 0, normal: [0.0; 3] };

    /// Whether something is hit.
    pub fn is_hit(&self) -> bool {
        self.range_m.is_finite()
    }
}
