//! The tree of one mesh or of one set of discs: built by `obvhs`, laid out for packet traversal.

use obvhs::BvhBuildParams;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::{build_bvh2, build_bvh2_from_tris};
use obvhs::triangle::Triangle;
use std::time::Duration;

/// Flag of a leaf reference: flag, index of the first triangle, number of triangles.
pub(super) const LEAF: u32 = 1 << 31;
/// Number of low bits that hold the number of triangles of a leaf.
pub(super) const COUNT_BITS: u32 = 4;
const TRIANGLES_PER_LEAF: u32 = 4;
/// Maximum ray length assumed for the padding of boxes, m.
const LONGEST_RAY_M: f32 = 300.0;

/// An inner node: bounding boxes of both children (minimum x, y, z, maximum x, y, z) and their references.
#[repr(C, align(64))]
#[derive(Clone, Copy, Debug)]
pub(super) struct Node {
    pub(super) boxes: [[f32; 6]; 2],
    pub(super) children: [u32; 2],
}

/// A triangle prepared for the intersection test: a corner, two edges from it (the first reversed), and their cross
/// product.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub(super) struct PackedTriangle {
    pub(super) corner: [f32; 3],
    pub(super) edge1: [f32; 3],
    pub(super) edge2: [f32; 3],
    pub(super) normal: [f32; 3],
}

/// A flat ellipse.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Disc {
    /// m.
    pub centre: [f32; 3],
    /// Two conjugate half axes, m: the border is `centre + cos(t) axes[0] + sin(t) axes[1]`.
    pub axes: [[f32; 3]; 2],
}

impl Disc {
    /// The triangle whose largest inscribed ellipse (Steiner's) is the disc. Its barycentric coordinates u, v, w fulfil
    /// u^2 + v^2 + w^2 <= 1/2 inside of the disc.
    fn triangle(&self) -> [[f32; 3]; 3] {
        // Corners at twice the half axes, a third of a turn apart.
        const CORNERS: [[f32; 2]; 3] = [[0.0, 2.0], [-1.732_050_8, -1.0], [1.732_050_8, -1.0]];
        let [a, b] = self.axes;
        CORNERS.map(|[s, t]| std::array::from_fn(|k| self.centre[k] + s * a[k] + t * b[k]))
    }

    fn bounds(&self) -> [[f32; 3]; 2] {
        let [a, b] = self.axes;
        let half: [f32; 3] = std::array::from_fn(|k| a[k].hypot(b[k]));
        [std::array::from_fn(|k| self.centre[k] - half[k]), std::array::from_fn(|k| self.centre[k] + half[k])]
    }
}

/// A triangle mesh or a set of discs prepared for ray casting.
#[derive(Clone, Debug)]
pub struct Tree {
    pub(super) nodes: Vec<Node>,
    pub(super) triangles: Vec<PackedTriangle>,
    /// Mesh index of each of `triangles`.
    pub(super) ids: Vec<u32>,
    pub(super) root: u32,
    /// Of each triangle only the largest inscribed ellipse can be hit.
    pub(super) discs: bool,
    /// Minimum and maximum coordinates, m.
    pub(super) low: [f32; 3],
    pub(super) high: [f32; 3],
}

impl Tree {
    /// Builds the tree of these triangles, m. Triangles with a non-finite corner are never hit.
    pub fn new(corners: &[[[f32; 3]; 3]]) -> Tree {
        let sound: Vec<u32> = (0..corners.len() as u32)
            .filter(|i| corners[*i as usize].iter().flatten().all(|v| v.is_finite()))
            .collect();
        let mut tree = Tree::nothing();
        if sound.is_empty() {
            return tree;
        }
        tree.widen(sound.iter().flat_map(|i| corners[*i as usize]));
        let triangle = |i: &u32| {
            let [v0, v1, v2] = corners[*i as usize].map(Into::into);
            Triangle { v0, v1, v2 }
        };
        let triangles: Vec<Triangle> = sound.iter().map(triangle).collect();
        let bvh = build_bvh2_from_tris(&triangles, build_params(), &mut Duration::default());
        tree.ids = bvh.primitive_indices.iter().map(|i| sound[*i as usize]).collect();
        tree.triangles = tree.ids.iter().map(|i| pack(&corners[*i as usize])).collect();
        tree.lay_out(&bvh);
        tree
    }

