//! Labels and objects: shifts of measured labels against simulated ones, and of measured returns on objects against
//! simulated ones.

mod clock;
mod describe;
mod hypotheses;
mod rows;

use self::clock::{alike, forward, late, own_speeds, surely_late, within_frames};
use self::describe::Description;
use self::hypotheses::{HYPOTHESES, Hypothesis, TARGETS_CLOCK};
use self::rows::{ALL, Row, displacement_m, distance, errors_by_vehicle, keep_known, row, set_noise, sums};
use super::geometry::Displacement;
use super::{ChannelResult, Context, Repair, Selected, Z_STAR, causes_of, confidence, first_demands, record};
use crate::catalogue::sizes::{CLOCK_S, LABELS_M, LABELS_MOVED_M, OBJECTS_M, OBJECTS_MOVED_M, SCAN_S};
use crate::catalogue::{Cause, Channel, Quantity};
use crate::channels::labels::object_shifts;
use crate::diagnosis::Minimum;
use crate::inference::choice::{Demands, Trial, as_good, choose, significant, total_and_z};
use crate::inference::linear::{LinearFit, LinearFrame, cross_expected, cross_gains, fit};
use crate::inference::roles::Role;
use nalgebra::Vector3;

/// What is compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Measured labels with simulated labels.
    Labels,
    /// Measured returns on objects with simulated ones.
    Objects,
}

impl Side {
    /// Its channel.
    pub fn channel(self) -> Channel {
        match self {
            Side::Labels => Channel::Labels,
            Side::Objects => Channel::Objects,
        }
    }

    /// Smallest constant shift that is reported, m.
    fn floor_m(self) -> f64 {
        match self {
            Side::Labels => LABELS_M,
            Side::Objects => OBJECTS_M,
        }
    }

    /// Smallest displacement of the objects that is reported, root mean square, m.
    fn least_displacement_m(self) -> f64 {
        match self {
            Side::Labels => LABELS_MOVED_M,
            Side::Objects => OBJECTS_MOVED_M,
        }
    }
}

/// Relative difference in gain below which causes of an object shift are reported as ambiguous even if it is
/// significant: surface fitting has a systematic error of this size.
const AS_GOOD: f64 = 0.02;

/// Fewest objects of the selecting frames.
const FEWEST: usize = 8;

/// No prior on the coefficients.
const NO_PRIOR: [f64; ALL] = [0.0; ALL];

