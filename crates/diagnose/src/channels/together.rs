//! Whether shots fare each by itself: losses and false alarms that come by chance do.

use super::cells::cell;
use super::mask::Mask;
use super::returns::{NEAREST_M, free_until_m};
use crate::pairing::{FramePair, Lies, Ray};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// Shots beside lost ones of a frame, and how many of these are lost as well.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct BesideLost {
    /// The next shot of the same row.
    pub in_row: [f64; 2],
    /// The shot of the next row at the same azimuth.
    pub in_column: [f64; 2],
}

/// Shots beside lost ones of each frame. Things that one side lacks are lost in rows and in columns alike; of losses by
/// chance both are as many as of any shots.
pub fn beside_lost(frames: &[FramePair], which: &[usize], mask: &Mask) -> Vec<BesideLost> {
    which.par_iter().map(|&f| of_frame(&frames[f].simulated, mask)).collect()
}

/// A shot with a simulated return: its azimuth, rad, and whether it is lost.
type Shot = (f32, bool);

fn of_frame(simulated: &[Ray], mask: &Mask) -> BesideLost {
    let mut rows = BTreeMap::<(u8, u16), Vec<Shot>>::new();
    for ray in simulated.iter().filter(|r| r.row != u16::MAX && cell(r).is_some() && !mask.hides(r)) {
        rows.entry((ray.sensor, ray.row)).or_default().push((ray.azimuth_rad, !ray.matched));
    }
    rows.values_mut().for_each(|row| row.sort_by(|a, b| a.0.total_cmp(&b.0)));
    let mut sum = BesideLost::default();
    for (&(sensor, row), shots) in &rows {
        let gaps = shots.windows(2).map(|two| two[1].0 - two[0].0).filter(|gap| *gap > 0.0).collect();
        let Some(step) = statistics::median_upper(gaps) else { continue };
        let below = rows.get(&(sensor, row + 1));
        for (i, (azimuth, _)) in shots.iter().enumerate().filter(|(_, shot)| shot.1) {
            let next = shots.get(i + 1).filter(|next| next.0 - azimuth < 1.5 * step);
            count(&mut sum.in_row, next);
            count(&mut sum.in_column, below.and_then(|row| nearest(row, *azimuth, 0.5 * step)));
        }
    }
    sum
}

fn count(sum: &mut [f64; 2], shot: Option<&Shot>) {
    if let Some((_, lost)) = shot {
        *sum = [sum[0] + 1.0, sum[1] + f64::from(u8::from(*lost))];
    }
}

/// The shot of a row that is nearest to an azimuth, within some distance.
fn nearest(row: &[Shot], azimuth: f32, within: f32) -> Option<&Shot> {
    let at = row.partition_point(|shot| shot.0 < azimuth);
    let beside = row[at.saturating_sub(1)..(at + 1).min(row.len())].iter();
    let off = |shot: &&Shot| (shot.0 - azimuth).abs();
    beside.min_by(|a, b| off(a).total_cmp(&off(b))).filter(|shot| off(shot) < within)
}

/// Width of a patch of directions, rad: 5 degrees.
const PATCH_RAD: f32 = 0.0873;

/// Length of the free path of a shot that is looked at, m: false alarms become rare far away.
const PATH_M: f64 = 40.0;

