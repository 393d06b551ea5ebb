//! Ray casting against triangle meshes and sets of discs: a two-level tree, traversed by packets of rays.
//!
//! The lower level has one tree for the static world and one per moving shape; the upper level is the list of
//! [`Instance`]s, few in a race, each a shape with a pose. Every ray has a time, and an instance moves with its
//! velocity within a frame, so that a scan of 50 ms sees it at the right position.
//!
//! Coordinates are f32 and must be centred by the caller in f64: within 0.9 km of the origin ranges are accurate to
//! about 1 mm; UTM coordinates are not usable.
//!
//! The nearest hit of a ray is the minimum of `(range, triangle)` over all triangles, independent of the other rays of
//! the packet: tree boxes are padded by more than the rounding error of a hit, the lower triangle wins a tie, and
//! every instruction set performs the same operations with the same fused multiply-adds. The bits of a hit therefore
//! depend neither on the number of threads nor on the vector width.

mod lanes;
mod scene;
mod through;
mod traverse;
mod tree;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use scene::{Instance, InstructionSet, Scene};
pub use tree::{Disc, Tree};

/// A ray in scene coordinates.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Origin, m.
    pub origin: [f32; 3],
    /// Unit direction.
    pub direction: [f32; 3],
    /// Emission time, s, relative to the time of the instance poses.
    pub time_s: f32,
}

/// The nearest surface along a ray.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance, m; infinite if nothing is hit.
    pub range_m: f32,
    /// Triangle index in the mesh that is hit.
    pub triangle: u32,
    /// 0: the static world; k: instance k - 1.
    pub object: u32,
    /// Unit normal in scene coordinates, facing the ray origin.
    pub normal: [f32; 3],
}

impl Hit {
    /// No hit.
    pub const MISS: Hit = Hit { range_m: f32::INFINITY, triangle: u32::MAX, object: 0, normal: [0.0; 3] };

    /// Whether something is hit.
    pub fn is_hit(&self) -> bool {
        self.range_m.is_finite()
    }
}
