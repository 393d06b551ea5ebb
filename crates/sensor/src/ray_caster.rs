//! Interface to a simulated scene for effects that need additional rays.

use crate::material::MaterialId;

/// A scene in which rays can be cast.
pub trait RayCaster {
    /// The first surface on each ray, at the middle of the scan. Rays are (origin in m, unit direction) in the cloud's
    /// frame.
    fn cast(&self, rays: &[([f32; 3], [f32; 3])]) -> Vec<Surface>;
}

/// Surface that a ray meets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Distance along the ray, m; infinite if there is no surface.
    pub range_m: f32,
    /// Unit normal towards the ray's origin, cloud's frame.
    pub normal: [f32; 3],
    /// Cosine of the angle of incidence.
    pub cos_incidence: f32,
    /// Material of the surface.
    pub material: MaterialId,
    /// A [`crate::object::Group`], or [`crate::object::FIRST_CAR`] plus the number of a car; 0 if there is no surface.
    pub object: u16,
}
