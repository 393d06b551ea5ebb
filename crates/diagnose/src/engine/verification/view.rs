//! One measured frame against the simulation, return by return, with findings applied to the simulation and not.
//!
//! Losses, returns in the air and noise are drawn at random: no simulation has the very same ones. What is shown of
//! them is what one side has more of in a patch of directions.

use super::{Part, Prepared, Verification};
use crate::catalogue::Channel;
use crate::channels::intensity::ln_ratio;
use crate::channels::mask::{DirectionCell, direction_cell};
use crate::channels::mean::origins;
use crate::channels::roughness::own_roughness_m;
use crate::diagnosis::Finding;
use crate::error::DiagnoseError;
use crate::inference::{evenly_spread, median};
use crate::pairing::{Corrections, FramePair, Lies, PairSide, Ray, SideFrame, pair_all};
use nalgebra::Point3;
use rayon::prelude::*;
use sensor::EffectList;
use statistics::{MEDIAN_OF_NORMAL, mean};
use std::collections::BTreeMap;
use std::sync::Arc;

/// Measured returns of a view, at most.
const MOST_POINTS: usize = 40_000;

/// Lost returns of a state, at most.
const MOST_LOST: usize = 5_000;

/// Findings that are switched, at most.
const MOST_FINDINGS: usize = 11;

/// Width and height of a patch of directions, in cells: 6 by 4 degrees.
const PATCH: i32 = 4;

/// Fewest returns of a side in a patch for a value of it.
const FEWEST: usize = 12;

/// What the colours of a view say of a measured return.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Discrepancy {
    /// Its range minus that of the simulated surface in its direction, m.
    Range,
    /// The scatter of the measured ranges in its patch of directions minus that of the simulated ones, as standard
    /// deviations, m.
    Scatter,
    /// The mean logarithm of the measured intensities over the simulated ones in its patch of directions.
    Intensity,
}

/// One measured frame with its discrepancies from the simulation.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Id of the frame: of those that were held out, the one that differs most from the simulation in the channels
    /// with findings.
    pub frame: String,
    /// Places of its returns in the frame of the clouds, m.
    pub points_m: Vec<[f32; 3]>,
    /// All findings together, if there are several; then each, the largest first. Those that do not change the
    /// returns of this frame are left out.
    pub switches: Vec<Switch>,
}

/// Findings that are applied to the simulation or not, with all others applied.
#[derive(Clone, Debug, PartialEq)]
pub struct Switch {
    /// Number of the finding; `None`: all of them.
    pub finding: Option<usize>,
    /// What is compared.
    pub discrepancy: Discrepancy,
    /// Not applied.
    pub off: ViewState,
    /// Applied.
    pub on: ViewState,
}

/// The discrepancies of one simulation.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewState {
    /// Of each measured return; `None`: the simulation has no return for it.
    pub values: Vec<Option<f32>>,
    /// Simulated returns that the measured frame lacks, in the frame of the clouds, m.
    pub lost_m: Vec<[f32; 3]>,
}

impl Discrepancy {
    const ALL: [Discrepancy; 3] = [Discrepancy::Range, Discrepancy::Scatter, Discrepancy::Intensity];

    /// What shows the findings of a channel.
    fn of(channel: Channel) -> Discrepancy {
        match channel {
            Channel::Roughness | Channel::Ranges => Discrepancy::Scatter,
            Channel::Intensity => Discrepancy::Intensity,
            _ => Discrepancy::Range,
        }
    }
}

