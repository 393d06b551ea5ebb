//! Lost returns: which simulated returns have no measured counterpart, and on what that depends.

mod as_effects;
mod by_table;
mod describe;
mod form;
mod select;

pub use self::by_table::{by_cell, by_table};

use self::describe::found;
use self::form::Corrections;
use self::select::Selection;
use super::unexplained::{Unexplained, mean_by_group};
use super::{ChannelResult, Context, Found, Z_STAR, first_demands, trimmed};
use crate::catalogue::sizes::{LOST_OF_KIND, LOST_SHARE};
use crate::catalogue::{Cause, Channel, Quantity};
use crate::channels::cells::{OBJECT, cell};
use crate::channels::groups::{Group, Grouping, PartedFrame, total as group_total};
use crate::channels::hits::{HitFrame, hit_frames, loss_groups, total};
use crate::channels::mask::Mask;
use crate::channels::together::{BesideLost, beside_lost};
use crate::diagnosis::Minimum;
use crate::inference::choice::{Demands, total_and_z};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::law::{FittedLaw, Law};
use crate::inference::linear::{FOLDS, fold_of};
use crate::inference::losses::LossTable;
use crate::inference::roles::Role;
use crate::pairing::Ray;
use rayon::prelude::*;
use statistics::{blocks_of, draw_blocks};
use std::collections::BTreeMap;

/// Share of its gain by which a richer law must exceed the simpler one to be reported beside it: the form of a law is
/// never exactly that of the sensor.
const RICHER_SHARE: f64 = 0.01;

/// Share of the returns of some part of a scene that may be lost where the scene is displaced as a whole: silhouettes
/// do not match.
pub(super) const LOST_DISPLACED: f64 = 0.1;

/// Bootstrap repetitions of the fits.
const REFITS: usize = 40;

/// Fit of the shares lost by groups of directions: prior standard deviation of a fifth.
const GROUPED: GroupFit = GroupFit { column: 0, precision: 25.0, centred: false, trust: 1.0 };

/// Share of the lost shots from which on more of those in the same column are lost as well than of those beside them in
/// the row: losses by chance are no columns.
const IN_COLUMNS: f64 = 0.1;

/// The search. Rays that the mask hides are left out. `displaced` says that the measured scene is turned or moved as
/// a whole: silhouettes do not match, and small losses are an effect of that.
pub fn search(context: &Context, mask: &Mask, displaced: bool) -> ChannelResult {
    let search = Search::new(context, mask, displaced);
    let mut result = ChannelResult::new(Channel::Hits, search.hold_out.len());
    let selection = search.select(&mut result);
    result.minimum.push((Cause::RandomDropout, search.minimum()));
    search.report(selection, &mut result);
    result
}

/// Counts of all frames, and the frames by role.
struct Search<'a> {
    context: &'a Context<'a>,
    mask: &'a Mask,
    /// 1 where the scene is displaced as a whole, else 0.
    displaced: f64,
    hits: Vec<HitFrame>,
    select: Vec<usize>,
    estimate: Vec<usize>,
    hold_out: Vec<usize>,
    /// Blocks and folds of the selecting frames.
    blocks: Vec<usize>,
    folds: Vec<usize>,
    /// Counts of the selecting frames: of all, and without those of each fold.
    table: LossTable,
    without_fold: Vec<LossTable>,
    demands: Demands,
}

impl<'a> Search<'a> {
    fn new(context: &'a Context<'a>, mask: &'a Mask, displaced: bool) -> Self {
        let hits = hit_frames(context.frames, mask);
        let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
        let blocks = context.blocks(&select);
        let folds = fold_of(&blocks);
        let without = |fold: usize| {
            let train: Vec<usize> = select.iter().zip(&folds).filter(|(_, f)| **f != fold).map(|(i, _)| *i).collect();
            table(&hits, &train)
        };
        Search {
            context,
            mask,
            displaced: f64::from(u8::from(displaced)),
            table: table(&hits, &select),
            without_fold: (0..FOLDS).map(without).collect(),
            blocks,
            folds,
            hits,
            select,
            estimate,
            hold_out,
            demands: Demands { richer: RICHER_SHARE, ..first_demands() },
        }
    }

