//! Cells of range, incidence and surface, in which the channels of hits and of roughness are summed.

use crate::pairing::{Ray, Surface};

/// Number of bins of the logarithm of range, from 1 m.
pub const RANGE_BINS: usize = 22;
/// Number of bins of the logarithm of the cosine of incidence, from 1 down.
pub const COS_BINS: usize = 14;
/// Number of zones: ground, standing surfaces, objects, and the lower corners of objects, where vehicles have wheels.
pub const ZONES: usize = 4;
/// Number of all cells.
pub const CELLS: usize = RANGE_BINS * COS_BINS * ZONES;

/// Width of a bin of ln(range).
const RANGE_STEP: f64 = 0.25;

/// Width of a bin of ln(cosine).
const COS_STEP: f64 = 0.4;

/// The first zone of objects.
pub const OBJECT: usize = 2;

/// Cosine of incidence that is assumed on edges and curved parts of objects, such as wheels: no surface can be fitted
/// to them.
pub const ROUND_COS: f64 = sensor::cloud_scan::ROUND_COS as f64;

/// Cosine of incidence of a ray on a smooth surface, or on an object; `None` on other edges.
fn cos_of(ray: &Ray) -> Option<f64> {
    match ray.smooth {
        true => (ray.cos_incidence > 0.0).then_some(f64::from(ray.cos_incidence)),
        false => (ray.surface == Surface::Object).then_some(ROUND_COS),
    }
}

/// Range, m, cosine of incidence and zone of a ray; `None` where its incidence is not known.
pub fn place_of(ray: &Ray) -> Option<(f64, f64, usize)> {
    cell(ray)?;
    Some((f64::from(ray.range_m), cos_of(ray)?.max(1e-4), zone(ray)?))
}

/// The cell of a ray; `None` where its incidence is not known.
pub fn cell(ray: &Ray) -> Option<usize> {
    let (zone, cos) = (zone(ray)?, cos_of(ray)?);
    if !(ray.range_m > 0.5) {
        return None;
    }
    let r = range_bin(f64::from(ray.range_m));
    let c = (-cos.ln() / COS_STEP).floor().clamp(0.0, COS_BINS as f64 - 1.0) as usize;
    Some((zone * COS_BINS + c) * RANGE_BINS + r)
}

/// Bin of the logarithm of a range, m.
pub fn range_bin(range_m: f64) -> usize {
    (range_m.ln() / RANGE_STEP).floor().clamp(0.0, RANGE_BINS as f64 - 1.0) as usize
}

/// Zone of a ray's surface; `None` without one.
pub fn zone(ray: &Ray) -> Option<usize> {
    match ray.surface {
        Surface::Ground => Some(0),
        Surface::Standing => Some(1),
        Surface::Object => Some(if ray.corner { OBJECT + 1 } else { OBJECT }),
        Surface::Open => None,
    }
}

/// Zone of a cell.
pub fn zone_of(cell: usize) -> usize {
    cell / (COS_BINS * RANGE_BINS)
}

/// A cell and those beside it in range and incidence, of the same zone.
pub fn cells_around(cell: usize) -> impl Iterator<Item = usize> {
    let (row, range) = (cell / RANGE_BINS, cell % RANGE_BINS);
    let (first, cos) = (row - row % COS_BINS, row % COS_BINS);
    let beside = |bin: usize, bins: usize| bin.saturating_sub(1)..(bin + 2).min(bins);
    beside(cos, COS_BINS)
        .flat_map(move |cos| beside(range, RANGE_BINS).map(move |range| (first + cos) * RANGE_BINS + range))
}

/// Sums over the rays of a cell, for its mean range and incidence.
#[derive(Clone, Copy, Debug, Default)]
pub struct Place {
    /// Number of rays.
    pub n: f64,
    /// Sum of ln(range).
    pub ln_range: f64,
    /// Sum of ln(cos).
    pub ln_cos: f64,
}

impl Place {
    /// Counts a ray.
    pub fn add(&mut self, ray: &Ray) {
        self.n += 1.0;
        self.ln_range += f64::from(ray.range_m).ln();
        self.ln_cos += cos_of(ray).unwrap_or(1.0).max(1e-4).ln();
    }

    /// Adds another sum.
    pub fn merge(&mut self, other: &Place) {
        self.n += other.n;
        self.ln_range += other.ln_range;
        self.ln_cos += other.ln_cos;
    }

    /// Geometric means of range, m, and cosine.
    pub fn mean(&self) -> (f64, f64) {
        let n = self.n.max(1e-9);
        ((self.ln_range / n).exp(), (self.ln_cos / n).exp())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_around_stay_in_their_zone() {
        let at = |zone: usize, cos: usize, range: usize| (zone * COS_BINS + cos) * RANGE_BINS + range;
        let around: Vec<usize> = cells_around(at(1, 0, 5)).collect();
        let want = [(0, 4), (0, 5), (0, 6), (1, 4), (1, 5), (1, 6)].map(|(cos, range)| at(1, cos, range));
        assert_eq!(around, want);
        assert_eq!(cells_around(at(2, 3, RANGE_BINS - 1)).count(), 6);
        assert_eq!(cells_around(at(0, 7, 7)).count(), 9);
        assert!(cells_around(at(3, COS_BINS - 1, 0)).all(|c| zone_of(c) == 3));
    }
}
