//! The static world and the car shape, prepared for ray casting, with the material of each triangle.

use crate::mesh::{Face, Mesh};
use crate::raycast::Tree;
use sensor::material::MaterialId;
use std::sync::Arc;

/// The static world.
#[derive(Clone, Debug)]
pub struct World {
    pub(crate) tree: Arc<Tree>,
    surfaces: Vec<(MaterialId, u16)>,
    /// World position of the tree's origin, m.
    pub(crate) origin: [f64; 3],
}

impl World {
    /// From a mesh in the world frame at any position: rays are cast relative to its centre.
    pub fn new(mesh: &Mesh) -> World {
        let [low, high] = mesh.bounds().unwrap_or_default();
        let origin = [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0, 0.0];
        World { tree: Arc::new(mesh.tree(origin)), surfaces: surfaces(&mesh.faces), origin }
    }

    /// Material and object of a triangle.
    pub(crate) fn surface(&self, triangle: u32) -> (MaterialId, u16) {
        self.surfaces[triangle as usize]
    }
}

/// The shape of all cars, in the car frame.
#[derive(Clone, Debug)]
pub struct CarShape {
    pub(crate) tree: Arc<Tree>,
    surfaces: Vec<(MaterialId, u16)>,
}

impl CarShape {
    /// From a mesh in the car frame.
    pub fn new(mesh: &Mesh) -> CarShape {
        CarShape { tree: Arc::new(mesh.tree([0.0; 3])), surfaces: surfaces(&mesh.faces) }
    }

    pub(crate) fn material(&self, triangle: u32) -> MaterialId {
        self.surfaces[triangle as usize].0
    }
}

fn surfaces(faces: &[Face]) -> Vec<(MaterialId, u16)> {
    faces.iter().map(|face| (face.material, face.object)).collect()
}
