//! Lost returns: which simulated returns has the measured side not, and on what does it depend?

mod words;

use self::words::found;
use super::unnamed::{Unnamed, mean_by_group, word};
use super::{ChannelResult, Context, Found, Z_STAR, confidence, first_demands, record, trimmed, unless_unsure};
use crate::channels::cells::cell;
use crate::channels::groups::{Grouping, PartedFrame, total as group_total};
use crate::channels::hits::{hit_frames, loss_groups, total};
use crate::channels::mask::Mask;
use crate::diagnosis::Minimum;
use crate::inference::choice::{Demands, Trial, UNNAMED, choose, total_and_z};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::law::{FittedLaw, LAWS, Law};
use crate::inference::linear::{FOLDS, fold_of};
use crate::inference::losses::LossTable;
use crate::inference::roles::Role;
use crate::pairing::Ray;
use rayon::prelude::*;
use statistics::{blocks_of, draw_blocks};

/// Smaller shares of lost returns are not spoken of.
const FLOOR: f64 = 0.005;

/// Of one kind of surface, this share of its own returns.
const ZONE_FLOOR: f64 = 0.03;

/// A share lost on one kind of surface that gains this share of a law of the signal is the material's.
const A_MATERIAL: f64 = 0.75;

/// What a second law brings at least, and what a table of directions: as shares of what the first law brings.
const JOINING_SHARE: f64 = 0.04;
const UNNAMED_SHARE: f64 = 0.02;

/// Repetitions of the bootstrap of fits.
const REFITS: usize = 40;

/// Spread of the share lost from group to group of directions below which nothing is said.
const GROUP_FLOOR: f64 = 0.02;

