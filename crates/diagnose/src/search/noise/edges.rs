//! Whether directions scatter or ranges do, by the edges.

use super::Search;
use crate::catalogue::Cause;
use crate::channels::edges::{Edges, edges, steps_rad};
use crate::diagnosis::Considered;
use crate::inference::roles::Role;
use crate::search::{ChannelResult, Z_STAR};
use rayon::prelude::*;

/// Noise that grows as the tangent of the incidence comes from beams that go elsewhere, or from those that are wide.
const BOTH: [Cause; 2] = [Cause::AngularJitter, Cause::IncidenceNoise];

impl Search<'_> {
    /// What noise by incidence, of directions with this standard deviation (rad), comes from: jitter makes edges
    /// ragged, wide beams do not. Both where the edges do not tell.
    pub(super) fn name_of_angular(&self, std_rad: f64) -> &'static [Cause] {
        if !self.same_edges {
            return &BOTH;
        }
        let frames = || (0..self.context.frames.len()).filter(|&i| self.context.roles[i].0 != Role::HoldOut);
        let Some(first) = frames().next() else { return &BOTH };
        let steps = steps_rad(&self.context.frames[first].simulated, self.context.rig.sensors.len());
        let of_frame = |i: usize| {
            let frame = &self.context.frames[i];
            [edges(&frame.measured, &steps, None), edges(&frame.simulated, &steps, Some(std_rad))]
        };
        let of_frames: Vec<[Edges; 2]> = frames().collect::<Vec<_>>().into_par_iter().map(of_frame).collect();
        let [measured, simulated] = [0, 1].map(|side| share(&of_frames, side));
        let (more, error) = (measured[0] - simulated[0], measured[1].hypot(simulated[1]));
        let sum = |number: fn(&Edges) -> f64| of_frames.iter().map(|f| number(&f[1])).sum::<f64>();
        let expected = sum(|e| e.by_jitter) / sum(|e| e.all);
        name_by(more, error, expected)
    }
}

/// Lists noise by the tangent of the incidence under both causes: it is looked for once.
pub(super) fn consider_both(result: &mut ChannelResult) {
    let [jitter, wide] = BOTH.map(|cause| result.found.iter().any(|f| f.causes.contains(&cause)));
    let mut again = Vec::new();
    for of_jitter in result.considered.iter_mut().filter(|c| c.cause.cause == Cause::AngularJitter) {
        let mut of_wide = Considered { cause: Cause::IncidenceNoise.into(), ..of_jitter.clone() };
        for (line, named) in [(of_jitter, jitter), (&mut of_wide, wide)] {
            if line.outcome == "chosen" && !named {
                line.outcome = "edges are as ragged as the other cause makes them".into();
            }
        }
        again.push(of_wide);
    }
    result.considered.extend(again);
}

/// Share of the expected edges that jitter makes ragged at least: how slanted edges are, and how the shots of rows lie
/// between each other, is not known exactly (0.4 to 3 of the expected ones in the tests of the edges).
const AT_LEAST: f64 = 0.3;

/// The cause by how many edges more are ragged, with the standard error, than there would be without jitter, and how
/// many are expected to be with it. A NaN tells nothing.
fn name_by(more: f64, error: f64, expected: f64) -> &'static [Cause] {
    let (by_chance, least) = (Z_STAR * error, AT_LEAST * expected);
    if more > by_chance && more > least / 2.0 {
        &BOTH[..1]
    } else if more < least - by_chance {
        &BOTH[1..]
    } else {
        &BOTH
    }
}

/// Share of ragged edges of one side with its standard error over frames; infinite without edges.
fn share(frames: &[[Edges; 2]], side: usize) -> [f64; 2] {
    let all: f64 = frames.iter().map(|f| f[side].all).sum();
    if all == 0.0 {
        return [0.0, f64::INFINITY];
    }
    let share = frames.iter().map(|f| f[side].ragged).sum::<f64>() / all;
    let off: f64 = frames.iter().map(|f| (f[side].ragged - share * f[side].all).powi(2)).sum();
    // At least that of independent edges.
    [share, (off.sqrt() / all).max((share.max(1.0 / all) / all).sqrt())]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_edges_tell_jitter_from_wide_beams_or_nothing() {
        assert_eq!(name_by(0.05, 0.004, 0.05), [Cause::AngularJitter]);
        assert_eq!(name_by(0.002, 0.003, 0.05), [Cause::IncidenceNoise]);
        for [more, error] in [[0.01, 0.004], [0.05, 0.04], [0.0, f64::INFINITY]] {
            assert_eq!(name_by(more, error, 0.05), BOTH, "{more} {error}");
        }
        assert_eq!(share(&[], 0), [0.0, f64::INFINITY]);
        assert_eq!(name_by(0.0, 0.01, f64::NAN), BOTH);
    }
}
