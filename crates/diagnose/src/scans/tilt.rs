//! A common elevation error: the ground becomes a cone, and vertical walls lean outwards on all sides.

use super::planes::{Patch, Plane};
use super::rings::RingScan;
use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};
use sensor::directions::lasers::Beam;

/// Distances of the ground that is used, m.
const GROUND_M: [f64; 2] = [4.0, 25.0];

/// Largest distance of a point of the road from its plane, m.
const OFF_ROAD_M: f64 = 0.25;

/// Fewest walls of a scan.
const FEWEST_WALLS: usize = 6;

/// Elevation error of one scan from its ground, rad: the slope over distance of the residuals of a free plane.
/// Positive: beams go higher than the sensor says. Also the points of the plot: distance, mean residual, number.
pub fn by_ground(scan: &RingScan, beams: &[Beam], ground: &Plane) -> Option<(f64, Vec<[f64; 3]>)> {
    let mut points: Vec<Vector3<f64>> = Vec::new();
    for (ring, beam) in scan.rings.iter().zip(beams) {
        points.extend(ring.iter().map(|s| beam.point(s.azimuth_rad, s.range_m)));
    }
    points.retain(|p| ground.off(p).abs() < OFF_ROAD_M && (GROUND_M[0]..GROUND_M[1]).contains(&p.xy().norm()));
    if points.len() < 1000 {
        return None;
    }
    let mut theta = Vector4::<f64>::zeros();
    for scale in [0.25, 0.1, 0.06, 0.04, 0.04] {
        let mut gram = Matrix4::<f64>::identity() * 1e-9;
        let mut right = Vector4::<f64>::zeros();
        for p in &points {
            let (x, y) = row(p, ground);
            let u = (y - x.dot(&theta)) / (3.0 * scale);
            if u.abs() < 1.0 {
                // Equal weight of distances: near rings have most points.
                let w = (1.0 - u * u).powi(2) * p.xy().norm();
                gram += x * x.transpose() * w;
                right += x * (w * y);
            }
        }
        theta = gram.try_inverse()? * right;
    }
    const BINS: usize = 14;
    let mut bins = [[0.0; 3]; BINS];
    for p in &points {
        let (x, y) = row(p, ground);
        let left = y - x.dot(&theta);
        if left.abs() > 0.12 {
            continue;
        }
        let at = (p.xy().norm() - GROUND_M[0]) / (GROUND_M[1] - GROUND_M[0]);
        let bin = &mut bins[((at * BINS as f64) as usize).min(BINS - 1)];
        *bin = [bin[0] + p.xy().norm(), bin[1] + left + theta[3] * x[3], bin[2] + 1.0];
    }
    let picture = bins.iter().filter(|b| b[2] > 30.0).map(|b| [b[0] / b[2], b[1] / b[2], b[2]]).collect();
    Some((-theta[3], picture))
}

/// Columns 1, x, y, distance (about 12 m), and the height over the plane.
fn row(p: &Vector3<f64>, ground: &Plane) -> (Vector4<f64>, f64) {
    (Vector4::new(1.0, p.x, p.y, p.xy().norm() - 12.0), ground.off(p))
}

/// Elevation error of one scan from its walls, rad: their outward lean beyond that of a tilt of the vehicle.
pub fn by_walls(walls: &[Patch], beams: &[Beam], ground: &Plane) -> Option<f64> {
    let rows: Vec<(Vector3<f64>, f64)> = walls.iter().filter_map(|w| lean(w, beams, ground)).collect();
    if rows.len() < FEWEST_WALLS {
        return None;
    }
    // Walls are vertical to some tenths of a degree; a few are no walls.
    let mut theta = Vector3::zeros();
    for scale in [0.03, 0.015, 0.008, 0.008] {
        // Prior: a tilt of about a degree.
        let mut gram = Matrix3::from_diagonal(&Vector3::new(1e-6, 0.2, 0.2));
        let mut right = Vector3::zeros();
        for (x, y) in &rows {
            let u = (y - x.dot(&theta)) / (3.0 * scale);
            if u.abs() < 1.0 {
                let w = (1.0 - u * u).powi(2);
                gram += x * x.transpose() * w;
                right += x * (w * y);
            }
        }
        theta = gram.try_inverse()? * right;
    }
    Some(theta[0])
}

/// Columns (cosine of horizontal incidence, outward direction) and the lean outwards over the ground's normal, rad.
fn lean(wall: &Patch, beams: &[Beam], ground: &Plane) -> Option<(Vector3<f64>, f64)> {
    let middle =
        wall.shots.iter().map(|s| beams[s.beam].point(s.shot.azimuth_rad, s.shot.range_m)).sum::<Vector3<f64>>()
            / wall.shots.len().max(1) as f64;
    let seen = middle.xy().try_normalize(1e-6)?;
    let mut normal = wall.plane.normal;
    if normal.xy().dot(&seen) > 0.0 {
        normal = -normal;
    }
    let outwards = -normal.xy().try_normalize(1e-6)?;
    let up = normal.dot(&ground.normal);
    Some((Vector3::new(outwards.dot(&seen), outwards.x, outwards.y), up))
}
