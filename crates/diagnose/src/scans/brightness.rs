//! Intensity contrast of single lasers: each against its two neighbours on the same plane at the same azimuth.

use super::planes::{OnPlane, Patch};
use nalgebra::{DMatrix, DVector};

/// Sums of one laser: samples, their sum, their squares.
pub type ContrastSums = Vec<[f64; 3]>;

/// Largest difference in azimuth of neighbours, rad: 0.2 degrees.
const NEIGHBOUR_RAD: f64 = 0.0035;

/// Largest relative difference in range of neighbours.
const SAME_RANGE: f64 = 0.12;

/// Fewest samples of a laser in a scan.
const FEWEST: f64 = 50.0;

/// Adds the samples of a plane.
pub fn add(sums: &mut [[f64; 3]], patch: &Patch) {
    let mut rings: Vec<Vec<&OnPlane>> = vec![Vec::new(); sums.len()];
    patch.shots.iter().for_each(|s| rings[s.beam].push(s));
    for ring in &mut rings {
        ring.sort_by(|a, b| a.shot.azimuth_rad.total_cmp(&b.shot.azimuth_rad));
    }
    for beam in 1..sums.len().saturating_sub(1) {
        for s in &rings[beam] {
            let (Some(above), Some(below)) = (nearest(&rings[beam - 1], s), nearest(&rings[beam + 1], s)) else {
                continue;
            };
            let contrast = s.shot.intensity - 0.5 * (above + below);
            let sum = &mut sums[beam];
            *sum = [sum[0] + 1.0, sum[1] + contrast, sum[2] + contrast * contrast];
        }
    }
}

fn nearest(ring: &[&OnPlane], to: &OnPlane) -> Option<f64> {
    let i = ring.partition_point(|s| s.shot.azimuth_rad < to.shot.azimuth_rad);
    let off = |s: &&&OnPlane| (s.shot.azimuth_rad - to.shot.azimuth_rad).abs();
    let near = ring[i.saturating_sub(1)..(i + 1).min(ring.len())].iter().min_by(|a, b| off(a).total_cmp(&off(b)))?;
    let same = (near.shot.range_m / to.shot.range_m - 1.0).abs() < SAME_RANGE;
    (off(&near) < NEIGHBOUR_RAD && same).then_some(near.shot.intensity)
}

/// Mean contrast of each laser; `None` where there are too few samples.
pub fn contrasts(scans: &[&ContrastSums]) -> Vec<Option<f64>> {
    let beams = scans.first().map_or(0, |s| s.len());
    // Scans have equal weight: scenes differ more than samples.
    let mean = |b: usize| {
        let seen: Vec<f64> = scans.iter().filter(|s| s[b][0] >= FEWEST).map(|s| s[b][1] / s[b][0]).collect();
        (!seen.is_empty()).then(|| seen.iter().sum::<f64>() / seen.len() as f64)
    };
    (0..beams).map(mean).collect()
}

/// Sum of squared deviations of the samples from the contrast of each laser, and their number.
pub fn squares(scan: &[[f64; 3]], contrasts: &[Option<f64>]) -> [f64; 2] {
    scan.iter().zip(contrasts).filter(|(_, t)| t.is_some()).fold([0.0; 2], |sum, ([n, s, ss], contrast)| {
        let t = contrast.unwrap_or(0.0);
        [sum[0] + ss - 2.0 * t * s + t * t * n, sum[1] + n]
    })
}

/// Intensity of each laser relative to the trend of all: the smallest offsets that have these contrasts.
pub fn offsets(contrasts: &[Option<f64>]) -> Vec<f64> {
    let n = contrasts.len();
    let mut gram = DMatrix::<f64>::identity(n, n) * 0.01;
    let mut right = DVector::<f64>::zeros(n);
    for (b, contrast) in contrasts.iter().enumerate() {
        let Some(c) = contrast else { continue };
        let x = [(b - 1, -0.5), (b, 1.0), (b + 1, -0.5)];
        for (i, u) in x {
            right[i] += u * c;
            x.iter().for_each(|(j, v)| gram[(i, *j)] += u * v);
        }
    }
    gram.try_inverse().map_or_else(|| vec![0.0; n], |inverse| (inverse * right).iter().copied().collect())
}