impl Verification<'_> {
    /// A held-out frame with the findings and without them. The simulated frames are prepared for all their effects.
    /// `None` where no finding changes it.
    ///
    /// # Errors
    /// Files that cannot be read, and frames that cannot be made.
    pub(in crate::engine) fn view(
        &self,
        effects: &EffectList,
        findings: &[Finding],
        (made, refused): &Prepared,
    ) -> Result<Option<View>, DiagnoseError> {
        let recordings = self.engine.recordings;
        let applied = effects.without(refused);
        let acts = |(_, finding): &(usize, &Finding)| applied.effects.iter().any(|e| finding.effects.contains(e));
        let acting: Vec<(usize, &Finding)> = findings.iter().enumerate().filter(acts).take(MOST_FINDINGS).collect();
        let Some(frame) = self.most_different().filter(|_| !acting.is_empty()) else { return Ok(None) };
        let remade = |list: &EffectList| -> Result<FramePair, DiagnoseError> {
            let (cloud, objects) = made.frame_with(list, recordings.id(frame))?;
            self.paired(frame, SideFrame::new(&cloud, objects, self.context.rig))
        };
        let origins = origins(self.context.rig);
        let on = remade(&applied)?;
        let with_all: BTreeMap<Discrepancy, ViewState> =
            Discrepancy::ALL.map(|discrepancy| (discrepancy, ViewState::of(&on, &origins, discrepancy))).into();
        let switch = |finding, off: &FramePair, discrepancy| {
            let [off, on] = thinned([ViewState::of(off, &origins, discrepancy), with_all[&discrepancy].clone()]);
            Switch { finding, discrepancy, off, on }
        };
        let of_one = |(number, finding): &(usize, &Finding)| {
            let off = remade(&applied.silencing(|effect| finding.effects.contains(effect)))?;
            Ok(switch(Some(*number), &off, Discrepancy::of(finding.channel)))
        };
        let mut switches = Vec::new();
        if acting.len() > 1 {
            let as_it_is = self.paired(frame, recordings.side(frame, PairSide::Simulated)?.clone())?;
            switches.push(switch(None, &as_it_is, Discrepancy::Range));
        }
        let of_each: Vec<Result<Switch, DiagnoseError>> = acting.par_iter().map(of_one).collect();
        switches.extend(of_each.into_iter().collect::<Result<Vec<_>, _>>()?);
        switches.retain(|switch| switch.off != switch.on);
        let points_m: Vec<[f32; 3]> = on.measured.iter().map(|ray| place_m(ray, &origins)).collect();
        let points_m = evenly_spread(&points_m, MOST_POINTS);
        let view = View { frame: recordings.id(frame).into(), points_m, switches };
        Ok(Some(view).filter(|view| !view.switches.is_empty()))
    }

    /// The held-out frame with the largest distance in the channels of findings.
    fn most_different(&self) -> Option<usize> {
        let counts = |part: &Part| matches!(part, Part::Channel(channel) if self.found.contains(channel));
        let nats = |at: usize| self.before.iter().filter(|(part, _)| counts(part)).map(|(_, d)| d[at]).sum::<f64>();
        let largest = (0..self.test.len()).max_by(|a, b| nats(*a).total_cmp(&nats(*b)).then(b.cmp(a)))?;
        Some(self.test[largest])
    }

    /// A frame with another simulated side, all returns of it.
    fn paired(&self, frame: usize, simulated: SideFrame) -> Result<FramePair, DiagnoseError> {
        let recordings = self.engine.recordings.with_sides(&[frame], None, &[Arc::new(simulated)])?;
        let corrections = Corrections::default();
        let mut pairs = pair_all(&recordings, self.engine.sensors, corrections, usize::MAX, &|_| ())?;
        Ok(pairs.swap_remove(0))
    }
}

/// Where a return lies, in the frame of the clouds, m.
fn place_m(ray: &Ray, origins: &[Point3<f64>]) -> [f32; 3] {
    ray.point(&origins[usize::from(ray.sensor)]).coords.cast::<f32>().into()
}

impl ViewState {
    fn of(pair: &FramePair, origins: &[Point3<f64>], discrepancy: Discrepancy) -> ViewState {
        let (values, lost_m) = match discrepancy {
            Discrepancy::Range => ranges(pair, origins),
            Discrepancy::Scatter => (of_patches(pair, |ray| own_roughness_m(ray).map(f64::abs), scatter_m), vec![]),
            Discrepancy::Intensity => (of_patches(pair, ln_ratio, |values| mean(&values)), vec![]),
        };
        ViewState { values, lost_m }
    }
}

/// Two states with at most as many returns as are kept. Both keep the same share of their lost returns, so that their
/// numbers can be compared.
fn thinned(states: [ViewState; 2]) -> [ViewState; 2] {
    let all = states.iter().map(|state| state.lost_m.len()).fold(MOST_LOST, usize::max);
    states.map(|ViewState { values, lost_m }| {
        let kept = lost_m.len() * MOST_LOST / all;
        ViewState { values: evenly_spread(&values, MOST_POINTS), lost_m: evenly_spread(&lost_m, kept) }
    })
}

/// The range of every measured return against the simulation, and the returns that it lacks.
fn ranges(pair: &FramePair, origins: &[Point3<f64>]) -> (Vec<Option<f32>>, Vec<[f32; 3]>) {
    let [extra, lost] = surplus(pair, |ray| !ray.matched);
    let [[in_front, _], [behind, _]] =
        [Lies::InFront, Lies::Behind].map(|lies| surplus(pair, move |ray| ray.lies() == lies));
    let value = |(i, ray): (usize, &Ray)| {
        let differs = match ray.lies() {
            Lies::On => true,
            Lies::InFront => in_front[i],
            Lies::Behind => behind[i],
            Lies::Open => false,
        };
        (!extra[i]).then(|| if differs { off_m(ray) as f32 } else { 0.0 })
    };
    let values = pair.measured.iter().enumerate().map(value).collect();
    let lacking = pair.simulated.iter().zip(&lost).filter(|(_, lost)| **lost);
    (values, lacking.map(|(ray, _)| place_m(ray, origins)).collect())
}

