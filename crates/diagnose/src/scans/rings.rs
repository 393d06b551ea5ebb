//! Scans of a spinning sensor as rings: the laser of each point, and the calibration of that laser.
//!
//! Files keep the order in which lasers stand, from the top, each all around counter-clockwise: a new ring begins
//! where the azimuth passes from below to above 0. The points of a ring lie on a cone, z = tan(elevation) rho +
//! height: the sensor's own table of beams is fitted to the points.

use crate::error::DiagnoseError;
use data::Cloud;
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

/// One return.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Counter-clockwise from +x, rad.
    pub azimuth_rad: f64,
    /// Along the ray from the laser's origin, m.
    pub range_m: f64,
    /// As the file has it; 0 where it has none.
    pub intensity: f64,
}

/// One scan by laser; lasers without returns have empty rings.
#[derive(Clone, Debug)]
pub struct RingScan {
    /// Its name.
    pub id: String,
    /// By laser, in the order of azimuth from 0 to a full turn.
    pub rings: Vec<Vec<Shot>>,
}

/// A ring before its laser is known: cylinder coordinates rho, z (m), azimuth (rad), intensity.
type RawRing = Vec<[f64; 4]>;

/// Largest distance of a point from the cone of its ring, m.
const OFF_CONE_M: f64 = 0.004;

/// Largest difference in elevation of rings of the same laser, rad: 0.1 degrees.
const SAME_LASER_RAD: f64 = 1.7e-3;

/// Fewest rings of a scan.
const FEWEST_RINGS: usize = 8;

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
}

/// Divides clouds into rings and fits the table of beams, from the top. Both have the same lasers in the same order.
pub fn rings(clouds: &[(String, Cloud)]) -> Result<(Vec<Beam>, Vec<RingScan>), DiagnoseError> {
    let raw: Vec<Vec<RawRing>> = clouds.iter().map(|(_, cloud)| cut(cloud)).collect();
    // Cones of all rings of all scans: elevation, sums of rho and z.
    let mut cones: Vec<(f64, [f64; 5])> = Vec::new();
    for ((id, _), scan) in clouds.iter().zip(&raw) {
        let own: Vec<_> = scan.iter().filter(|r| r.len() >= FEWEST_POINTS).filter_map(|r| cone(r)).collect();
        if own.len() < FEWEST_RINGS {
            return Err(DiagnoseError::Pair(format!(
                "scan {id}: its points do not lie in rings ({} of at least {FEWEST_RINGS} found); scans of a spinning sensor in the order of their lasers are wanted",
                own.len()
            )));
        }
        cones.extend(own);
    }
    cones.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut table: Vec<Vec<(f64, [f64; 5])>> = Vec::new();
    for cone in cones {
        match table.last_mut().filter(|beam| (beam[0].0 - cone.0).abs() < SAME_LASER_RAD) {
            Some(beam) => beam.push(cone),
            None => table.push(vec![cone]),
        }
    }
    let beams: Vec<Beam> = table.iter().filter_map(|cones| line(&pooled(cones))).collect();
    let scans = clouds.iter().zip(raw).map(|((id, _), scan)| assigned(id, scan, &beams)).collect();
    Ok((beams, scans))
}

/// Rings in the order of the file.
fn cut(cloud: &Cloud) -> Vec<RawRing> {
    let mut rings: Vec<RawRing> = vec![Vec::new()];
    let mut before = 0.0f64;
    for p in cloud.points() {
        let [x, y, z] = [p[0], p[1], p[2]].map(f64::from);
        if !(x.is_finite() && y.is_finite() && z.is_finite()) {
            continue;
        }
        let azimuth = y.atan2(x);
        if before < 0.0 && (0.0..FRAC_PI_2).contains(&azimuth) {
            rings.push(Vec::new());
        }
        before = azimuth;
        let intensity = p.get(3).map_or(0.0, |v| f64::from(*v));
        if let Some(ring) = rings.last_mut() {
            ring.push([x.hypot(y), z, azimuth, intensity]);
        }
    }
    rings
}

