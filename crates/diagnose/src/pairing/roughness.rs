//! Roughness of measured rays, and the choice of the rays of both sides whose roughness is compared: those whose
//! neighbours lie on one surface on both sides. The edges of the two worlds lie a little apart. If the surface of one
//! side alone decided, the edges of the other would look like its noise.

use super::ray::Ray;
use sensor::directions::{DirectionIndex, Entry, LocalSurface, SensorScan, fit_surface};

/// Returns with at most this many neighbours at their range are not of a surface.
pub(super) const LONE: u8 = 1;

/// Distance from the predicted surface, across it, from which on a return is not used for the roughness of its
/// neighbours, m.
pub const STRAY_M: f64 = 0.5;

/// Standard deviations of the measured noise within which neighbours are of one surface.
const WITHIN: f64 = 4.0;

/// Bins of the logarithms of range, from 1 m, and of the cosine of incidence, from 1 down, in which the usual roughness
/// is taken: noise may depend on both.
const BINS: [usize; 2] = [12, 8];

/// Width of the bins of both logarithms.
const BIN_STEP: f64 = 0.4;

/// Fewest rays of each side in a bin.
const FEWEST: usize = 30;

/// The measured scan of a sensor, to look around.
pub(super) struct Roughness<'a> {
    /// Measured returns by direction.
    pub own: &'a DirectionIndex,
    /// Half widths of the window of neighbours, rad.
    pub window: [f64; 2],
    /// Distance from a plane from which on neighbours are beyond an edge, m.
    pub edge_m: f64,
    /// Measured returns that are left out: lone ones, and those off the predicted surface. False alarms would make all
    /// returns around them rough.
    pub stray: &'a [bool],
}

/// Rays of one side with their numbers in a scan.
pub(super) type Rays<'a> = (&'a mut [Ray], &'a [usize], &'a SensorScan);

impl Roughness<'_> {
    /// Sets the roughness of measured rays; then takes that of both sides away where the measured scan has an edge.
    pub fn set(&self, [(measured, of_measured, scan), (simulated, of_simulated, simulated_scan)]: [Rays; 2]) {
        let around = |az: f32, el: f32, without: u32| {
            fit_surface(self.own, self.window, az, el, |e: &Entry| e.index != without && !self.stray[e.index as usize])
        };
        let mut surfaces: Vec<Option<LocalSurface>> = vec![None; measured.len()];
        let rays = measured.iter_mut().zip(of_measured).zip(&mut surfaces);
        for ((ray, &i), surface) in rays.filter(|((ray, i), _)| ray.smooth && !self.stray[**i]) {
            *surface = around(scan.azimuth_rad[i], scan.elevation_rad[i], i as u32);
            if let Some(s) = surface {
                ray.roughness_m = (f64::from(scan.range_m[i]) - s.range_m) as f32;
                ray.roughness_leverage = s.leverage as f32;
            }
        }
        let more_m = more_noise_m(measured, simulated);
        let even = |s: &Option<LocalSurface>, ray: &Ray| {
            s.is_some_and(|s| s.smooth_but_for(WITHIN * more_m[bin(ray)], self.edge_m))
        };
        for (ray, surface) in measured.iter_mut().zip(&surfaces) {
            if !even(surface, ray) {
                ray.roughness_m = f32::NAN;
            }
        }
        for (ray, &i) in simulated.iter_mut().zip(of_simulated).filter(|(r, _)| r.roughness_m.is_finite()) {
            let surface = around(simulated_scan.azimuth_rad[i], simulated_scan.elevation_rad[i], u32::MAX);
            if !even(&surface, ray) {
                ray.roughness_m = f32::NAN;
            }
        }
    }
}

/// Bin of a ray.
fn bin(ray: &Ray) -> usize {
    let of = |ln: f64, bins: usize| (ln / BIN_STEP).floor().clamp(0.0, bins as f64 - 1.0) as usize;
    let (range_m, cos) = (f64::from(ray.range_m).max(1.0), f64::from(ray.cos_incidence).max(1e-4));
    of(range_m.ln(), BINS[0]) * BINS[1] + of(-cos.ln(), BINS[1])
}

