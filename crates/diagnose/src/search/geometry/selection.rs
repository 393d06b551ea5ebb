//! Which hypotheses are chosen: one after the other, then each anew beside the others, and of these those that hold
//! once their displacement is undone.

use super::floor::{above_floor, sizable};
use super::hypotheses::{Hypothesis, hypotheses, is_pose, may_join};
use super::rows::drop_less_certain_rows;
use super::{Chosen, Search, directions};
use crate::catalogue::Cause;
use crate::channels::mean::Column;
use crate::inference::choice::{Choice, Trial, choose, total_and_z};
use crate::search::{ChannelResult, Selected, causes_of, record, rivals_and_confidence};
use rayon::prelude::*;

/// Share of the gain of the last hypothesis that a second pose must bring.
const SECOND_POSE_SHARE: f64 = 0.3;

/// Most rounds in which hypotheses are chosen anew beside the others.
const ROUNDS: usize = 3;

/// Share of the gain of the last hypothesis that a further one must bring.
const FURTHER_SHARE: f64 = 0.02;

/// All but one of the chosen hypotheses.
fn without(chosen: &[Hypothesis], k: usize) -> Vec<Hypothesis> {
    chosen.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, hypothesis)| hypothesis.clone()).collect()
}

impl Search<'_> {
    /// Forward selection, until no hypothesis brings what is demanded.
    pub(super) fn select(&self, result: &mut ChannelResult) -> Chosen {
        let mut chosen = Chosen::default();
        self.select_beside(&mut chosen, result);
        chosen
    }

    /// The same beside hypotheses that were chosen before, of which the displacement is undone: what differs from frame
    /// to frame has only to bring what any effect has to, however large the others are. Errors of what was undone are
    /// the same in all frames, and may look like anything that is.
    pub(super) fn select_beside(&self, (chosen, selected): &mut Chosen, result: &mut ChannelResult) {
        let mut all = hypotheses(self.context, &self.sums.columns, self.is_moved_back);
        let beside = !chosen.is_empty();
        if beside {
            let varies = |&column: &usize| matches!(self.sums.columns[column], Column::Lean | Column::Drift(_));
            all.retain(|h| !h.columns().is_empty() && h.columns().iter().all(varies));
        }
        let mut last_gains: Vec<f64> = Vec::new();
        for _ in 0..all.len() {
            let candidates: Vec<&Hypothesis> = all.iter().filter(|h| may_join(h, chosen)).collect();
            let mut trials = self.trials(&candidates, chosen, &last_gains);
            drop_less_certain_rows(&mut trials, &candidates);
            drop_remainders(&mut trials, &last_gains);
            let (choice, refused) = self.choose(&mut trials, &candidates, chosen);
            let mut considered = record(&trials, choice.as_ref(), result.channel, self.returns, &self.demands);
            for k in refused {
                considered[k].outcome = "surfaces in other directions do not say so".into();
            }
            result.considered.extend(considered);
            let Some(choice) = choice else { break };
            let trial = &trials[choice.chosen];
            if !beside {
                last_gains.clone_from(&trial.gains);
            }
            let equals = causes_of(&trials, &choice.equals);
            let rivals = rivals_and_confidence(equals, &trials, &self.blocks, trial.cause, &self.demands);
            selected.push(self.that_vary(candidates[trial.candidate], rivals));
            chosen.push(candidates[trial.candidate].clone());
        }
        self.choose_anew(&all, chosen, selected);
        // What is there as well is no rival.
        let is_chosen = |cause: &Cause| chosen.iter().any(|h| h.cause() == *cause);
        selected.iter_mut().for_each(|s| s.rivals.retain(|r| !is_chosen(r)));
    }

    /// Chooses every hypothesis anew beside the others, as long as that changes one: the first one was chosen alone,
    /// and may have taken for its own what later ones explain.
    fn choose_anew(&self, all: &[Hypothesis], chosen: &mut [Hypothesis], selected: &mut [Selected]) {
        if chosen.len() < 2 {
            return;
        }
        for _ in 0..ROUNDS {
            let mut changed = false;
            for k in 0..chosen.len() {
                if !all.contains(&chosen[k]) {
                    continue;
                }
                let others = without(chosen, k);
                let one_pose =
                    |h: &Hypothesis| !is_pose(h) || h.cause() == chosen[k].cause() || !others.iter().any(is_pose);
                let candidates: Vec<&Hypothesis> = all.iter().filter(|h| may_join(h, &others) && one_pose(h)).collect();
                let mut trials = self.trials(&candidates, &others, &[]);
                drop_less_certain_rows(&mut trials, &candidates);
                let (Some(choice), _) = self.choose(&mut trials, &candidates, &others) else { continue };
                let trial = &trials[choice.chosen];
                let rivals = causes_of(&trials, &choice.equals);
                let anew = candidates[trial.candidate];
                let rivals = rivals_and_confidence(rivals, &trials, &self.blocks, trial.cause, &self.demands);
                selected[k] = self.that_vary(anew, rivals);
                changed |= *anew != chosen[k];
                chosen[k] = anew.clone();
            }
            if !changed {
                return;
            }
        }
    }

    /// Chooses one of the trials that surfaces in all directions agree on, and the places of those that were refused.
    fn choose(
        &self,
        trials: &mut [Trial],
        candidates: &[&Hypothesis],
        chosen: &[Hypothesis],
    ) -> (Option<Choice>, Vec<usize>) {
        let mut refused = Vec::new();
        while let Some(choice) = choose(trials, &self.demands) {
            let hypothesis = candidates[trials[choice.chosen].candidate];
            let with: Vec<Hypothesis> = chosen.iter().chain([hypothesis]).cloned().collect();
            if directions::agree(&self.paired(), &self.sums, &self.select, &self.blocks, &with) {
                return (Some(choice), refused);
            }
            trials[choice.chosen].above_floor = false;
            refused.push(choice.chosen);
        }
        (None, refused)
    }

    /// The rivals of a hypothesis. Offsets of rows are the same at all speeds: they are none of what grows with the
    /// speed.
    fn that_vary(&self, hypothesis: &Hypothesis, mut selected: Selected) -> Selected {
        if hypothesis.columns().iter().any(|&c| self.sums.columns[c] == Column::Lean) {
            selected.rivals.retain(|r| !matches!(r, Cause::BeamRangeOffset | Cause::BeamElevationOffset));
        }
        selected
    }

    /// A trial of each candidate on top of what is chosen.
    fn trials(&self, candidates: &[&Hypothesis], chosen: &[Hypothesis], last_gains: &[f64]) -> Vec<Trial> {
        let before = self.gains(chosen);
        let trial = |(k, hypothesis): (usize, &&Hypothesis)| {
            let with: Vec<Hypothesis> = chosen.iter().cloned().chain([(*hypothesis).clone()]).collect();
            let mut gains = self.gains(&with);
            gains.iter_mut().zip(&before).for_each(|(g, b)| *g -= b);
            let second_pose = is_pose(hypothesis) && chosen.iter().any(is_pose);
            let enough = !second_pose || total_and_z(&gains).0 > SECOND_POSE_SHARE * last_gains.iter().sum::<f64>();
            Trial {
                candidate: k,
                cause: hypothesis.cause(),
                parameters: hypothesis.parameters(),
                gains,
                expected: self.sums.expected(&self.select, &self.blocks, [chosen, &with]),
                above_floor: enough && above_floor(&self.sums, &self.select, &self.blocks, &with),
            }
        };
        candidates.par_iter().enumerate().map(trial).collect()
    }

    /// Those of the chosen hypotheses that gain what is demanded beside the others once their displacement is undone: a
    /// small one may have made up for what is not linear of a large one.
    pub(super) fn still_significant(&self, (mut chosen, mut selected): Chosen) -> Chosen {
        while chosen.len() > 1 {
            let whole = self.gains(&chosen);
            let total_and_z = |k: usize| {
                let others = without(&chosen, k);
                let gains: Vec<f64> = whole.iter().zip(self.gains(&others)).map(|(all, rest)| all - rest).collect();
                let with = [&others[..], &chosen[k..=k]].concat();
                let expected = self.sums.expected(&self.select, &self.blocks, [&others, &with]);
                Trial { candidate: k, cause: chosen[k].cause(), parameters: 0, gains, expected, above_floor: true }
                    .total_and_z()
            };
            let all: Vec<(f64, f64)> = (0..chosen.len()).map(total_and_z).collect();
            let fails = |k: &usize| all[*k].0 <= self.demands.nats || all[*k].1 <= self.demands.z;
            let Some(least) = (0..chosen.len()).filter(fails).min_by(|a, b| all[*a].0.total_cmp(&all[*b].0)) else {
                break;
            };
            chosen.remove(least);
            selected.remove(least);
        }
        (chosen, selected)
    }

    /// Those of the chosen hypotheses whose effect exceeds the floor on the estimating frames as well.
    pub(super) fn large_enough(&self, (chosen, selected): Chosen) -> Chosen {
        let mut large: Chosen = (Vec::new(), Vec::new());
        for ((k, hypothesis), mut selected) in chosen.iter().enumerate().zip(selected) {
            let last = [without(&chosen, k), vec![hypothesis.clone()]].concat();
            if !above_floor(&self.sums, &self.estimate, &self.estimate_blocks, &last) {
                continue;
            }
            // At one speed a constant pitch and one that grows with the speed are the same.
            let one_speed = self.sums.moments.drives && !self.sums.moments.speed_varies;
            if is_pose(hypothesis)
                && one_speed
                && sizable(&self.sums, &self.estimate, &self.estimate_blocks, &last) == [Column::Pose(1)]
            {
                selected.rivals.push(Cause::EgoAttitude);
            }
            large.0.push(hypothesis.clone());
            large.1.push(selected);
        }
        large
    }
}

/// Drops trials of a further step that only fit what the last one left.
fn drop_remainders(trials: &mut [Trial], last_gains: &[f64]) {
    let last: f64 = last_gains.iter().sum();
    trials.iter_mut().for_each(|t| t.above_floor &= t.gains.iter().sum::<f64>() > FURTHER_SHARE * last);
}
