//! Spray or dust behind vehicles: returns in the air behind them, and not in that before them.

use super::{Z_BY_SIGNS, poisson_distance};
use crate::catalogue::sizes::SPRAY_SHARE;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::plumes::{Droplet, Extent, Plume, PlumeFrame};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Status};
use crate::effects::rounded;
use crate::inference::bisect;
use crate::inference::choice::{significant, significant_by_signs, total_and_z};
use crate::inference::counts::gain_of_count;
use crate::inference::linear::cross_validated;
use crate::search::{ChannelResult, Found, Z_STAR, first_demands, parameter};
use sensor::Effect;

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
    let floor_per_m = SPRAY_SHARE * frames.returns / select.iter().map(|f| f.path_m(0)).sum::<f64>().max(1.0);
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
        let spray = found(&estimate, frames.within, on_estimate.base, held, z);
        let on_free_paths = spray.parameter(Quantity::DensityPerM).is_some_and(|d| d.estimate >= floor_per_m);
        if on_free_paths { (Some(spray), "chosen") } else { (None, "too few on free paths behind vehicles") }
    };
    result.consider(Cause::Spray, (total, z), frames.returns, outcome);
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
    base_per_m: f64,
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
    let plumes: Vec<&Plume> = plumes.iter().flat_map(|f| &f.plumes).collect();
    let Fitted { per_m, at_speed_m_s } = fitted(&plumes, base_per_m);
    let error = per_m * (1.0 / (droplets.len() as f64).max(1.0).sqrt()).hypot(OF_FORM);
    let spray = sensor::effects::Spray {
        density_per_m: rounded(per_m, 5),
        at_speed_m_s: rounded(at_speed_m_s, 2),
        length_m: rounded(length_m.max(1.0), 2),
        height_m: rounded(height_m.max(0.5), 2),
    };
    let by_speed = if at_speed_m_s > 0.0 {
        format!("; the density is that at {at_speed_m_s:.0} m/s and grows with the square of the speed")
    } else {
        String::new()
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
             {height_m:.1} m high; the air before them does not: spray or dust that your simulator does not have\
             {by_speed}"
        ),
        separate_by: None,
        curve: curve(&droplets, plumes.iter().map(|p| p.path_m()).sum()),
        effects: vec![Effect::Spray(spray)],
    }
}

/// Speed from which on a vehicle moves, m/s: that of a walk.
const MOVING_M_S: f64 = 1.0;

/// Density of plumes.
struct Fitted {
    /// Mean over the paths, behind moving vehicles where speeds are known, 1/m.
    per_m: f64,
    /// Speed at which it is that, m/s, where it grows with the square of the speed; 0 where all plumes are alike.
    at_speed_m_s: f64,
}

/// The density of plumes: the same behind all vehicles, or with the square of their speed where that is more likely by
/// what a further parameter has to gain. `base_per_m` is there without spray.
fn fitted(plumes: &[&Plume], base_per_m: f64) -> Fitted {
    // The density that fits where each plume has so many times of it, and how likely the droplets are.
    let with = |plumes: &[&Plume], times: &[f64]| {
        let per_m = density(plumes, times);
        let of_plume = |(p, times): (&&Plume, &f64)| {
            let expected = p.expected(per_m * times) + base_per_m * p.path_m() + 1e-6;
            p.droplets * expected.ln() - expected
        };
        (per_m, plumes.iter().zip(times).map(of_plume).sum::<f64>())
    };
    let alike = |plumes: &[&Plume]| with(plumes, &vec![1.0; plumes.len()]);
    let (known, squares): (Vec<&Plume>, Vec<f64>) =
        plumes.iter().filter_map(|p| Some((*p, p.speed_m_s?.powi(2)))).unzip();
    let moving = known.iter().zip(&squares).filter(|(_, square)| **square > MOVING_M_S * MOVING_M_S);
    let [path, weighed] = moving.fold([0.0; 2], |sum, (p, s)| [sum[0] + p.path_m(), sum[1] + s * p.path_m()]);
    if path > 0.0 {
        let square = weighed / path;
        let times: Vec<f64> = squares.iter().map(|s| s / square).collect();
        let (per_m, nats) = with(&known, &times);
        if nats > alike(&known).1 + first_demands().nats {
            return Fitted { per_m, at_speed_m_s: square.sqrt() };
        }
    }
    Fitted { per_m: alike(plumes).0, at_speed_m_s: 0.0 }
}

impl Plume {
    /// Metres of all paths.
    fn path_m(&self) -> f64 {
        self.paths_m.iter().map(|[counted, _]| f64::from(*counted)).sum()
    }

    /// Expected droplets at a density, 1/m: a shot returns from one droplet of its whole path.
    fn expected(&self, per_m: f64) -> f64 {
        let of_path = |path: &[f32; 2]| {
            let [counted, whole] = path.map(f64::from);
            (1.0 - (-per_m * whole).exp()) * counted / whole.max(1e-6)
        };
        self.paths_m.iter().map(of_path).sum()
    }
}

/// Density with which plumes have as many droplets as they have, 1/m; that of each is so many times as high.
fn density(plumes: &[&Plume], times: &[f64]) -> f64 {
    let number: f64 = plumes.iter().map(|p| p.droplets).sum();
    let expected = |per_m: f64| plumes.iter().zip(times).map(|(p, times)| p.expected(per_m * times)).sum::<f64>();
    bisect([0.0, 10.0], 60, |per_m| expected(per_m) < number)
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
            plumes: vec![Plume { speed_m_s: None, paths_m: vec![[4.0; 2]; 200], droplets: (behind + i % 2) as f64 }],
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

    #[test]
    fn plumes_that_grow_with_the_square_of_the_speed_are_distinguished_from_plumes_that_are_alike() {
        let plumes = |times: fn(f64) -> f64| {
            let of_speed = |speed: f64| {
                let plume = Plume { speed_m_s: Some(speed), paths_m: vec![[3.0, 5.0]; 400], droplets: 0.0 };
                Plume { droplets: plume.expected(0.05 * times(speed)).round(), ..plume }
            };
            [0.0, 0.0, 4.0, 8.0, 12.0].map(of_speed)
        };
        let growing = plumes(|speed| (speed / 8.0).powi(2));
        let Fitted { per_m, at_speed_m_s } = fitted(&growing.each_ref(), 1e-5);
        let mean: f64 = [16.0, 64.0, 144.0].iter().sum::<f64>() / 3.0;
        assert!((at_speed_m_s - mean.sqrt()).abs() < 1e-6);
        assert!((per_m / (0.05 * mean / 64.0) - 1.0).abs() < 0.02, "{per_m}");
        let alike = plumes(|_| 1.0);
        let Fitted { per_m, at_speed_m_s } = fitted(&alike.each_ref(), 1e-5);
        assert!(at_speed_m_s == 0.0 && (per_m / 0.05 - 1.0).abs() < 0.02, "{per_m}");
    }
}