/// Relative variance of the number of lone returns on the free path to smooth surfaces, from frame to frame in each
/// patch of directions, beyond what chance makes of so few, with its standard error. The length of free path, the rate
/// of each frame and that of each direction are taken out: 0 for false alarms that know nothing of each other.
/// `is_lone` says which measured returns count, by the number of the frame and their place there.
pub fn crowding(frames: &[&FramePair], is_lone: &(dyn Fn(usize, usize) -> bool + Sync)) -> [f64; 2] {
    type Patch = (u8, i32, i32);
    let patch = |r: &Ray| -> Patch {
        let of = |angle: f32| (angle / PATCH_RAD).floor() as i32;
        (r.sensor, of(r.azimuth_rad), of(r.elevation_rad))
    };
    // Of each frame and patch: lone returns, and length of free path.
    let sums = |(f, frame): (usize, &&FramePair)| {
        let mut sums = BTreeMap::<Patch, [f64; 2]>::new();
        let before = |r: &Ray| r.lies() == Lies::InFront && r.own_range_m() < PATH_M;
        let inside = |(i, r): &(usize, &Ray)| before(r) && is_lone(f, *i);
        frame.measured.iter().enumerate().filter(inside).for_each(|(_, r)| sums.entry(patch(r)).or_default()[0] += 1.0);
        for ray in frame.simulated.iter().filter(|r| r.smooth) {
            sums.entry(patch(ray)).or_default()[1] += (free_until_m(ray).min(PATH_M) - NEAREST_M).max(0.0);
        }
        sums
    };
    let frames: Vec<BTreeMap<Patch, [f64; 2]>> = frames.par_iter().enumerate().map(sums).collect();
    let mut of_patches = BTreeMap::<Patch, [f64; 2]>::new();
    for (at, [n, path]) in frames.iter().flatten() {
        let sum = of_patches.entry(*at).or_default();
        *sum = [sum[0] + n, sum[1] + path];
    }
    let rate = |at: &Patch| of_patches[at][0] / of_patches[at][1].max(1e-9);
    let (mut excess, mut squares) = (0.0, 0.0);
    for frame in &frames {
        let [n, usual] = frame.iter().fold([0.0; 2], |s, (at, [n, path])| [s[0] + n, s[1] + rate(at) * path]);
        let factor = n / usual.max(1e-9);
        for (at, [n, path]) in frame {
            let expected = factor * rate(at) * path;
            // What the patch itself has in its rate.
            let own = path / of_patches[at][1].max(1e-9);
            excess += (n - expected).powi(2) - expected * (1.0 - own);
            squares += expected * expected;
        }
    }
    [excess / squares.max(1e-9), (2.0 / squares.max(1e-9)).sqrt()]
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rand::RngExt;

    const STEP_RAD: f32 = 0.004;

    /// A wall all around, 30 m away; `lost` says which shots are lost, by row and column.
    fn wall(lost: impl Fn(u16, u16) -> bool) -> Vec<Ray> {
        let shots = (0..16).flat_map(|row| (0..1500).map(move |column| (row, column)));
        let shot = |(row, column): (u16, u16)| {
            let (azimuth, elevation) = (f32::from(column) * STEP_RAD - 3.0, 0.03 * f32::from(row) - 0.2);
            let at = Vector3::new(azimuth.cos(), azimuth.sin(), elevation.tan()).cast::<f64>() * 30.0;
            Ray { row, matched: !lost(row, column), ..Ray::standing(&at) }
        };
        shots.map(shot).collect()
    }

    #[test]
    fn a_column_is_lost_together_and_chance_loses_single_shots() {
        let share = |of: [f64; 2]| of[1] / of[0];
        let columns = of_frame(&wall(|row, column| column % 5 == 0 && (row + column / 5) % 4 != 0), &Mask::default());
        assert!(share(columns.in_column) > 0.6 && share(columns.in_row) == 0.0, "{columns:?}");
        let rng = std::cell::RefCell::new(data::stream(5, "together", 0, 0));
        let chance = of_frame(&wall(|_, _| rng.borrow_mut().random_bool(0.1)), &Mask::default());
        assert!((share(chance.in_column) - share(chance.in_row)).abs() < 0.05, "{chance:?}");
        let things = of_frame(&wall(|row, column| row < 8 && column % 100 < 10), &Mask::default());
        assert!(share(things.in_column) < share(things.in_row) + 0.01, "{things:?}");
    }

    #[test]
    fn false_alarms_by_chance_do_not_crowd_and_those_in_stripes_do() {
        let mut rng = data::stream(6, "together", 0, 0);
        let mut crowding_of = |stripes: bool| {
            let frames: Vec<FramePair> = (0..12)
                .map(|f| {
                    let simulated = wall(|_, _| false);
                    let mut lone = Vec::new();
                    for ray in &simulated {
                        let inside = (ray.azimuth_rad * 5.0 + f as f32).sin() > 0.9;
                        let rate = match [stripes, inside] {
                            [false, _] => 0.01,
                            [true, true] => 0.07,
                            [true, false] => 0.0,
                        };
                        if rng.random_bool(rate) {
                            lone.push(Ray { residual_m: -15.0, company: 0, matched: false, ..*ray });
                        }
                    }
                    FramePair::of_rays(f.to_string(), lone, simulated)
                })
                .collect();
            crowding(&frames.iter().collect::<Vec<_>>(), &|_, _| true)
        };
        let [[by_chance, error], [in_stripes, _]] = [crowding_of(false), crowding_of(true)];
        assert!(by_chance.abs() < 4.0 * error && error < 0.1, "{by_chance} {error}");
        assert!(in_stripes > 3.0, "{in_stripes}");
    }
}
