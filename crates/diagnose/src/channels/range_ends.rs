//! The smallest and the largest range that are measured.

use crate::inference::simplex::minimise;
use crate::pairing::{FramePair, Ray, Surface};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use statistics::{blocks_of, deviation, draw_blocks};
use std::collections::BTreeMap;

/// One of so many measured returns may lie beyond the largest range: false alarms. The second value is for scenes
/// with few returns near it.
const OUTLIER_ONE_IN: [usize; 2] = [2_000, 20_000];

/// Least share of the returns that other losses leave inside of a step: where fewer are left, a law of losses ends
/// there.
const LEAST_USUAL: f64 = 0.4;

/// The largest measured range, m: beyond it only the simulation has returns, before it both sides have.
pub fn range_cut(frames: &[FramePair], which: &[usize]) -> Option<f64> {
    cut(frames, which, |range_m| range_m)
}

/// Share of the simulated returns nearer than the smallest measured range that have a counterpart in their direction,
/// from which on the near surface was moved and not lost.
const MOVED: f64 = 0.1;

/// The smallest measured range, m: nearer only the simulation has returns, and nothing is measured in their directions.
pub fn near_cut(frames: &[FramePair], which: &[usize]) -> Option<f64> {
    let near_m = 1.0 / cut(frames, which, |range_m| 1.0 / range_m.max(1e-3))?;
    let nearer = || which.iter().flat_map(|&i| &frames[i].simulated).filter(|r| r.own_range_m() < 0.985 * near_m);
    let moved = nearer().filter(|r| r.matched).count() as f64;
    (moved < MOVED * nearer().count() as f64).then_some(near_m)
}

/// The largest value of the measured returns, by a value of their range: beyond it only the simulation has returns,
/// before it both sides have.
fn cut(frames: &[FramePair], which: &[usize], value: impl Fn(f64) -> f64) -> Option<f64> {
    // Returns with neighbours at their range only: false alarms occur at all ranges.
    let ranges = |measured: bool| {
        let mut all: Vec<f64> = which
            .iter()
            .flat_map(|&i| if measured { &frames[i].measured } else { &frames[i].simulated })
            .filter(|r| r.company >= 2)
            .map(|r| value(r.own_range_m()))
            .collect();
        all.sort_by(f64::total_cmp);
        all
    };
    let (a, b) = (ranges(true), ranges(false));
    if a.len() < 200 || b.len() < 200 {
        return None;
    }
    let above = |v: &[f64], r: f64| (v.len() - v.partition_point(|x| *x <= r)) as f64;
    let between = |v: &[f64], low: f64, high: f64| above(v, low) - above(v, high);
    OUTLIER_ONE_IN.into_iter().find_map(|one_in| {
        let farthest = a[a.len() - 1 - a.len() / one_in];
        let lost = above(&b, 1.01 * farthest);
        let [[before_a, before_b], [inside_a, inside_b]] = [[0.9, 0.995], [0.75, 0.9]]
            .map(|[low, high]| [&a, &b].map(|v| between(v, low * farthest, high * farthest)));
        let beyond = above(&a, 1.01 * farthest) / lost.max(1.0);
        let step = lost > 60.0 && lost > 0.0015 * b.len() as f64 && beyond < 0.05;
        // Other losses take as much just before a step as farther inside; a law of range takes more and more.
        let usual = (inside_a / inside_b.max(1.0)).min(1.0);
        (step && before_b > 40.0 && usual > LEAST_USUAL && before_a > 0.7 * usual * before_b)
            .then(|| change(&a, &b, 0.8 * farthest))
    })
}

/// The most likely single step of the share of measured returns among all, beyond `from_m`, m.
fn change(measured: &[f64], simulated: &[f64], from_m: f64) -> f64 {
    let mut all: Vec<(f64, f64)> =
        measured.iter().map(|r| (*r, 1.0)).chain(simulated.iter().map(|r| (*r, 0.0))).collect();
    all.retain(|(r, _)| *r > from_m);
    all.sort_by(|x, y| x.0.total_cmp(&y.0));
    let total: f64 = all.iter().map(|(_, m)| m).sum();
    let count = all.len() as f64;
    let likelihood = |n: f64, m: f64| {
        let p = ((m + 0.5) / (n + 1.0)).clamp(1e-6, 1.0 - 1e-6);
        m * p.ln() + (n - m) * (1.0 - p).ln()
    };
    let (mut best, mut at, mut m) = (f64::NEG_INFINITY, from_m, 0.0);
    for (i, (range, measured)) in all.iter().enumerate() {
        m += measured;
        let n = i as f64 + 1.0;
        let value = likelihood(n, m) + likelihood(count - n, total - m);
        if value > best {
            (best, at) = (value, *range);
        }
    }
    at
}

