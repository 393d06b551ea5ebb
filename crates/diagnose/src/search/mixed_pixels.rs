//! Ranges between the two surfaces of an edge: beams have a width, and the light of both surfaces comes back in one
//! pulse. Edges with jumps that are shorter than the pulse then have returns between their levels, as many for each
//! edge as beams are wide, and those with longer jumps have none.

use super::{ChannelResult, Context, Found, Z_STAR, first_demands};
use crate::catalogue::sizes::BEAM_RAD;
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::mean::noise_m;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Parameter, Status};
use crate::inference::bisect;
use crate::inference::choice::{Demands, Trial, directions_agree};
use crate::inference::counts::{factor_of_counts, likelihood_of_counts};
use crate::inference::linear::cross_validated;
use crate::inference::roles::Role;
use crate::pairing::{JUMPS, Jumps, LEVEL, OCTANTS, RowEdges, jump_m};
use rayon::prelude::*;
use statistics::{blocks_of, deviation, draw_blocks};

/// Largest width of a beam, rad.
const WIDEST_RAD: f64 = 0.05;

/// Edges that the rate of all jumps stands for in that of each size.
const SMOOTHING: f64 = 50.0;

/// Standard deviations of the difference of two ranges within which a return is at the level of its side.
const NOISE: f64 = 3.0;

/// Factor by which the true width of a beam may differ from that of one that mixes as many ranges: how its light is
/// spread, and how bright the two surfaces are, is not known.
const OF_BEAM: f64 = 2.5;

/// Parts of a bin of jumps in which a pulse may end.
const PARTS: usize = 3;

/// Factors of a frame on what a width mixes: sixths of a gamma distribution of mean 1 and shape 2. In each scene edges
/// are met at other angles, and between surfaces of other brightness.
const OF_FRAME: [f64; 6] = [0.23, 0.48, 0.72, 0.98, 1.35, 2.14];

/// Bootstrap repetitions for intervals.
const REPETITIONS: usize = 40;

/// Both sides of a frame.
type Sides = [RowEdges; 2];

/// Edges by jump.
type Counts = [Jumps; JUMPS];

fn sum<'a>(all: impl Iterator<Item = &'a Counts>) -> Counts {
    all.fold(Counts::default(), |mut sum, counts| {
        sum.iter_mut().zip(counts).for_each(|(s, c)| s.merge(c));
        sum
    })
}

/// Sums over octants of both sides.
fn both(frame: &Sides) -> [Counts; 2] {
    [0, 1].map(|side| sum(frame[side].iter()))
}

/// Returns between the levels for each edge, by jump.
fn rates(counts: &Counts) -> [f64; JUMPS] {
    let [edges, between] = counts.iter().fold([0.0; 2], |s, j| [s[0] + j.edges, s[1] + j.between]);
    let rate = (between + 0.5) / edges.max(1.0);
    counts.map(|j| (j.between + SMOOTHING * rate) / (j.edges + SMOOTHING))
}

/// Rates of the simulated side, and beams with a width on top of them; beside rates that both sides have. Both sides
/// see the same surfaces: those that are seen at an angle have returns between their levels as well, and rates have a
/// factor for each frame.
#[derive(Clone, Copy, Debug)]
struct Law {
    /// Returns between the levels for each edge, by jump.
    base: [f64; JUMPS],
    /// The same of both sides together.
    common: [f64; JUMPS],
    width_rad: f64,
    /// Jumps that are compared.
    from: usize,
    /// The jump that is as long as the pulse, in bins: of the bin in which it lies this part mixes.
    end: f64,
}

impl Law {
    /// Fitted to some frames, to jumps of the bin `from` on.
    fn of(frames: &[&Sides], from: usize) -> Law {
        let frames: Vec<[Counts; 2]> = frames.iter().map(|frame| both(frame)).collect();
        let [measured, simulated] = [0, 1].map(|side| sum(frames.iter().map(|f| &f[side])));
        let all = sum([&measured, &simulated].into_iter());
        let none = Law { base: rates(&simulated), common: rates(&all), width_rad: 0.0, from, end: from as f64 };
        let ends = 1..=PARTS * JUMPS.saturating_sub(from);
        let laws = ends.map(|parts| none.up_to(from as f64 + parts as f64 / PARTS as f64, &frames));
        let gain = |law: &Law| frames.iter().map(|frame| law.gain(frame)).sum::<f64>();
        let by_gain = laws.map(|law| (gain(&law), law));
        by_gain.max_by(|a, b| a.0.total_cmp(&b.0)).map_or(none, |(_, law)| law)
    }

