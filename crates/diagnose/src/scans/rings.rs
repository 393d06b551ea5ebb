//! Scans of a spinning sensor as rings: the laser of each point, and the calibration of that laser.

use crate::error::DiagnoseError;
use data::Cloud;
use sensor::directions::lasers::{self, Beam, Ring};

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

/// Fewest rings of a scan.
const FEWEST_RINGS: usize = 8;

/// Divides clouds into rings and fits the table of beams, from the top. Both have the same lasers in the same order.
pub fn rings(clouds: &[(String, Cloud)]) -> Result<(Vec<Beam>, Vec<RingScan>), DiagnoseError> {
    let raw: Vec<Vec<Ring>> = clouds.iter().map(|(_, cloud)| lasers::rings(points(cloud))).collect();
    let mut cones = Vec::new();
    for ((id, _), scan) in clouds.iter().zip(&raw) {
        let own = lasers::cones(scan);
        if own.len() < FEWEST_RINGS {
            return Err(DiagnoseError::Pair(format!(
                "scan {id}: its points do not lie in rings ({} of at least {FEWEST_RINGS} found); scans of a spinning sensor in the order of their lasers are wanted",
                own.len()
            )));
        }
        cones.extend(own);
    }
    let beams = lasers::beams(cones);
    let scans = clouds.iter().zip(raw).map(|((id, _), scan)| assigned(id, scan, &beams)).collect();
    Ok((beams, scans))
}

/// The finite points of a cloud: rho, z, m, azimuth, rad, and intensity.
fn points(cloud: &Cloud) -> impl Iterator<Item = [f64; 4]> {
    let finite = cloud.points().filter(|p| p[..3].iter().all(|v| v.is_finite()));
    finite.map(|p| {
        let [x, y, z] = [p[0], p[1], p[2]].map(f64::from);
        [x.hypot(y), z, y.atan2(x), p.get(3).map_or(0.0, |v| f64::from(*v))]
    })
}

/// Assigns each ring to the laser on whose cone most of its points lie.
fn assigned(id: &str, raw: Vec<Ring>, beams: &[Beam]) -> RingScan {
    let mut rings = vec![Vec::new(); beams.len()];
    for ring in raw {
        let on = |beam: &Beam| ring.iter().filter(|p| beam.has(p)).count();
        let Some(best) = (0..beams.len()).max_by_key(|&b| on(&beams[b])) else { continue };
        let beam = &beams[best];
        let shots = ring.iter().filter(|p| beam.has(p)).map(|[rho, _, azimuth, intensity]| Shot {
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