/// How much farther a return is than what the simulation has in its direction, m: 0 between the surfaces of an edge.
fn off_m(ray: &Ray) -> f64 {
    let [near, far] = ray.near_far_m.map(f64::from);
    let own = ray.own_range_m();
    if ray.smooth { f64::from(ray.residual_m) } else { own - own.max(near).min(far) }
}

/// The patch of directions of a return.
fn patch(ray: &Ray) -> DirectionCell {
    let (sensor, azimuth, elevation) = direction_cell(ray);
    (sensor, azimuth.div_euclid(PATCH), elevation.div_euclid(PATCH))
}

/// Marks the measured and the simulated returns of a kind of which their side has more in their patch than the other:
/// as many as it has more, spread over all of the kind there.
fn surplus(pair: &FramePair, of_kind: impl Fn(&Ray) -> bool) -> [Vec<bool>; 2] {
    let sides = [&pair.measured, &pair.simulated];
    let mut counts: BTreeMap<DirectionCell, [usize; 2]> = BTreeMap::new();
    for (side, rays) in sides.iter().enumerate() {
        rays.iter().filter(|ray| of_kind(ray)).for_each(|ray| counts.entry(patch(ray)).or_default()[side] += 1);
    }
    [0, 1].map(|side| {
        let mut passed: BTreeMap<DirectionCell, usize> = BTreeMap::new();
        let mut mark = |ray: &Ray| {
            let patch = patch(ray);
            let Some(count) = counts.get(&patch).filter(|_| of_kind(ray)) else { return false };
            let more = count[side].saturating_sub(count[1 - side]);
            let before = passed.entry(patch).or_default();
            *before += 1;
            *before * more / count[side] > (*before - 1) * more / count[side]
        };
        sides[side].iter().map(&mut mark).collect()
    })
}

/// For every measured return what the measured side has more of a value in its patch, in the middle of the patch's
/// returns; 0 where either side has too few.
fn of_patches(
    pair: &FramePair,
    value: impl Fn(&Ray) -> Option<f64>,
    middle: impl Fn(Vec<f64>) -> f64,
) -> Vec<Option<f32>> {
    let mut values: BTreeMap<DirectionCell, [Vec<f64>; 2]> = BTreeMap::new();
    for (side, rays) in [&pair.measured, &pair.simulated].into_iter().enumerate() {
        for ray in rays {
            values.entry(patch(ray)).or_default()[side].extend(value(ray));
        }
    }
    let enough = values.into_iter().filter(|(_, sides)| sides.iter().all(|side| side.len() >= FEWEST));
    let differences: BTreeMap<DirectionCell, f64> =
        enough.map(|(patch, [measured, simulated])| (patch, middle(measured) - middle(simulated))).collect();
    pair.measured.iter().map(|ray| Some(differences.get(&patch(ray)).map_or(0.0, |d| *d as f32))).collect()
}

