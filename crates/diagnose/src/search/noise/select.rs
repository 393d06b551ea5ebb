//! Which causes of noise are there: all sets of causes are compared, each with laws of any form of its causes.

use super::{CONSTANT, NO_PRIOR, Search, Term};
use crate::catalogue::{Cause, Channel};
use crate::channels::groups::Grouping;
use crate::diagnosis::Considered;
use crate::inference::choice::{Choice, Demands, Trial, choose, total_and_z};
use crate::inference::grouped::GroupFit;
use crate::inference::linear::{LinearFrame, cross_gains, positive_cross_gains, positive_fit};
use crate::inference::noise::NOISE_LAWS;
use crate::search::unexplained::table_by_direction;
use crate::search::{ChannelResult, Selected, UNEXPLAINED_SHARE, causes_of, record, rivals_and_confidence};
use statistics::{blocks_of, draw_blocks};

/// Causes of noise.
const CAUSES: [Cause; 3] = [Cause::RangeNoise, Cause::SignalNoise, Cause::AngularJitter];

/// Bootstrap repetitions of the choice among sets of causes.
const REPETITIONS: usize = 200;

/// What the selection chose.
#[derive(Default)]
pub(super) struct Selection {
    /// Laws by their place in the list.
    pub(super) laws: Vec<usize>,
    /// What is said of each law; empty where a table by direction makes the laws mere forms.
    pub(super) selected: Vec<Selected>,
    /// Grouping and confidence of a table by direction.
    pub(super) unexplained: Option<(Grouping, f64)>,
}

/// Causes that add noise together.
#[derive(Clone)]
struct Set {
    causes: Vec<Cause>,
    /// The law of each cause that fits best beside those of the others.
    laws: Vec<usize>,
    /// Free parameters of these laws.
    parameters: usize,
    /// Gain of each selecting frame by any mixture of the laws of these causes, nats.
    gains: Vec<f64>,
}

