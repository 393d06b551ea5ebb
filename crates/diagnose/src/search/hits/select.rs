//! Which laws lose returns: a sum of laws, each chosen beside any form of the others.

use super::{GROUPED, Search, refit};
use crate::catalogue::sizes::LOST_SPREAD;
use crate::catalogue::{Cause, Channel};
use crate::channels::groups::Grouping;
use crate::diagnosis::Considered;
use crate::inference::choice::{Choice, Trial, choose, total_and_z};
use crate::inference::grouped::GroupFit;
use crate::inference::law::{FittedLaw, LAWS, Law};
use crate::inference::losses::LossTable;
use crate::search::unexplained::{direction_trials, table_by_direction};
use crate::search::{ChannelResult, Selected, UNEXPLAINED_SHARE, causes_of, record, rivals_and_confidence};
use rayon::prelude::*;

/// Share of the gain of the first law from which on a random loss is tried in its place.
const MOSTLY_RANDOM: f64 = 0.5;

/// The same for any other law beside a sum of several: a tenth is more than any second law brings that stands for what
/// the first one lacks.
const NEARLY_ALL: f64 = 0.9;

/// Largest number of laws.
const MOST_LAWS: usize = 4;

/// A loss on one kind of surface with at least this share of the gain of a signal law that is confined to it is
/// reported as a material.
const MATERIAL_SHARE: f64 = 0.75;

/// What was chosen.
#[derive(Default)]
pub(super) struct Selection {
    pub(super) laws: Vec<Law>,
    /// What is said of each law; empty where a table by direction makes the laws mere forms.
    pub(super) selected: Vec<Selected>,
    /// Grouping and confidence of a table by direction.
    pub(super) unexplained: Option<(Grouping, f64)>,
}

