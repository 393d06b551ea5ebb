//! What happens around bright targets, such as signs and number plates of retroreflective foil: false returns at their
//! range, and lost returns of what is before or behind them. Edges of surfaces that are not bright are counted in the
//! same way: where things stand a little elsewhere, or are missing, returns come and go beside them as well.

use super::brightness::Brightness;
use crate::pairing::{FramePair, Lies, Ray};
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// Width of a bin of angles, rad: a quarter of a degree.
const BIN_RAD: f64 = 0.25 * std::f64::consts::PI / 180.0;

/// Bins of angles, up to 12 degrees.
pub const BINS: usize = 48;

/// Middle of a bin, rad.
pub fn angle_rad(bin: usize) -> f64 {
    (bin as f64 + 0.5) * BIN_RAD
}

/// Shares of the returns, the brightest ones, that may be of bright targets.
const BRIGHTEST: [f64; 6] = [0.005, 0.002, 0.001, 5e-4, 2e-4, 1e-4];

/// Difference of ranges within which a return is at the range of a target, m.
const SAME_RANGE_M: f64 = 0.5;

/// Smallest jump of the range at the edge of a surface, m.
const EDGE_M: f64 = 1.5;

/// Targets nearer to each other than this, rad, in range, m, are one.
const ONE_TARGET: [f64; 2] = [0.0045, 1.0];

/// Edges for each bright target, and at least.
const EDGES: [usize; 2] = [2, 30];

/// Most pairs of a shot and a target that are looked at for a profile: of more, every second shot, or fewer.
const PAIRS: usize = 3_000_000;

/// A target as a sensor sees it.
#[derive(Clone, Copy, Debug)]
struct Target {
    direction: Vector3<f64>,
    range_m: f64,
}

/// Shots at some angle from targets.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Around {
    /// Shots around which all simulated surfaces are farther than the nearest target.
    pub free: f64,
    /// Measured returns before their surface at the range of a target.
    pub returns: f64,
    /// Shots of which the simulated surface is at another range than the nearest target: a sample.
    pub shots: f64,
    /// Of these without a measured return.
    pub lost: f64,
}

impl Around {
    fn merge(&mut self, other: &Around) {
        self.free += other.free;
        self.returns += other.returns;
        self.shots += other.shots;
        self.lost += other.lost;
    }
}

/// Around targets, by angle.
pub type Profile = [Around; BINS];

/// Sum of profiles.
pub fn total<'a>(profiles: impl Iterator<Item = &'a Profile>) -> Profile {
    profiles.fold([Around::default(); BINS], |mut sum, one| {
        sum.iter_mut().zip(one).for_each(|(sum, bin)| sum.merge(bin));
        sum
    })
}

/// What one frame shows.
#[derive(Clone, Debug)]
pub struct HaloFrame {
    /// Around bright targets.
    pub bright: Profile,
    /// Around edges of other surfaces.
    pub usual: Profile,
}

impl Default for HaloFrame {
    fn default() -> Self {
        HaloFrame { bright: [Around::default(); BINS], usual: [Around::default(); BINS] }
    }
}

/// Brightnesses from which on the returns of some frames may be of bright targets.
pub fn thresholds(frames: &[FramePair], brightness: &Brightness) -> Vec<f64> {
    let all = frames.iter().flat_map(|f| &f.simulated);
    let mut ln: Vec<f64> = all.filter_map(|r| brightness.towards_sensor(r)).collect();
    ln.sort_by(f64::total_cmp);
    let at = |share: &f64| ln.get(ln.len() - 1 - (share * ln.len() as f64) as usize).copied();
    let mut thresholds: Vec<f64> = BRIGHTEST.iter().filter(|_| !ln.is_empty()).filter_map(at).collect();
    thresholds.dedup();
    thresholds
}

/// The targets of a sensor among some returns, one for each place.
fn targets<'a>(rays: impl Iterator<Item = &'a Ray>) -> Vec<Target> {
    let mut places = BTreeSet::<[i64; 4]>::new();
    let one = |ray: &'a Ray| {
        let target = Target { direction: ray.direction_vector(), range_m: ray.own_range_m() };
        let at = |k: usize| (target.direction[k] / ONE_TARGET[0]).round() as i64;
        let range = (target.range_m / ONE_TARGET[1]).round() as i64;
        places.insert([at(0), at(1), at(2), range]).then_some(target)
    };
    rays.filter_map(one).collect()
}

/// The bin of the angle to the nearest of those targets that a return may have to do with.
fn nearest(targets: &[Target], direction: &Vector3<f64>, counts: impl Fn(&Target) -> bool) -> Option<usize> {
    let near = targets.iter().filter(|t| counts(t));
    let cos = near.map(|t| t.direction.dot(direction)).max_by(f64::total_cmp)?;
    Some((cos.clamp(-1.0, 1.0).acos() / BIN_RAD) as usize).filter(|bin| *bin < BINS)
}

fn at_its_range(ray: &Ray) -> impl Fn(&Target) -> bool {
    let own_m = ray.own_range_m();
    move |target| (target.range_m - own_m).abs() < SAME_RANGE_M
}

/// Whether a shot with a simulated return shows what is before or behind a target.
fn at_another_range(ray: &Ray) -> impl Fn(&Target) -> bool {
    let own_m = ray.own_range_m();
    move |target| (target.range_m - own_m).abs() > SAME_RANGE_M
}

