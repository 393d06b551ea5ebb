//! What happens around bright targets, such as signs and number plates of retroreflective foil: false returns at their
//! range, and lost returns of what is before or behind them. Edges of surfaces that are not bright are counted in the
//! same way: where things stand a little elsewhere, or are missing, returns come and go beside them as well.

use super::brightness::Brightness;
use super::cells::{RANGE_BINS, ZONES, range_bin, zone};
use crate::pairing::{FramePair, Lies, Ray, at_object};
use geometry::Box3;
use nalgebra::{Point3, Vector3};
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
    /// As many of them as are lost of all shots to such surfaces at such ranges.
    pub usually_lost: f64,
}

impl Around {
    fn merge(&mut self, other: &Around) {
        self.free += other.free;
        self.returns += other.returns;
        self.shots += other.shots;
        self.lost += other.lost;
        self.usually_lost += other.usually_lost;
    }
}

/// Shares of the shots that are lost by kind of surface and range, whatever is bright near them.
#[derive(Clone, Debug)]
pub struct UsualLosses([[f64; RANGE_BINS]; ZONES + 1]);

/// Shots that the share of a kind of surface stands for in that at a range.
const SMOOTHING: f64 = 20.0;

impl UsualLosses {
    /// Of some frames.
    pub fn of<'a>(frames: impl Iterator<Item = &'a FramePair>) -> Self {
        let mut counts = [[[0.0; 2]; RANGE_BINS]; ZONES + 1];
        for ray in frames.flat_map(|f| &f.simulated) {
            let (kind, bin) = Self::place(ray);
            counts[kind][bin][0] += 1.0;
            counts[kind][bin][1] += f64::from(u8::from(!ray.matched));
        }
        UsualLosses(counts.map(|of_kind| {
            let [n, lost] = of_kind.iter().fold([0.0; 2], |s, c| [s[0] + c[0], s[1] + c[1]]);
            let share = lost / f64::max(n, 1.0);
            of_kind.map(|[n, lost]| (lost + SMOOTHING * share) / (n + SMOOTHING))
        }))
    }

    fn place(ray: &Ray) -> (usize, usize) {
        (zone(ray).unwrap_or(ZONES), range_bin(f64::from(ray.range_m)))
    }

    fn share(&self, ray: &Ray) -> f64 {
        let (kind, bin) = Self::place(ray);
        self.0[kind][bin]
    }
}

/// What the frames have in common.
pub struct Shared<'a> {
    /// Brightness of returns, with the fall with range taken out.
    pub brightness: &'a Brightness,
    /// Brightness from which on a target is bright.
    pub least: f64,
    /// Origins of the sensors in the cloud's frame, m.
    pub origins: &'a [Point3<f64>],
    /// Usual losses.
    pub losses: &'a UsualLosses,
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

