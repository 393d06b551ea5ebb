//! The lasers of a spinning sensor whose rays start at heights of their own, as those of an HDL-64E do: their returns
//! lie on cones with tips beside the origin of the cloud, so that the elevations of a row seen from there vary with
//! range.
//!
//! Files keep the order in which lasers stand, from the top, each all around counter-clockwise: a new ring begins
//! where the azimuth passes from below to above 0. The points of a ring lie on a cone, z = tan(elevation) rho +
//! height: the sensor's own table of beams is fitted to the points.

use nalgebra::Vector3;
use std::f64::consts::FRAC_PI_2;

/// Calibration of one laser, as the sensor applied it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beam {
    /// Elevation, rad.
    pub elevation_rad: f64,
    /// Height of its origin over that of the cloud, m.
    pub height_m: f64,
}

/// The points of a ring in the order of the file: cylinder coordinates rho, z (m), azimuth (rad), intensity.
pub type Ring = Vec<[f64; 4]>;

/// Largest distance of a point from the cone of its ring, m.
const OFF_CONE_M: f64 = 0.004;

/// Largest difference in elevation of rings of the same laser, rad: 0.1 degrees.
const SAME_LASER_RAD: f64 = 1.7e-3;

/// Fewest points of a ring whose cone is fitted.
const FEWEST_POINTS: usize = 100;

impl Beam {
    /// Where its rays start.
    pub fn origin(&self) -> Vector3<f64> {
        Vector3::new(0.0, 0.0, self.height_m)
    }

    /// Unit vector of a ray.
    pub fn direction(&self, azimuth_rad: f64) -> Vector3<f64> {
        let (s, c) = self.elevation_rad.sin_cos();
        Vector3::new(c * azimuth_rad.cos(), c * azimuth_rad.sin(), s)
    }

    /// The point of a shot at a range.
    pub fn point(&self, azimuth_rad: f64, range_m: f64) -> Vector3<f64> {
        self.origin() + self.direction(azimuth_rad) * range_m
    }

    /// Whether a point of a ring lies on the cone of the laser.
    pub fn has(&self, point: &[f64; 4]) -> bool {
        self.off_m(point).abs() < OFF_CONE_M
    }

    fn off_m(&self, [rho, z, ..]: &[f64; 4]) -> f64 {
        z - self.elevation_rad.tan() * rho - self.height_m
    }
}

/// The cone of a ring.
#[derive(Clone, Copy, Debug)]
pub struct Cone {
    elevation_rad: f64,
    sums: [f64; 5],
}

impl Cone {
    /// Number of the points on it.
    pub fn points(&self) -> f64 {
        self.sums[0]
    }
}

/// Divides points, each rho, z (m), azimuth (rad) and intensity, into rings in the order of the file.
pub fn rings(points: impl Iterator<Item = [f64; 4]>) -> Vec<Ring> {
    let mut rings: Vec<Ring> = vec![Vec::new()];
    let mut before = 0.0f64;
    for point in points {
        let azimuth = point[2];
        if before < 0.0 && (0.0..FRAC_PI_2).contains(&azimuth) {
            rings.push(Vec::new());
        }
        before = azimuth;
        if let Some(ring) = rings.last_mut() {
            ring.push(point);
        }
    }
    rings
}

/// The cones of those rings that are ones.
pub fn cones(rings: &[Ring]) -> Vec<Cone> {
    rings.iter().filter(|r| r.len() >= FEWEST_POINTS).filter_map(|r| cone(r)).collect()
}

/// The lasers, from the top, of the cones of all rings of all scans.
pub fn beams(mut cones: Vec<Cone>) -> Vec<Beam> {
    cones.sort_by(|a, b| b.elevation_rad.total_cmp(&a.elevation_rad));
    let mut table: Vec<Vec<Cone>> = Vec::new();
    for cone in cones {
        match table.last_mut().filter(|beam| (beam[0].elevation_rad - cone.elevation_rad).abs() < SAME_LASER_RAD) {
            Some(beam) => beam.push(cone),
            None => table.push(vec![cone]),
        }
    }
    table.iter().filter_map(|cones| line(&pooled(cones))).collect()
}

/// The cone on which most points of a ring lie; `None` where it is no cone.
fn cone(ring: &[[f64; 4]]) -> Option<Cone> {
    let mut near = 0.1f64;
    let mut fitted = line(&sums(ring, |_| true))?;
    for _ in 0..4 {
        let of = sums(ring, |p| fitted.off_m(p).abs() < near);
        fitted = line(&of)?;
        near = (0.2 * near).max(OFF_CONE_M);
    }
    let of = sums(ring, |p| fitted.has(p));
    (of[0] > 0.7 * ring.len() as f64).then_some(Cone { elevation_rad: fitted.elevation_rad, sums: of })
}

/// n, sums of rho, z, rho^2, rho z.
fn sums(ring: &[[f64; 4]], keep: impl Fn(&[f64; 4]) -> bool) -> [f64; 5] {
    ring.iter()
        .filter(|p| keep(p))
        .fold([0.0; 5], |s, [rho, z, ..]| [s[0] + 1.0, s[1] + rho, s[2] + z, s[3] + rho * rho, s[4] + rho * z])
}

fn pooled(cones: &[Cone]) -> [f64; 5] {
    cones.iter().fold([0.0; 5], |s, c| std::array::from_fn(|k| s[k] + c.sums[k]))
}

fn line([n, r, z, rr, rz]: &[f64; 5]) -> Option<Beam> {
    let det = n * rr - r * r;
    // Without two distances there is no cone.
    if !(det > 1e-3 * n * n) {
        return None;
    }
    let slope = (n * rz - r * z) / det;
    Some(Beam { elevation_rad: slope.atan(), height_m: (z - slope * r) / n })
}
