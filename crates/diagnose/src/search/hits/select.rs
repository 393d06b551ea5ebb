//! Which laws lose returns: a sum of laws, each chosen beside any form of the others.

use super::{GROUP_FLOOR, GROUPED, Search, refit, table};
use crate::catalogue::{Cause, Channel};
use crate::channels::groups::{Grouping, total as group_total};
use crate::diagnosis::Considered;
use crate::inference::choice::{Choice, Trial, choose, total_and_z};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::law::{FittedLaw, LAWS, Law};
use crate::inference::linear::FOLDS;
use crate::inference::losses::LossTable;
use crate::search::{
    ChannelResult, Selected, UNEXPLAINED_SHARE, causes_of, confidence, record, rivals_and_confidence, trimmed,
};
use rayon::prelude::*;

/// Share of the gain of the first law from which on a random loss is tried in its place.
const MOSTLY_RANDOM: f64 = 0.5;

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
    /// Selection of a sum of laws. Where a random loss explains most of what the first law does, the sum that begins
    /// with it is tried as well: a law can lose nearly the same everywhere. The sum with fewer parameters is taken
    /// unless the other one gains more, significantly.
    pub(super) fn select(&self, result: &mut ChannelResult) -> Selection {
        let first = self.trials(&[], 0.0);
        let Some(choice) = self.choose(&first, &mut result.considered) else { return Selection::default() };
        let gain = |t: &Trial| total_and_z(&t.gains).0;
        let chosen = gain(&first[choice.chosen]);
        let one = self.grow(&first, &choice, &mut result.considered);
        let random = first.iter().position(|t| t.cause == Cause::RandomDropout && t.above_floor);
        let other = random.filter(|&r| r != choice.chosen && gain(&first[r]) > MOSTLY_RANDOM * chosen);
        let Some(random) = other.filter(|_| one.unexplained.is_none()) else { return one };
        let mut considered = vec![];
        let two = self.grow(&first, &Choice { chosen: random, equals: vec![] }, &mut considered);
        if two.laws.len() < 2 || two.unexplained.is_some() {
            return one;
        }
        let parameters = |s: &Selection| s.laws.iter().map(|l| l.parameters()).sum::<usize>();
        let [of_one, of_two] = [&one, &two].map(|s| self.gains_of(&s.laws));
        let (ahead, z) = total_and_z(&of_two.iter().zip(&of_one).map(|(b, a)| b - a).collect::<Vec<f64>>());
        let better =
            if parameters(&two) <= parameters(&one) { ahead > 0.0 || z > -2.0 } else { ahead > 0.0 && z > 2.0 };
        if !better {
            return one;
        }
        result.considered.extend(considered);
        two
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
            let grouping = if trial.candidate == LAWS.len() { Grouping::Row } else { Grouping::Azimuth };
            let confidence = confidence(trials, &self.blocks, Cause::Unexplained, &self.demands);
            selection.unexplained = Some((grouping, confidence));
            selection.selected.clear();
        } else {
            selection.laws.push(candidates[trial.candidate]);
            selection.selected.push(self.selected(trials, choice));
        }
    }

    /// Gains of the selecting frames by a sum of laws of any form, fitted on other blocks.
    fn gains_of(&self, laws: &[Law]) -> Vec<f64> {
        let tables = self.tables();
        let kept = |table: &LossTable| {
            let laws = refit(table, laws);
            [table.kept_by_forms(&laws, &laws), table.kept_by_forms(&[], &[])]
        };
        let kept: Vec<[Vec<f64>; 2]> = tables.iter().map(kept).collect();
        let gain = |(&i, &fold): (&usize, &usize)| {
            let [by_laws, without] = &kept[fold];
            tables[fold].gain_of_shares(&self.hits[i], by_laws, without)
        };
        self.select.iter().zip(&self.folds).map(gain).collect()
    }

    /// Counts of the selecting frames without those of each fold.
    fn tables(&self) -> Vec<LossTable> {
        let train = |fold: usize| -> Vec<usize> {
            (0..self.select.len()).filter(|&i| self.folds[i] != fold).map(|i| self.select[i]).collect()
        };
        (0..FOLDS).map(|fold| table(&self.hits, &train(fold))).collect()
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
        let tables = self.tables();
        let before: Vec<Vec<FittedLaw>> = tables.iter().map(|t| refit(t, chosen)).collect();
        let kept_before: Vec<Vec<f64>> = (0..FOLDS).map(|f| tables[f].kept_by_forms(&before[f], &before[f])).collect();
        let trial = |(k, &law): (usize, &Law)| {
            let kept = |fold: usize| {
                let laws = tables[fold].fit(&before[fold], law);
                tables[fold].kept_by_forms(&laws, &laws[..chosen.len()])
            };
            let kept: Vec<Vec<f64>> = (0..FOLDS).map(kept).collect();
            let gain = |i: usize| {
                let fold = self.folds[i];
                tables[fold].gain_of_shares(&self.hits[self.select[i]], &kept[fold], &kept_before[fold])
            };
            let gains = (0..self.select.len()).map(gain).collect();
            let whole = self.table.fit(&refit(&self.table, chosen), law);
            let above_floor = self.above_floor(&self.table, &whole);
            let trial = Trial { candidate: k, cause: law.cause(), parameters: law.parameters(), gains, above_floor };
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

    /// Trials of tables by row and by azimuth on top of the chosen laws: no cause of the catalogue.
    fn direction_trials(&self, chosen: &[Law]) -> Vec<Trial> {
        let laws = refit(&self.table, chosen);
        let trial = |grouping: Grouping| {
            let groups = self.loss_groups(grouping, &self.table, &laws);
            let how = GroupFit { centred: !chosen.is_empty(), ..GROUPED };
            let all = group_total(self.select.iter().flat_map(|&i| &groups[i]));
            let (spread, _) = grouped::spread(&all, how, trimmed(grouping));
            Trial {
                candidate: LAWS.len() + grouping as usize,
                cause: Cause::Unexplained,
                parameters: 12,
                gains: grouped::cross_part_gains(&groups, &self.select, &self.blocks, how, false),
                above_floor: spread > GROUP_FLOOR,
            }
        };
        [Grouping::Row, Grouping::Azimuth].map(trial).into()
    }
}

/// All laws but some.
fn others(laws: &[Law]) -> Vec<Law> {
    LAWS.into_iter().filter(|l| !laws.contains(l)).collect()
}