/// The bin of the angle to the nearest of those targets that a return may have to do with, and the target's range, m.
fn nearest(targets: &[Target], direction: &Vector3<f64>, counts: impl Fn(&Target) -> bool) -> Option<(usize, f64)> {
    let near = targets.iter().filter(|t| counts(t)).map(|t| (t.direction.dot(direction), t.range_m));
    let (cos, range_m) = near.max_by(|a, b| a.0.total_cmp(&b.0))?;
    Some(((cos.clamp(-1.0, 1.0).acos() / BIN_RAD) as usize, range_m)).filter(|(bin, _)| *bin < BINS)
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

fn profile(
    frame: &FramePair,
    (sensor, origin): (u8, &Point3<f64>),
    targets: &[Target],
    losses: &UsualLosses,
) -> Profile {
    let mut out = [Around::default(); BINS];
    // What lies beside a label may be the object: vehicles are larger than simulated.
    let boxes: Vec<Box3> = frame.objects.iter().filter_map(|o| o.simulated).collect();
    let beside = |direction: &Vector3<f64>, range_m: f64| at_object(&boxes, (origin + direction * range_m).into());
    let step = (frame.simulated.len() * targets.len()).div_ceil(PAIRS).max(1);
    for ray in frame.simulated.iter().filter(|r| r.sensor == sensor).step_by(step) {
        let direction = ray.direction_vector();
        // At the edge of the target itself a return at its range is on a surface.
        let free_m = ray.own_range_m().min(f64::from(ray.near_far_m[0]));
        if let Some((bin, range_m)) = nearest(targets, &direction, |t| t.range_m + SAME_RANGE_M < free_m)
            && !beside(&direction, range_m)
        {
            out[bin].free += step as f64;
        }
        if let Some((bin, _)) = nearest(targets, &direction, at_another_range(ray)) {
            out[bin].shots += 1.0;
            out[bin].lost += f64::from(u8::from(!ray.matched));
            out[bin].usually_lost += losses.share(ray);
        }
    }
    // Where the simulation has no return no shot is counted.
    for ray in frame.measured.iter().filter(|r| r.sensor == sensor && r.lies() == Lies::InFront) {
        let direction = ray.direction_vector();
        if let Some((bin, _)) = nearest(targets, &direction, at_its_range(ray))
            && !beside(&direction, ray.own_range_m())
        {
            out[bin].returns += 1.0;
        }
    }
    out
}

/// Bright targets of each sensor in a frame.
fn bright_targets(frame: &FramePair, shared: &Shared) -> Vec<Vec<Target>> {
    let is_bright = |ray: &&Ray| shared.brightness.towards_sensor(ray).is_some_and(|b| b >= shared.least);
    let of = |s: usize| targets(frame.simulated.iter().filter(|r| usize::from(r.sensor) == s).filter(is_bright));
    (0..shared.origins.len()).map(of).collect()
}

/// The profiles of a frame.
pub fn halo_frame(frame: &FramePair, shared: &Shared) -> HaloFrame {
    let mut out = HaloFrame::default();
    for (sensor, bright) in bright_targets(frame, shared).iter().enumerate() {
        if bright.is_empty() {
            continue;
        }
        let (sensor, origin) = (sensor as u8, &shared.origins[sensor]);
        let is_edge = |ray: &&Ray| {
            let [_, far_m] = ray.near_far_m.map(f64::from);
            ray.sensor == sensor && far_m > ray.own_range_m() + EDGE_M
        };
        let far_off = |ray: &&Ray| nearest(bright, &ray.direction_vector(), |_| true).is_none();
        let edges = targets(frame.simulated.iter().filter(is_edge).filter(far_off));
        let step = edges.len().div_ceil((EDGES[0] * bright.len()).max(EDGES[1])).max(1);
        let edges: Vec<Target> = edges.into_iter().step_by(step).collect();
        out.bright = total([out.bright, profile(frame, (sensor, origin), bright, shared.losses)].iter());
        out.usual = total([out.usual, profile(frame, (sensor, origin), &edges, shared.losses)].iter());
    }
    out
}

/// A frame without the measured returns at the range of bright targets within an angle from them, rad, and without the
/// shots within another angle from them that show what is before or behind.
pub fn without_halos(frame: &FramePair, shared: &Shared, [halo_rad, dark_rad]: [f64; 2]) -> FramePair {
    let bright = bright_targets(frame, shared);
    let within = |ray: &Ray, most_rad: f64, counts: &dyn Fn(&Target) -> bool| {
        let near = nearest(&bright[usize::from(ray.sensor)], &ray.direction_vector(), counts);
        near.is_some_and(|(bin, _)| angle_rad(bin) < most_rad)
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
    use crate::pairing::{ObjectPair, Surface};

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

    fn profile_of(frame: &FramePair, targets: &[Target]) -> Profile {
        profile(frame, (0, &Point3::origin()), targets, &UsualLosses::of([frame].into_iter()))
    }

    #[test]
    fn returns_at_the_range_of_a_target_and_lost_shots_are_counted_by_angle() {
        let sign = [Target { direction: Vector3::x(), range_m: 15.0 }];
        let of = profile_of(&frame(), &sign);
        let sum = |bins: std::ops::Range<usize>, of_bin: fn(&Around) -> f64| of[bins].iter().map(of_bin).sum::<f64>();
        // Up to 3, up to 5 and up to 12 degrees.
        assert!((sum(0..12, |a| a.returns) / sum(0..12, |a| a.free) - 0.5).abs() < 0.1);
        assert_eq!(sum(12..BINS, |a| a.returns), 0.0);
        assert!((sum(0..20, |a| a.lost) / sum(0..20, |a| a.shots) - 0.33).abs() < 0.05);
        assert!(sum(20..BINS, |a| a.lost) == 0.0 && sum(20..BINS, |a| a.shots) > 100.0);
    }

    #[test]
    fn what_lies_beside_a_label_belongs_to_the_object() {
        let mut frame = frame();
        let car = Box3::from_array([16.0, 0.0, 0.0, 2.2, 2.0, 4.0, 0.0]);
        let object = ObjectPair { simulated: Some(car), measured: None, shift: None, points: [0, 0] };
        frame.objects.push(object);
        let of = profile_of(&frame, &[Target { direction: Vector3::x(), range_m: 15.0 }]);
        // 1.5 m are 5.7 degrees at its range; below it is the ground.
        assert!(of[..20].iter().map(|a| a.returns).sum::<f64>() < 12.0);
        assert!(of[24..].iter().map(|a| a.free).sum::<f64>() > 50.0);
    }

    #[test]
    fn losses_of_a_kind_of_surface_are_usual_wherever_it_is_bright() {
        let mut frame = frame();
        for ray in &mut frame.simulated {
            ray.matched = ray.azimuth_rad > 0.1;
            ray.surface = if ray.matched { Surface::Standing } else { Surface::Object };
        }
        let of = profile_of(&frame, &[Target { direction: Vector3::x(), range_m: 15.0 }]);
        let [lost, usually] = of.iter().fold([0.0; 2], |s, a| [s[0] + a.lost, s[1] + a.usually_lost]);
        assert!(lost > 20.0 && (usually / lost - 1.0).abs() < 0.1, "{usually} {lost}");
    }

    #[test]
    fn a_target_at_the_range_of_the_wall_has_no_halo() {
        let of = profile_of(&frame(), &[Target { direction: Vector3::x(), range_m: 30.0 }]);
        assert!(of.iter().all(|a| *a == Around::default()));
    }
}