    /// Whether the last of some laws loses enough to be reported. A second law must lose more than a correction of
    /// the form of the first, and more than moving losses from the others to itself: `alone` are the others fitted
    /// without it.
    fn above_floor(&self, table: &LossTable, laws: &[FittedLaw], alone: &[FittedLaw]) -> bool {
        let Some((last, before)) = laws.split_last() else { return false };
        let joins = f64::from(u8::from(before.iter().any(|l| l.law.has_form())));
        // What loses less than the laws before it say only corrects their form.
        let own = if before.is_empty() { last.numbers[0].abs() } else { last.numbers[0] };
        // What the simulation loses beyond the measured side is no more than what only the measured side has.
        let most = |zone: Option<usize>| if last.numbers[0] < 0.0 { table.only_measured(zone) } else { f64::INFINITY };
        match last.law {
            Law::Zone(zone) => {
                // The angle of incidence is not known on curved bodies: whatever it is, a material loses.
                let on_round = if joins > 0.0 && zone >= OBJECT { lost_on_round(table, laws) } else { own };
                let lost = own.min(on_round).min(most(Some(zone)));
                lost > LOST_OF_KIND + 0.07 * joins + LOST_DISPLACED * self.displaced
            }
            Law::Random => own.min(most(None)) > LOST_SHARE + 0.02 * joins + 0.01 * self.displaced,
            _ => {
                let lost = (table.lost(laws) - table.lost(before)).abs();
                lost.min(table.changed(laws, alone)) > LOST_SHARE + 0.005 * joins + 0.01 * self.displaced
            }
        }
    }

    fn loss_groups(&self, grouping: Grouping, table: &LossTable, laws: &[FittedLaw]) -> Vec<PartedFrame> {
        loss_groups(self.context.frames, self.context.rig, self.mask, grouping, &|c| table.kept(laws, c))
    }

    /// The smallest share of lost returns that would be detected.
    fn minimum(&self) -> Minimum {
        let cells = || self.select.iter().flat_map(|&i| &self.hits[i]).map(|(_, c)| c);
        let mismatches: f64 = cells().map(|c| c.simulated.n - c.matched + c.measured.n - c.matched).sum();
        let simulated: f64 = cells().map(|c| c.simulated.n).sum();
        Minimum::new(Quantity::Share, (Z_STAR * mismatches.max(1.0).sqrt() / simulated.max(1.0)).max(LOST_SHARE))
    }

    /// Those of the chosen laws that lose enough on the estimating frames as well.
    fn large_enough(&self, mut selection: Selection, on_estimate: &LossTable) -> Selection {
        // Of the first laws, from none to all.
        let mut fits = vec![vec![]];
        for &law in &selection.laws {
            fits.push(on_estimate.fit(&fits[fits.len() - 1], law));
        }
        let fitted = &fits[selection.laws.len()];
        let large = (1..=fitted.len()).map(|n| self.above_floor(on_estimate, &fitted[..n], &fits[n - 1]));
        let large: Vec<bool> = large.collect();
        // Below a table by direction laws are forms, whatever they lose.
        if selection.unexplained.is_none() {
            let mut of_laws = large.iter();
            selection.laws.retain(|_| of_laws.next() == Some(&true));
            let mut of_selected = large.iter();
            selection.selected.retain(|_| of_selected.next() == Some(&true));
        }
        selection
    }

    /// Fits what was chosen on the estimating frames and measures it on the held-out ones.
    fn report(&self, selection: Selection, result: &mut ChannelResult) {
        let on_estimate = table(&self.hits, &self.estimate);
        let selection = self.large_enough(selection, &on_estimate);
        let fitted = refit(&on_estimate, &selection.laws);
        let repeated = self.bootstrap(&selection.laws);
        let on_hold_out = table(&self.hits, &self.hold_out);
        for (k, selected) in selection.selected.into_iter().enumerate() {
            let others = fitted.iter().enumerate().filter(|(i, _)| *i != k);
            let without: Vec<FittedLaw> = others.map(|(_, l)| *l).collect();
            let gain = |&i: &usize| on_hold_out.gain(&self.hits[i], &fitted, &without);
            let gains = self.hold_out.iter().map(gain).collect();
            let draws: Vec<FittedLaw> = repeated.iter().map(|r| r[k]).collect();
            // The form is corrected once: with the first law over a covariate.
            let first = fitted.iter().position(|l| l.law.has_form()) == Some(k);
            let corrections = if first { self.corrections(k, &fitted, &on_estimate) } else { Corrections::default() };
            let mut found = found(&fitted[k], &draws, selected, gains, &on_hold_out, (&fitted, corrections));
            if fitted[k].law == Law::Random && self.lose_columns() {
                describe::of_columns(&mut found);
            }
            result.found.push(found);
        }
        let shares = on_estimate.matched_shares(&fitted);
        let distance = |&i: &usize| {
            let frame = &self.hits[i];
            [
                on_hold_out.distance(frame),
                on_hold_out.gain(frame, &fitted, &[]),
                on_hold_out.gain_by_table(frame, &shares),
            ]
        };
        result.distance = self.hold_out.iter().map(distance).collect();
        if let Some((grouping, confidence)) = selection.unexplained {
            let mut found = self.unexplained(grouping, confidence, &on_estimate, &fitted);
            for (d, g) in result.distance.iter_mut().zip(&found.held_out_gains) {
                d[1] += g;
                d[2] += g.max(0.0);
            }
            // The laws below the table are a part of it: their causes are not named.
            for (g, &i) in found.held_out_gains.iter_mut().zip(&self.hold_out) {
                *g += on_hold_out.gain(&self.hits[i], &fitted, &[]);
            }
            result.found.push(found);
        }
    }