    /// With jumps that mix up to one, and the width that is likeliest.
    fn up_to(self, end: f64, frames: &[[Counts; 2]]) -> Law {
        let law = Law { end, ..self };
        let slope = |width_rad: f64| frames.iter().map(|frame| law.wide(width_rad).slope(frame)).sum::<f64>();
        law.wide(bisect([0.0, WIDEST_RAD], 20, |width_rad| slope(width_rad) > 0.0))
    }

    fn wide(mut self, width_rad: f64) -> Law {
        self.width_rad = width_rad;
        self
    }

    /// Derivative of the logarithm of the likelihood of a frame by the width, with the factor of the frame that is
    /// likeliest.
    fn slope(&self, frame: &[Counts; 2]) -> f64 {
        let [base, mixed] = [self.of_surfaces(&frame[0], &self.base), self.mixed(&frame[0])];
        let simulated = self.of_surfaces(&frame[1], &self.base);
        let [counts, of_simulated] = frame.each_ref().map(|side| self.between(side));
        let factor = factor_of_counts([&counts, &of_simulated], [&base, &simulated], &mixed);
        let of_bin = |(k, per_rad): (usize, f64)| per_rad * (counts[k] / (factor * base[k] + mixed[k]) - 1.0);
        self.per_rad(&frame[0]).into_iter().enumerate().filter(|(_, per_rad)| *per_rad > 0.0).map(of_bin).sum()
    }

    /// Returns between the levels, of the bins that are compared.
    fn between(&self, side: &Counts) -> Vec<f64> {
        side[self.from..].iter().map(|jumps| jumps.between).collect()
    }

    /// Returns between the levels that rates make of edges.
    fn of_surfaces(&self, side: &Counts, rates: &[f64; JUMPS]) -> Vec<f64> {
        (self.from..JUMPS).map(|bin| rates[bin] * side[bin].edges).collect()
    }

    /// Returns between the levels that jumps up to the length of the pulse make for each radian of the width.
    fn per_rad(&self, side: &Counts) -> Vec<f64> {
        (self.from..JUMPS).map(|bin| (self.end - bin as f64).clamp(0.0, 1.0) * side[bin].per_rad).collect()
    }

    /// Returns between the levels that the width makes.
    fn mixed(&self, side: &Counts) -> Vec<f64> {
        self.per_rad(side).iter().map(|per_rad| self.width_rad * per_rad).collect()
    }

    /// Returns between the levels of some edges.
    fn expected(&self, side: &Counts) -> Vec<f64> {
        self.of_surfaces(side, &self.base).iter().zip(self.mixed(side)).map(|(base, mixed)| base + mixed).collect()
    }

    /// Gain of the counts of both sides over rates that both have, nats (Poisson).
    fn gain(&self, sides: &[Counts; 2]) -> f64 {
        let [measured, simulated] = sides.each_ref().map(|side| self.between(side));
        let mixed = self.mixed(&sides[0]);
        let [base, common] =
            [&self.base, &self.common].map(|rates| sides.each_ref().map(|side| self.of_surfaces(side, rates)));
        let likelihood = |[of_measured, of_simulated]: &[Vec<f64>; 2], factor: f64| {
            let more: Vec<f64> = mixed.iter().map(|mixed| factor * mixed).collect();
            likelihood_of_counts([&measured, &simulated], [of_measured, of_simulated], &more)
        };
        let of_factors = OF_FRAME.map(|factor| likelihood(&base, factor));
        let most = of_factors.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mean = of_factors.iter().map(|l| (l - most).exp()).sum::<f64>() / OF_FRAME.len() as f64;
        most + mean.ln() - likelihood(&common, 0.0)
    }

    /// What counts are expected to gain of edges as many as there are.
    fn expected_gain(&self, sides: &[Counts; 2]) -> f64 {
        let mut all = *sides;
        let expected = [self.expected(&sides[0]), self.of_surfaces(&sides[1], &self.base)];
        for (side, expected) in all.iter_mut().zip(expected) {
            side[self.from..].iter_mut().zip(expected).for_each(|(jumps, between)| jumps.between = between);
        }
        self.gain(&all)
    }

    fn gain_of(&self, frame: &Sides) -> f64 {
        self.gain(&both(frame))
    }

