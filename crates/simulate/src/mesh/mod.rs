//! Triangle meshes of the world and the cars.

mod file;
mod gltf_file;
mod shapes;

pub use file::{MOST_MESH_BYTES, MOST_MESH_VERTICES, MeshFile, UpAxis};
pub use gltf_file::MOST_NODES;
pub use shapes::{cuboid, cylinder, grid, loft};

use crate::raycast::Tree;
use geometry::Pose;
use nalgebra::Point3;
use sensor::material::MaterialId;
use std::collections::BTreeMap;

/// A triangle: vertex indices, material and object.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Face {
    /// Indices into [`Mesh::vertices`].
    pub corners: [u32; 3],
    /// Its material.
    pub material: MaterialId,
    /// Object number; see [`crate::track::Group`].
    pub object: u16,
}

/// Triangles with shared vertices, m.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Mesh {
    /// Positions, m.
    pub vertices: Vec<[f64; 3]>,
    /// Triangles.
    pub faces: Vec<Face>,
}

impl Mesh {
    /// Appends the triangles of another mesh.
    pub fn append(&mut self, other: &Mesh) {
        let first = self.vertices.len() as u32;
        self.vertices.extend(&other.vertices);
        self.faces.extend(other.faces.iter().map(|face| Face { corners: face.corners.map(|c| c + first), ..*face }));
    }

    /// The mesh with a function applied to every vertex.
    pub fn mapped(mut self, change: impl Fn([f64; 3]) -> [f64; 3]) -> Mesh {
        self.vertices.iter_mut().for_each(|v| *v = change(*v));
        self
    }

    /// The mesh transformed to the frame `dst`.
    pub fn moved(self, dst_from_mesh: &Pose) -> Mesh {
        self.mapped(|v| (dst_from_mesh * Point3::from(v)).coords.into())
    }

    /// The mesh with all faces assigned to one object.
    pub fn of_object(mut self, object: u16) -> Mesh {
        self.faces.iter_mut().for_each(|face| face.object = object);
        self
    }

    /// Minimum and maximum of x, y, z, m; `None` for an empty mesh.
    pub fn bounds(&self) -> Option<[[f64; 3]; 2]> {
        let first = *self.vertices.first()?;
        Some(self.vertices.iter().fold([first; 2], |[low, high], v| {
            [std::array::from_fn(|k| low[k].min(v[k])), std::array::from_fn(|k| high[k].max(v[k]))]
        }))
    }

    /// Builds the tree for ray casting. `origin` (m) is subtracted in f64 before coordinates are rounded to f32.
    pub fn tree(&self, origin: [f64; 3]) -> Tree {
        let corner = |i: u32| {
            let v = self.vertices[i as usize];
            std::array::from_fn(|k| (v[k] - origin[k]) as f32)
        };
        let corners: Vec<[[f32; 3]; 3]> = self.faces.iter().map(|face| face.corners.map(corner)).collect();
        Tree::new(&corners)
    }

    /// Describes why the mesh is unusable.
    pub fn check(&self) -> Result<(), String> {
        if self.faces.is_empty() {
            return Err("the mesh has no triangle".into());
        }
        if let Some(i) = self.vertices.iter().position(|v| v.iter().any(|c| !c.is_finite())) {
            return Err(format!("vertex {i} (from 0) is {:?}, not a place", self.vertices[i]));
        }
        let outside = |face: &Face| face.corners.iter().any(|c| *c as usize >= self.vertices.len());
        if let Some(i) = self.faces.iter().position(outside) {
            return Err(format!("triangle {i} (from 0) names a vertex that does not exist"));
        }
        Ok(())
    }

    /// Number of edges shared by an odd number of triangles; 0 for a closed surface. Vertices at the same position are
    /// merged.
    pub fn open_edges(&self) -> usize {
        let mut place_of: BTreeMap<[u64; 3], usize> = BTreeMap::new();
        let place: Vec<usize> = self
            .vertices
            .iter()
            .map(|v| {
                let key = v.map(|c| (c + 0.0).to_bits()); // maps -0.0 to 0.0
                let next = place_of.len();
                *place_of.entry(key).or_insert(next)
            })
            .collect();
        let mut edges: BTreeMap<(usize, usize), usize> = BTreeMap::new();
        for face in &self.faces {
            let [a, b, c] = face.corners.map(|i| place[i as usize]);
            for (from, to) in [(a, b), (b, c), (c, a)] {
                if from != to {
                    *edges.entry((from.min(to), from.max(to))).or_default() += 1;
                }
            }
        }
        edges.values().filter(|n| **n % 2 == 1).count()
    }
}
