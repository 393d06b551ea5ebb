//! All discs along a ray, not only the nearest.

use super::tree::{COUNT_BITS, LEAF, Tree};

/// Maximum depth of the stack; see [`super::traverse`].
const DEEPEST: usize = 128;

impl Tree {
    /// Calls `visit` for every disc that a ray meets before `far_m`, in no order that can be relied upon, with the
    /// number of the disc, the range (m), and the squared distance from the centre of the disc in units of its half
    /// axes (0 to 1). `visit` returns the range beyond which nothing is of interest any more.
    ///
    /// The tree is one of discs ([`Tree::of_discs`]); `direction` is a unit vector.
    pub fn through(
        &self,
        origin: [f32; 3],
        direction: [f32; 3],
        far_m: f32,
        mut visit: impl FnMut(u32, f32, f32) -> f32,
    ) {
        debug_assert!(self.discs || self.is_empty(), "a tree of triangles");
        let inverse = direction.map(|d| 1.0 / if d == 0.0 { 1e-20 } else { d });
        let enter = |bounds: &[f32; 6], far: f32| {
            let (mut near, mut end) = (0.0f32, far);
            for k in 0..3 {
                let low = (bounds[k] - origin[k]) * inverse[k];
                let high = (bounds[k + 3] - origin[k]) * inverse[k];
                near = near.max(low.min(high));
                end = end.min(low.max(high));
            }
            (near <= end).then_some(near)
        };
        let mut far = far_m;
        let mut stack = [(0.0f32, 0u32); DEEPEST];
        let (mut depth, mut at) = (0, self.root);
        loop {
            if at & LEAF == 0 {
                let node = &self.nodes[at as usize];
                match (enter(&node.boxes[0], far), enter(&node.boxes[1], far)) {
                    (Some(a), Some(b)) => {
                        let (first, second, later) = if a <= b {
                            (node.children[0], node.children[1], b)
                        } else {
                            (node.children[1], node.children[0], a)
                        };
                        stack[depth] = (later, second);
                        depth += 1;
                        at = first;
                        continue;
                    }
                    (Some(_), None) => {
                        at = node.children[0];
                        continue;
                    }
                    (None, Some(_)) => {
                        at = node.children[1];
                        continue;
                    }
                    (None, None) => {}
                }
            } else {
                let count = at & ((1 << COUNT_BITS) - 1);
                let first = (at & !LEAF) >> COUNT_BITS;
                for place in first..first + count {
                    if let Some((range, off)) = self.meets(place as usize, origin, direction)
                        && range < far
                    {
                        far = far.min(visit(self.ids[place as usize], range, off));
                    }
                }
            }
            loop {
                if depth == 0 {
                    return;
                }
                depth -= 1;
                let (near, node) = stack[depth];
                if near < far {
                    at = node;
                    break;
                }
            }
        }
    }

    /// Range at which a ray meets a disc, and the squared distance from its centre in half axes.
    fn meets(&self, place: usize, o: [f32; 3], d: [f32; 3]) -> Option<(f32, f32)> {
        let t = &self.triangles[place];
        let dot = |a: &[f32; 3], b: &[f32; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
        let c: [f32; 3] = std::array::from_fn(|k| t.corner[k] - o[k]);
        let det = dot(&d, &t.normal);
        let r = [d[1] * c[2] - d[2] * c[1], d[2] * c[0] - d[0] * c[2], d[0] * c[1] - d[1] * c[0]];
        let (u, v) = (dot(&r, &t.edge2), dot(&r, &t.edge1));
        let w = det - u - v;
        let squares = u * u + v * v + w * w;
        let squared = det * det;
        if !(squares <= 0.5 * squared && squared > 0.0) {
            return None;
        }
        let range = dot(&c, &t.normal) / det;
        (range >= 0.0).then(|| (range, ((squares / squared - 1.0 / 3.0) * 6.0).clamp(0.0, 1.0)))
    }
}