/// Standard deviation by which the measured ranges scatter more than the simulated ones, by bin, m: from the lower
/// quartiles of their roughness. In a bin that holds the foot of a wall more than half of the returns can be at an
/// edge.
fn more_noise_m(measured: &[Ray], simulated: &[Ray]) -> Vec<f64> {
    let usual = |rays: &[Ray]| -> Vec<Option<f64>> {
        let mut rough = vec![Vec::new(); BINS[0] * BINS[1]];
        for ray in rays.iter().filter(|r| r.roughness_m.is_finite()) {
            rough[bin(ray)].push(f64::from(ray.roughness_m.abs() / (1.0 + ray.roughness_leverage).sqrt()));
        }
        let quartile = |mut r: Vec<f64>| {
            r.sort_unstable_by(f64::total_cmp);
            (r.len() >= FEWEST).then(|| r[r.len() / 4])
        };
        rough.into_iter().map(quartile).collect()
    };
    let more = |pair: (Option<f64>, Option<f64>)| match pair {
        (Some(a), Some(b)) => (a * a - b * b).max(0.0).sqrt() / statistics::QUARTILE_OF_NORMAL,
        _ => 0.0,
    };
    usual(measured).into_iter().zip(usual(simulated)).map(more).collect()
}

#[cfg(test)]
mod tests {
    use super::super::frame::{Corrections, RecordedFrame, pair_frame};
    use super::super::matching::Matched;
    use super::super::recordings::SideFrame;
    use rand_distr::{Distribution, StandardNormal};
    use sensor::Rig;
    use sensor::directions::{ScanPattern, SensorScan, Sensors, Steps};

    /// A front of houses 20 m away with steps of half a metre; `beside_m` shifts it sideways.
    fn scan(rows: &[f32], beside_m: f32, noise_m: f64, seed: u64) -> SensorScan {
        let mut rng = data::stream(seed, "roughness", 0, 0);
        let mut scan = SensorScan::default();
        for el in rows {
            for k in 0..500 {
                let az = (k as f32 - 250.0) * 0.003;
                let noise: f64 = StandardNormal.sample(&mut rng);
                let stands_back = ((20.0 * az.tan() + beside_m) / 3.0).rem_euclid(1.0) < 0.5;
                let depth = if stands_back { 20.5 } else { 20.0 };
                scan.azimuth_rad.push(az);
                scan.elevation_rad.push(*el);
                scan.range_m.push(depth / az.cos() / el.cos() + (noise_m * noise) as f32);
            }
        }
        scan
    }

    /// Variances of the roughness of both sides, m2, and returns with one.
    fn variances(measured: SensorScan, simulated: SensorScan, rows: &[f32]) -> ([f64; 2], usize) {
        let steps = Steps { azimuth_rad: 0.003, elevation_rad: 0.006 };
        let pattern = ScanPattern { rows_rad: rows.to_vec(), steps, ..ScanPattern::default() };
        let sensors = Sensors { rig: Rig::single(), patterns: vec![pattern], edge_m: 0.12 };
        let [of_measured, of_simulated] = [&measured, &simulated].map(|scan| vec![true; scan.len()]);
        let matched = [Matched { measured: of_measured, simulated: of_simulated, repeats: true }];
        let side = |scan| SideFrame { scans: vec![scan], objects: vec![], second: 0 };
        let recorded = RecordedFrame {
            number: 0,
            id: "0",
            measured: &side(measured),
            simulated: &side(simulated),
            matched: &matched,
            edges: &Default::default(),
        };
        let frame = pair_frame(&recorded, &sensors, Corrections::default(), usize::MAX);
        let rough = |rays: &[super::Ray]| -> Vec<f64> {
            let scaled = |r: &super::Ray| f64::from(r.roughness_m) / (1.0 + f64::from(r.roughness_leverage)).sqrt();
            // Across an edge a slanted plane may fit.
            rays.iter().filter(|r| r.cos_incidence > 0.85).map(scaled).filter(|v| v.is_finite()).collect()
        };
        let both = [rough(&frame.measured), rough(&frame.simulated)];
        (both.each_ref().map(|v| v.iter().map(|x| x * x).sum::<f64>() / v.len() as f64), both[0].len())
    }

    #[test]
    fn edges_a_little_elsewhere_are_no_noise_and_noise_is() {
        let rows: Vec<f32> = (0..24).map(|i| -0.05 + 0.006 * i as f32).collect();
        let simulated = || scan(&rows, 0.0, 0.01, 1);
        let ([a, b], n) = variances(scan(&rows, 0.02, 0.01, 2), simulated(), &rows);
        assert!((a / b - 1.0).abs() < 0.1 && n > 6_000, "{a} {b} {n}");
        let ([a, b], n) = variances(scan(&rows, 0.02, 0.05, 3), simulated(), &rows);
        assert!((a / 0.0025 - 1.0).abs() < 0.15 && (b / 1e-4 - 1.0).abs() < 0.15 && n > 6_000, "{a} {b} {n}");
    }
}
