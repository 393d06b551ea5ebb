//! Bright targets: halos of false returns at their range (blooming), and shots beside them that return nothing.

use super::hits::LOST_DISPLACED;
use super::{ChannelResult, Context, Found, Z_STAR, first_demands, parameter, with_error};
use crate::catalogue::sizes::BRIGHT_SHARE;
use crate::catalogue::{Cause, Channel, Covariate, Quantity, Unit};
use crate::channels::brightness::Brightness;
use crate::channels::halos::{
    Around, BINS, HaloFrame, Profile, Shared, UsualLosses, angle_rad, halo_frame, thresholds, total, without_halos,
};
use crate::channels::mean::origins;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Minimum, Status};
use crate::inference::bisect;
use crate::inference::choice::{significant, total_and_z};
use crate::inference::counts::gain_of_count;
use crate::inference::linear::cross_validated;
use crate::inference::roles::Role;
use crate::pairing::FramePair;
use rayon::prelude::*;
use statistics::{blocks_of, deviation, draw_blocks};

/// Bins beyond which nothing is left of an effect: from 9 degrees.
const FAR: usize = 36;

/// Shots that the rate around edges as a whole stands for in the rate of each angle.
const SMOOTHING: f64 = 200.0;

/// Smallest and largest angle of a law, rad: 0.2 and 5 degrees.
const REACH_RAD: [f64; 2] = [3.5e-3, 0.087];

/// Angles that are tried, evenly spread in their logarithm.
const REACHES: usize = 24;

/// Relative error of the law: halos are neither round nor of one strength.
const OF_FORM: f64 = 0.1;

/// Bootstrap repetitions for intervals.
const REPETITIONS: usize = 40;

/// What may happen around bright targets.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum What {
    /// False returns at their range, with a rate that falls exponentially with the angle.
    Halo,
    /// Lost returns, with a rate that falls as a Gaussian of the angle.
    Dark,
}

impl What {
    fn cause(self) -> Cause {
        match self {
            What::Halo => Cause::Blooming,
            What::Dark => Cause::BrightTargetDropout,
        }
    }

    fn channel(self) -> Channel {
        match self {
            What::Halo => Channel::Returns,
            What::Dark => Channel::Hits,
        }
    }

    /// The parameter for its rate beside a target.
    fn size(self) -> Quantity {
        match self {
            What::Halo => Quantity::Strength,
            What::Dark => Quantity::Share,
        }
    }

    /// Shots, and those to which it happened.
    fn counts(self, around: &Around) -> [f64; 2] {
        match self {
            What::Halo => [around.free, around.returns],
            What::Dark => [around.shots, around.lost],
        }
    }

    /// To how many of the shots it usually happens, up to a factor that all angles have in common: surfaces of some
    /// kinds at some ranges are lost more often than others.
    fn usually(self, around: &Around) -> f64 {
        match self {
            What::Halo => around.free,
            What::Dark => around.usually_lost,
        }
    }

    fn shape(self, bin: usize, reach_rad: f64) -> f64 {
        let angle = angle_rad(bin) / reach_rad;
        match self {
            What::Halo => (-angle).exp(),
            What::Dark => (-angle * angle).exp(),
        }
    }

    /// Angle beyond which hardly anything is left, rad.
    fn end_rad(self, reach_rad: f64) -> f64 {
        match self {
            What::Halo => 4.0 * reach_rad,
            What::Dark => 2.5 * reach_rad,
        }
    }
}

/// Rates by angle: that of surfaces as there are around edges which are not bright, at the level of bright targets far
/// off, and beyond it a law.
#[derive(Clone, Copy, Debug)]
struct Law {
    what: What,
    base: [f64; BINS],
    /// Rate at the target.
    size: f64,
    reach_rad: f64,
}

