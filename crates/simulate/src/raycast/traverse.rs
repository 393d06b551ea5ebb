//! Traversal of one tree by a packet of rays.

use super::lanes::Lanes;
use super::tree::{COUNT_BITS, LEAF, PackedTriangle, Tree};
use std::mem::MaybeUninit;

/// Maximum depth; larger than that of any tree: every level holds at least one triangle less than its parent, and the
/// builder balances.
const DEEPEST: usize = 128;
/// Width of the widest packet.
pub(super) const MOST_LANES: usize = 16;
/// Relative slack for box distances: both box and hit distances are rounded.
const SLACK: f32 = 1.000_000_5;
/// Replaces a direction component of exactly 0, which would give 0 * infinity in the slab test.
const LEAST_COMPONENT: f32 = 1e-20;

/// Rays side by side: lane i of each vector belongs to ray i.
#[derive(Clone, Copy)]
pub(super) struct Packet<L: Lanes> {
    pub(super) origin: [L; 3],
    pub(super) direction: [L; 3],
    pub(super) inverse: [L; 3],
}

impl<L: Lanes> Packet<L> {
    /// # Safety
    /// See [`Lanes`].
    #[inline(always)]
    pub(super) unsafe fn new(origin: [L; 3], direction: [L; 3]) -> Self {
        unsafe {
            let [least, zero, one] = [LEAST_COMPONENT, 0.0, 1.0].map(|v| L::splat(v));
            let inverse = direction.map(|d| one.div(L::select(d.eq(zero), d, least)));
            Packet { origin, direction, inverse }
        }
    }

    /// Entry distance of each ray into a box, and the mask of rays that enter before their best hit.
    ///
    /// # Safety
    /// See [`Lanes`].
    #[inline(always)]
    pub(super) unsafe fn enter(&self, bounds: &[f32; 6], range: L) -> (L, L::Mask) {
        unsafe {
            let (mut near, mut far) = (L::splat(0.0), range);
            for k in 0..3 {
                let low = L::splat(bounds[k]).sub(self.origin[k]).mul(self.inverse[k]);
                let high = L::splat(bounds[k + 3]).sub(self.origin[k]).mul(self.inverse[k]);
                near = near.max(low.min(high));
                far = far.min(low.max(high));
            }
            (near, near.le(far.mul(L::splat(SLACK))))
        }
    }
}

/// Best hits of a packet so far.
pub(super) struct Best<L: Lanes> {
    /// Range of each lane, m.
    pub(super) range: L,
    /// Index in [`Tree::triangles`] of each lane's hit.
    pub(super) place: [u32; MOST_LANES],
}

/// Finds hits nearer than `best`; bit i of the result is set if lane i was improved.
///
/// # Safety
/// See [`Lanes`].
#[inline(always)]
pub(super) unsafe fn traverse<L: Lanes>(tree: &Tree, packet: &Packet<L>, best: &mut Best<L>) -> u32 {
    unsafe { if tree.discs { walk::<L, true>(tree, packet, best) } else { walk::<L, false>(tree, packet, best) } }
}

