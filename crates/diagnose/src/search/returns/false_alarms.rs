//! Rate of false alarms, ranges at which nothing is, and the largest range at which they occur.

use super::weather::Air;
use crate::channels::free_path::scale;
use crate::channels::returns::{OWN_CAR_M, Odd, margin_m, odd};
use crate::pairing::{FramePair, Lies, Ray};
use crate::search::Context;

/// False alarms, uniform over range.
#[derive(Clone, Copy)]
pub(super) struct FalseAlarms {
    /// False alarms for each shot.
    pub(super) rate: f64,
    /// Farthest range, m.
    pub(super) reach_m: f64,
    /// Whether they take the place of nearer true returns as well.
    pub(super) instead: bool,
}

/// Lone returns, and the lengths of ray on which they could be seen, between the ego vehicle and a range.
#[derive(Clone, Copy, Default)]
struct Seen {
    /// Excess over the simulated side: in front of surfaces and in the open, and behind surfaces.
    returns: [f64; 2],
    /// Lengths of the rays on which they would be lone, m.
    lengths_m: [f64; 2],
    /// Whether ghosts explain what lies behind surfaces.
    ghosts: bool,
    /// Share of the receiver in those in front of surfaces; the others are droplets.
    of_receiver: f64,
}

impl Seen {
    /// False alarms for each metre in front of surfaces and behind them.
    fn rates(&self) -> [f64; 2] {
        [0, 1].map(|k| self.false_alarms(k) / self.lengths_m[k].max(1.0))
    }

    /// Returns of the receiver, in front of surfaces or behind them.
    fn false_alarms(&self, place: usize) -> f64 {
        self.returns[place] * [self.of_receiver, 1.0][place]
    }

    /// Whether there are about as many behind surfaces as in front of them.
    fn behind_as_well(&self) -> bool {
        let [front, behind] = self.rates();
        !self.ghosts && behind > 0.5 * front
    }

    /// False alarms for each metre of ray. Sensors whose false alarms replace the true return show them behind
    /// surfaces as well; others only in front of them.
    fn per_metre(&self) -> f64 {
        let [front, _] = self.rates();
        if self.behind_as_well() {
            (self.false_alarms(0) + self.false_alarms(1)) / (self.lengths_m[0] + self.lengths_m[1]).max(1.0)
        } else {
            front
        }
    }
}

/// False alarms of the measured side beyond those of the simulated one; simulated frames end at `end_m`. Where there
/// are ghosts, what lies behind surfaces does not count. What is in front of them is the receiver's by `air`.
pub(super) fn false_alarms(context: &Context, frames: &[usize], end_m: f64, ghosts: bool, air: &Air) -> FalseAlarms {
    let frames: Vec<&FramePair> = frames.iter().map(|&f| &context.frames[f]).collect();
    let of_receiver = air.of_receiver().unwrap_or(1.0);
    let mut reach_m = air.reach_m().unwrap_or_else(|| reach_m(&frames, ghosts)).max(OWN_CAR_M + 1.0);
    let seen = |between| Seen { ghosts, of_receiver, ..seen(&frames, between) };
    let within = seen([OWN_CAR_M, end_m.min(reach_m)]);
    if reach_m > end_m {
        // A much higher rate beyond the end of the simulation is due to real returns: the reach is then not known.
        let beyond = seen([end_m, reach_m]);
        if beyond.per_metre() > 2.0 * within.per_metre() {
            reach_m = end_m;
        }
    }
    let rate = (within.per_metre() * reach_m).clamp(0.0, 1.0);
    FalseAlarms { rate, reach_m, instead: within.behind_as_well() }
}

/// Largest range of false alarms, m: the 99 % quantile of the excess of lone returns, over 0.99.
fn reach_m(frames: &[&FramePair], ghosts: bool) -> f64 {
    let mut ranges: Vec<(f64, f64)> = Vec::new();
    for frame in frames {
        let alone = |r: &&Ray| odd(r) == Some(Odd::Alone) && !(ghosts && r.lies() == Lies::Behind);
        ranges.extend(frame.measured.iter().filter(alone).map(|r| (r.own_range_m(), 1.0)));
        ranges.extend(frame.simulated.iter().filter(alone).map(|r| (r.own_range_m(), -scale(frame))));
    }
    ranges.sort_by(|a, b| a.0.total_cmp(&b.0));
    let all: f64 = ranges.iter().map(|r| r.1).sum();
    let mut nearer = 0.0;
    let at = ranges.iter().find(|r| {
        nearer += r.1;
        nearer >= 0.99 * all
    });
    at.map_or(0.0, |r| r.0 / 0.99)
}

/// Lone returns between two ranges.
fn seen(frames: &[&FramePair], [from, to]: [f64; 2]) -> Seen {
    let mut seen = Seen::default();
    for frame in frames {
        for (rays, weight) in [(&frame.measured, 1.0), (&frame.simulated, -scale(frame))] {
            let inside = |r: &&Ray| odd(r) == Some(Odd::Alone) && (from..to).contains(&r.own_range_m());
            for ray in rays.iter().filter(inside) {
                seen.returns[usize::from(ray.lies() == Lies::Behind)] += weight;
            }
        }
        // Shots without a return show the whole interval. At edges no return is lone.
        seen.lengths_m[0] += frame.open * (to - from).max(0.0);
        for ray in frame.simulated.iter().filter(|r| r.smooth) {
            let (range, margin) = (ray.own_range_m(), margin_m(ray));
            seen.lengths_m[0] += (to.min(range - margin) - from).max(0.0);
            seen.lengths_m[1] += (to - from.max(range + margin)).max(0.0);
        }
    }
    seen.returns.iter_mut().for_each(|n| *n = n.max(0.0));
    seen
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn false_alarms_before_surfaces_are_related_to_the_length_before_them() {
        // 1000 m of ray before surfaces and 2000 m behind them, one false alarm in 100 m.
        let lengths_m = [1000.0, 2000.0];
        let all = Seen { lengths_m, of_receiver: 1.0, ..Seen::default() };
        let before = Seen { returns: [10.0, 0.0], ..all };
        let instead = Seen { returns: [10.0, 20.0], ..all };
        assert!((before.per_metre() - 0.01).abs() < 1e-12 && (instead.per_metre() - 0.01).abs() < 1e-12);
        let ghosts = Seen { returns: [10.0, 500.0], ghosts: true, ..all };
        assert!((ghosts.per_metre() - 0.01).abs() < 1e-12);
        // Three quarters of those before surfaces are droplets.
        let droplets = Seen { returns: [40.0, 20.0], of_receiver: 0.25, ..all };
        assert!((droplets.per_metre() - 0.01).abs() < 1e-12);
        assert_eq!(Seen::default().per_metre(), 0.0);
    }
}