impl Search<'_> {
    /// The causes of added noise; a table by direction where there is none, or where their laws leave one, unless heavy
    /// tails make the surfaces rough. Where the measured side has less noise, the law by which it has less.
    pub(super) fn select(&self, result: &mut ChannelResult) -> Selection {
        let mut trials: Vec<Trial> = (0..NOISE_LAWS.len()).map(|k| self.trial(k)).collect();
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
        let alone = || Selection {
            laws: vec![trial.candidate],
            selected: vec![rivals_and_confidence(equals, &trials, &self.blocks, trial.cause, &self.demands)],
            unexplained: None,
        };
        let adds = self.whole(&[trial.candidate]).theta[0] > 0.0;
        let mut selection = adds.then(|| self.select_set(result)).flatten().unwrap_or_else(alone);
        if self.drawn_m2 == 0.0 {
            self.try_directions(&mut selection, result);
        }
        selection
    }

    fn record(&self, result: &mut ChannelResult, trials: &[Trial], choice: Option<&Choice>, demands: &Demands) {
        let returns = self.context.returns(&self.select);
        result.considered.extend(record(trials, choice, Channel::Roughness, returns, demands));
    }

    /// A trial of one law.
    fn trial(&self, law: usize) -> Trial {
        let frames: Vec<&LinearFrame> = self.linear.iter().collect();
        Trial {
            candidate: law,
            cause: NOISE_LAWS[law].cause(),
            parameters: NOISE_LAWS[law].parameters(),
            gains: cross_gains(&frames, &self.blocks, &[law], &NO_PRIOR),
            expected: vec![],
            above_floor: self.above_floor(NOISE_LAWS[law], self.whole(&[law]).theta[0]),
        }
    }

    /// Places of the laws of a cause.
    fn laws_of(cause: Cause) -> impl Iterator<Item = usize> {
        (0..NOISE_LAWS.len()).filter(move |&k| NOISE_LAWS[k].cause() == cause)
    }

    /// A set of causes with its best laws; `None` where some cause adds too little to speak of.
    fn set(&self, causes: Vec<Cause>) -> Option<Set> {
        let frames: Vec<&LinearFrame> = self.linear.iter().collect();
        let mut combinations: Vec<Vec<usize>> = vec![vec![]];
        for cause in &causes {
            let with = |laws: &Vec<usize>, law: usize| [laws.as_slice(), &[law]].concat();
            combinations =
                combinations.iter().flat_map(|laws| Self::laws_of(*cause).map(move |law| with(laws, law))).collect();
        }
        let gain = |laws: &Vec<usize>| positive_cross_gains(&frames, &self.blocks, laws).iter().sum::<f64>();
        let (_, laws) = combinations.into_iter().map(|laws| (gain(&laws), laws)).max_by(|a, b| a.0.total_cmp(&b.0))?;
        let theta = positive_fit(&frames, &laws);
        let large = laws.iter().zip(theta).all(|(&law, theta)| self.above_floor(NOISE_LAWS[law], theta));
        let all: Vec<usize> = causes.iter().flat_map(|c| Self::laws_of(*c)).collect();
        large.then(|| Set {
            parameters: laws.iter().map(|&law| NOISE_LAWS[law].parameters()).sum(),
            gains: positive_cross_gains(&frames, &self.blocks, &all),
            laws,
            causes,
        })
    }

    /// The set of causes with the fewest parameters of those that are as good as the best. Every cause of a set has to
    /// bring what is demanded of a finding beside any form of the others.
    fn select_set(&self, result: &mut ChannelResult) -> Option<Selection> {
        let subsets = (1..1usize << CAUSES.len()).map(|bits| {
            let causes = CAUSES.iter().enumerate().filter(|(k, _)| bits & (1 << k) != 0);
            causes.map(|(_, cause)| *cause).collect::<Vec<_>>()
        });
        let sets: Vec<Set> = subsets.filter_map(|causes| self.set(causes)).collect();
        let frames: Vec<&LinearFrame> = self.linear.iter().collect();
        // What a cause brings beside any form of the others of its set. Surfaces that heavy tails draw are uneven.
        let brings = |set: &Set, cause: Cause| -> Vec<f64> {
            let others = set.causes.iter().filter(|c| **c != cause).flat_map(|c| Self::laws_of(*c));
            let drawn = (self.drawn_m2 > 0.0 && cause != Cause::RangeNoise).then_some(CONSTANT);
            let others: Vec<usize> = others.chain(drawn.filter(|_| !set.causes.contains(&Cause::RangeNoise))).collect();
            let with: Vec<usize> = others.iter().copied().chain(Self::laws_of(cause)).collect();
            let [with, without] = [with, others].map(|laws| positive_cross_gains(&frames, &self.blocks, &laws));
            with.iter().zip(without).map(|(with, without)| with - without).collect()
        };
        let is_needed = |gains: &[f64]| {
            let (total, z) = total_and_z(gains);
            total > self.demands.nats && z > self.demands.z
        };
        let needed: Vec<bool> = sets.iter().map(|s| s.causes.iter().all(|c| is_needed(&brings(s, *c)))).collect();
        let chosen = choose_set(&sets, &needed, &self.demands)?;
        let set = &sets[chosen.chosen];
        let confidence = same_again(&sets, &needed, chosen.chosen, &self.blocks, &self.demands);
        for cause in CAUSES {
            let chosen = set.causes.contains(&cause);
            let causes = CAUSES.into_iter().filter(|c| *c == cause || set.causes.contains(c)).collect();
            let (total, z, outcome) = match self.set(causes) {
                Some(with) => {
                    let (total, z) = total_and_z(&brings(&with, cause));
                    (total, z, if chosen { "chosen" } else { "no more than another form of the others" })
                }
                None => (0.0, 0.0, "too small to speak of beside the others"),
            };
            result.considered.push(Considered {
                cause: cause.into(),
                channel: Channel::Roughness,
                nats_per_ray: total / self.context.returns(&self.select),
                z,
                outcome: outcome.into(),
            });
        }
        // Each cause has those of the rival sets as rivals that are not chosen themselves.
        let mut rivals: Vec<Cause> = chosen.equals.iter().flat_map(|&k| sets[k].causes.clone()).collect();
        rivals.retain(|c| !set.causes.contains(c));
        rivals.sort();
        rivals.dedup();
        // A cause that all rival sets have as well is certain.
        let is_certain = |c: &Cause| chosen.equals.iter().all(|&k| sets[k].causes.contains(c));
        let of = |c: &Cause| Selected { rivals: if is_certain(c) { vec![] } else { rivals.clone() }, confidence };
        Some(Selection { selected: set.causes.iter().map(of).collect(), laws: set.laws.clone(), unexplained: None })
    }

    /// Looks for a dependence on the direction that the chosen laws leave. Where there is one, the laws are forms,
    /// not causes.
    fn try_directions(&self, selection: &mut Selection, result: &mut ChannelResult) {
        let so_far = self.whole(&selection.laws);
        let terms: Vec<Term> =
            selection.laws.iter().zip(so_far.theta.iter()).map(|(&k, &t)| (NOISE_LAWS[k], t)).collect();
        let tables = self.direction_trials(&terms, GroupFit { centred: true, ..super::directions::GROUPED });
        let frames: Vec<&LinearFrame> = self.linear.iter().collect();
        let by_laws: f64 = cross_gains(&frames, &self.blocks, &selection.laws, &NO_PRIOR).iter().sum();
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
        table_by_direction(trials, chosen, NOISE_LAWS.len(), &self.blocks, &self.demands)
    }
}

