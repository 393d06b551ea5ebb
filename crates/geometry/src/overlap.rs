//! Exact overlap of rotated boxes, by convex clipping in f64.
//!
//! One box is clipped in the frame of the other. This is robust against large distances from the origin and against
//! equal, touching or collinear edges. Boxes without extent or with values that are not finite have overlap 0.

use crate::Box3;
use std::f64::consts::PI;

/// The BEV rectangle of a box with precomputed quantities for clipping.
#[derive(Clone, Copy, Debug)]
pub(crate) struct BevRectangle {
    center: [f64; 2],
    half: [f64; 2],
    sin: f64,
    cos: f64,
    /// Area, m2; 0 for a box without extent or with values that are not finite.
    pub(crate) area: f64,
    /// Radius of the circumscribed circle, m.
    radius: f64,
    /// Radius of the inscribed circle, m.
    inner_radius: f64,
}

impl BevRectangle {
    pub(crate) fn new(b: &Box3) -> Self {
        let (sin, cos) = b.yaw_rad.sin_cos();
        let half = [b.size[0] / 2.0, b.size[1] / 2.0];
        let area = b.size[0] * b.size[1];
        let sound = half[0] > 0.0 && half[1] > 0.0 && (area + b.center[0] + b.center[1] + sin).is_finite();
        BevRectangle {
            center: [b.center[0], b.center[1]],
            half,
            sin,
            cos,
            area: if sound { area } else { 0.0 },
            radius: half[0].hypot(half[1]),
            inner_radius: half[0].min(half[1]),
        }
    }

    /// Area, m2.
    pub(crate) fn intersection(&self, other: &BevRectangle) -> f64 {
        self.intersection_above(other, 0.0)
    }

    /// Area of the intersection, m2; 0 if a cheap bound shows that it is at most `least`.
    pub(crate) fn intersection_above(&self, other: &BevRectangle, least: f64) -> f64 {
        let (a, b) = (self, other);
        if !(a.area > 0.0 && b.area > 0.0) {
            return 0.0;
        }
        let apart = [b.center[0] - a.center[0], b.center[1] - a.center[1]];
        let apart_squared = apart[0] * apart[0] + apart[1] * apart[1];
        let reach = a.radius + b.radius;
        if apart_squared >= reach * reach || a.is_too_far(b, apart_squared, least) {
            return 0.0;
        }
        // Centre of b in the frame of a, and the sine and cosine of its yaw relative to a.
        let center = [apart[0] * a.cos + apart[1] * a.sin, apart[1] * a.cos - apart[0] * a.sin];
        let (sin, cos) = (b.sin * a.cos - b.cos * a.sin, b.cos * a.cos + b.sin * a.sin);
        if bound(a.half, b.half, center, sin, cos) <= least {
            return 0.0;
        }
        let center_in_b = [-(center[0] * cos + center[1] * sin), center[0] * sin - center[1] * cos];
        if bound(b.half, a.half, center_in_b, sin, cos) <= least {
            return 0.0;
        }
        let (lx, ly) = ([b.half[0] * cos, b.half[0] * sin], [-b.half[1] * sin, b.half[1] * cos]);
        let mut polygon = Polygon::default();
        for (u, v) in [(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)] {
            polygon.push([center[0] + u * lx[0] + v * ly[0], center[1] + u * lx[1] + v * ly[1]]);
        }
        for axis in [0, 1] {
            polygon = polygon.clipped(axis, 1.0, a.half[axis]).clipped(axis, -1.0, a.half[axis]);
        }
        polygon.area().clamp(0.0, a.area.min(b.area))
    }
}

impl BevRectangle {
    /// Whether the distance of the centres alone shows that the intersection is at most `least`.
    ///
    /// The perpendicular bisector of the centres splits the intersection. Each part lies in one rectangle beyond a
    /// strip that starts at its centre and is half the distance of the centres wide, so it is at most half the
    /// rectangle minus that strip. The strip of the rectangle contains that of the inscribed circle, whose area is at
    /// least pi/4 of strip width times diameter.
    fn is_too_far(&self, other: &BevRectangle, apart_squared: f64, least: f64) -> bool {
        let spare = (self.area + other.area) / 2.0 - least;
        let strips_by_distance = PI / 4.0 * (self.inner_radius + other.inner_radius);
        let width = 2.0 * self.inner_radius.min(other.inner_radius);
        least > 0.0 && spare * spare <= strips_by_distance * strips_by_distance * apart_squared.min(width * width)
    }
}