impl Search<'_> {
    /// Selection of a sum of laws. Which law gains most alone depends on what the others lose: sums that begin with
    /// another law are tried as well. The sum with fewer parameters is taken unless the other one gains more,
    /// significantly.
    pub(super) fn select(&self, result: &mut ChannelResult) -> Selection {
        let first = self.trials(&[], 0.0);
        let Some(choice) = self.choose(&first, &mut result.considered) else { return Selection::default() };
        let mut best = self.grow(&first, &choice, &mut result.considered);
        for start in other_starts(&first, choice.chosen, best.laws.len()) {
            if best.unexplained.is_some() {
                break;
            }
            let mut considered = vec![];
            let other = self.grow(&first, &Choice { chosen: start, equals: vec![] }, &mut considered);
            // Of two single laws the choice is made.
            let sums = other.unexplained.is_none() && other.laws.len().max(best.laws.len()) > 1;
            if sums && self.explains_better(&other.laws, &best.laws) {
                result.considered.extend(considered);
                best = other;
            }
        }
        best
    }

    /// Whether a sum of laws is taken in place of another one.
    fn explains_better(&self, laws: &[Law], than: &[Law]) -> bool {
        let parameters = |laws: &[Law]| laws.iter().map(|l| l.parameters()).sum::<usize>();
        let (ahead, z) = total_and_z(&self.gains_over(laws, than));
        if parameters(laws) <= parameters(than) { ahead > 0.0 || z > -2.0 } else { ahead > 0.0 && z > 2.0 }
    }

    /// Adds laws to a first one: the one that gains most beside any form of those before it; then each law is chosen
    /// anew beside the others, until none brings enough. A table by direction tells against laws.
    fn grow(&self, first: &[Trial], choice: &Choice, considered: &mut Vec<Considered>) -> Selection {
        let mut selection = Selection::default();
        self.add(&mut selection, &LAWS, first, choice);
        if selection.unexplained.is_some() {
            return selection;
        }
        let mut most = total_and_z(&first[choice.chosen].gains).0;
        for _ in 1..MOST_LAWS {
            let trials = self.trials(&selection.laws, most);
            let Some(choice) = self.choose(&trials, considered) else { break };
            most = most.max(total_and_z(&trials[choice.chosen].gains).0);
            let candidates = others(&selection.laws);
            self.add(&mut selection, &candidates, &trials, &choice);
            if selection.unexplained.is_some() {
                break;
            }
            self.choose_anew(&mut selection);
        }
        selection
    }

    /// Trials of laws and of tables by direction beside any form of the chosen laws, the first of which gains `most`.
    fn trials(&self, chosen: &[Law], most: f64) -> Vec<Trial> {
        let mut trials = self.law_trials(&others(chosen), chosen);
        trials.extend(self.direction_trials(chosen));
        for trial in trials.iter_mut().filter(|t| t.cause == Cause::Unexplained) {
            trial.above_floor &= total_and_z(&trial.gains).0 > UNEXPLAINED_SHARE * most;
        }
        trials
    }

    /// Adds what was chosen among trials of some laws.
    fn add(&self, selection: &mut Selection, candidates: &[Law], trials: &[Trial], choice: &Choice) {
        let trial = &trials[choice.chosen];
        if trial.cause == Cause::Unexplained {
            let found = table_by_direction(trials, choice.chosen, LAWS.len(), &self.blocks, &self.demands);
            selection.unexplained = Some(found);
            selection.selected.clear();
        } else {
            selection.laws.push(candidates[trial.candidate]);
            selection.selected.push(self.selected(trials, choice));
        }
    }

    /// Gains of the selecting frames by a sum of laws over another one, each of any form, fitted on other blocks.
    fn gains_over(&self, laws: &[Law], others: &[Law]) -> Vec<f64> {
        let kept = |table: &LossTable, laws: &[Law]| {
            let laws = refit(table, laws);
            table.kept_by_forms(&laws, &laws)
        };
        let kept: Vec<[Vec<f64>; 2]> = self.without_fold.iter().map(|t| [laws, others].map(|l| kept(t, l))).collect();
        self.gains(|fold| [&kept[fold][0], &kept[fold][1]])
    }

    /// Gains of the selecting frames by the first of two shares that are kept in each cell, fitted without a fold.
    fn gains<'k>(&self, kept: impl Fn(usize) -> [&'k Vec<f64>; 2]) -> Vec<f64> {
        let gain = |(&i, &fold): (&usize, &usize)| {
            let [by_laws, before] = kept(fold);
            self.without_fold[fold].gain_of_shares(&self.hits[i], by_laws, before)
        };
        self.select.iter().zip(&self.folds).map(gain).collect()
    }

    /// Chooses each law anew beside the others; one that brings too little there is dropped.
    fn choose_anew(&self, selection: &mut Selection) {
        let mut k = 0;
        while k < selection.laws.len() {
            let beside = [&selection.laws[..k], &selection.laws[k + 1..]].concat();
            let candidates = others(&beside);
            let trials = self.law_trials(&candidates, &beside);
            match choose(&trials, &self.demands) {
                Some(choice) => {
                    selection.laws[k] = candidates[trials[choice.chosen].candidate];
                    selection.selected[k] = self.selected(&trials, &choice);
                    k += 1;
                }
                None => {
                    selection.laws.remove(k);
                    selection.selected.remove(k);
                }
            }
        }
    }

    fn choose(&self, trials: &[Trial], considered: &mut Vec<Considered>) -> Option<Choice> {
        let choice = choose(trials, &self.demands);
        let returns = self.context.returns(&self.select);
        considered.extend(record(trials, choice.as_ref(), Channel::Hits, returns, &self.demands));
        choice
    }

    /// What is said of a chosen law.
    fn selected(&self, trials: &[Trial], choice: &Choice) -> Selected {
        let mut equals = causes_of(trials, &choice.equals);
        equals.retain(|c| *c != Cause::Unexplained);
        rivals_and_confidence(equals, trials, &self.blocks, trials[choice.chosen].cause, &self.demands)
    }

    /// A trial of each law beside any form of the chosen ones.
    fn law_trials(&self, candidates: &[Law], chosen: &[Law]) -> Vec<Trial> {
        let tables = &self.without_fold;
        let before: Vec<Vec<FittedLaw>> = tables.iter().map(|t| refit(t, chosen)).collect();
        let before_on_all = refit(&self.table, chosen);
        let kept_before: Vec<Vec<f64>> = tables.iter().zip(&before).map(|(t, b)| t.kept_by_forms(b, b)).collect();
        let trial = |(k, &law): (usize, &Law)| {
            let kept = |(table, before): (&LossTable, &Vec<FittedLaw>)| {
                let laws = table.fit(before, law);
                table.kept_by_forms(&laws, &laws[..chosen.len()])
            };
            let kept: Vec<Vec<f64>> = tables.iter().zip(&before).map(kept).collect();
            let gains = self.gains(|fold| [&kept[fold], &kept_before[fold]]);
            let whole = self.table.fit(&before_on_all, law);
            let above_floor = self.above_floor(&self.table, &whole, &before_on_all);
            let trial = Trial {
                candidate: k,
                cause: law.cause(),
                parameters: law.parameters(),
                gains,
                expected: vec![],
                above_floor,
            };
            let confined = (law == Law::Signal).then(|| self.table.confined_to(&whole[whole.len() - 1..]));
            (trial, confined.flatten())
        };
        let (mut trials, confined): (Vec<Trial>, Vec<Option<usize>>) =
            candidates.par_iter().enumerate().map(trial).unzip();
        // A signal law whose losses are confined to one kind of surface is a material.
        for (k, zone) in confined.into_iter().enumerate().filter_map(|(k, zone)| Some((k, zone?))) {
            let total = |k: usize| total_and_z(&trials[k].gains).0;
            let of_zone = candidates.iter().position(|l| *l == Law::Zone(zone));
            let material = of_zone.is_some_and(|z| trials[z].above_floor && total(z) > MATERIAL_SHARE * total(k));
            trials[k].above_floor &= !material;
        }
        trials
    }

    /// Trials of tables by row and by azimuth on top of the chosen laws.
    fn direction_trials(&self, chosen: &[Law]) -> Vec<Trial> {
        let laws = refit(&self.table, chosen);
        let how = GroupFit { centred: !chosen.is_empty(), ..GROUPED };
        let groups = |grouping| self.loss_groups(grouping, &self.table, &laws);
        direction_trials(&self.select, &self.blocks, LAWS.len(), how, [LOST_SPREAD; 2], groups)
    }
}

/// Trials of the laws that a sum may begin with in place of the chosen one: a random loss that explains much of it, as
/// a law can lose nearly the same everywhere, and beside a sum of several `laws` what explains nearly as much.
fn other_starts(first: &[Trial], chosen: usize, laws: usize) -> Vec<usize> {
    let gain = |t: &Trial| total_and_z(&t.gains).0;
    let most = gain(&first[chosen]);
    let may = |t: &Trial| match t.cause {
        Cause::Unexplained => false,
        Cause::RandomDropout => gain(t) > MOSTLY_RANDOM * most,
        _ => laws > 1 && gain(t) > NEARLY_ALL * most,
    };
    (0..first.len()).filter(|&k| k != chosen && first[k].above_floor && may(&first[k])).collect()
}

/// All laws but some.
fn others(laws: &[Law]) -> Vec<Law> {
    LAWS.into_iter().filter(|l| !laws.contains(l)).collect()
}