    /// Whether edges in all directions say so, on some frames.
    fn directions_agree(&self, frames: &[&Sides]) -> bool {
        let octants = (0..OCTANTS).map(|k| [0, 1].map(|side| sum(frames.iter().map(|f| &f[side][k]))));
        let (gains, expected): (Vec<f64>, Vec<f64>) = octants.map(|o| (self.gain(&o), self.expected_gain(&o))).unzip();
        directions_agree(&gains, &expected)
    }
}

/// The first bin of jumps whose levels are farther apart than noise of the measured side carries a range.
fn first_bin(context: &Context) -> usize {
    let own_m = noise_m(context.frames.iter().flat_map(|f| &f.measured));
    (0..JUMPS).find(|&bin| LEVEL * jump_m(bin as f64) > NOISE * std::f64::consts::SQRT_2 * own_m).unwrap_or(JUMPS)
}

/// Edges of both sides of some frames.
fn sides<'a>(context: &'a Context, frames: &[usize]) -> Vec<&'a Sides> {
    frames.iter().map(|&i| &context.frames[i].edges).collect()
}

/// The search. Nothing is found without known rows.
pub fn search(context: &Context) -> ChannelResult {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(Channel::Returns, hold_out.len());
    let [on_select, on_estimate] = [&select, &estimate].map(|frames| sides(context, frames));
    if on_select.iter().all(|frame| frame[0].iter().flatten().all(|jumps| jumps.edges == 0.0)) {
        return result;
    }
    let from = first_bin(context);
    let fit = |train: &[usize]| Law::of(&train.iter().map(|&i| on_select[i]).collect::<Vec<_>>(), from);
    let blocks = context.blocks(&select);
    let of_frame = |law: &Law, i: usize| {
        let counts = both(on_select[i]);
        (law.gain(&counts), law.expected_gain(&counts))
    };
    let (gains, expected) = cross_validated(&blocks, fit, of_frame).into_iter().unzip();
    let trial = Trial { candidate: 0, cause: Cause::MixedPixels, parameters: 2, gains, expected, above_floor: true };
    let (nats, z) = trial.total_and_z();
    let [chosen, law] = [&on_select, &on_estimate].map(|frames| Law::of(frames, from));
    let draws = drawn(&on_estimate, &context.blocks(&estimate), from);
    let error = deviation(&draws.iter().map(|law| law.width_rad).collect::<Vec<f64>>());
    let demands = first_demands();
    let confirmed: f64 = on_estimate.iter().map(|frame| chosen.gain_of(frame)).sum();
    let outcome = if !trial.gains_enough(&Demands { of_few: true, ..demands }) {
        "no more of them than on the simulated side"
    } else if chosen.width_rad < BEAM_RAD || law.width_rad < BEAM_RAD.max(1.96 * error) {
        "too small to speak of"
    } else if !chosen.directions_agree(&on_select) {
        "edges in other directions do not say so"
    } else if confirmed <= demands.nats {
        "other frames do not confirm it"
    } else {
        "chosen"
    };
    result.consider(Cause::MixedPixels, (nats, z), context.returns(&select), outcome);
    result.minimum.push((Cause::MixedPixels, Minimum::new(Quantity::DivergenceRad, BEAM_RAD.max(Z_STAR * error))));
    if outcome == "chosen" {
        let gains: Vec<f64> = sides(context, &hold_out).iter().map(|frame| law.gain_of(frame)).collect();
        result.distance = gains.iter().map(|g| [g.max(0.0), *g, *g]).collect();
        let counts = sum(on_estimate.iter().flat_map(|frame| &frame[0]));
        result.found.push(found(&law, &draws, error, &counts, gains, z));
    }
    result
}

/// Gains of the `test` frames by the rates of the `train` frames, nats.
pub fn by_table(context: &Context, train: &[usize], test: &[usize]) -> Vec<f64> {
    let law = Law::of(&sides(context, train), first_bin(context));
    sides(context, test).iter().map(|frame| law.gain_of(frame)).collect()
}

/// The law of some frames, drawn anew by blocks.
fn drawn(frames: &[&Sides], blocks: &[usize], from: usize) -> Vec<Law> {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose mixed pixels", 0, 0);
    let draws: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let again = |drawn: &Vec<usize>| Law::of(&drawn.iter().map(|&i| frames[i]).collect::<Vec<_>>(), from);
    draws.par_iter().map(again).collect()
}