impl Law {
    /// Fitted to the profiles of some frames.
    fn of(what: What, frames: &[&HaloFrame]) -> Law {
        let [near_bright, near_edges] =
            [total(frames.iter().map(|f| &f.bright)), total(frames.iter().map(|f| &f.usual))];
        let of = |profile: &Profile| profile.map(|a| (what.counts(&a), what.usually(&a)));
        let (bright, edges) = (of(&near_bright), of(&near_edges));
        let sum = |of: &[([f64; 2], f64)]| {
            of.iter().fold([0.0; 3], |s, ([n, k], usually)| [s[0] + n, s[1] + k, s[2] + usually])
        };
        let [all, happened, usually] = sum(&edges);
        // Beside what usually happens to the surfaces there.
        let ratio = (happened + 0.5) / usually.max(0.5);
        let smoothing = SMOOTHING * usually / all.max(1.0);
        let near_edges = edges.map(|([_, k], usually)| (k + smoothing * ratio) / (usually + smoothing).max(1e-9));
        let expected: f64 = (FAR..BINS).map(|i| near_edges[i] * bright[i].1).sum();
        let level = ((sum(&bright[FAR..])[1] + 1.0) / (expected + 1.0)).clamp(0.2, 5.0);
        let base = std::array::from_fn(|i| {
            let ([shots, _], usually) = bright[i];
            (level * near_edges[i] * usually / shots.max(1.0)).min(1.0)
        });
        let bright = bright.map(|(counts, _)| counts);
        let none = Law { what, base, size: 0.0, reach_rad: REACH_RAD[0] };
        let ratio = (REACH_RAD[1] / REACH_RAD[0]).ln() / (REACHES - 1) as f64;
        let reaches = (0..REACHES).map(|k| REACH_RAD[0] * (ratio * k as f64).exp());
        let laws = reaches.map(|reach_rad| none.with_reach(reach_rad, &bright));
        laws.max_by(|a, b| a.gain(&bright).total_cmp(&b.gain(&bright))).unwrap_or(none)
    }

    /// With another reach, and the size that is likeliest with it.
    fn with_reach(self, reach_rad: f64, counts: &[[f64; 2]]) -> Law {
        let law = Law { reach_rad, ..self };
        Law { size: law.best_size(counts), ..law }
    }

    /// The size that is likeliest at its reach: the likelihood is concave in it.
    fn best_size(&self, counts: &[[f64; 2]]) -> f64 {
        let slope = |size: f64| -> f64 {
            let law = Law { size, ..*self };
            let of_bin = |(i, [n, k]): (usize, &[f64; 2])| {
                let more = self.what.shape(i, self.reach_rad);
                if *n > 0.0 { more * (k / law.rate(i) - n) } else { 0.0 }
            };
            counts.iter().enumerate().map(of_bin).sum()
        };
        bisect([0.0, 1.0], 30, |size| slope(size) > 0.0)
    }

    fn rate(&self, bin: usize) -> f64 {
        self.base[bin] + self.size * self.what.shape(bin, self.reach_rad)
    }

    /// Gain of counts over the rates without it, nats (Poisson).
    fn gain(&self, counts: &[[f64; 2]]) -> f64 {
        let of_bin = |(i, [n, k]): (usize, &[f64; 2])| {
            let (rate, base) = (self.rate(i), self.base[i]);
            if *n > 0.0 { gain_of_count(*k, *n, rate, base) } else { 0.0 }
        };
        counts.iter().enumerate().map(of_bin).sum()
    }

    fn gain_of(&self, frame: &HaloFrame) -> f64 {
        self.gain(&counts(self.what, &frame.bright))
    }
}

fn counts(what: What, profile: &Profile) -> [[f64; 2]; BINS] {
    profile.map(|around| what.counts(&around))
}

