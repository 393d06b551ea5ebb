//! What further rays meet: the question that an effect may ask of a simulated scene.

use crate::material::MaterialId;

/// A scene in which rays can be cast.
pub trait RayCaster {
    /// What rays of the cloud's frame meet at the middle of the scan. Origins in m, directions of length 1.
    fn cast(&self, rays: &[([f32; 3], [f32; 3])]) -> Vec<Surface>;
}

/// What a ray meets.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surface {
    /// Distance, m; infinite when there is nothing.
    pub range_m: f32,
    /// Unit normal towards the ray's origin, cloud's frame.
    pub normal: [f32; 3],
    /// Cosine of the angle of incidence.
    pub cos_incidence: f32,
    /// What it is made of.
    pub material: MaterialId,
    /// What it is: a [`crate::object::Group`], or [`crate::object::FIRST_CAR`] and more for a car; 0 for nothing.
    pub object: u16,
}
