//! The smallest and the largest range that are measured.

use crate::catalogue::sizes::CUT_SHARE;
use crate::inference::simplex::minimise;
use crate::pairing::{FramePair, OCTANTS, Ray, Surface};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;
use statistics::{blocks_of, deviation, draw_blocks};
use std::collections::BTreeMap;

/// Largest share of the simulated returns beyond an end that the measured side has there: false alarms occur at all
/// ranges.
const BEYOND: f64 = 0.05;

/// The same, from where on the end is looked for: farther inside, a law of losses may fall.
const LOOKED_FOR: f64 = 0.01;

/// Least share of the returns that other losses leave inside of a step: where fewer are left, a law of losses ends
/// there.
const LEAST_USUAL: f64 = 0.4;

/// Largest width of a step, as a share of its range: the threshold of a receiver is softer than a sharp end, while laws
/// of losses fall over a fifth of a range or more.
const WIDEST: f64 = 0.06;

/// A smallest or largest measured range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RangeEnd {
    /// Where it is, m.
    pub at_m: f64,
    /// Standard deviation of the step, as a share of that range.
    pub width: f64,
}

/// Least share of its range on either side of an end where it may take returns: range noise moves them across it.
const LEAST_MARGIN: f64 = 0.015;

impl RangeEnd {
    /// The range about it, m, where it may take returns: two standard deviations to either side.
    pub fn about_m(&self) -> [f64; 2] {
        let margin = LEAST_MARGIN.max(2.0 * self.width);
        [1.0 - margin, 1.0 + margin].map(|share| share * self.at_m)
    }
}

/// The largest measured range: beyond it only the simulation has returns, before it both sides have.
pub fn range_cut(frames: &[FramePair], which: &[usize]) -> Option<RangeEnd> {
    cut(frames, which, End::Far)
}

/// Share of the simulated returns nearer than the smallest measured range from which on the near surface was moved and
/// not lost: those that have a counterpart in their direction, on the ground or at about their range.
const MOVED: f64 = 0.1;

/// The smallest measured range: nearer only the simulation has returns. In their directions something else may be
/// measured farther away, where the simulation has a thing that is not there.
pub fn near_cut(frames: &[FramePair], which: &[usize]) -> Option<RangeEnd> {
    let near = cut(frames, which, End::Near)?;
    let below_m = (1.0 - LEAST_MARGIN) * near.at_m;
    let nearer = || which.iter().flat_map(|&i| &frames[i].simulated).filter(|r| r.own_range_m() < below_m);
    let is_moved = |r: &&Ray| r.matched && (r.shown || r.surface == Surface::Ground);
    let moved = nearer().filter(is_moved).count() as f64;
    (moved < MOVED * nearer().count() as f64).then_some(near)
}

