//! How often a sensor reports a range at which nothing is, and how far such ranges reach.

use crate::channels::returns::{OWN_CAR_M, Odd, odd};
use crate::pairing::{FramePair, Lies, Ray, company_m};
use crate::search::Context;

/// Nearer to a surface than that a return lies on it, m: along the ray, or across the surface.
const ON_M: [f64; 2] = [0.6, 0.3];

/// False alarms, evenly over ranges.
pub(super) struct Alarms {
    /// Share of the shots.
    pub(super) rate: f64,
    /// Farthest range, m.
    pub(super) reach_m: f64,
}

/// Lone returns and where they could be seen, between the own car and a range.
#[derive(Default)]
struct Seen {
    /// In front of surfaces and in the open, and behind surfaces: more than the simulated side has.
    returns: [f64; 2],
    /// Lengths of the rays on which they would stand alone, m.
    lengths_m: [f64; 2],
}

impl Seen {
    /// Alarms a metre of ray. Those that replace what a shot meets are seen behind surfaces as well, those that only come before it are not.
    fn a_metre(&self) -> f64 {
        let [front, behind] = [0, 1].map(|k| self.returns[k] / self.lengths_m[k].max(1.0));
        if behind > 0.5 * front {
            (self.returns[0] + self.returns[1]) / (self.lengths_m[0] + self.lengths_m[1]).max(1.0)
        } else {
            front
        }
    }
}

/// The alarms of the measured side beyond those of the simulated one; simulated frames end at `end_m`.
pub(super) fn alarms(context: &Context, frames: &[usize], end_m: f64) -> Alarms {
    let frames: Vec<&FramePair> = frames.iter().map(|&f| &context.frames[f]).collect();
    let mut reach_m = reach_m(&frames).max(OWN_CAR_M + 1.0);
    let within = seen(&frames, [OWN_CAR_M, end_m.min(reach_m)]);
    if reach_m > end_m {
        // Far more of them beyond the end of the simulation are real returns, and nothing tells how far alarms reach.
        let beyond = seen(&frames, [end_m, reach_m]);
        if beyond.a_metre() > 2.0 * within.a_metre() {
            reach_m = end_m;
        }
    }
    Alarms { rate: (within.a_metre() * reach_m).clamp(0.0, 1.0), reach_m }
}

/// Measured returns for a simulated one.
fn scale(frame: &FramePair) -> f64 {
    frame.measured.len() as f64 / frame.simulated.len().max(1) as f64
}

/// Range below which 99 of 100 lone returns lie that the simulated side has not, over 0.99, m.
fn reach_m(frames: &[&FramePair]) -> f64 {
    let mut ranges: Vec<(f64, f64)> = Vec::new();
    for frame in frames {
        let alone = |r: &&Ray| odd(r) == Some(Odd::Alone);
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

/// What is seen between two ranges.
fn seen(frames: &[&FramePair], [from, to]: [f64; 2]) -> Seen {
    let mut seen = Seen::default();
    for frame in frames {
        for (rays, weight) in [(&frame.measured, 1.0), (&frame.simulated, -scale(frame))] {
            let inside = |r: &&Ray| odd(r) == Some(Odd::Alone) && (from..to).contains(&r.own_range_m());
            for ray in rays.iter().filter(inside) {
                seen.returns[usize::from(ray.lies() == Lies::Behind)] += weight;
            }
        }
        // Shots of which nothing comes back show all of it; at edges nothing stands alone.
        seen.lengths_m[0] += frame.open * (to - from).max(0.0);
        for ray in frame.simulated.iter().filter(|r| r.smooth) {
            let range = ray.own_range_m();
            let margin = (ON_M[1] / f64::from(ray.cos_incidence).max(1e-3)).max(ON_M[0]).max(company_m(range));
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
    fn alarms_that_only_come_before_surfaces_are_held_against_what_lies_before_them() {
        // A thousand metres of ray before surfaces and two thousand behind them, one alarm in a hundred metres.
        let before = Seen { returns: [10.0, 0.0], lengths_m: [1000.0, 2000.0] };
        let instead = Seen { returns: [10.0, 20.0], lengths_m: [1000.0, 2000.0] };
        assert!((before.a_metre() - 0.01).abs() < 1e-12 && (instead.a_metre() - 0.01).abs() < 1e-12);
        assert_eq!(Seen::default().a_metre(), 0.0);
    }
}
