//! The oriented 3D box.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// An upright box: geometric centre (m), full extents along its own axes (m), yaw counter-clockwise from +x (rad).
///
/// The same seven numbers, in the same order, as OpenPCDet's `[x, y, z, dx, dy, dz, heading]`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Box3 {
    /// Geometric centre, m.
    pub center: [f64; 3],
    /// Length along the heading, width across it, height; m.
    pub size: [f64; 3],
    /// Heading, rad, counter-clockwise from +x seen from above.
    pub yaw_rad: f64,
}

impl Box3 {
    /// From `[x, y, z, dx, dy, dz, yaw]`.
    pub fn from_array(v: [f64; 7]) -> Self {
        Box3 { center: [v[0], v[1], v[2]], size: [v[3], v[4], v[5]], yaw_rad: v[6] }
    }

    /// `[x, y, z, dx, dy, dz, yaw]`.
    pub fn to_array(&self) -> [f64; 7] {
        let ([x, y, z], [dx, dy, dz]) = (self.center, self.size);
        [x, y, z, dx, dy, dz, self.yaw_rad]
    }

    /// Base area times height, m3.
    pub fn volume(&self) -> f64 {
        self.size[0] * self.size[1] * self.size[2]
    }

    /// Lowest and highest z, m.
    pub fn z_range(&self) -> (f64, f64) {
        (self.center[2] - self.size[2] / 2.0, self.center[2] + self.size[2] / 2.0)
    }

    /// The four corners of the base seen from above, counter-clockwise, starting front left.
    pub fn bev_corners(&self) -> [[f64; 2]; 4] {
        let (s, c) = self.yaw_rad.sin_cos();
        let (hx, hy) = (self.size[0] / 2.0, self.size[1] / 2.0);
        [[hx, hy], [-hx, hy], [-hx, -hy], [hx, -hy]]
            .map(|[x, y]| [self.center[0] + x * c - y * s, self.center[1] + x * s + y * c])
    }

    /// A point of the outer frame in the box's own frame: origin at the centre, x along the heading.
    pub fn to_local(&self, p: [f64; 3]) -> [f64; 3] {
        let (s, c) = self.yaw_rad.sin_cos();
        let (x, y) = (p[0] - self.center[0], p[1] - self.center[1]);
        [x * c + y * s, -x * s + y * c, p[2] - self.center[2]]
    }

    /// Whether a point is certainly farther than a margin from the box, seen from above, m. Most points are far from
    /// most boxes, and this asks for no turn.
    pub fn is_far(&self, p: [f64; 3], margin_m: f64) -> bool {
        let (x, y) = (p[0] - self.center[0], p[1] - self.center[1]);
        let reach_m = 0.5 * (self.size[0] + self.size[1]) + 2.0 * margin_m;
        x * x + y * y > reach_m * reach_m
    }

    /// A point of the box's own frame in the outer frame; the inverse of [`Box3::to_local`].
    pub fn from_local(&self, p: [f64; 3]) -> [f64; 3] {
        let (s, c) = self.yaw_rad.sin_cos();
        [self.center[0] + p[0] * c - p[1] * s, self.center[1] + p[0] * s + p[1] * c, self.center[2] + p[2]]
    }

    /// Distances at which a ray enters and leaves the box, m, between 0 and `until_m`; `None` for a ray that misses it.
    pub fn path_through(&self, origin: [f64; 3], direction: [f64; 3], until_m: f64) -> Option<[f64; 2]> {
        // Most rays pass far from most boxes: the sphere around the box is missed, or lies beyond the end.
        let [x, y, z] = direction;
        let [u, v, w] = [0, 1, 2].map(|k| self.center[k] - origin[k]);
        let (along, norm2) = (u * x + v * y + w * z, x * x + y * y + z * z);
        let radius2 = self.size.iter().map(|side| side * side).sum::<f64>() / 4.0;
        if (u * u + v * v + w * w - radius2) * norm2 > along * along {
            return None;
        }
        let start = self.to_local(origin);
        let (s, c) = self.yaw_rad.sin_cos();
        let local = [x * c + y * s, y * c - x * s, z];
        let (mut near, mut far) = (0.0, until_m);
        for k in 0..3 {
            let half = self.size[k] / 2.0;
            if local[k] == 0.0 {
                if start[k].abs() > half {
                    return None;
                }
                continue;
            }
            let (a, z) = ((-half - start[k]) / local[k], (half - start[k]) / local[k]);
            near = f64::max(near, a.min(z));
            far = f64::min(far, a.max(z));
        }
        (near < far).then_some([near, far])
    }

    /// The same box with its yaw in [-pi, pi).
    pub fn with_wrapped_yaw(mut self) -> Self {
        self.yaw_rad = limit_period(self.yaw_rad, 0.5, 2.0 * PI);
        self
    }
}

/// `v` shifted by whole periods into `[-offset * period, (1 - offset) * period)`.
pub fn limit_period(v: f64, offset: f64, period: f64) -> f64 {
    v - (v / period + offset).floor() * period
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_beside_a_box_is_not_far() {
        let b = Box3::from_array([10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.6]);
        for corner in [[2.4, 1.4, 0.0], [-2.4, 1.4, 0.0], [2.4, -1.4, 0.0], [-2.4, -1.4, 0.0]] {
            assert!(!b.is_far(b.from_local(corner), 0.4));
        }
        assert!(b.is_far([14.0, 0.0, 1.0], 0.4) && b.is_far([10.0, -4.0, 1.0], 0.0));
    }

    #[test]
    fn a_ray_passes_through_a_turned_box_up_to_where_it_ends() {
        let b = Box3::from_array([10.0, 0.0, 1.0, 4.0, 2.0, 2.0, PI / 2.0]);
        let ahead = [1.0, 0.0, 0.0];
        let near = |got: Option<[f64; 2]>, want: [f64; 2]| {
            let got = got.unwrap();
            assert!((0..2).all(|k| (got[k] - want[k]).abs() < 1e-9), "{got:?}");
        };
        near(b.path_through([0.0, 0.0, 1.0], ahead, 50.0), [9.0, 11.0]);
        near(b.path_through([0.0, 0.0, 1.0], ahead, 10.5), [9.0, 10.5]);
        near(b.path_through([10.0, 0.0, 1.0], ahead, 50.0), [0.0, 1.0]);
        assert_eq!(b.path_through([0.0, 0.0, 3.0], ahead, 50.0), None);
        assert_eq!(b.path_through([0.0, 0.0, 1.0], ahead, 8.0), None);
        assert_eq!(b.path_through([0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], 50.0), None);
    }

    #[test]
    fn local_and_back() {
        let b = Box3::from_array([3.0, -2.0, 1.0, 4.0, 2.0, 1.5, 0.7]);
        let p = [10.0, 4.0, -1.0];
        let q = b.from_local(b.to_local(p));
        assert!((0..3).all(|i| (p[i] - q[i]).abs() < 1e-12), "{q:?}");
        let front_left = b.to_local([b.bev_corners()[0][0], b.bev_corners()[0][1], 1.0]);
        assert!((front_left[0] - 2.0).abs() < 1e-12 && (front_left[1] - 1.0).abs() < 1e-12);
    }

    #[test]
    fn yaw_wraps_to_half_open_interval() {
        for (yaw, want) in [(PI, -PI), (-PI, -PI), (3.0 * PI / 2.0, -PI / 2.0), (0.25, 0.25)] {
            assert!((limit_period(yaw, 0.5, 2.0 * PI) - want).abs() < 1e-12, "{yaw}");
        }
    }
}