/// The search, beside what hides rays altogether. `displaced` tells that the measured scene is turned or moved as a whole: silhouettes do not fit any more, and small losses are theirs.
pub fn search(context: &Context, mask: &Mask, displaced: bool) -> ChannelResult {
    let displaced = f64::from(u8::from(displaced));
    let hits = hit_frames(context.frames, mask);
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let of = |frames: &[usize]| LossTable::new(total(frames.iter().map(|&i| &hits[i])));
    let blocks = context.blocks(&select);
    let folds = fold_of(&blocks);
    let returns = context.returns(&select);
    let table = of(&select);
    // The form of a law is never quite that of the sensor.
    let demands = Demands { told: 0.01, ..first_demands() };
    let mut result = ChannelResult::default();
    let mut chosen: Vec<Law> = Vec::new();
    let mut stories = Vec::new();
    let mut unnamed = None;
    let mut first_gain = 0.0f64;
    // One law, then at most one more of another kind.
    for step in 0..2 {
        let tables: Vec<LossTable> = (0..FOLDS)
            .map(|fold| of(&(0..select.len()).filter(|&i| folds[i] != fold).map(|i| select[i]).collect::<Vec<_>>()))
            .collect();
        let before: Vec<Vec<FittedLaw>> = tables.iter().map(|t| refit(t, &chosen)).collect();
        let candidates: Vec<Law> = LAWS.into_iter().filter(|l| step == 0 || may_join(*l, &chosen)).collect();
        let (mut trials, confined): (Vec<Trial>, Vec<Option<usize>>) = candidates
            .par_iter()
            .enumerate()
            .map(|(k, &law)| {
                let fits: Vec<Vec<FittedLaw>> = (0..FOLDS).map(|f| tables[f].fit(&before[f], law)).collect();
                let gains = (0..select.len())
                    .map(|i| tables[folds[i]].gain(&hits[select[i]], &fits[folds[i]], &before[folds[i]]))
                    .collect();
                let whole = table.fit(&refit(&table, &chosen), law);
                let lost = table.lost(&whole) - table.lost(&whole[..whole.len() - 1]);
                let own = whole.last().map_or(0.0, |l| l.numbers[0].abs());
                // On top of another law a small share only mends the form of that.
                let joins = f64::from(u8::from(step > 0));
                let above_floor = match law {
                    Law::Zone(_) => own > ZONE_FLOOR + 0.07 * joins + 0.1 * displaced,
                    Law::Random => own > FLOOR + 0.02 * joins + 0.01 * displaced,
                    _ => lost.abs() > FLOOR + 0.005 * joins + 0.01 * displaced,
                };
                let trial =
                    Trial { candidate: k, name: law.name().into(), parameters: law.parameters(), gains, above_floor };
                (trial, if law == Law::Signal { table.confined_to(&whole[whole.len() - 1..]) } else { None })
            })
            .unzip();
        // A signal that falls on one kind of surface alone is a material.
        for (k, zone) in confined.into_iter().enumerate().filter_map(|(k, zone)| Some((k, zone?))) {
            let total = |k: usize| total_and_z(&trials[k].gains).0;
            let of_zone = candidates.iter().position(|l| *l == Law::Zone(zone));
            let material = of_zone.is_some_and(|z| trials[z].above_floor && total(z) > A_MATERIAL * total(k));
            trials[k].above_floor &= !material;
        }
        // What depends on the direction has no name.
        let laws = refit(&table, &chosen);
        for grouping in [Grouping::Row, Grouping::Azimuth] {
            let groups = loss_groups(context.frames, context.rig, mask, grouping, &|c| table.kept(&laws, c));
            let how = GroupFit { centred: step > 0, ..GROUPED };
            let (spread, _) =
                grouped::spread(&group_total(select.iter().flat_map(|&i| &groups[i])), how, trimmed(grouping));
            trials.push(Trial {
                candidate: LAWS.len() + grouping as usize,
                name: UNNAMED.into(),
                parameters: 12,
                gains: grouped::cross_part_gains(&groups, &select, &blocks, how, false),
                above_floor: spread > GROUP_FLOOR,
            });
        }
        // On top of a law another one has to bring more than the mending of its form; what depends on the direction tells against the law.
        for trial in trials.iter_mut().filter(|_| step > 0) {
            let share = if trial.name == UNNAMED { UNNAMED_SHARE } else { JOINING_SHARE };
            trial.above_floor &= total_and_z(&trial.gains).0 > share * first_gain;
        }
        let choice = choose(&trials, &demands);
        result.considered.extend(record(&trials, choice.as_ref(), "hits", returns, &demands));
        let Some(choice) = choice else { break };
        let trial = &trials[choice.chosen];
        first_gain = total_and_z(&trial.gains).0;
        if trial.name == UNNAMED {
            let grouping = if trial.candidate == LAWS.len() { Grouping::Row } else { Grouping::Azimuth };
            unnamed = Some((grouping, confidence(&trials, &blocks, UNNAMED, &demands)));
            // A law that leaves losses that depend on the direction is a form, not a name.
            stories.clear();
            break;
        }
        chosen.push(candidates[trial.candidate]);
        let mut equals: Vec<String> =
            choice.equals.iter().map(|&i| trials[i].name.clone()).filter(|n| n != UNNAMED).collect();
        equals.sort();
        equals.dedup();
        stories.push(unless_unsure(equals, &trials, &blocks, &trial.name, &demands));
    }
    let mismatches: f64 = select
        .iter()
        .flat_map(|&i| &hits[i])
        .map(|(_, c)| c.simulated.n - c.simulated_matched + c.measured.n - c.measured_matched)
        .sum();
    let simulated: f64 = select.iter().flat_map(|&i| &hits[i]).map(|(_, c)| c.simulated.n).sum();
    result.minimum.push((
        "random_dropout".into(),
        Minimum {
            parameter: "share".into(),
            value: (Z_STAR * mismatches.max(1.0).sqrt() / simulated.max(1.0)).max(FLOOR),
            unit: "1".into(),
        },
    ));
    // Parameters from other frames, intervals from refits of drawn blocks.
    let table_e = of(&estimate);
    let fitted = refit(&table_e, &chosen);
    let members = blocks_of(&context.blocks(&estimate));
    let repeated: Vec<Vec<FittedLaw>> = if chosen.is_empty() {
        vec![]
    } else {
        (0..REFITS)
            .into_par_iter()
            .map(|r| {
                let drawn = draw_blocks(&members, &mut data::stream(0, "diagnose losses", 0, r as u64));
                let frames: Vec<usize> = drawn.iter().map(|&i| estimate[i]).collect();
                refit(&of(&frames), &chosen)
            })
            .collect()
    };
    let table_h = of(&hold_out);
    for (k, (equals, confidence)) in stories.into_iter().enumerate() {
        let without: Vec<FittedLaw> = fitted.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, l)| *l).collect();
        let gains = hold_out.iter().map(|&i| table_h.gain(&hits[i], &fitted, &without)).collect();
        let draws: Vec<FittedLaw> = repeated.iter().map(|r| r[k]).collect();
        result.found.push(found(&fitted[k], &draws, equals, confidence, gains, &table_h, &fitted));
    }
    let told = table_e.told(&fitted);
    result.distance = hold_out
        .iter()
        .map(|&i| {
            [table_h.distance(&hits[i]), table_h.gain(&hits[i], &fitted, &[]), table_h.gain_by_table(&hits[i], &told)]
        })
        .collect();
    if let Some((grouping, confidence)) = unnamed {
        let groups = loss_groups(context.frames, context.rig, mask, grouping, &|c| table_e.kept(&fitted, c));
        let kept = |ray: &Ray| cell(ray).filter(|_| !mask.hides(ray)).map(|c| table_e.kept(&fitted, c));
        let shares = mean_by_group(estimate.iter().flat_map(|&i| &context.frames[i].simulated), grouping, kept);
        let mut found = unnamed_found(&groups, &shares, grouping, &estimate, &hold_out, confidence);
        for (d, g) in result.distance.iter_mut().zip(&found.held_out_gains) {
            d[1] += g;
            d[2] += g.max(0.0);
        }
        // The forms below the table are part of it: they have no name of their own.
        for (g, &i) in found.held_out_gains.iter_mut().zip(&hold_out) {
            *g += table_h.gain(&hits[i], &fitted, &[]);
        }
        result.found.push(found);
    }
    result
}