/// [`traverse`] of a tree of discs or of triangles.
#[inline(always)]
unsafe fn walk<L: Lanes, const DISCS: bool>(tree: &Tree, packet: &Packet<L>, best: &mut Best<L>) -> u32 {
    unsafe {
        let mut stack = [const { MaybeUninit::<(L, u32)>::uninit() }; DEEPEST];
        let (mut depth, mut at, mut improved) = (0, tree.root, 0);
        loop {
            if at & LEAF == 0 {
                let node = tree.nodes.get_unchecked(at as usize);
                let (near0, enters0) = packet.enter(&node.boxes[0], best.range);
                let (near1, enters1) = packet.enter(&node.boxes[1], best.range);
                let (bits0, bits1) = (L::bits(enters0), L::bits(enters1));
                if bits0 != 0 && bits1 != 0 {
                    // Visits first the child that more rays enter first.
                    let both = bits0 & bits1;
                    let first0 = (L::bits(near0.le(near1)) & both).count_ones() * 2 >= both.count_ones();
                    let (first, second, near, enters) = if first0 {
                        (node.children[0], node.children[1], near1, enters1)
                    } else {
                        (node.children[1], node.children[0], near0, enters0)
                    };
                    assert!(depth < DEEPEST, "the tree is deeper than any builder makes it");
                    stack[depth].write((L::select(enters, L::splat(f32::INFINITY), near), second));
                    depth += 1;
                    at = first;
                    continue;
                }
                if bits0 != 0 {
                    at = node.children[0];
                    continue;
                }
                if bits1 != 0 {
                    at = node.children[1];
                    continue;
                }
            } else {
                let count = at & ((1 << COUNT_BITS) - 1);
                let first = (at & !LEAF) >> COUNT_BITS;
                for place in first..first + count {
                    improved |= test::<L, DISCS>(tree, packet, place, best, improved);
                }
            }
            loop {
                if depth == 0 {
                    return improved;
                }
                depth -= 1;
                let (near, node) = stack[depth].assume_init();
                if L::bits(near.le(best.range.mul(L::splat(SLACK)))) != 0 {
                    at = node;
                    break;
                }
            }
        }
    }
}

/// Intersects one triangle, or the largest ellipse in it, with all rays (Möller-Trumbore, no division for misses); both
/// sides can be hit.
#[inline(always)]
unsafe fn test<L: Lanes, const DISCS: bool>(
    tree: &Tree,
    packet: &Packet<L>,
    place: u32,
    best: &mut Best<L>,
    improved: u32,
) -> u32 {
    unsafe {
        let triangle = tree.triangles.get_unchecked(place as usize);
        let (o, d) = (&packet.origin, &packet.direction);
        let PackedTriangle { corner, edge1, edge2, normal } = triangle;
        let c: [L; 3] = std::array::from_fn(|k| L::splat(corner[k]).sub(o[k]));
        let r = [
            d[1].mul(c[2]).sub(d[2].mul(c[1])),
            d[2].mul(c[0]).sub(d[0].mul(c[2])),
            d[0].mul(c[1]).sub(d[1].mul(c[0])),
        ];
        let (u, v, det, along) = (dot(&r, edge2), dot(&r, edge1), dot(d, normal), dot(&c, normal));
        let zero = L::splat(0.0);
        let squared = det.mul(det);
        let inside = if DISCS {
            // The barycentric coordinates times the determinant; their squares add up to half at the border.
            let w = det.sub(u).sub(v);
            let squares = w.mul_add(w, v.mul_add(v, u.mul(u)));
            L::and(squares.le(squared.mul(L::splat(0.5))), zero.lt(squared))
        } else {
            L::and(
                L::and(zero.le(u.mul(det)), zero.le(v.mul(det))),
                L::and(u.add(v).mul(det).le(squared), zero.lt(squared)),
            )
        };
        if L::bits(inside) == 0 {
            return 0;
        }
        let range = along.div(det);
        let nearer = L::and(inside, L::and(zero.le(range), range.lt(best.range)));
        let mut better = L::bits(nearer);
        // The lower triangle wins a tie, so that the order of visits does not matter.
        let equal = L::bits(L::and(inside, range.eq(best.range))) & improved;
        if equal != 0 {
            for lane in lanes_of(equal) {
                let now = best.place[lane];
                if *tree.ids.get_unchecked(place as usize) < *tree.ids.get_unchecked(now as usize) {
                    better |= 1 << lane;
                }
            }
        }
        if better != 0 {
            best.range = L::select(nearer, best.range, range);
            for lane in lanes_of(better) {
                best.place[lane] = place;
            }
        }
        better
    }
}

/// Indices of the set bits, ascending.
pub(super) fn lanes_of(mut bits: u32) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let lane = bits.trailing_zeros() as usize;
        let some = bits != 0;
        bits &= bits.wrapping_sub(1);
        some.then_some(lane)
    })
}

#[inline(always)]
unsafe fn dot<L: Lanes>(a: &[L; 3], b: &[f32; 3]) -> L {
    unsafe { a[2].mul_add(L::splat(b[2]), a[1].mul_add(L::splat(b[1]), a[0].mul(L::splat(b[0])))) }
}