fn found(law: &Law, draws: &[Law], error: f64, counts: &Counts, held_out_gains: Vec<f64>, z: f64) -> Found {
    let width = Parameter {
        estimate: law.width_rad,
        unit: Quantity::DivergenceRad.unit(),
        ci95: [(law.width_rad - 1.96 * error).max(0.0) / OF_BEAM, (law.width_rad + 1.96 * error) * OF_BEAM],
    };
    // As good as a bin: where a jump ends up in it is not compared.
    let ends = || draws.iter().map(|law| law.end);
    let [first, last] = [ends().fold(law.end, f64::min), ends().fold(law.end, f64::max)];
    let pulse = Parameter {
        estimate: jump_m(law.end),
        unit: Quantity::PulseM.unit(),
        ci95: [jump_m(first - 1.0), jump_m(last + 1.0)],
    };
    let expected = law.expected(counts);
    let seen = (law.from..JUMPS).filter(|&i| counts[i].edges > 0.0);
    let points = seen.map(|i| (i, &counts[i])).map(|(i, jumps)| CurvePoint {
        sensor: 0,
        x: jump_m(i as f64),
        measured: jumps.between / jumps.edges,
        before: law.base[i],
        after: expected[i - law.from] / jumps.edges,
        error: jumps.between.max(1.0).sqrt() / jumps.edges,
    });
    Found {
        status: Status::Named,
        causes: vec![Cause::MixedPixels],
        parameters: vec![(Quantity::DivergenceRad.into(), width), (Quantity::PulseM.into(), pulse)],
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: Channel::Returns,
        covariate: Covariate::Edge,
        held_out_gains,
        says: format!(
            "returns lie between the two surfaces of edges with jumps of up to {:.1} m: beams have a width, about {:.1} \
             mrad, your simulator's are lines",
            jump_m(law.end),
            1e3 * law.width_rad
        ),
        separate_by: None,
        curve: Curve {
            x: "jump of the range at an edge, m".into(),
            y: "returns between the two surfaces for each edge".into(),
            by_sensor: false,
            points: points.collect(),
        },
        effects: vec![],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_distr::{Distribution, Poisson};

    const STEP_RAD: f64 = 4e-3;

    /// Frames with 40 edges of each jump and octant on both sides, 1 % of which have a return between their levels;
    /// on the measured side also those that beams of a width mix over jumps up to a length.
    fn frames(width_rad: f64, pulse_m: f64) -> Vec<Sides> {
        let mut rng = data::stream(5, "mixed pixels", 0, 0);
        let mut side = |width_rad: f64| -> RowEdges {
            let mut one = |bin: usize| {
                let edges = 40.0;
                let per_rad = edges * 0.55 / STEP_RAD;
                let mixed = if jump_m(bin as f64) < pulse_m { width_rad * per_rad } else { 0.0 };
                let between = Poisson::new(0.01 * edges + mixed).unwrap().sample(&mut rng);
                Jumps { edges, between, per_rad }
            };
            std::array::from_fn(|_| std::array::from_fn(&mut one))
        };
        (0..20).map(|_| [side(width_rad), side(0.0)]).collect()
    }

    #[test]
    fn the_width_of_a_beam_and_the_length_of_its_pulse_are_found() {
        let frames = frames(2e-3, 2.5);
        let law = Law::of(&frames.iter().collect::<Vec<_>>(), 0);
        assert!((law.width_rad / 2e-3 - 1.0).abs() < 0.05, "{law:?}");
        assert!(jump_m(law.end - 1.0) < 2.5 && jump_m(law.end) >= 2.5, "{law:?}");
        assert!(law.directions_agree(&frames.iter().collect::<Vec<_>>()));
    }

    #[test]
    fn what_both_sides_have_between_edges_is_no_width() {
        let frames = frames(0.0, 2.5);
        let law = Law::of(&frames[..10].iter().collect::<Vec<_>>(), 0);
        let others: f64 = frames[10..].iter().map(|f| law.gain_of(f)).sum();
        assert!(law.width_rad < BEAM_RAD && others < 3.0, "{others} {law:?}");
    }

    #[test]
    fn a_thing_in_one_direction_is_no_width() {
        let mut frames = frames(0.0, 2.5);
        frames.iter_mut().flat_map(|f| &mut f[0][3]).for_each(|jumps| jumps.between += 20.0);
        let all: Vec<&Sides> = frames.iter().collect();
        assert!(!Law::of(&all, 0).directions_agree(&all));
    }
}