fn profile(frame: &FramePair, sensor: u8, targets: &[Target]) -> Profile {
    let mut out = [Around::default(); BINS];
    let step = (frame.simulated.len() * targets.len()).div_ceil(PAIRS).max(1);
    for ray in frame.simulated.iter().filter(|r| r.sensor == sensor).step_by(step) {
        let direction = ray.direction_vector();
        // At the edge of the target itself a return at its range is on a surface.
        let free_m = ray.own_range_m().min(f64::from(ray.near_far_m[0]));
        if let Some(bin) = nearest(targets, &direction, |t| t.range_m + SAME_RANGE_M < free_m) {
            out[bin].free += step as f64;
        }
        if let Some(bin) = nearest(targets, &direction, at_another_range(ray)) {
            out[bin].shots += 1.0;
            out[bin].lost += f64::from(u8::from(!ray.matched));
        }
    }
    // Where the simulation has no return no shot is counted.
    for ray in frame.measured.iter().filter(|r| r.sensor == sensor && r.lies() == Lies::InFront) {
        if let Some(bin) = nearest(targets, &ray.direction_vector(), at_its_range(ray)) {
            out[bin].returns += 1.0;
        }
    }
    out
}

/// Bright targets of each sensor in a frame.
fn bright_targets(frame: &FramePair, sensors: usize, brightness: &Brightness, least: f64) -> Vec<Vec<Target>> {
    let is_bright = |ray: &&Ray| brightness.towards_sensor(ray).is_some_and(|b| b >= least);
    let of = |s: usize| targets(frame.simulated.iter().filter(|r| usize::from(r.sensor) == s).filter(is_bright));
    (0..sensors).map(of).collect()
}

/// The profiles of a frame.
pub fn halo_frame(frame: &FramePair, sensors: usize, brightness: &Brightness, least: f64) -> HaloFrame {
    let mut out = HaloFrame::default();
    for (sensor, bright) in bright_targets(frame, sensors, brightness, least).iter().enumerate() {
        if bright.is_empty() {
            continue;
        }
        let sensor = sensor as u8;
        let is_edge = |ray: &&Ray| {
            let [_, far_m] = ray.near_far_m.map(f64::from);
            ray.sensor == sensor && far_m > ray.own_range_m() + EDGE_M
        };
        let far_off = |ray: &&Ray| nearest(bright, &ray.direction_vector(), |_| true).is_none();
        let edges = targets(frame.simulated.iter().filter(is_edge).filter(far_off));
        let step = edges.len().div_ceil((EDGES[0] * bright.len()).max(EDGES[1])).max(1);
        let edges: Vec<Target> = edges.into_iter().step_by(step).collect();
        out.bright = total([out.bright, profile(frame, sensor, bright)].iter());
        out.usual = total([out.usual, profile(frame, sensor, &edges)].iter());
    }
    out
}

/// A frame without the measured returns at the range of bright targets within an angle from them, rad, and without the
/// shots within another angle from them that show what is before or behind.
pub fn without_halos(
    frame: &FramePair,
    sensors: usize,
    brightness: &Brightness,
    least: f64,
    [halo_rad, dark_rad]: [f64; 2],
) -> FramePair {
    let bright = bright_targets(frame, sensors, brightness, least);
    let within = |ray: &Ray, most_rad: f64, counts: &dyn Fn(&Target) -> bool| {
        let near = nearest(&bright[usize::from(ray.sensor)], &ray.direction_vector(), counts);
        near.is_some_and(|bin| angle_rad(bin) < most_rad)
    };
    let is_halo = |ray: &Ray| ray.is_in_the_air() && within(ray, halo_rad, &at_its_range(ray));
    let is_dark = |ray: &Ray| within(ray, dark_rad, &at_another_range(ray));
    let mut out = frame.clone();
    out.measured.retain(|r| !is_halo(r));
    out.only_measured.retain(|r| !is_halo(r));
    out.simulated.retain(|r| !is_dark(r));
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A sign 15 m ahead before a wall 30 m away. Every second shot within three degrees of it returns at its range,
    /// and every third one within five degrees is lost.
    fn frame() -> FramePair {
        let (mut measured, mut simulated) = (Vec::new(), Vec::new());
        for k in 1..400u16 {
            let angle = 0.02 + 1e-3 * f64::from(k);
            let turn = 2.4 * f64::from(k);
            let across = angle.sin();
            let direction = Vector3::new(angle.cos(), across * turn.cos(), across * turn.sin());
            let ray = Ray { row: 0, ..Ray::standing(&(direction * 30.0)) };
            let lost = angle < 0.087 && k % 3 == 0;
            simulated.push(Ray { matched: !lost, ..ray });
            if angle < 0.052 && k % 2 == 0 {
                measured.push(Ray { residual_m: -15.0, ..ray });
            } else if !lost {
                measured.push(ray);
            }
        }
        FramePair::of_rays(String::new(), measured, simulated)
    }

    #[test]
    fn returns_at_the_range_of_a_target_and_lost_shots_are_counted_by_angle() {
        let sign = [Target { direction: Vector3::x(), range_m: 15.0 }];
        let of = profile(&frame(), 0, &sign);
        let sum = |bins: std::ops::Range<usize>, of_bin: fn(&Around) -> f64| of[bins].iter().map(of_bin).sum::<f64>();
        // Up to 3, up to 5 and up to 12 degrees.
        assert!((sum(0..12, |a| a.returns) / sum(0..12, |a| a.free) - 0.5).abs() < 0.1);
        assert_eq!(sum(12..BINS, |a| a.returns), 0.0);
        assert!((sum(0..20, |a| a.lost) / sum(0..20, |a| a.shots) - 0.33).abs() < 0.05);
        assert!(sum(20..BINS, |a| a.lost) == 0.0 && sum(20..BINS, |a| a.shots) > 100.0);
    }

    #[test]
    fn a_target_at_the_range_of_the_wall_has_no_halo() {
        let of = profile(&frame(), 0, &[Target { direction: Vector3::x(), range_m: 30.0 }]);
        assert!(of.iter().all(|a| *a == Around::default()));
    }
}