/// Hypotheses that were chosen, with what is said of each.
type Chosen = (Vec<&'static Hypothesis>, Vec<Selected>);

/// The search on one side; `displaced` is the displacement of the scene that the search of geometry found.
pub fn search(context: &Context, side: Side, displaced: &Displacement) -> ChannelResult {
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let mut result = ChannelResult::new(side.channel(), hold_out.len());
    let shifts = object_shifts(context.frames, context.times.as_deref(), &context.to_next);
    let mut rows: Vec<Row> = shifts.iter().filter_map(|s| row(context, s, side, displaced)).collect();
    if rows.iter().filter(|r| select.contains(&r.frame)).count() < FEWEST {
        return result;
    }
    let usable = keep_known(&mut rows);
    set_noise(&mut rows, &select, side);
    let blocks = context.blocks(&select);
    let on_select: Vec<LinearFrame> = select.iter().map(|&f| sums(&rows, f)).collect();
    let speeds = own_speeds(context.motion.as_deref());
    let line = within_frames(&rows, &select, &blocks);
    let frames: Vec<&LinearFrame> = on_select.iter().collect();
    let gains = |columns: &[usize]| cross_gains(&frames, &blocks, columns, &NO_PRIOR);
    let more_alike = || gains(&[0]).iter().zip(gains(TARGETS_CLOCK)).map(|(a, b)| a - b).collect::<Vec<f64>>();
    let clock = usable[3] && surely_late(forward(&rows, line[0]), line, speeds) && !significant(&more_alike(), Z_STAR);
    let demands = Demands { nats: 6.0, slack: 0.03, richer: 0.03, of_few: true, ..first_demands() };
    let search =
        Search { context, side, rows, usable, blocks, on_select, speeds, line, clock, demands, estimate, hold_out };
    if side == Side::Labels {
        result.minimum = search.minimum();
    }
    match search.select(&select, &mut result) {
        Some((chosen, selected)) => search.report(&chosen, selected, &mut result),
        None => result.distance = search.hold_out.iter().map(|&f| [distance(&search.rows, f), 0.0, 0.0]).collect(),
    }
    result
}

/// Gains of the `test` frames by all shifts fitted on the `train` frames, nats; zeros with too few objects.
pub fn by_table(context: &Context, side: Side, train: &[usize], test: &[usize]) -> Vec<f64> {
    let shifts = object_shifts(context.frames, context.times.as_deref(), &context.to_next);
    let in_place = Displacement::default();
    let mut rows: Vec<Row> = shifts.iter().filter_map(|s| row(context, s, side, &in_place)).collect();
    if rows.iter().filter(|r| train.contains(&r.frame)).count() < FEWEST {
        return vec![0.0; test.len()];
    }
    let usable = keep_known(&mut rows);
    set_noise(&mut rows, train, side);
    let known: Vec<usize> = (0..ALL).filter(|&k| usable[k]).collect();
    let linear: Vec<LinearFrame> = train.iter().map(|&f| sums(&rows, f)).collect();
    let best = fit(&linear.iter().collect::<Vec<_>>(), &context.blocks(train), &known, &[1e-3; ALL]);
    test.iter().map(|&f| best.gain(&sums(&rows, f))).collect()
}

/// Objects of all frames, and what is known before the selection.
struct Search<'a> {
    context: &'a Context<'a>,
    side: Side,
    rows: Vec<Row>,
    /// Whether each column is used.
    usable: [bool; ALL],
    /// Blocks of the selecting frames.
    blocks: Vec<usize>,
    /// Linear sums of the selecting frames.
    on_select: Vec<LinearFrame>,
    /// Range of the ego speed, m/s.
    speeds: [f64; 2],
    /// Slope of the shift over the relative velocity among objects of the same frame, and its standard error, s.
    line: [f64; 2],
    /// Whether that slope proves a late clock.
    clock: bool,
    demands: Demands,
    estimate: Vec<usize>,
    hold_out: Vec<usize>,
}

