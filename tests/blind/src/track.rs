//! A banked oval: two straights and two half circles, driven counter-clockwise. World frame: x along the first
//! straight, z up, m.

use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use std::f64::consts::PI;

/// Shape of the track.
#[derive(Clone, Debug)]
pub struct Track {
    /// Length of a straight, m.
    pub straight_m: f64,
    /// Radius of the centre line in the turns, m.
    pub radius_m: f64,
    /// Cross slope on the straights and in the turns: tangent of the banking angle.
    pub slope: [f64; 2],
    /// Half width of the road, m.
    pub half_width_m: f64,
    /// Amplitude of long-wave road unevenness, m.
    pub waves_m: f64,
}

impl Track {
    /// Length of a lap along the centre line, m.
    pub fn lap_m(&self) -> f64 {
        2.0 * self.straight_m + 2.0 * PI * self.radius_m
    }

    /// Position along the centre line and lateral offset to its left, m.
    pub fn curve_coordinates(&self, x: f64, y: f64) -> (f64, f64) {
        let (half, radius) = (self.straight_m / 2.0, self.radius_m);
        if x.abs() <= half {
            return if y < 0.0 {
                (x + half, y + radius)
            } else {
                (self.straight_m + PI * radius + half - x, radius - y)
            };
        }
        let side = x.signum();
        let (dx, dy) = (x - side * half, y);
        let from_center = dx.hypot(dy);
        if side > 0.0 {
            let angle = dy.atan2(dx) + PI / 2.0; // 0 at the end of the first straight
            (self.straight_m + angle * radius, radius - from_center)
        } else {
            let angle = (-dy).atan2(-dx) + PI / 2.0;
            (2.0 * self.straight_m + PI * radius + angle * radius, radius - from_center)
        }
    }

    /// World position (without height) and heading at a position along the curve.
    pub fn at(&self, s: f64, left: f64) -> ([f64; 2], f64) {
        let (half, radius, straight) = (self.straight_m / 2.0, self.radius_m, self.straight_m);
        let s = s.rem_euclid(self.lap_m());
        let turn = PI * radius;
        if s < straight {
            ([s - half, -radius + left], 0.0)
        } else if s < straight + turn {
            let a = (s - straight) / radius - PI / 2.0;
            ([half + (radius - left) * a.cos(), (radius - left) * a.sin()], a + PI / 2.0)
        } else if s < 2.0 * straight + turn {
            ([half - (s - straight - turn), radius - left], PI)
        } else {
            let a = (s - 2.0 * straight - turn) / radius + PI / 2.0;
            ([-half + (radius - left) * a.cos(), (radius - left) * a.sin()], a + PI / 2.0)
        }
    }

    /// Cross slope at a position along the centre line; positive: the left edge is lower.
    fn slope_at(&self, s: f64) -> f64 {
        let turn = PI * self.radius_m;
        let ramp = 50.0;
        let soft = |d: f64| {
            let u = (d / ramp).clamp(-0.5, 0.5) + 0.5;
            u * u * (3.0 - 2.0 * u)
        };
        let s = s.rem_euclid(self.lap_m());
        let one = |begin: f64| soft(s - begin) * (1.0 - soft(s - begin - turn));
        let lap = self.lap_m();
        let inside = one(self.straight_m) + one(2.0 * self.straight_m + turn) + one(2.0 * self.straight_m + turn - lap);
        self.slope[0] + (self.slope[1] - self.slope[0]) * inside.min(1.0)
    }

    /// Height of the road and of the apron beside it, m.
    pub fn height_m(&self, x: f64, y: f64) -> f64 {
        let (s, left) = self.curve_coordinates(x, y);
        let waves = self.waves_m * ((s * 0.11).sin() + 0.6 * (s * 0.043 + left * 0.2).cos());
        self.plain_m(s, left) + waves
    }

    /// Upper bound of the road height including unevenness, m.
    pub fn at_most_m(&self, x: f64, y: f64) -> f64 {
        let (s, left) = self.curve_coordinates(x, y);
        self.plain_m(s, left) + 1.6 * self.waves_m
    }

    /// Height without unevenness, m.
    fn plain_m(&self, s: f64, left: f64) -> f64 {
        -left.clamp(-1.3 * self.half_width_m, 1.6 * self.half_width_m) * self.slope_at(s)
    }

    /// Pose of a car whose origin is `above_m` above the road: x along the curve, z along the surface normal.
    pub fn pose(&self, s: f64, left: f64, above_m: f64) -> Isometry3<f64> {
        let ([x, y], heading) = self.at(s, left);
        let h = 0.6;
        let (c, n) = (heading.cos(), heading.sin());
        let z = self.height_m(x, y);
        let ahead = (self.height_m(x + h * c, y + h * n) - self.height_m(x - h * c, y - h * n)) / (2.0 * h);
        let aside = (self.height_m(x - h * n, y + h * c) - self.height_m(x + h * n, y - h * c)) / (2.0 * h);
        let forward = Vector3::new(c, n, ahead).normalize();
        let up = forward.cross(&Vector3::new(-n, c, aside)).normalize();
        let rotation = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[forward, up.cross(&forward), up]));
        Isometry3::from_parts(
            Translation3::from(Vector3::new(x, y, z) + up * above_m),
            UnitQuaternion::from_rotation_matrix(&rotation),
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_go_round() {
        let track = Track { straight_m: 300.0, radius_m: 120.0, slope: [0.1, 0.31], half_width_m: 7.0, waves_m: 0.0 };
        let mut before = track.height_m(track.at(0.0, -5.0).0[0], track.at(0.0, -5.0).0[1]);
        for i in 0..2000 {
            let (s, left) = (track.lap_m() * i as f64 / 2000.0, -5.0 + (i % 11) as f64);
            let ([x, y], _) = track.at(s, left);
            let (s2, left2) = track.curve_coordinates(x, y);
            let ds = (s - s2 + track.lap_m() / 2.0).rem_euclid(track.lap_m()) - track.lap_m() / 2.0;
            assert!(ds.abs() < 1e-6 && (left - left2).abs() < 1e-6, "{s} {left}: {s2} {left2}");
            let ([x, y], _) = track.at(s, -5.0);
            let height = track.height_m(x, y);
            assert!((height - before).abs() < 0.1, "the road has no steps");
            before = height;
        }
    }
}
