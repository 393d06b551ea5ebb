//! Range offsets of single lasers: their mean residuals on flat walls, each with a free plane.
//!
//! The plane of a wall absorbs an offset of all lasers and one that grows along the wall: offsets are known up to
//! these.

use super::planes::Patch;
use nalgebra::{Matrix3, Vector3};
use sensor::directions::lasers::Beam;
use std::collections::BTreeMap;

/// Sums of one wall: residuals along the rays against the derivatives by the wall's own plane.
#[derive(Clone, Debug)]
pub struct WallSums {
    gram: Matrix3<f64>,
    right: Vector3<f64>,
    squares: f64,
    n: f64,
    beams: BTreeMap<usize, BeamSums>,
}

#[derive(Clone, Debug)]
struct BeamSums {
    n: f64,
    columns: Vector3<f64>,
    residual: f64,
}

/// Offset of each laser, m; `None` where too few walls show it.
pub type Offsets = Vec<Option<f64>>;

/// Largest weight of one laser on a wall, points: errors of its points are correlated by the shape of the wall.
const MOST_POINTS: f64 = 25.0;

/// Fewest walls of a laser with a known offset.
const FEWEST_WALLS: usize = 5;

/// Rounds of alternating fits of planes and offsets.
const ROUNDS: usize = 12;

impl WallSums {
    /// Sums of a wall.
    pub fn new(patch: &Patch, beams: &[Beam]) -> WallSums {
        let plane = &patch.plane;
        let across = Vector3::z().cross(&plane.normal).normalize();
        let up = plane.normal.cross(&across);
        let mut out = WallSums {
            gram: Matrix3::identity() * 1e-6,
            right: Vector3::zeros(),
            squares: 0.0,
            n: 0.0,
            beams: BTreeMap::new(),
        };
        let points: Vec<Vector3<f64>> =
            patch.shots.iter().map(|s| beams[s.beam].point(s.shot.azimuth_rad, s.shot.range_m)).collect();
        let middle = points.iter().sum::<Vector3<f64>>() / points.len().max(1) as f64;
        for (s, p) in patch.shots.iter().zip(&points) {
            let Some([range, cos]) = plane.meets(&beams[s.beam], s.shot.azimuth_rad) else { continue };
            let (y, p) = (s.shot.range_m - range, p - middle);
            let x = Vector3::new(1.0, p.dot(&across), p.dot(&up)) / cos.max(0.05);
            out.gram += x * x.transpose();
            out.right += x * y;
            out.squares += y * y;
            out.n += 1.0;
            let own = out.beams.entry(s.beam).or_insert(BeamSums { n: 0.0, columns: Vector3::zeros(), residual: 0.0 });
            own.n += 1.0;
            own.columns += x;
            own.residual += y;
        }
        out
    }

    fn plane(&self, offsets: &[Option<f64>]) -> Vector3<f64> {
        let known = |b: &usize| offsets.get(*b).copied().flatten().unwrap_or(0.0);
        let right = self.beams.iter().fold(self.right, |r, (b, s)| r - s.columns * known(b));
        self.gram.try_inverse().map_or_else(Vector3::zeros, |inverse| inverse * right)
    }

    /// Mean residual of a laser from a plane, and its weight.
    fn left(&self, beam: usize, plane: &Vector3<f64>) -> Option<(f64, f64)> {
        let s = self.beams.get(&beam)?;
        Some(((s.residual - s.columns.dot(plane)) / s.n, s.n.min(MOST_POINTS)))
    }

    /// Sum of squared residuals off the best plane, m2, and points.
    pub fn squares(&self, offsets: &[Option<f64>]) -> [f64; 2] {
        let known = |b: &usize| offsets.get(*b).copied().flatten().unwrap_or(0.0);
        let plane = self.plane(offsets);
        let moved: f64 = self.beams.iter().map(|(b, s)| known(b) * (known(b) * s.n - 2.0 * s.residual)).sum();
        let right = self.beams.iter().fold(self.right, |r, (b, s)| r - s.columns * known(b));
        [(self.squares + moved - plane.dot(&right)).max(0.0), self.n]
    }
}

/// Offsets of all lasers: alternating fits of planes and of medians over walls.
pub fn fit(walls: &[&WallSums], beams: &[Beam]) -> Offsets {
    let mut offsets: Offsets = vec![None; beams.len()];
    for _ in 0..ROUNDS {
        let planes: Vec<Vector3<f64>> = walls.iter().map(|w| w.plane(&offsets)).collect();
        for (b, offset) in offsets.iter_mut().enumerate() {
            let seen: Vec<(f64, f64)> =
                walls.iter().zip(&planes).filter_map(|(w, plane)| w.left(b, plane)).filter(|s| s.1 >= 3.0).collect();
            *offset = (seen.len() >= FEWEST_WALLS).then(|| statistics::weighted_median(seen)).flatten();
        }
        centre(&mut offsets, beams);
    }
    offsets
}

/// Subtracts what free planes absorb: the mean, and the slope over the tangent of the elevation.
fn centre(offsets: &mut [Option<f64>], beams: &[Beam]) {
    let known: Vec<(f64, f64)> =
        offsets.iter().zip(beams).filter_map(|(o, b)| Some((b.elevation_rad.tan(), (*o)?))).collect();
    let n = known.len() as f64;
    if known.len() < 3 {
        return;
    }
    let mean = known.iter().fold([0.0; 2], |s, (t, o)| [s[0] + t / n, s[1] + o / n]);
    let [tt, to] =
        known.iter().fold([0.0; 2], |s, (t, o)| [s[0] + (t - mean[0]).powi(2), s[1] + (t - mean[0]) * (o - mean[1])]);
    let slope = if tt > 0.0 { to / tt } else { 0.0 };
    for (o, b) in offsets.iter_mut().zip(beams) {
        if let Some(o) = o {
            *o -= mean[1] + slope * (b.elevation_rad.tan() - mean[0]);
        }
    }
}