    /// Builds the tree of these discs. A disc with a non-finite value is never hit. The number of the triangle in a hit
    /// is that of the disc.
    pub fn of_discs(discs: &[Disc]) -> Tree {
        let finite = |d: &Disc| d.bounds().iter().flatten().all(|v| v.is_finite());
        let sound: Vec<u32> = (0..discs.len() as u32).filter(|i| finite(&discs[*i as usize])).collect();
        let mut tree = Tree { discs: true, ..Tree::nothing() };
        if sound.is_empty() {
            return tree;
        }
        let bounds: Vec<[[f32; 3]; 2]> = sound.iter().map(|i| discs[*i as usize].bounds()).collect();
        tree.widen(bounds.iter().flatten().copied());
        let boxes: Vec<Aabb> = bounds.iter().map(|[low, high]| Aabb::new((*low).into(), (*high).into())).collect();
        let bvh = build_bvh2(&boxes, build_params(), &mut Duration::default());
        tree.ids = bvh.primitive_indices.iter().map(|i| sound[*i as usize]).collect();
        tree.triangles = tree.ids.iter().map(|i| pack(&discs[*i as usize].triangle())).collect();
        tree.lay_out(&bvh);
        tree
    }

    fn nothing() -> Tree {
        Tree {
            nodes: Vec::new(),
            triangles: Vec::new(),
            ids: Vec::new(),
            root: LEAF,
            discs: false,
            low: [f32::INFINITY; 3],
            high: [f32::NEG_INFINITY; 3],
        }
    }

    /// Widens the bounds by these points.
    fn widen(&mut self, points: impl Iterator<Item = [f32; 3]>) {
        for point in points {
            for (k, v) in point.into_iter().enumerate() {
                self.low[k] = self.low[k].min(v);
                self.high[k] = self.high[k].max(v);
            }
        }
    }

    /// Number of triangles that can be hit.
    pub fn len(&self) -> usize {
        self.triangles.len()
    }

    /// Whether no triangle can be hit.
    pub fn is_empty(&self) -> bool {
        self.triangles.is_empty()
    }

    /// Stores inner nodes in depth-first order, with boxes padded by more than the rounding error of a hit.
    fn lay_out(&mut self, bvh: &Bvh2) {
        let mut place = vec![0_u32; bvh.nodes.len()];
        let (mut order, mut open) = (Vec::new(), vec![0_usize]);
        while let Some(i) = open.pop() {
            let node = &bvh.nodes[i];
            if node.prim_count == 0 {
                place[i] = order.len() as u32;
                order.push(i);
                open.extend([node.first_index as usize + 1, node.first_index as usize]);
            }
        }
        let reference = |i: usize| {
            let node = &bvh.nodes[i];
            if node.prim_count == 0 { place[i] } else { LEAF | node.first_index << COUNT_BITS | node.prim_count }
        };
        let extent = self.low.iter().chain(&self.high).fold(0.0, |most: f32, v| most.max(v.abs()));
        let pad = 32.0 * f32::EPSILON * (extent + LONGEST_RAY_M);
        let padded = |i: usize| {
            let aabb = bvh.nodes[i].aabb;
            let ([x, y, z], [u, v, w]) = (aabb.min.to_array(), aabb.max.to_array());
            [x - pad, y - pad, z - pad, u + pad, v + pad, w + pad]
        };
        let node = |i: &usize| {
            let first = bvh.nodes[*i].first_index as usize;
            Node { boxes: [padded(first), padded(first + 1)], children: [reference(first), reference(first + 1)] }
        };
        self.nodes = order.iter().map(node).collect();
        self.root = reference(0);
    }
}

fn build_params() -> BvhBuildParams {
    let mut params = BvhBuildParams::medium_build();
    params.max_prims_per_leaf = TRIANGLES_PER_LEAF;
    params
}

pub(super) fn pack(&[a, b, c]: &[[f32; 3]; 3]) -> PackedTriangle {
    let edge1 = std::array::from_fn(|k| a[k] - b[k]);
    let edge2 = std::array::from_fn(|k| c[k] - a[k]);
    PackedTriangle { corner: a, edge1, edge2, normal: cross(edge1, edge2) }
}

fn cross(a: [f32; 3], b: [f32; 3]) -> [f32; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}
