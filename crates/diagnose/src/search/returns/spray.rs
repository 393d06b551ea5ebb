//! Spray or dust behind vehicles: returns in the air behind them, and not in that before them.

use super::{Z_BY_SIGNS, poisson_distance};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::plumes::{Droplet, Extent, PlumeFrame};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Considered, Minimum, Status};
use crate::effects::rounded;
use crate::inference::choice::{significant, significant_by_signs, total_and_z};
use crate::inference::counts::gain_of_count;
use crate::inference::linear::cross_validated;
use crate::search::{ChannelResult, Found, Z_STAR, first_demands, parameter};
use sensor::Effect;

/// Smallest share of all returns that is reported: some droplets behind the nearest vehicle.
const FLOOR: f64 = 2e-4;

/// Ratio of the density behind vehicles to that before them from which on it is theirs: what is missing in the
/// simulation stands before vehicles as often as behind them.
const TIMES: f64 = 3.0;

/// Share of the droplets within the length and the height of a plume.
const WITHIN: f64 = 0.95;

/// Relative error of the density by its form: plumes become thinner with distance.
const OF_FORM: f64 = 0.15;

/// Frames of one role, with the blocks of the selecting ones.
pub(super) struct Frames<'a> {
    pub(super) plumes: &'a [PlumeFrame],
    /// The air of the estimating frames up to an extent.
    pub(super) within: &'a dyn Fn(Extent) -> Vec<PlumeFrame>,
    pub(super) select: &'a [usize],
    pub(super) blocks: &'a [usize],
    pub(super) estimate: &'a [usize],
    pub(super) hold_out: &'a [usize],
    /// Returns of the selecting frames.
    pub(super) returns: f64,
}

/// Density behind vehicles, and what is there without spray, for each metre of path.
#[derive(Clone, Copy)]
struct Density {
    behind: f64,
    base: f64,
}

impl Density {
    /// Over some frames. Without spray there are as many returns behind vehicles as before them, or as many as the
    /// simulation has there.
    fn of<'a>(frames: impl Iterator<Item = &'a PlumeFrame> + Clone) -> Density {
        let sum = |number: &dyn Fn(&PlumeFrame) -> f64| frames.clone().map(number).sum::<f64>();
        let path = [0, 1].map(|place| sum(&|f| f.path_m(place)).max(1.0));
        let behind = sum(&|f| f.measured[0].len() as f64) / path[0];
        let before = (sum(&|f| f.measured[1].len() as f64) + 0.5) / path[1];
        let simulated = (sum(&|f| f.simulated[0].len() as f64) + 0.5) / path[0];
        Density { behind, base: before.max(simulated) }
    }

    /// Kullback-Leibler distance of a frame's count from what is there without spray, and from that with it, nats.
    fn distance(&self, frame: &PlumeFrame) -> [f64; 2] {
        let path = frame.path_m(0);
        [self.base, self.behind.max(self.base)]
            .map(|rate| poisson_distance(frame.measured[0].len() as f64, rate * path))
    }

    fn gain(&self, frame: &PlumeFrame) -> f64 {
        let rate = self.behind.max(self.base);
        gain_of_count(frame.measured[0].len() as f64, frame.path_m(0), rate, self.base)
    }
}