    /// Whether the shots of a column are lost together in the estimating frames: what is lost by chance is lost shot by
    /// shot.
    fn lose_columns(&self) -> bool {
        let each = beside_lost(self.context.frames, &self.estimate, self.mask);
        let sum = |of: fn(&BesideLost) -> [f64; 2]| {
            each.iter().map(of).fold([0.0; 2], |sum, of| [sum[0] + of[0], sum[1] + of[1]])
        };
        let share = |[all, lost]: [f64; 2]| lost / all.max(1.0);
        let in_rows = share(sum(|b| b.in_row));
        let more: Vec<f64> = each.iter().map(|b| b.in_column[1] - in_rows * b.in_column[0]).collect();
        share(sum(|b| b.in_column)) - in_rows > IN_COLUMNS && total_and_z(&more).1 > Z_STAR
    }

    /// Fits of the laws on estimating frames whose blocks are drawn with replacement.
    fn bootstrap(&self, laws: &[Law]) -> Vec<Vec<FittedLaw>> {
        if laws.is_empty() {
            return vec![];
        }
        let members = blocks_of(&self.context.blocks(&self.estimate));
        let repeat = |r: usize| {
            let drawn = draw_blocks(&members, &mut data::stream(0, "diagnose losses", 0, r as u64));
            let frames: Vec<usize> = drawn.iter().map(|&i| self.estimate[i]).collect();
            refit(&table(&self.hits, &frames), laws)
        };
        (0..REFITS).into_par_iter().map(repeat).collect()
    }

    /// The finding of losses that depend on row or azimuth.
    fn unexplained(&self, grouping: Grouping, confidence: f64, table: &LossTable, laws: &[FittedLaw]) -> Found {
        let groups = self.loss_groups(grouping, table, laws);
        let kept = |ray: &Ray| cell(ray).filter(|_| !self.mask.hides(ray)).map(|c| table.kept(laws, c));
        let rays = self.estimate.iter().flat_map(|&i| &self.context.frames[i].simulated);
        let shares: BTreeMap<Group, f64> = mean_by_group(rays, grouping, kept);
        let all = group_total(self.estimate.iter().flat_map(|&i| &groups[i]));
        let (spread, _) = grouped::spread(&all, GROUPED, trimmed(grouping));
        let unexplained = Unexplained {
            channel: Channel::Hits,
            grouping,
            confidence,
            parameters: vec![],
            says: format!(
                "the share of lost returns depends on the {}, by {:.1} % from one to the next; no cause of the catalogue does that",
                grouping.name(),
                100.0 * spread
            ),
            y: "share of simulated returns that are measured",
        };
        unexplained.found(&all, GROUPED, self.hold_out.iter().map(|&i| &groups[i]), |group, lost, std| {
            [shares.get(&group).copied().unwrap_or(1.0) - lost, std]
        })
    }
}

/// Counts over some frames.
fn table(hits: &[HitFrame], frames: &[usize]) -> LossTable {
    LossTable::new(total(frames.iter().map(|&i| &hits[i])))
}

/// Share that the last of some laws loses where objects are met at all cosines of incidence alike.
fn lost_on_round(table: &LossTable, laws: &[FittedLaw]) -> f64 {
    let laws: Vec<Law> = laws.iter().map(|l| l.law).collect();
    refit(&table.of_round_objects(), &laws).last().map_or(0.0, |l| l.numbers[0])
}

/// Fits laws one on top of the other.
pub(super) fn refit(table: &LossTable, laws: &[Law]) -> Vec<FittedLaw> {
    laws.iter().fold(Vec::new(), |before, &law| table.fit(&before, law))
}