/// Shares lost by groups of directions: prior spread of a fifth.
const GROUPED: GroupFit = GroupFit { column: 0, precision: 25.0, centred: false, trust: 1.0 };

fn unnamed_found(
    groups: &[PartedFrame],
    shares: &std::collections::BTreeMap<u32, f64>,
    grouping: Grouping,
    estimate: &[usize],
    hold_out: &[usize],
    confidence: f64,
) -> Found {
    let all = group_total(estimate.iter().flat_map(|&i| &groups[i]));
    let (spread, _) = grouped::spread(&all, GROUPED, trimmed(grouping));
    let told = Unnamed {
        channel: "hits",
        confidence,
        parameters: vec![],
        says: format!(
            "the share of lost returns depends on the {}, by {:.1} % from one to the next; no cause of the catalogue does that",
            word(grouping),
            100.0 * spread
        ),
        y: "share of simulated returns that are measured",
    };
    told.found(&all, GROUPED, grouping, hold_out.iter().map(|&i| &groups[i]), |group, lost, std| {
        [shares.get(&group).copied().unwrap_or(1.0) - lost, std]
    })
}

/// Fits laws one on top of the other.
pub(super) fn refit(table: &LossTable, laws: &[Law]) -> Vec<FittedLaw> {
    laws.iter().fold(Vec::new(), |before, &law| table.fit(&before, law))
}

/// Laws that tell the same story are not put on top of each other: a second one mends the form of the first.
fn may_join(law: Law, chosen: &[Law]) -> bool {
    let smooth = |l: &Law| matches!(l, Law::Range | Law::Incidence | Law::Signal);
    !(chosen.contains(&law) || smooth(&law) && chosen.iter().any(smooth))
}