/// Share of bootstrap repetitions over blocks of frames that choose the same set.
fn same_again(sets: &[Set], needed: &[bool], chosen: usize, blocks: &[usize], demands: &Demands) -> f64 {
    let members = blocks_of(blocks);
    let mut rng = data::stream(0, "diagnose noise", sets.len() as u64, 0);
    let mut again: Vec<Set> = sets.to_vec();
    let mut same = |_: &usize| {
        let drawn = draw_blocks(&members, &mut rng);
        for (to, of) in again.iter_mut().zip(sets) {
            to.gains = drawn.iter().map(|&i| of.gains[i]).collect();
        }
        choose_set(&again, needed, demands).is_some_and(|c| c.chosen == chosen)
    };
    (0..REPETITIONS).filter(|k| same(k)).count() as f64 / REPETITIONS as f64
}

/// The set with the fewest parameters of those whose gain is less than the slack behind the best one, or not
/// significantly; then the one that gains most. Sets with as many parameters or fewer, from which it is not
/// significantly different, are its equals. Only needed sets count.
fn choose_set(sets: &[Set], needed: &[bool], demands: &Demands) -> Option<Choice> {
    let total = |k: usize| sets[k].gains.iter().sum::<f64>();
    let counted: Vec<usize> = (0..sets.len()).filter(|&k| needed[k]).collect();
    let best = counted.iter().copied().max_by(|&a, &b| total(a).total_cmp(&total(b)))?;
    let behind = |k: usize, of: usize| {
        let differences: Vec<f64> = sets[of].gains.iter().zip(&sets[k].gains).map(|(a, b)| a - b).collect();
        total_and_z(&differences)
    };
    let near = |k: &usize| {
        let (deficit, z) = behind(*k, best);
        deficit < demands.slack * total(best) || z < 2.0
    };
    let order =
        |&a: &usize, &b: &usize| sets[a].parameters.cmp(&sets[b].parameters).then(total(b).total_cmp(&total(a)));
    let chosen = counted.iter().copied().filter(near).min_by(order)?;
    let equal = |k: &usize| {
        *k != chosen && sets[*k].parameters <= sets[chosen].parameters && behind(*k, chosen).1 < 2.0 && near(k)
    };
    Some(Choice { chosen, equals: counted.iter().copied().filter(equal).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::search::first_demands;

    fn set(causes: &[Cause], parameters: usize, gains: [f64; 4]) -> Set {
        Set { causes: causes.to_vec(), laws: vec![], parameters, gains: gains.to_vec() }
    }

    #[test]
    fn a_cause_more_is_chosen_where_it_brings_more_than_a_form() {
        let [range, signal, jitter] = CAUSES;
        let demands = first_demands();
        let sets = |pair: [f64; 4]| {
            [
                set(&[range], 1, [800.0, 810.0, 790.0, 800.0]),
                set(&[signal], 2, [1000.0, 1010.0, 990.0, 1000.0]),
                set(&[signal, jitter], 3, pair),
            ]
        };
        let chosen = |pair, needed: [bool; 3]| choose_set(&sets(pair), &needed, &demands).unwrap().chosen;
        assert_eq!(chosen([1040.0, 1052.0, 1029.0, 1041.0], [true; 3]), 2, "4 % more");
        assert_eq!(chosen([1010.0, 1021.0, 999.0, 1010.0], [true; 3]), 1, "1 % more: another form");
        assert_eq!(chosen([1040.0, 1052.0, 1029.0, 1041.0], [true, true, false]), 1, "a cause that is not needed");
        let equal = [
            set(&[signal], 2, [1000.0, 1030.0, 985.0, 1001.0]),
            set(&[range, jitter], 2, [1001.0, 1000.0, 1010.0, 1000.0]),
        ];
        let choice = choose_set(&equal, &[true; 2], &demands).unwrap();
        assert_eq!((choice.chosen, choice.equals), (0, vec![1]));
        assert!(choose_set(&equal, &[false; 2], &demands).is_none());
    }
}