/// The end of the measured ranges: beyond it only the simulation has returns, before it both sides have.
fn cut(frames: &[FramePair], which: &[usize], end: End) -> Option<RangeEnd> {
    // A value that is larger the farther beyond.
    let value = |range_m: f64| if end == End::Near { 1.0 / range_m.max(1e-3) } else { range_m };
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
    // The outermost place beyond which the measured side has next to nothing of what the simulation has.
    let empty = |i: &usize| (a.len() - 1 - i) as f64 <= LOOKED_FOR * above(&b, a[*i]);
    let outermost = a[(0..a.len()).find(empty)?];
    let at = change(&a, &b, 0.8 * outermost);
    let lost = above(&b, 1.01 * at);
    let beyond = above(&a, 1.01 * at) / lost.max(1.0);
    let before = above(&b, 0.9 * at) - above(&b, 0.995 * at);
    if lost < 60.0 || lost < CUT_SHARE * b.len() as f64 || beyond > BEYOND || before < 40.0 {
        return None;
    }
    let end_m = value(at);
    let step = SoftStep::fit(&sum_of(counts_about(frames, which, end_m).iter().flatten()), end);
    let found = RangeEnd { at_m: end_m * (1.0 + step.middle), width: step.width };
    (step.width < WIDEST && step.usual > LEAST_USUAL).then_some(found)
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

/// Bins around an end, and their width as a share of its range: a sharp end lies anywhere between the middles of two.
const BINS: usize = 360;
const BIN: f64 = 0.001;

/// Width of a step from which on its fit begins, as a share of the range.
const FIRST_WIDTH: f64 = 0.012;

/// Bootstrap repetitions for the error of an end.
const REPETITIONS: usize = 60;

/// Simulated returns by bins around an end: those with a measured counterpart in their direction, and those without.
type Counts = [[f64; BINS]; 2];

/// The range at which half of the returns are lost, and its standard error, m: over blocks of frames, or over the
/// directions about the vehicle, which show other surfaces, whichever is larger. The threshold of a receiver is soft:
/// returns become fewer over some range. The share of the simulated returns that have a counterpart
/// is a normal distribution function of the range, whose middle and width are fitted. `end_m` is about where the end
/// is.
///
/// Rows meet near ground in rings, which a sensor that stands one centimetre lower sees some centimetres nearer. The
/// simulated rings are moved to where the measured ones are.
pub fn half_point(frames: &[FramePair], which: &[usize], blocks: &[usize], end_m: f64, end: End) -> [f64; 2] {
    let each = counts_about(frames, which, end_m);
    let fit_counts = |counts: &Counts| end_m * (1.0 + SoftStep::fit(counts, end).middle);
    let fit = |drawn: &[usize]| fit_counts(&sum_of(drawn.iter().flat_map(|&i| &each[i])));
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose end of ranges", 0, 0);
    let draws: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let again: Vec<f64> = draws.par_iter().map(|drawn| fit(drawn)).collect();
    let in_octant = |k: usize| sum_of(each.iter().map(|octants| &octants[k]));
    let octants: Vec<Counts> = (0..OCTANTS).map(in_octant).filter(|c| c.iter().flatten().any(|n| *n > 0.0)).collect();
    let without = |k: usize| fit_counts(&sum_of(octants.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, c)| c)));
    let jackknife: Vec<f64> = (0..octants.len()).into_par_iter().map(without).collect();
    let over_octants = (jackknife.len() as f64 - 1.0).max(0.0).sqrt() * deviation(&jackknife);
    [fit(&(0..which.len()).collect::<Vec<_>>()), deviation(&again).max(over_octants)]
}

/// Counts about an end of each frame, by octant.
fn counts_about(frames: &[FramePair], which: &[usize], end_m: f64) -> Vec<[Counts; OCTANTS]> {
    let bin = |range_m: f64| {
        let at = (range_m / end_m - 1.0) / BIN + 0.5 * BINS as f64;
        (0.0..BINS as f64).contains(&at).then_some(at as usize)
    };
    let of_frame = |&i: &usize| {
        let mut counts = [[[0.0; BINS]; 2]; OCTANTS];
        let ground = GroundMoved::new(&frames[i].measured, 2.0 * end_m);
        for ray in frames[i].simulated.iter().filter(|r| r.company >= 2) {
            if let Some(k) = bin(ray.own_range_m() + ground.range_m(ray)) {
                counts[ray.octant()][usize::from(!ray.matched)][k] += 1.0;
            }
        }
        counts
    };
    which.par_iter().map(of_frame).collect()
}

fn sum_of<'a>(counts: impl Iterator<Item = &'a Counts>) -> Counts {
    counts.fold([[0.0; BINS]; 2], |mut sum, c| {
        sum.iter_mut().flatten().zip(c.iter().flatten()).for_each(|(s, v)| *s += v);
        sum
    })
}

/// Where the measured ground near a sensor lies beside the simulated one, in one frame: for each sensor, distance
/// across the surface as a linear function of the place, m.
struct GroundMoved(BTreeMap<u8, Vector3<f64>>);