/// Standard deviation of noise with these absolute values, m.
fn scatter_m(values: Vec<f64>) -> f64 {
    median(values) / MEDIAN_OF_NORMAL
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;

    /// Returns of a wall at 10 m, 400 in a patch of directions and 400 in the next one.
    fn wall() -> Vec<Ray> {
        let at = |k: usize| {
            let (azimuth, elevation) = (0.0002 + 0.0005 * (k % 400) as f64, if k < 400 { 0.01 } else { 0.09 });
            Ray::standing(&(10.0 * Vector3::new(azimuth.cos(), azimuth.sin(), elevation)))
        };
        (0..800).map(at).collect()
    }

    fn with(change: impl Fn(usize, &mut Ray)) -> Vec<Ray> {
        let mut rays = wall();
        rays.iter_mut().enumerate().for_each(|(k, ray)| change(k, ray));
        rays
    }

    fn state(measured: Vec<Ray>, simulated: Vec<Ray>, discrepancy: Discrepancy) -> ViewState {
        ViewState::of(&FramePair::of_rays("0".into(), measured, simulated), &[Point3::origin()], discrepancy)
    }

    fn close(a: f32, b: f32) -> bool {
        (a - b).abs() < 1e-5
    }

    #[test]
    fn what_is_on_a_surface_is_zero_and_an_offset_has_its_sign_and_size() {
        let nearer = |k: usize, ray: &mut Ray| match k {
            10 => ray.residual_m = -0.1,
            20 => ray.residual_m = 0.2,
            // Of an edge nothing is predicted but its two surfaces.
            30 => (ray.smooth, ray.near_far_m) = (false, [9.0, 12.0]),
            40 => (ray.smooth, ray.near_far_m) = (false, [ray.range_m + 0.1, 12.0]),
            _ => {}
        };
        let state = state(with(nearer), wall(), Discrepancy::Range);
        assert!(state.lost_m.is_empty());
        for (k, value) in state.values.iter().enumerate() {
            let expected = [(10, -0.1), (20, 0.2), (40, -0.1)].iter().find(|e| e.0 == k).map_or(0.0, |e| e.1);
            assert!(close(value.unwrap(), expected), "{k} {value:?}");
        }
    }

    #[test]
    fn a_lost_return_is_listed_where_it_lies() {
        let simulated = with(|k, ray| ray.matched = k != 5);
        let state = state(wall(), simulated.clone(), Discrepancy::Range);
        assert_eq!(state.lost_m, [place_m(&simulated[5], &[Point3::origin()])]);
        assert!(state.values.iter().all(|value| *value == Some(0.0)));
    }

    #[test]
    fn of_random_losses_that_either_side_has_only_the_surplus_is_shown() {
        // A quarter of the returns of the one patch, and a tenth of the other side's there.
        let quarter = || with(|k, ray| ray.matched = k >= 400 || k % 4 != 0);
        let tenth = || with(|k, ray| ray.matched = k >= 400 || k % 10 != 1);
        let missing = |state: &ViewState| state.values.iter().filter(|value| value.is_none()).count();
        let lacks = state(tenth(), quarter(), Discrepancy::Range);
        assert_eq!((lacks.lost_m.len(), missing(&lacks)), (60, 0));
        let exceeds = state(quarter(), tenth(), Discrepancy::Range);
        assert_eq!((exceeds.lost_m.len(), missing(&exceeds)), (0, 60));
        // Spread over all of them.
        let at: Vec<usize> = (0..800).filter(|k| exceeds.values[*k].is_none()).collect();
        assert!(at.iter().all(|k| *k < 400 && k % 4 == 0) && at.windows(2).all(|w| w[1] - w[0] <= 8), "{at:?}");
        let [off, on] = [lacks, state(quarter(), quarter(), Discrepancy::Range)];
        assert_eq!((on.lost_m.len(), missing(&on)), (0, 0));
        assert_ne!(off, on);
    }

    #[test]
    fn returns_in_the_air_are_shown_where_the_simulation_has_fewer() {
        let raining = || with(|k, ray| ray.residual_m = if k % 8 == 0 && k < 400 { -4.0 } else { 0.0 });
        let shown = |simulated| {
            let values = state(raining(), simulated, Discrepancy::Range).values;
            values.iter().filter(|value| value.is_some_and(|v| close(v, -4.0))).count()
        };
        assert_eq!((shown(wall()), shown(raining())), (50, 0));
    }

    #[test]
    fn scatter_and_intensity_are_those_of_the_patch() {
        let rough = |scatter: f32| {
            with(move |k, ray| {
                ray.roughness_m = if k < 400 { scatter } else { 0.01 } * if k % 2 == 0 { 1.0 } else { -1.0 };
                ray.roughness_leverage = 0.0;
            })
        };
        let values = state(rough(0.03), rough(0.01), Discrepancy::Scatter).values;
        let expected = 0.02 / MEDIAN_OF_NORMAL as f32;
        assert!(values[..400].iter().all(|v| close(v.unwrap(), expected)), "{:?}", values[0]);
        assert!(values[400..].iter().all(|v| *v == Some(0.0)), "{:?}", values[400]);
        let bright = |factor: f32| with(move |_, ray| (ray.intensity, ray.intensity_simulated) = (factor * 20.0, 20.0));
        let values = state(bright(1.5), bright(1.0), Discrepancy::Intensity).values;
        assert!(values.iter().all(|v| close(v.unwrap(), 1.5f32.ln())), "{:?}", values[0]);
        // Too few to be compared.
        let few = bright(1.5)[..FEWEST - 1].to_vec();
        assert!(state(few, bright(1.0), Discrepancy::Intensity).values.iter().all(|v| *v == Some(0.0)));
    }

    #[test]
    fn both_states_keep_the_same_share_of_their_returns() {
        let of = |lost: usize| ViewState {
            values: (0..2 * MOST_POINTS).map(|k| Some(k as f32)).collect(),
            lost_m: (0..lost).map(|k| [k as f32; 3]).collect(),
        };
        let [off, on] = thinned([of(4 * MOST_LOST), of(400)]);
        assert_eq!((off.lost_m.len(), on.lost_m.len()), (MOST_LOST, 100));
        assert_eq!((off.lost_m[3], on.lost_m[3]), ([12.0; 3], [12.0; 3]));
        assert_eq!((off.values.len(), off.values[7]), (MOST_POINTS, Some(14.0)));
        // Few are all kept.
        assert_eq!(thinned([of(300), of(400)]).map(|state| state.lost_m.len()), [300, 400]);
    }
}