/// Elevation of a ring and the sums of its cone; `None` where it is no cone.
fn cone(ring: &[[f64; 4]]) -> Option<(f64, [f64; 5])> {
    let mut near = 0.1f64;
    let mut fitted = line(&sums(ring, |_| true))?;
    for _ in 0..4 {
        let of = sums(ring, |p| off(&fitted, p).abs() < near);
        fitted = line(&of)?;
        near = (0.2 * near).max(OFF_CONE_M);
    }
    let of = sums(ring, |p| off(&fitted, p).abs() < OFF_CONE_M);
    (of[0] > 0.7 * ring.len() as f64).then_some((fitted.elevation_rad, of))
}

fn off(beam: &Beam, [rho, z, ..]: &[f64; 4]) -> f64 {
    z - beam.elevation_rad.tan() * rho - beam.height_m
}

/// n, sums of rho, z, rho^2, rho z.
fn sums(ring: &[[f64; 4]], keep: impl Fn(&[f64; 4]) -> bool) -> [f64; 5] {
    ring.iter()
        .filter(|p| keep(p))
        .fold([0.0; 5], |s, [rho, z, ..]| [s[0] + 1.0, s[1] + rho, s[2] + z, s[3] + rho * rho, s[4] + rho * z])
}

fn pooled(cones: &[(f64, [f64; 5])]) -> [f64; 5] {
    cones.iter().fold([0.0; 5], |s, (_, c)| std::array::from_fn(|k| s[k] + c[k]))
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

/// Assigns each ring to the laser on whose cone most of its points lie.
fn assigned(id: &str, raw: Vec<RawRing>, beams: &[Beam]) -> RingScan {
    let mut rings = vec![Vec::new(); beams.len()];
    for ring in raw {
        let on = |beam: &Beam| ring.iter().filter(|p| off(beam, p).abs() < OFF_CONE_M).count();
        let Some(best) = (0..beams.len()).max_by_key(|&b| on(&beams[b])) else { continue };
        let beam = &beams[best];
        let shots = ring.iter().filter(|p| off(beam, p).abs() < OFF_CONE_M).map(|[rho, _, azimuth, intensity]| Shot {
            azimuth_rad: *azimuth,
            range_m: rho / beam.elevation_rad.cos(),
            intensity: *intensity,
        });
        rings[best].extend(shots);
    }
    RingScan { id: id.into(), rings }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_of_beams_is_fitted_to_the_points() {
        let beams: Vec<Beam> = (0..16)
            .map(|b| Beam { elevation_rad: 0.03 - 0.012 * f64::from(b), height_m: if b < 8 { 0.2 } else { 0.12 } })
            .collect();
        let mut cloud = Cloud::new(4);
        for beam in &beams {
            for i in 0..900 {
                let azimuth = (0.1 + 0.4 * f64::from(i)).to_radians();
                let p = beam.point(azimuth, 8.0 + 5.0 * (3.0 * azimuth).sin()).map(|v| (v * 1000.0).round() / 1000.0);
                cloud.values.extend([p.x as f32, p.y as f32, p.z as f32, 0.3]);
            }
        }
        let (found, scans) = rings(&[("a".into(), cloud)]).unwrap();
        assert_eq!((found.len(), scans[0].rings.len()), (16, 16));
        for (a, b) in found.iter().zip(&beams) {
            assert!(
                (a.elevation_rad - b.elevation_rad).abs() < 1e-5 && (a.height_m - b.height_m).abs() < 2e-4,
                "{a:?} {b:?}"
            );
        }
        assert!(scans[0].rings.iter().all(|r| r.len() > 850));
    }

    #[test]
    fn points_without_rings_are_refused() {
        let values = (0..3000).map(|i| ((i * 7919) % 1000) as f32 / 37.0).collect();
        let error = rings(&[("a".into(), Cloud { values, channels: 3 })]).unwrap_err().to_string();
        assert!(error.contains("scan a: its points do not lie in rings"), "{error}");
    }
}