impl GroundMoved {
    /// From the measured returns up to a range, m.
    fn new(measured: &[Ray], until_m: f64) -> GroundMoved {
        let mut sums = BTreeMap::<u8, (Matrix3<f64>, Vector3<f64>)>::new();
        let near = |r: &&Ray| is_ground(r) && r.own_range_m() < until_m && r.across_nearest_m().abs() < MOST_MOVED_M;
        for ray in measured.iter().filter(near) {
            let x = terms(ray);
            // One metre for each coefficient, from a return with a standard deviation of a decimetre.
            let sum = sums.entry(ray.sensor).or_insert((Matrix3::identity() * 0.01, Vector3::zeros()));
            sum.0 += x * x.transpose();
            sum.1 += x * ray.across_nearest_m();
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

/// The share of returns with a counterpart about an end: a normal distribution function of the range.
struct SoftStep {
    /// Middle and standard deviation, as shares of the range in the middle of the bins; the middle from there.
    middle: f64,
    width: f64,
    /// Share before the end, where some have none.
    usual: f64,
}

impl SoftStep {
    /// The most likely one. Beyond the end some have a counterpart by chance, or one of what stands behind. Where all
    /// have one, as in different streets, which are not compared return by return, the step is sharp.
    fn fit(counts: &Counts, end: End) -> SoftStep {
        if counts[1].iter().sum::<f64>() == 0.0 {
            return SoftStep { middle: 0.0, width: 0.0, usual: 1.0 };
        }
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
        let (p, _) = minimise(&[0.0, FIRST_WIDTH.ln(), 2.0, -4.0], &[FIRST_WIDTH, 0.7, 1.0, 1.0], surprise);
        SoftStep { middle: p[0], width: p[1].exp(), usual: share(p[2]) }
    }
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
    fn without_counterparts_to_count_the_step_is_sharp() {
        let SoftStep { middle, width, usual } = SoftStep::fit(&[[5.0; BINS], [0.0; BINS]], End::Far);
        assert_eq!([middle, width, usual], [0.0, 0.0, 1.0]);
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
                let SoftStep { middle: found, width: wide, usual } = SoftStep::fit(&counts, end);
                assert!((wide / width - 1.0).abs() < 0.1 && (usual - 0.9).abs() < 0.01, "{wide} {usual}");
                assert!((found - middle_at).abs() < 0.002, "{end:?} {middle_at} {width} {found}");
            }
        }
    }

    /// In all frames the walls on one side lie 10 cm farther away than simulated: frames do not tell that, sides do.
    #[test]
    fn directions_that_disagree_are_an_error_of_the_end() {
        let frame = |off_m: f64| {
            let ray = |azimuth: f64, range_m: f64| {
                let end_m = if azimuth > 0.0 { 6.0 + off_m } else { 6.0 };
                let place = Vector3::new(azimuth.cos(), azimuth.sin(), 0.0) * range_m;
                Ray { matched: range_m > end_m, ..Ray::standing(&place) }
            };
            let simulated = (0..8 * 200).map(|k| ray(0.75 * f64::from(k % 8) - 2.6, 5.0 + 0.01 * f64::from(k / 8)));
            FramePair::of_rays(String::new(), vec![], simulated.collect())
        };
        let of = |off_m: f64| {
            let frames = vec![frame(off_m); 6];
            half_point(&frames, &[0, 1, 2, 3, 4, 5], &[0, 1, 2, 3, 4, 5], 6.0, End::Near)
        };
        let [[same_m, alike], [middle_m, error]] = [of(0.0), of(0.1)];
        assert!((same_m - 6.0).abs() < 0.01 && alike < 0.01, "{same_m} {alike}");
        assert!((middle_m - 6.05).abs() < 2.0 * error && (0.01..0.05).contains(&error), "{middle_m} {error}");
    }

    #[test]
    fn a_few_returns_beyond_an_end_do_not_hide_it() {
        let ray = |range_m: f64, matched: bool| Ray { matched, ..Ray::standing(&Vector3::new(range_m, 0.0, 0.0)) };
        let simulated = || (0..6000).map(|k| 3.0 + 0.005 * f64::from(k));
        // One in two hundred of the nearer ones is a false alarm.
        let measured = simulated().filter(|r| *r > 8.0).chain((0..5).map(|k| 5.4 + 0.01 * f64::from(k)));
        let frame = FramePair::of_rays(
            String::new(),
            measured.map(|r| ray(r, true)).collect(),
            simulated().map(|r| ray(r, r > 8.0)).collect(),
        );
        let near = near_cut(&[frame], &[0]).unwrap();
        assert!((near.at_m - 8.0).abs() < 0.02, "{near:?}");
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
