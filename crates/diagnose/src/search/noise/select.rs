//! Forward selection of noise laws.

use super::{ANGULAR, CONSTANT, NO_PRIOR, Search, Term};
use crate::catalogue::{Cause, Channel};
use crate::channels::groups::Grouping;
use crate::inference::choice::{Demands, Trial, choose, total_and_z};
use crate::inference::grouped::GroupFit;
use crate::inference::linear::{LinearFrame, cross_gains};
use crate::inference::noise::{NOISE_LAWS, NoiseLaw};
use crate::search::{ChannelResult, Selected, UNEXPLAINED_SHARE, causes_of, confidence, record, rivals_and_confidence};

/// Share of the first law's gain by which a pair of range noise and angular jitter must exceed a law of the signal.
const PAIR_SHARE: f64 = 0.003;

/// What the forward selection chose.
#[derive(Default)]
pub(super) struct Selection {
    /// Laws by their place in the list.
    pub(super) laws: Vec<usize>,
    /// What is said of each law; empty where a table by direction makes the laws mere forms.
    pub(super) selected: Vec<Selected>,
    /// Grouping and confidence of a table by direction.
    pub(super) unexplained: Option<(Grouping, f64)>,
}

impl Search<'_> {
    /// Forward selection: one law and at most a second one of another cause, or a pair that replaces a law of the
    /// signal; a table by direction where no law is chosen, or where laws leave one, unless heavy tails make the
    /// surfaces rough.
    pub(super) fn select(&self, result: &mut ChannelResult) -> Selection {
        let mut trials: Vec<Trial> = (0..NOISE_LAWS.len()).map(|k| self.trial(&[k], None)).collect();
        let mut choice = choose(&trials, &self.demands);
        if choice.is_none() && self.drawn_m2 == 0.0 {
            trials.extend(self.direction_trials(&[], super::directions::GROUPED));
            choice = choose(&trials, &self.demands);
        }
        self.record(result, &trials, choice.as_ref(), &self.demands);
        let Some(first) = choice else { return Selection::default() };
        let trial = &trials[first.chosen];
        if trial.cause == Cause::Unexplained {
            return Selection {
                unexplained: Some(self.table_by_direction(&trials, first.chosen)),
                ..Selection::default()
            };
        }
        let equals = causes_of(&trials, &first.equals);
        let mut selection = Selection {
            laws: vec![trial.candidate],
            selected: vec![rivals_and_confidence(equals, &trials, &self.blocks, trial.cause, &self.demands)],
            unexplained: None,
        };
        let gains = self.add_second(trial, &mut selection, result);
        self.try_pair(trial, gains, &mut selection, result);
        if self.drawn_m2 == 0.0 {
            self.try_directions(&mut selection, result);
        }
        selection
    }

    fn record(
        &self,
        result: &mut ChannelResult,
        trials: &[Trial],
        choice: Option<&crate::inference::choice::Choice>,
        demands: &Demands,
    ) {
        let returns = self.context.returns(&self.select);
        result.considered.extend(record(trials, choice, Channel::Roughness, returns, demands));
    }

    /// A trial of the last of some laws, with the others fitted beside it.
    fn trial(&self, columns: &[usize], before: Option<&[f64]>) -> Trial {
        let fitted = self.whole(columns);
        let last = columns.len() - 1;
        let law = NOISE_LAWS[columns[last]];
        let frames: Vec<&LinearFrame> = self.linear.iter().collect();
        let mut gains = cross_gains(&frames, &self.blocks, columns, &NO_PRIOR);
        if let Some(before) = before {
            gains.iter_mut().zip(before).for_each(|(g, b)| *g -= b);
        }
        Trial {
            candidate: columns[last],
            cause: law.cause(),
            parameters: law.parameters(),
            gains,
            // A negative second law only corrects the form of the first.
            above_floor: (last == 0 || fitted.theta[last] > 0.0) && self.above_floor(law, fitted.theta[last]),
        }
    }

    /// Adds a second law of another cause that brings at least 5 % of the first gain. Returns the gains of the
    /// selecting frames.
    fn add_second(&self, first: &Trial, selection: &mut Selection, result: &mut ChannelResult) -> Vec<f64> {
        let mut gains = first.gains.clone();
        let (first_gain, _) = total_and_z(&first.gains);
        let demands = Demands { nats: (0.05 * first_gain).max(8.0), ..self.demands };
        let rivals: Vec<Trial> = (0..NOISE_LAWS.len())
            .filter(|&k| NOISE_LAWS[k].cause() != NOISE_LAWS[first.candidate].cause())
            .map(|k| self.trial(&[first.candidate, k], Some(&first.gains)))
            .collect();
        let second = choose(&rivals, &demands);
        self.record(result, &rivals, second.as_ref(), &demands);
        if let Some(second) = second {
            let trial = &rivals[second.chosen];
            let equals = causes_of(&rivals, &second.equals);
            selection.laws.push(trial.candidate);
            selection.selected.push(rivals_and_confidence(equals, &rivals, &self.blocks, trial.cause, &demands));
            gains.iter_mut().zip(&trial.gains).for_each(|(g, more)| *g += more);
        }
        gains
    }

    /// Replaces a law of the signal by range noise together with angular jitter, where the pair gains more: the two
    /// together resemble noise that grows as the signal falls.
    fn try_pair(&self, first: &Trial, gains: Vec<f64>, selection: &mut Selection, result: &mut ChannelResult) {
        let range_noise = NOISE_LAWS[CONSTANT].cause();
        let along = (0..NOISE_LAWS.len()).filter(|&k| NOISE_LAWS[k].cause() == range_noise);
        let pairs = along.map(|k| (k, self.trial(&[k, ANGULAR], None))).filter(|(k, t)| {
            let theta = || self.whole(&[*k, ANGULAR]).theta[0].max(0.0);
            t.above_floor && self.above_floor(NOISE_LAWS[*k], theta())
        });
        let best = pairs.max_by(|a, b| total_and_z(&a.1.gains).0.total_cmp(&total_and_z(&b.1.gains).0));
        let by_signal = selection.laws.iter().any(|&c| matches!(NOISE_LAWS[c], NoiseLaw::Signal(_)));
        let Some((k, pair)) = best.filter(|_| by_signal) else { return };
        let (first_gain, _) = total_and_z(&first.gains);
        let (more, z) = total_and_z(&pair.gains.iter().zip(&gains).map(|(a, b)| a - b).collect::<Vec<_>>());
        if more > (PAIR_SHARE * first_gain).max(self.demands.nats) && z > 2.0 {
            let both = [pair, Trial { cause: Cause::SignalNoise, gains, ..first.clone() }];
            let confidence = confidence(&both, &self.blocks, both[0].cause, &self.demands);
            selection.laws = vec![k, ANGULAR];
            selection.selected = vec![Selected { rivals: vec![], confidence }; 2];
            self.record(result, &both, None, &self.demands);
        }
    }

    /// Looks for a dependence on the direction that the chosen laws leave. Where there is one, the laws are forms,
    /// not causes.
    fn try_directions(&self, selection: &mut Selection, result: &mut ChannelResult) {
        let so_far = self.whole(&selection.laws);
        let terms: Vec<Term> =
            selection.laws.iter().zip(so_far.theta.iter()).map(|(&k, &t)| (NOISE_LAWS[k], t)).collect();
        let tables = self.direction_trials(&terms, GroupFit { centred: true, ..super::directions::GROUPED });
        let (by_laws, _) = total_and_z(&self.trial(&selection.laws, None).gains);
        let demands = Demands { nats: (UNEXPLAINED_SHARE * by_laws).max(self.demands.nats), ..self.demands };
        let remains = choose(&tables, &demands);
        self.record(result, &tables, remains.as_ref(), &demands);
        if let Some(remains) = remains {
            selection.unexplained = Some(self.table_by_direction(&tables, remains.chosen));
            selection.selected.clear();
        }
    }

    /// Grouping and confidence of a chosen table by direction.
    fn table_by_direction(&self, trials: &[Trial], chosen: usize) -> (Grouping, f64) {
        let by_row = trials[chosen].candidate == NOISE_LAWS.len();
        let grouping = if by_row { Grouping::Row } else { Grouping::Azimuth };
        (grouping, confidence(trials, &self.blocks, Cause::Unexplained, &self.demands))
    }
}