/// An end of the ranges that are measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// Nothing is measured nearer.
    Near,
    /// Nothing is measured farther away.
    Far,
}

/// Bins around an end, and their width as a share of its range.
const BINS: usize = 60;
const BIN: f64 = 0.006;

/// Bootstrap repetitions for the error of an end.
const REPETITIONS: usize = 60;

/// Simulated returns by bins around an end: those with a measured counterpart in their direction, and those without.
type Counts = [[f64; BINS]; 2];

/// The range at which half of the returns are lost, and its standard error over blocks of frames, m. The threshold of a
/// receiver is soft: returns become fewer over some range. The share of the simulated returns that have a counterpart
/// is a normal distribution function of the range, whose middle and width are fitted. `end_m` is about where the end
/// is.
///
/// Rows meet near ground in rings, which a sensor that stands one centimetre lower sees some centimetres nearer. The
/// simulated rings are moved to where the measured ones are.
pub fn half_point(frames: &[FramePair], which: &[usize], blocks: &[usize], end_m: f64, end: End) -> [f64; 2] {
    let bin = |range_m: f64| {
        let at = (range_m / end_m - 1.0) / BIN + 0.5 * BINS as f64;
        (0.0..BINS as f64).contains(&at).then_some(at as usize)
    };
    let of_frame = |&i: &usize| {
        let mut counts: Counts = [[0.0; BINS]; 2];
        let ground = GroundMoved::new(&frames[i].measured, 2.0 * end_m);
        for ray in frames[i].simulated.iter().filter(|r| r.company >= 2) {
            if let Some(k) = bin(ray.own_range_m() + ground.range_m(ray)) {
                counts[usize::from(!ray.matched)][k] += 1.0;
            }
        }
        counts
    };
    let each: Vec<Counts> = which.par_iter().map(of_frame).collect();
    let fit = |drawn: &[usize]| {
        let mut sum: Counts = [[0.0; BINS]; 2];
        drawn.iter().for_each(|&i| (0..2).for_each(|s| (0..BINS).for_each(|k| sum[s][k] += each[i][s][k])));
        end_m * (1.0 + middle(&sum, end))
    };
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose end of ranges", 0, 0);
    let draws: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let again: Vec<f64> = draws.par_iter().map(|drawn| fit(drawn)).collect();
    [fit(&(0..which.len()).collect::<Vec<_>>()), deviation(&again)]
}

/// Where the measured ground near a sensor lies beside the simulated one, in one frame: for each sensor, distance
/// across the surface as a linear function of the place, m.
struct GroundMoved(BTreeMap<u8, Vector3<f64>>);

impl GroundMoved {
    /// From the measured returns up to a range, m.
    fn new(measured: &[Ray], until_m: f64) -> GroundMoved {
        let mut sums = BTreeMap::<u8, (Matrix3<f64>, Vector3<f64>)>::new();
        let near = |r: &&Ray| is_ground(r) && r.own_range_m() < until_m && r.across_m().abs() < MOST_MOVED_M;
        for ray in measured.iter().filter(near) {
            let x = terms(ray);
            // One metre for each coefficient, from a return with a standard deviation of a decimetre.
            let sum = sums.entry(ray.sensor).or_insert((Matrix3::identity() * 0.01, Vector3::zeros()));
            sum.0 += x * x.transpose();
            sum.1 += x * ray.across_m();
        }
        let solved =
            |(sensor, (gram, right)): (u8, (Matrix3<f64>, Vector3<f64>))| Some((sensor, gram.try_inverse()? * right));
        GroundMoved(sums.into_iter().filter_map(solved).collect())
    }

    /// By how much farther away a simulated return would have been measured, m.
    fn range_m(&self, ray: &Ray) -> f64 {
        let moved = self.0.get(&ray.sensor).filter(|_| is_ground(ray));
        moved.map_or(0.0, |moved| -moved.dot(&terms(ray)) / f64::from(ray.cos_incidence))
    }
}

/// Largest distance of measured ground from the simulated one that is a displacement, m.
const MOST_MOVED_M: f64 = 0.3;