/// Results by channel, and the frames without what was found; `None` where nothing was. `displaced` says that the
/// measured scene is turned or moved as a whole: silhouettes do not match, and small losses are an effect of that.
pub fn search(context: &Context, displaced: bool) -> ([ChannelResult; 2], Option<Vec<FramePair>>) {
    let hold_out = context.of(Role::HoldOut).len();
    let mut results = [What::Halo, What::Dark].map(|what| ChannelResult::new(what.channel(), hold_out));
    let simulated = context.frames.iter().flat_map(|f| &f.simulated);
    let Some(brightness) = Brightness::of(simulated) else { return (results, None) };
    let origins = origins(context.rig);
    let select = context.of(Role::Select);
    let losses = UsualLosses::of(select.iter().map(|&f| &context.frames[f]));
    let shared = |least: f64| Shared { brightness: &brightness, least, origins: &origins, losses: &losses };
    // The brightness from which on a target is bright is that by which most is explained.
    let at = |least: f64| {
        let of_frame = |f: &FramePair| halo_frame(f, &shared(least));
        let profiles: Vec<HaloFrame> = context.frames.par_iter().map(of_frame).collect();
        let nats = |what| cross_gains(context, what, &profiles, &select).iter().sum::<f64>().max(0.0);
        (nats(What::Halo) + nats(What::Dark), least, profiles)
    };
    let best = thresholds(context.frames, &brightness).into_iter().map(at).max_by(|a, b| a.0.total_cmp(&b.0));
    let Some((_, least, profiles)) = best else { return (results, None) };
    let mut ends_rad = [0.0; 2];
    for ((what, result), end) in [What::Halo, What::Dark].into_iter().zip(&mut results).zip(&mut ends_rad) {
        if let Some(law) = search_one(context, (what, displaced), &profiles, result) {
            *end = what.end_rad(law.reach_rad);
        }
    }
    let found = ends_rad.iter().any(|end| *end > 0.0);
    let without = |f: &FramePair| without_halos(f, &shared(least), ends_rad);
    (results, found.then(|| context.frames.par_iter().map(without).collect()))
}

/// Cross-validated gains of the selecting frames, nats.
fn cross_gains(context: &Context, what: What, profiles: &[HaloFrame], select: &[usize]) -> Vec<f64> {
    let on_select: Vec<&HaloFrame> = select.iter().map(|&f| &profiles[f]).collect();
    let fit = |train: &[usize]| Law::of(what, &train.iter().map(|&i| on_select[i]).collect::<Vec<_>>());
    cross_validated(&context.blocks(select), fit, |law, i| law.gain_of(on_select[i]))
}

fn search_one(
    context: &Context,
    (what, displaced): (What, bool),
    profiles: &[HaloFrame],
    result: &mut ChannelResult,
) -> Option<Law> {
    let least = BRIGHT_SHARE + if displaced && what == What::Dark { LOST_DISPLACED } else { 0.0 };
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let on = |which: &[usize]| which.iter().map(|&f| &profiles[f]).collect::<Vec<_>>();
    let gains = cross_gains(context, what, profiles, &select);
    let (nats, z) = total_and_z(&gains);
    let [chosen, law] = [&select, &estimate].map(|which| Law::of(what, &on(which)));
    let errors = errors(what, &on(&estimate), &context.blocks(&estimate));
    let demands = first_demands();
    let confirmed: f64 = on(&estimate).iter().map(|frame| chosen.gain_of(frame)).sum();
    let outcome = if nats <= demands.nats || !significant(&gains, Z_STAR) {
        "no more around bright targets than around other edges"
    } else if [&chosen, &law].iter().any(|law| law.reach_rad > 0.99 * REACH_RAD[1]) {
        "as far from bright targets as is looked at: not around them"
    } else if chosen.size < least || law.size < least.max(1.96 * errors[0]) {
        "too small to speak of"
    } else if law.reach_rad < 1.96 * errors[1] || confirmed <= demands.nats {
        "other frames do not confirm it"
    } else {
        "chosen"
    };
    result.consider(what.cause(), (nats, z), context.returns(&select), outcome);
    result.minimum.push((what.cause(), Minimum::new(what.size(), least)));
    if outcome != "chosen" {
        return None;
    }
    let gains: Vec<f64> = hold_out.iter().map(|&f| law.gain_of(&profiles[f])).collect();
    result.distance = gains.iter().map(|g| [g.max(0.0), *g, *g]).collect();
    result.found.push(found(&law, &on(&estimate), errors, gains, z));
    Some(law)
}

/// Standard errors of size and reach, rad, over blocks of frames and by the form.
fn errors(what: What, frames: &[&HaloFrame], blocks: &[usize]) -> [f64; 2] {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose bright targets", 0, 0);
    let draws: Vec<Vec<usize>> = (0..REPETITIONS).map(|_| draw_blocks(&members, &mut rng)).collect();
    let again = |drawn: &Vec<usize>| Law::of(what, &drawn.iter().map(|&i| frames[i]).collect::<Vec<_>>());
    let laws: Vec<Law> = draws.par_iter().map(again).collect();
    let error = |of: fn(&Law) -> f64| {
        let values: Vec<f64> = laws.iter().map(of).collect();
        let mean = values.iter().sum::<f64>() / values.len().max(1) as f64;
        deviation(&values).hypot(OF_FORM * mean)
    };
    [error(|law| law.size), error(|law| law.reach_rad)]
}