impl Search<'_> {
    fn frames(&self) -> Vec<&LinearFrame> {
        self.on_select.iter().collect()
    }

    /// A trial of a hypothesis, `k` in the list, beside the columns of others that were chosen with `before` as their
    /// gains.
    fn trial(&self, k: usize, others: &[usize], before: Option<&[f64]>) -> Trial {
        let Hypothesis { cause, columns: own } = HYPOTHESES[k];
        let columns = [others, own].concat();
        let fitted = fit(&self.frames(), &self.blocks, &columns, &NO_PRIOR);
        let theta: Vec<f64> = (0..own.len()).map(|i| fitted.theta[others.len() + i]).collect();
        let size = theta.iter().map(|t| t.abs()).fold(0.0, f64::max);
        let moved = displacement_m(&self.rows, own, &theta);
        let plausible = match cause {
            _ if own == TARGETS_CLOCK => self.clock,
            Cause::LabelOffset => !(self.clock && own.contains(&0)),
            _ => true,
        };
        let mut gains = cross_gains(&self.frames(), &self.blocks, &columns, &NO_PRIOR);
        if let Some(before) = before {
            gains.iter_mut().zip(before).for_each(|(g, b)| *g -= b);
        }
        let least = match cause {
            Cause::TimeOffset if own != TARGETS_CLOCK => CLOCK_S,
            Cause::RollingShutter => SCAN_S,
            _ => self.side.floor_m(),
        };
        Trial {
            candidate: k,
            cause,
            parameters: own.len(),
            gains,
            expected: cross_expected(&self.frames(), &self.blocks, [others, &columns], &NO_PRIOR),
            above_floor: plausible && size > least && moved > self.side.least_displacement_m(),
        }
    }

    /// Whether a hypothesis can be tried: its columns are known. Labels have no shape of their own and are not
    /// scanned.
    fn allowed(&self, k: usize) -> bool {
        let Hypothesis { cause, columns } = HYPOTHESES[k];
        columns.iter().all(|&c| self.usable[c])
            && (self.side == Side::Objects || !matches!(cause, Cause::WrongShape | Cause::RollingShutter))
    }

    /// Forward selection of one hypothesis and at most a second one of another cause; `None` where there is none.
    fn select(&self, select: &[usize], result: &mut ChannelResult) -> Option<Chosen> {
        let allowed = || (0..HYPOTHESES.len()).filter(|k| self.allowed(*k));
        let trials: Vec<Trial> = allowed().map(|k| self.trial(k, &[], None)).collect();
        let choice = choose(&trials, &self.demands);
        let returns = self.context.returns(select);
        result.considered = record(&trials, choice.as_ref(), self.side.channel(), returns, &self.demands);
        for (considered, t) in result.considered.iter_mut().zip(&trials).filter(|_| self.clock) {
            if t.cause == Cause::LabelOffset && HYPOTHESES[t.candidate].columns.contains(&0) {
                considered.outcome = "objects of the same frame are shifted by their speeds, not all alike".into();
            }
        }
        let choice = choice?;
        let first = &HYPOTHESES[trials[choice.chosen].candidate];
        let mut chosen = vec![first];
        let mut selected = vec![Selected {
            rivals: self.rivals_of_first(&trials, choice.chosen, &choice.equals),
            confidence: confidence(&trials, &self.blocks, first.cause, &self.demands),
        }];
        let first_gains = &trials[choice.chosen].gains;
        let (first_gain, _) = total_and_z(first_gains);
        let demands = Demands { nats: (0.1 * first_gain).max(8.0), ..self.demands };
        let joins = |k: &usize| {
            let Hypothesis { cause, columns } = HYPOTHESES[*k];
            cause != first.cause && columns.iter().all(|c| !first.columns.contains(c))
        };
        let trials: Vec<Trial> =
            allowed().filter(joins).map(|k| self.trial(k, first.columns, Some(first_gains))).collect();
        if let Some(second) = choose(&trials, &demands) {
            let trial = &trials[second.chosen];
            chosen.push(&HYPOTHESES[trial.candidate]);
            selected.push(Selected {
                rivals: causes_of(&trials, &second.equals),
                confidence: confidence(&trials, &self.blocks, trial.cause, &demands),
            });
        }
        Some((chosen, selected))
    }

    /// Rival causes of the first hypothesis. Where velocities over the ground are not known, a forward shift that is
    /// the same for all objects may be a late clock, unless relative velocities contradict it, or the shifts scatter
    /// less than the speeds of a long recording.
    fn rivals_of_first(&self, trials: &[Trial], chosen: usize, equals: &[usize]) -> Vec<Cause> {
        let mut rivals = causes_of(trials, equals);
        if self.side == Side::Objects {
            rivals.extend(as_good(trials, chosen, AS_GOOD));
        }
        let first = &HYPOTHESES[trials[chosen].candidate];
        let forward_alike = first.cause == Cause::LabelOffset && first.columns.contains(&0);
        let may_be_late = || late(forward(&self.rows, self.line[0]), self.line, self.speeds);
        let select = self.context.of(Role::Select);
        let differ = || !alike(&self.rows, &select, self.context.times.as_deref());
        if forward_alike && !self.usable[4] && differ() && (!self.usable[3] || may_be_late()) {
            rivals.push(Cause::TimeOffset);
        }
        rivals.sort();
        rivals.dedup();
        rivals
    }

    /// Detectable effect sizes.
    fn minimum(&self) -> Vec<(Cause, Minimum)> {
        let error = |k: usize| fit(&self.frames(), &self.blocks, &[k], &NO_PRIOR).error(0);
        let offset = Minimum::new(Quantity::ForwardM, (Z_STAR * error(0)).max(self.side.floor_m()));
        let mut all = vec![(Cause::LabelOffset, offset)];
        if let Some(k) = [4, 3].into_iter().find(|&k| self.usable[k]) {
            all.push((Cause::TimeOffset, Minimum::new(Quantity::OffsetS, (Z_STAR * error(k)).max(CLOCK_S))));
        }
        all
    }

    /// Fits what was chosen on the estimating frames and measures it on the held-out ones.
    fn report(&self, chosen: &[&'static Hypothesis], selected: Vec<Selected>, result: &mut ChannelResult) {
        let columns: Vec<usize> = chosen.iter().flat_map(|h| h.columns.to_vec()).collect();
        let linear = |frames: &[usize]| -> Vec<LinearFrame> { frames.iter().map(|&f| sums(&self.rows, f)).collect() };
        let (on_estimate, on_hold_out) = (linear(&self.estimate), linear(&self.hold_out));
        let blocks = self.context.blocks(&self.estimate);
        let frames: Vec<&LinearFrame> = on_estimate.iter().collect();
        let fitted = fit(&frames, &blocks, &columns, &NO_PRIOR);
        let by_vehicle = errors_by_vehicle(&self.rows, &self.estimate, &columns);
        let errors: Vec<f64> = by_vehicle.iter().enumerate().map(|(i, error)| fitted.error(i).max(*error)).collect();
        let line = within_frames(&self.rows, &self.estimate, &blocks);
        let line = if line[1].is_finite() { line } else { self.line };
        let mut at = 0;
        for (hypothesis, selected) in chosen.iter().zip(selected) {
            let own = at..at + hypothesis.columns.len();
            at = own.end;
            let mut without = fitted.clone();
            own.clone().for_each(|i| without.theta[i] = 0.0);
            let gains = on_hold_out.iter().map(|f| fitted.gain(f) - without.gain(f)).collect();
            let description = Description {
                hypothesis,
                fitted: &fitted,
                errors: &errors,
                own,
                line,
                side: self.side,
                rows: &self.rows,
                usable: &self.usable,
            };
            result.found.push(description.found(selected, gains));
        }
        let known: Vec<usize> = (0..ALL).filter(|&k| self.usable[k]).collect();
        let best = fit(&frames, &blocks, &known, &[1e-3; ALL]);
        let of_frame =
            |(&f, sums): (&usize, &LinearFrame)| [distance(&self.rows, f), fitted.gain(sums), best.gain(sums)];
        result.distance = self.hold_out.iter().zip(&on_hold_out).map(of_frame).collect();
        if chosen.iter().all(|h| matches!(h.cause, Cause::LabelOffset | Cause::TimeOffset)) {
            result.repairs = self.rows.iter().map(|r| repair(r, &fitted, self.side)).collect();
        }
    }
}

/// The correction of a measured label that places it on its returns: displaced labels are moved back, displaced
/// objects take their labels along.
fn repair(r: &Row, fitted: &LinearFit, side: Side) -> Repair {
    let sign = if side == Side::Labels { -1.0 } else { 1.0 };
    let (s, c) = r.yaw_rad.sin_cos();
    let shifts_m = [0.0, -1.0, 1.0].map(|end: f64| {
        let coefficient = |(i, theta): (usize, &f64)| theta + end * 3f64.sqrt() * fitted.error(i) * theta.signum();
        let theta: Vec<f64> = fitted.theta.iter().enumerate().map(coefficient).collect();
        let shift = [0, 1, 2].map(|axis: usize| r.expected(axis, &fitted.columns, theta.iter()));
        let shift = Vector3::new(shift[0] * c - shift[1] * s, shift[0] * s + shift[1] * c, shift[2]) * sign;
        shift.into()
    });
    Repair { frame: r.frame, object: r.object, shifts_m }
}