/// Searches spray. What it explains, other searches leave out.
pub(super) fn search(frames: &Frames, result: &mut ChannelResult) -> bool {
    let of = |which: &[usize]| which.iter().map(|&i| &frames.plumes[i]).collect::<Vec<_>>();
    let select = of(frames.select);
    let fit = |train: &[usize]| Density::of(train.iter().map(|&i| select[i]));
    let gains = cross_validated(frames.blocks, fit, |density, i| density.gain(select[i]));
    let (total, z) = total_and_z(&gains);
    let differences: Vec<f64> =
        select.iter().map(|f| f.measured[0].len() as f64 - f.measured[1].len() as f64).collect();
    let density = Density::of(select.iter().copied());
    let seen = significant(&gains, Z_STAR) || significant_by_signs(&differences, Z_BY_SIGNS[0]);
    let floor_per_m = FLOOR * frames.returns / select.iter().map(|f| f.path_m(0)).sum::<f64>().max(1.0);
    let few = |density: &Density| density.behind < floor_per_m.max(TIMES * density.base);
    let (estimate, hold_out) = (of(frames.estimate), of(frames.hold_out));
    let on_estimate = Density::of(estimate.iter().copied());
    let (spray, outcome) = if total <= first_demands().nats || !seen {
        (None, "no more returns behind vehicles than before them")
    } else if few(&density) {
        (None, "too few to speak of")
    } else if few(&on_estimate) {
        (None, "not on other frames")
    } else {
        let held = hold_out.iter().map(|f| on_estimate.gain(f)).collect();
        let spray = found(&estimate, frames.within, held, z);
        let on_free_paths = spray.parameter(Quantity::DensityPerM).is_some_and(|d| d.estimate >= floor_per_m);
        if on_free_paths { (Some(spray), "chosen") } else { (None, "too few on free paths behind vehicles") }
    };
    result.considered.push(Considered {
        cause: Cause::Spray.into(),
        channel: Channel::Returns,
        nats_per_ray: total / frames.returns.max(1.0),
        z,
        outcome: outcome.into(),
    });
    if select.iter().any(|f| f.path_m(0) > 0.0) {
        let detectable = floor_per_m.max(TIMES * density.base);
        result.minimum.push((Cause::Spray, Minimum::new(Quantity::DensityPerM, detectable)));
    }
    let Some(spray) = spray else { return false };
    for (d, frame) in result.distance.iter_mut().zip(&hold_out) {
        let [before, after] = on_estimate.distance(frame);
        *d = [d[0] + before, d[1] + before - after, d[2] + before - after];
    }
    result.found.push(spray);
    true
}

/// Gains of the `test` frames by the density behind vehicles of the `train` frames over the simulated one, nats.
pub(super) fn by_table(plumes: &[PlumeFrame], train: &[usize], test: &[usize]) -> Vec<f64> {
    let sum = |number: &dyn Fn(&PlumeFrame) -> f64| train.iter().map(|&i| number(&plumes[i])).sum::<f64>();
    let path = sum(&|f| f.path_m(0)).max(1.0);
    let rate = (sum(&|f| f.measured[0].len() as f64) + 0.5) / path;
    let base = (sum(&|f| f.simulated[0].len() as f64) + 0.5) / path;
    let gain = |f: &PlumeFrame| gain_of_count(f.measured[0].len() as f64, f.path_m(0), rate, base);
    test.iter().map(|&i| gain(&plumes[i])).collect()
}

fn found(
    frames: &[&PlumeFrame],
    within: &dyn Fn(Extent) -> Vec<PlumeFrame>,
    held_out_gains: Vec<f64>,
    z: f64,
) -> Found {
    let droplets: Vec<Droplet> = frames.iter().flat_map(|f| &f.measured[0]).copied().collect();
    let quantile = |of: &dyn Fn(&Droplet) -> f64| {
        let mut values: Vec<f64> = droplets.iter().map(of).collect();
        values.sort_by(f64::total_cmp);
        values.get((WITHIN * values.len() as f64) as usize).copied().unwrap_or(0.0) / WITHIN
    };
    let (length_m, height_m) = (quantile(&|d| d.behind_m), quantile(&|d| d.over_ground_m));
    // Plumes of the simulator are as wide as the vehicle.
    let plumes = within(Extent { until_m: length_m, height_m, beside_m: 0.0 });
    let paths: Vec<f64> = plumes.iter().flat_map(|f| &f.paths_m[0]).copied().map(f64::from).collect();
    let inside = plumes.iter().flat_map(|f| &f.measured[0]).filter(|d| d.on_path).count();
    let per_m = density(&paths, inside as f64);
    let error = per_m * (1.0 / (droplets.len() as f64).max(1.0).sqrt()).hypot(OF_FORM);
    let spray = sensor::effects::Spray {
        density_per_m: rounded(per_m, 5),
        length_m: rounded(length_m.max(1.0), 2),
        height_m: rounded(height_m.max(0.5), 2),
    };
    Found {
        status: Status::Named,
        causes: vec![Cause::Spray],
        parameters: vec![
            parameter(Quantity::DensityPerM, per_m, error),
            parameter(Quantity::LengthM, length_m, 0.1 * length_m),
            parameter(Quantity::HeightM, height_m, 0.1 * height_m),
        ],
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: Channel::Returns,
        covariate: Covariate::Place,
        held_out_gains,
        says: format!(
            "behind vehicles the air returns light, {per_m:.3} droplets a metre up to {length_m:.0} m behind them and \
             {height_m:.1} m high; the air before them does not: spray or dust that your simulator does not have"
        ),
        separate_by: None,
        curve: curve(&droplets, paths.iter().sum()),
        effects: vec![Effect::Spray(spray)],
    }
}