/// Area of the part of a rectangle (half sizes `inner`, at the origin) inside the axis-aligned bounds of another at
/// `center`.
fn bound(inner: [f64; 2], outer: [f64; 2], center: [f64; 2], sin: f64, cos: f64) -> f64 {
    let ex = outer[0] * cos.abs() + outer[1] * sin.abs();
    let ey = outer[0] * sin.abs() + outer[1] * cos.abs();
    let width = (center[0] + ex).min(inner[0]) - (center[0] - ex).max(-inner[0]);
    let height = (center[1] + ey).min(inner[1]) - (center[1] - ey).max(-inner[1]);
    width.max(0.0) * height.max(0.0)
}

/// A convex polygon, counter-clockwise. Clipping a quadrilateral four times gives at most eight corners; rounding may
/// add a few.
#[derive(Clone, Copy, Default)]
struct Polygon {
    corners: [[f64; 2]; 16],
    len: usize,
}

impl Polygon {
    fn push(&mut self, p: [f64; 2]) {
        self.corners[self.len & 15] = p;
        self.len += 1;
    }

    fn corners(&self) -> &[[f64; 2]] {
        &self.corners[..self.len.min(16)]
    }

    /// The part with `sign * p[axis] <= limit` (Sutherland and Hodgman).
    fn clipped(&self, axis: usize, sign: f64, limit: f64) -> Polygon {
        let mut out = Polygon::default();
        let Some(mut from) = self.corners().last() else { return out };
        let mut from_over = sign * from[axis] - limit;
        for to in self.corners() {
            let to_over = sign * to[axis] - limit;
            if (from_over > 0.0) != (to_over > 0.0) {
                let t = from_over / (from_over - to_over);
                let mut p = [0.0; 2];
                p[axis] = sign * limit;
                p[1 - axis] = from[1 - axis] + t * (to[1 - axis] - from[1 - axis]);
                out.push(p);
            }
            if to_over <= 0.0 {
                out.push(*to);
            }
            (from, from_over) = (to, to_over);
        }
        out
    }

    fn area(&self) -> f64 {
        let [first, rest @ ..] = self.corners() else { return 0.0 };
        let from_first = |p: &[f64; 2]| [p[0] - first[0], p[1] - first[1]];
        rest.windows(2)
            .map(|pair| {
                let (p, q) = (from_first(&pair[0]), from_first(&pair[1]));
                p[0] * q[1] - p[1] * q[0]
            })
            .sum::<f64>()
            / 2.0
    }
}

/// Area of the BEV intersection of two boxes, m2.
pub fn bev_intersection(a: &Box3, b: &Box3) -> f64 {
    BevRectangle::new(a).intersection(&BevRectangle::new(b))
}

/// BEV IoU of two boxes, 0 to 1.
pub fn bev_iou(a: &Box3, b: &Box3) -> f64 {
    let (a, b) = (BevRectangle::new(a), BevRectangle::new(b));
    over_union(a.intersection(&b), a.area, b.area)
}

/// 3D IoU of two upright boxes, 0 to 1.
pub fn iou_3d(a: &Box3, b: &Box3) -> f64 {
    let ((a_low, a_high), (b_low, b_high)) = (a.z_range(), b.z_range());
    let height = a_high.min(b_high) - a_low.max(b_low);
    let sound = a.size[2] > 0.0 && b.size[2] > 0.0 && (a.center[2] + b.center[2]).is_finite();
    if sound && height > 0.0 {
        let shared = bev_intersection(a, b) * height;
        over_union(shared, a.volume(), b.volume())
    } else {
        0.0
    }
}