fn found(law: &Law, frames: &[&HaloFrame], errors: [f64; 2], held_out_gains: Vec<f64>, z: f64) -> Found {
    let deg = f64::to_degrees;
    // Of what is as bright, a part are retroreflectors: their rate is this one or higher.
    let mut size = with_error(law.size, errors[0], Unit::One);
    size.ci95[1] = 1.0;
    let (reach, what) = match law.what {
        What::Halo => (
            Quantity::HaloDeg,
            format!(
                "bright targets have halos of false returns at their range: {:.0} % of the shots beside them or more, \
                 1/e of that {:.1} degrees away",
                100.0 * law.size,
                deg(law.reach_rad)
            ),
        ),
        What::Dark => (
            Quantity::RadiusDeg,
            format!(
                "returns are lost around bright targets: {:.0} % of those beside them or more, within about {:.1} degrees",
                100.0 * law.size,
                deg(law.reach_rad)
            ),
        ),
    };
    Found {
        status: Status::Named,
        causes: vec![law.what.cause()],
        parameters: vec![(law.what.size().into(), size), parameter(reach, deg(law.reach_rad), deg(errors[1]))],
        confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
        channel: law.what.channel(),
        covariate: Covariate::Brightness,
        held_out_gains,
        says: what,
        separate_by: None,
        curve: curve(law, frames),
        effects: vec![],
    }
}

/// Rates over the angle from bright targets.
fn curve(law: &Law, frames: &[&HaloFrame]) -> Curve {
    let counts = counts(law.what, &total(frames.iter().map(|f| &f.bright)));
    let point = |(i, [n, k]): (usize, &[f64; 2])| CurvePoint {
        sensor: 0,
        x: angle_rad(i).to_degrees(),
        measured: k / n,
        before: law.base[i],
        after: law.rate(i),
        error: (k.max(1.0)).sqrt() / n,
    };
    Curve {
        x: "angle from the nearest bright target, degrees".into(),
        y: match law.what {
            What::Halo => "shots that return at its range".into(),
            What::Dark => "shots without a return".into(),
        },
        by_sensor: false,
        points: counts.iter().enumerate().filter(|(_, c)| c[0] > 0.0).map(point).collect(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    /// Profiles of frames with some rate around bright targets, and 1 % around all edges.
    fn frames(rate: impl Fn(f64) -> f64) -> Vec<HaloFrame> {
        let mut rng = data::stream(3, "halos", 0, 0);
        let mut around = |more: f64, n: usize| {
            let happened = (0..n).filter(|_| rng.random_bool((0.01 + more).min(1.0))).count() as f64;
            Around { free: n as f64, returns: happened, shots: n as f64, lost: happened, usually_lost: 0.01 * n as f64 }
        };
        let mut one = || HaloFrame {
            bright: std::array::from_fn(|i| around(rate(angle_rad(i)), 8 + 3 * i)),
            usual: std::array::from_fn(|i| around(0.0, 30 + 9 * i)),
        };
        (0..40).map(|_| one()).collect()
    }

    #[test]
    fn a_halo_has_its_strength_and_angle() {
        let frames = frames(|angle| 0.6 * (-angle / 0.02).exp());
        let law = Law::of(What::Halo, &frames.iter().collect::<Vec<_>>());
        assert!((law.size - 0.6).abs() < 0.1 && (law.reach_rad - 0.02).abs() < 0.004, "{law:?}");
        let total: f64 = frames.iter().map(|f| law.gain_of(f)).sum();
        assert!(total > 100.0, "{total}");
    }

    #[test]
    fn what_edges_have_as_well_is_no_halo() {
        let frames = frames(|_| 0.0);
        let law = Law::of(What::Dark, &frames[..20].iter().collect::<Vec<_>>());
        let others: f64 = frames[20..].iter().map(|f| law.gain_of(f)).sum();
        assert!(others < 3.0, "{others} {law:?}");
    }
}
