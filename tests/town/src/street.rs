//! The street grid of a town and the height of its ground. World frame: x east, y north, z up, m.

use nalgebra::{Point3, Vector3};

/// A wave of the ground: amplitude (m), wave numbers along x and y (rad/m), phase (rad).
pub type GroundWave = [f64; 4];

/// Streets along x and along y, with carriageways, kerbs and pavements.
#[derive(Clone, Debug, PartialEq)]
pub struct Streets {
    /// Centre lines of the streets along y: their x, ascending, m.
    pub at_x: Vec<f64>,
    /// Centre lines of the streets along x: their y, ascending, m.
    pub at_y: Vec<f64>,
    /// Half of the width of a carriageway, m.
    pub half_road_m: f64,
    /// Width of a pavement, m.
    pub pavement_m: f64,
    /// Height of a kerb, m.
    pub kerb_m: f64,
    /// Fall of the carriageway from its middle to the kerb: tangent of the slope.
    pub crown: f64,
    /// Rolling of the ground.
    pub waves: Vec<GroundWave>,
}

/// Distance of the nearest of some sorted places.
fn nearest(places: &[f64], at: f64) -> f64 {
    let next = places.partition_point(|p| *p < at);
    let before = next.checked_sub(1).map_or(f64::INFINITY, |i| at - places[i]);
    before.min(places.get(next).map_or(f64::INFINITY, |p| p - at))
}

impl Streets {
    /// Distance from the centre line of the nearest street, m.
    pub fn off_middle_m(&self, x: f64, y: f64) -> f64 {
        nearest(&self.at_x, x).min(nearest(&self.at_y, y))
    }

    /// Whether a place is on a carriageway.
    pub fn is_road(&self, x: f64, y: f64) -> bool {
        self.off_middle_m(x, y) < self.half_road_m
    }

    /// Whether a place is where two carriageways cross, extended by a margin on all sides, m.
    pub fn is_crossing(&self, x: f64, y: f64, margin_m: f64) -> bool {
        let reach = self.half_road_m + margin_m;
        nearest(&self.at_x, x) < reach && nearest(&self.at_y, y) < reach
    }

    /// Height of the ground, m.
    pub fn height_m(&self, x: f64, y: f64) -> f64 {
        let off = self.off_middle_m(x, y);
        let step = if off < self.half_road_m { -self.crown * off } else { self.kerb_m - self.crown * self.half_road_m };
        step + self.rolling_m(x, y)
    }

    /// Height without crown and kerbs, m.
    fn rolling_m(&self, x: f64, y: f64) -> f64 {
        self.waves.iter().map(|[amplitude, kx, ky, phase]| amplitude * (kx * x + ky * y + phase).sin()).sum()
    }

    /// Upward unit normal of the ground.
    pub fn normal(&self, x: f64, y: f64) -> Vector3<f64> {
        let mut slope = [0.0, 0.0];
        for [amplitude, kx, ky, phase] in &self.waves {
            let rate = amplitude * (kx * x + ky * y + phase).cos();
            slope = [slope[0] + rate * kx, slope[1] + rate * ky];
        }
        let (off_x, off_y) = (nearest(&self.at_x, x), nearest(&self.at_y, y));
        if off_x.min(off_y) < self.half_road_m {
            let k = usize::from(off_y < off_x);
            let (places, at) = if k == 0 { (&self.at_x, x) } else { (&self.at_y, y) };
            let side = places.iter().map(|p| at - p).min_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap_or(0.0);
            slope[k] -= self.crown * side.signum();
        }
        Vector3::new(-slope[0], -slope[1], 1.0).normalize()
    }

    /// Whether a place is on a painted line: the dashes along the middle of a street.
    pub fn is_painted(&self, x: f64, y: f64) -> bool {
        let (off_x, off_y) = (nearest(&self.at_x, x), nearest(&self.at_y, y));
        let along = if off_x < off_y { y } else { x };
        off_x.min(off_y) < 0.08 && !self.is_crossing(x, y, 0.0) && along.rem_euclid(6.0) < 3.0
    }

    /// Where a ray between two of its points goes below the ground, as a multiple of its direction; `None` if it ends
    /// above it. It must begin above.
    pub fn cross(&self, origin: &Point3<f64>, direction: &Vector3<f64>, from: f64, to: f64) -> Option<f64> {
        let above = |t: f64| {
            let p = origin + direction * t;
            p.z - self.height_m(p.x, p.y)
        };
        let (mut low, mut high) = ((from, above(from)), (to, above(to)));
        if high.1 > 0.0 || low.1 <= 0.0 {
            return (low.1 <= 0.0 && from > 0.0).then_some(from);
        }
        // Steps of a secant, kept inside of the bracket; halved where they do not shrink it.
        for i in 0..60 {
            let width = high.0 - low.0;
            if width < 1e-7 {
                break;
            }
            let secant = low.0 + width * low.1 / (low.1 - high.1);
            let t = if i % 3 == 2 { 0.5 * (low.0 + high.0) } else { secant };
            let g = above(t);
            if g.abs() < 1e-7 {
                return Some(t);
            }
            if g > 0.0 { low = (t, g) } else { high = (t, g) }
        }
        Some(0.5 * (low.0 + high.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn streets() -> Streets {
        Streets {
            at_x: vec![0.0, 80.0],
            at_y: vec![0.0, 70.0],
            half_road_m: 5.0,
            pavement_m: 3.0,
            kerb_m: 0.12,
            crown: 0.02,
            waves: vec![[0.2, 0.05, 0.03, 1.0]],
        }
    }

    #[test]
    fn carriageways_fall_to_kerbs() {
        let mut flat = streets();
        flat.waves.clear();
        assert_eq!(flat.height_m(0.0, 35.0), 0.0);
        assert!((flat.height_m(4.0, 35.0) + 0.08).abs() < 1e-12);
        assert!((flat.height_m(6.0, 35.0) - 0.02).abs() < 1e-12 && !flat.is_road(6.0, 35.0));
        assert!(flat.is_crossing(3.0, 2.0, 0.0) && !flat.is_crossing(3.0, 20.0, 0.0));
    }

    #[test]
    fn normals_are_those_of_the_height() {
        let s = streets();
        for [x, y] in [[1.5, 30.0], [-2.0, 30.0], [30.0, 2.0], [30.0, 68.0], [30.0, 30.0], [78.0, 40.0]] {
            let h = 1e-4;
            let slope = |dx: f64, dy: f64| (s.height_m(x + dx, y + dy) - s.height_m(x - dx, y - dy)) / (2.0 * h);
            let want = Vector3::new(-slope(h, 0.0), -slope(0.0, h), 1.0).normalize();
            assert!((s.normal(x, y) - want).norm() < 1e-6, "{x} {y}");
        }
    }

    #[test]
    fn a_ray_meets_the_ground_where_the_height_is_its_own() {
        let s = streets();
        let (origin, direction) = (Point3::new(1.0, 20.0, 2.0), Vector3::new(0.3, 0.9, -0.08).normalize());
        let t = s.cross(&origin, &direction, 0.0, 60.0).unwrap();
        let p = origin + direction * t;
        assert!((p.z - s.height_m(p.x, p.y)).abs() < 1e-5, "{p}");
        assert!(s.cross(&origin, &Vector3::new(0.0, 1.0, 0.1), 0.0, 40.0).is_none());
    }
}