/// `shared / (a + b - shared)`; 0 if the union is empty.
pub(crate) fn over_union(shared: f64, a: f64, b: f64) -> f64 {
    let iou = shared / (a + b - shared);
    if iou > 0.0 { iou.min(1.0) } else { 0.0 } // NaN is not > 0
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    fn car(x: f64, y: f64, yaw: f64) -> Box3 {
        Box3::from_array([x, y, 0.5, 4.88, 1.9, 1.18, yaw])
    }

    fn close(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-12
    }

    #[test]
    fn equal_boxes_have_overlap_1_at_any_distance() {
        for (x, y) in [(0.0, 0.0), (31.7, -88.2), (691_608.0, 5_334_000.0)] {
            for i in 0..100 {
                let yaw = i as f64 * 0.37 - 15.0;
                let turned = car(x, y, yaw + PI);
                assert!(close(bev_iou(&car(x, y, yaw), &car(x, y, yaw)), 1.0), "{x} {yaw}");
                assert!(close(iou_3d(&car(x, y, yaw), &turned), 1.0), "{x} {yaw}");
            }
        }
    }

    #[test]
    fn quarter_turn_shares_the_square() {
        assert!(close(bev_intersection(&car(1.0, 2.0, 0.3), &car(1.0, 2.0, 0.3 + FRAC_PI_2)), 1.9 * 1.9));
    }

    #[test]
    fn touching_boxes_have_overlap_0() {
        assert_eq!(bev_intersection(&car(0.0, 0.0, 0.0), &car(4.88, 0.0, 0.0)), 0.0);
        assert_eq!(bev_intersection(&car(0.0, 0.0, 0.0), &car(4.88, 1.9, 0.0)), 0.0);
        let mut above = car(0.0, 0.0, 0.0);
        above.center[2] += 1.18;
        assert_eq!(iou_3d(&car(0.0, 0.0, 0.0), &above), 0.0);
    }

    #[test]
    fn tiny_and_huge() {
        for scale in [1e-9, 1e-3, 1e6, 1e12] {
            let b = |x: f64| Box3::from_array([x * scale, 0.0, 0.0, 2.0 * scale, scale, scale, 0.4]);
            let shift = [0.4f64.cos(), 0.4f64.sin()]; // shift by half the length along the heading: IoU 1/3
            let mut moved = b(0.0);
            moved.center = [shift[0] * scale, shift[1] * scale, 0.0];
            assert!(close(bev_iou(&b(0.0), &moved), 1.0 / 3.0), "{scale}");
            assert!(close(iou_3d(&b(0.0), &moved), 1.0 / 3.0), "{scale}");
        }
    }

    #[test]
    fn bounds_never_hide_an_overlap() {
        for i in 0..20_000u32 {
            let v = |k: u32, low: f64, high: f64| {
                low + (high - low) * f64::from(i * 7919 % (89 + 14 * k)) / f64::from(89 + 14 * k)
            };
            let a = BevRectangle::new(&Box3::from_array([
                0.0,
                0.0,
                0.0,
                v(0, 0.5, 5.0),
                v(1, 0.5, 5.0),
                1.0,
                v(2, -3.0, 3.0),
            ]));
            let b = Box3::from_array([
                v(3, -2.0, 2.0),
                v(4, -2.0, 2.0),
                0.0,
                v(5, 0.5, 5.0),
                v(6, 0.5, 5.0),
                1.0,
                v(7, -3.0, 3.0),
            ]);
            let b = BevRectangle::new(&b);
            let shared = a.intersection(&b);
            assert_eq!(a.intersection_above(&b, shared * 0.999_999), shared);
        }
    }

    #[test]
    fn degenerate_boxes_have_overlap_0() {
        let good = car(0.0, 0.0, 0.2);
        for i in 0..7 {
            for v in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
                let mut bad = good.to_array();
                bad[i] = v;
                let bad = Box3::from_array(bad);
                for (a, b) in [(&good, &bad), (&bad, &good), (&bad, &bad)] {
                    let iou = iou_3d(a, b);
                    assert_eq!(iou, 0.0, "{a:?} {b:?}");
                    assert!(i == 2 || i == 5 || bev_iou(a, b) == 0.0, "{a:?} {b:?}");
                }
            }
            for v in [0.0, -1.0, -0.0] {
                let mut bad = good.to_array();
                bad[3 + i % 3] = v;
                let bad = Box3::from_array(bad);
                assert_eq!(iou_3d(&good, &bad), 0.0);
                assert_eq!(iou_3d(&bad, &bad), 0.0);
            }
        }
    }
}