/// Terms of the displacement of the ground: height, and tilts about both axes.
fn terms(ray: &Ray) -> Vector3<f64> {
    let recorded = ray.recorded_vector();
    Vector3::new(1.0, recorded.x, recorded.y)
}

fn is_ground(ray: &Ray) -> bool {
    ray.smooth && ray.surface == Surface::Ground && ray.cos_incidence > 0.05
}

/// Middle of the step of the share of returns with a counterpart, as a share of the range in the middle of the bins.
/// Beyond the end some have one by chance, before it some have none.
fn middle(counts: &Counts, end: End) -> f64 {
    let sign = if end == End::Near { 1.0 } else { -1.0 };
    let share = |x: f64| 1.0 / (1.0 + (-x).exp());
    let surprise = |p: &[f64]| {
        let (middle, width, usual, chance) = (p[0], p[1].exp(), share(p[2]), share(p[3]));
        let of_bin = |k: usize| {
            let place = (k as f64 + 0.5 - 0.5 * BINS as f64) * BIN;
            let inside = 0.5 * libm::erfc(-sign * (place - middle) / width / std::f64::consts::SQRT_2);
            let kept = (chance + (usual - chance) * inside).clamp(1e-4, 1.0 - 1e-4);
            -counts[0][k] * kept.ln() - counts[1][k] * (1.0 - kept).ln()
        };
        (0..BINS).map(of_bin).sum::<f64>()
    };
    let (p, _) = minimise(&[0.0, (2.0 * BIN).ln(), 2.0, -4.0], &[2.0 * BIN, 0.7, 1.0, 1.0], surprise);
    p[0]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_step_of_returns_is_found() {
        let simulated: Vec<f64> = (0..2000).map(|i| 0.1 * f64::from(i) + 0.03).collect();
        let measured: Vec<f64> = (0..800).map(|i| 0.1 * f64::from(i)).chain([130.0]).collect();
        assert!((change(&measured, &simulated, 60.0) - 80.0).abs() < 0.2);
    }

    #[test]
    fn the_middle_of_a_soft_step_is_found() {
        for (end, sign) in [(End::Near, 1.0), (End::Far, -1.0)] {
            for (middle_at, width) in [(0.012, 0.02), (-0.02, 0.004)] {
                let mut counts: Counts = [[0.0; BINS]; 2];
                for k in 0..BINS {
                    let place = (k as f64 + 0.5 - 0.5 * BINS as f64) * BIN;
                    let inside = 0.5 * libm::erfc(-sign * (place - middle_at) / width / 2f64.sqrt());
                    let kept = 0.02 + 0.88 * inside;
                    (counts[0][k], counts[1][k]) = (400.0 * kept, 400.0 * (1.0 - kept));
                }
                let found = middle(&counts, end);
                assert!((found - middle_at).abs() < 0.002, "{end:?} {middle_at} {width} {found}");
            }
        }
    }

    #[test]
    fn rings_of_the_ground_are_moved_with_the_sensor() {
        let height_m = 1.8;
        // Measured from 3 cm lower, nose down by 0.2 degrees.
        let (lower_m, down) = (0.03, 0.2f64.to_radians());
        let ray = |range_m: f64, azimuth: f64, moved: bool| {
            let down_by = (height_m / range_m).asin();
            let direction = Vector3::new(down_by.cos() * azimuth.cos(), down_by.cos() * azimuth.sin(), -down_by.sin());
            let surface = Ray::standing(&(direction * range_m));
            let across_m = if moved { lower_m + down * direction.x * range_m } else { 0.0 };
            Ray {
                surface: Surface::Ground,
                cos_incidence: down_by.sin() as f32,
                normal: [0.0, 0.0, 1.0],
                residual_m: (-across_m / down_by.sin()) as f32,
                ..surface
            }
        };
        let directions = (0..72).map(|k| f64::from(k) * 5f64.to_radians());
        let measured: Vec<Ray> = directions.flat_map(|az| [5.0, 6.0, 7.5].map(|r| ray(r, az, true))).collect();
        let ground = GroundMoved::new(&measured, 10.0);
        for azimuth in [0.0, 1.0, 3.0] {
            let truth = f64::from(ray(4.5, azimuth, true).residual_m);
            let found = ground.range_m(&ray(4.5, azimuth, false));
            assert!((found - truth).abs() < 0.01 && truth < -0.02, "{azimuth}: {found} {truth}");
        }
        assert_eq!(ground.range_m(&Ray::standing(&Vector3::new(5.0, 0.0, 0.0))), 0.0, "walls stay");
    }
}