/// Density with which so many of the paths have a droplet, 1/m: `sum(1 - exp(-density * path)) = number`.
fn density(paths_m: &[f64], number: f64) -> f64 {
    let (mut low, mut high) = (0.0, 10.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        let expected: f64 = paths_m.iter().map(|path| 1.0 - (-middle * path).exp()).sum();
        if expected < number { low = middle } else { high = middle }
    }
    0.5 * (low + high)
}

/// Droplets by distance behind the vehicle.
fn curve(droplets: &[Droplet], path_m: f64) -> Curve {
    let bin = |k: usize| droplets.iter().filter(|d| (d.behind_m - 1.5) as usize == k).count() as f64;
    let points = (0..12).map(|k| CurvePoint {
        sensor: 0,
        x: k as f64 + 2.0,
        measured: bin(k) / path_m.max(1.0),
        before: 0.0,
        after: bin(k) / path_m.max(1.0),
        error: bin(k).sqrt() / path_m.max(1.0),
    });
    let y = "droplets for each metre of path";
    Curve { x: "distance behind the vehicle, m".into(), y: y.into(), by_sensor: false, points: points.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Twelve frames with so many droplets behind and before a vehicle.
    fn searched(behind: usize, before: usize) -> (bool, ChannelResult) {
        let droplet = |k: usize| Droplet { on_path: true, behind_m: 1.5 + (k % 80) as f64 / 10.0, over_ground_m: 0.8 };
        let frame = |i: usize| PlumeFrame {
            measured: [(0..behind + i % 2).map(droplet).collect(), (0..before + i % 3).map(droplet).collect()],
            simulated: [vec![], vec![]],
            around: Default::default(),
            paths_m: [vec![4.0; 200], vec![4.0; 200]],
        };
        let plumes: Vec<PlumeFrame> = (0..12).map(frame).collect();
        let of = |from: usize| (from..from + 4).collect::<Vec<_>>();
        let (select, estimate, hold_out) = (of(0), of(4), of(8));
        let frames = Frames {
            plumes: &plumes,
            select: &select,
            blocks: &[0, 1, 2, 3],
            estimate: &estimate,
            hold_out: &hold_out,
            within: &|_| plumes[4..8].to_vec(),
            returns: 1e5,
        };
        let mut result = ChannelResult::new(Channel::Returns, 4);
        (search(&frames, &mut result), result)
    }

    #[test]
    fn returns_behind_vehicles_are_spray_unless_there_are_as_many_before_them() {
        let (found, result) = searched(80, 1);
        assert!(found, "{:?}", result.considered);
        let per_m = result.found[0].parameter(Quantity::DensityPerM).unwrap();
        // A share of 0.4 of the paths of 4 m has a droplet.
        let truth = -(1.0f64 - 80.5 / 200.0).ln() / 4.0;
        assert!((per_m.estimate / truth - 1.0).abs() < 0.02, "{per_m:?} {truth}");
        assert!(result.distance.iter().all(|d| d[1] > 10.0));
        assert!(!searched(80, 60).0 && !searched(1, 0).0);
    }
}
