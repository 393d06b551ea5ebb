//! Lost returns: which simulated returns has the measured side not, and on what does it depend?

use super::{ChannelResult, Context, Found, Z_STAR, by_block, confidence, draw_blocks, first_demands, record};
use crate::channels::cells::ZONE_NAMES;
use crate::channels::hits::{HitFrame, hit_frames, total};
use crate::diagnosis::{Curve, CurvePoint, Minimum, Parameter, Status};
use crate::inference::choice::{Demands, Trial, choose, total_and_z};
use crate::inference::linear::{FOLDS, fold_of};
use crate::inference::losses::{FittedLaw, LAWS, Law, LossTable};
use crate::inference::roles::Role;
use rayon::prelude::*;

/// Smaller shares of lost returns are not spoken of.
const FLOOR: f64 = 0.005;

/// Of one kind of surface, this share of its own returns.
const ZONE_FLOOR: f64 = 0.03;

/// Repetitions of the bootstrap of fits.
const REFITS: usize = 40;

/// The search.
pub fn search(context: &Context) -> ChannelResult {
    let hits = hit_frames(context.frames);
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let of = |frames: &[usize]| LossTable::new(total(frames.iter().map(|&i| &hits[i])));
    let blocks = context.blocks(&select);
    let folds = fold_of(&blocks);
    let returns = context.returns(&select);
    let table = of(&select);
    let demands = first_demands();
    let mut result = ChannelResult::default();
    let mut chosen: Vec<Law> = Vec::new();
    let mut stories = Vec::new();
    let mut first_gain = 0.0f64;
    // One law, then at most one more of another kind.
    for step in 0..2 {
        let tables: Vec<LossTable> = (0..FOLDS)
            .map(|fold| of(&(0..select.len()).filter(|&i| folds[i] != fold).map(|i| select[i]).collect::<Vec<_>>()))
            .collect();
        let before: Vec<Vec<FittedLaw>> = tables.iter().map(|t| refit(t, &chosen)).collect();
        let candidates: Vec<Law> = LAWS.into_iter().filter(|l| step == 0 || may_join(*l, &chosen)).collect();
        let trials: Vec<Trial> = candidates
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
                let above_floor = match law {
                    Law::Zone(_) => own > ZONE_FLOOR,
                    _ => lost.abs() > FLOOR,
                };
                Trial { candidate: k, name: law.name().into(), parameters: law.parameters(), gains, above_floor }
            })
            .collect();
        let demands = if step == 0 { demands } else { Demands { nats: (0.04 * first_gain).max(8.0), ..demands } };
        let choice = choose(&trials, &demands);
        result.considered.extend(record(&trials, choice.as_ref(), "hits", returns, &demands));
        let Some(choice) = choice else { break };
        let trial = &trials[choice.chosen];
        first_gain = total_and_z(&trial.gains).0;
        chosen.push(candidates[trial.candidate]);
        let mut equals: Vec<String> = choice.equals.iter().map(|&i| trials[i].name.clone()).collect();
        equals.sort();
        equals.dedup();
        stories.push((equals, confidence(&trials, &blocks, &trial.name, &demands)));
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
    let members = by_block(&context.blocks(&estimate));
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
        let draws: Vec<[f64; 4]> = repeated.iter().map(|r| r[k].numbers).collect();
        result.found.push(found(&fitted[k], &draws, equals, confidence, gains, &table_h, &fitted));
    }
    result.distance = hold_out.iter().map(|&i| distance(&table_h, &hits[i], &fitted)).collect();
    result
}

fn refit(table: &LossTable, laws: &[Law]) -> Vec<FittedLaw> {
    laws.iter().fold(Vec::new(), |before, &law| table.fit(&before, law))
}

/// Laws that tell the same story are not put on top of each other: a second one mends the form of the first.
fn may_join(law: Law, chosen: &[Law]) -> bool {
    let smooth = |l: &Law| matches!(l, Law::Range | Law::Incidence | Law::Signal);
    !(chosen.contains(&law) || smooth(&law) && chosen.iter().any(smooth))
}

/// Kullback-Leibler distance of a frame's losses, before and after, and of an independent draw.
fn distance(table: &LossTable, frame: &HitFrame, laws: &[FittedLaw]) -> [f64; 3] {
    let (before, cells) = table.distance(frame, &[]);
    let (after, _) = table.distance(frame, laws);
    [before, after, 0.5 * cells]
}

/// Numbers of a law as people read them.
fn reading(law: Law, n: &[f64; 4]) -> Vec<(&'static str, f64, &'static str)> {
    match law {
        Law::Random => vec![("share", n[0], "1")],
        Law::Zone(_) => vec![("share", n[0], "1")],
        Law::Cut => vec![("max_range_m", n[0].exp(), "m")],
        Law::Range => vec![("half_at_m", n[0].exp(), "m"), ("steepness", n[1].exp(), "1")],
        Law::Incidence => vec![("half_at_cos", n[0].exp(), "1"), ("steepness", n[1].exp(), "1")],
        // u: ln(0.1 cos / R^2) - ln(0.1 / 250^2).
        Law::Signal => vec![
            ("half_at_u", n[0] + 2.0 * 250f64.ln(), "1"),
            ("steepness", n[1].exp(), "1"),
            ("brighter_standing", n[2], "1"),
            ("brighter_objects", n[3], "1"),
        ],
    }
}

fn found(
    law: &FittedLaw,
    draws: &[[f64; 4]],
    equals: Vec<String>,
    confidence: f64,
    held_out_gains: Vec<f64>,
    table: &LossTable,
    all: &[FittedLaw],
) -> Found {
    let values = reading(law.law, &law.numbers);
    let parameters = values
        .iter()
        .enumerate()
        .map(|(k, (name, estimate, unit))| {
            let drawn: Vec<f64> = draws.iter().map(|d| reading(law.law, d)[k].1).collect();
            let mean = drawn.iter().sum::<f64>() / drawn.len().max(1) as f64;
            let sd =
                (drawn.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (drawn.len() as f64 - 1.0).max(1.0)).sqrt();
            // The form of the truth may differ.
            let half = 2.1 * sd.hypot(form_error(law.law) * estimate.abs());
            let parameter =
                Parameter { estimate: *estimate, unit: (*unit).into(), ci95: [estimate - half, estimate + half] };
            ((*name).to_owned(), parameter)
        })
        .collect();
    let name = law.law.name().to_owned();
    let says = match law.law {
        Law::Random => format!(
            "{:.1} % of the returns are lost wherever they come from; your simulator keeps them",
            100.0 * law.numbers[0]
        ),
        Law::Zone(z) => format!(
            "returns of {} are lost more than others: {:.0} %; your simulator keeps them",
            zone_words(z),
            100.0 * law.numbers[0]
        ),
        Law::Cut => {
            format!("nothing is measured beyond {:.1} m; your simulator has returns there", law.numbers[0].exp())
        }
        Law::Range => {
            format!("returns are lost with range: 50 % at {:.0} m; your simulator keeps them all", law.numbers[0].exp())
        }
        Law::Incidence => format!(
            "returns are lost at grazing angles: 50 % at {:.1} degrees from the surface; your simulator keeps them all",
            law.numbers[0].exp().min(1.0).asin().to_degrees()
        ),
        Law::Signal => format!(
            "returns are lost as the signal falls: 50 % at u = {:.1}, on the road at {:.0} m if it is met at 2 degrees; your simulator keeps them all",
            values[0].1,
            (0.5 * (2f64.to_radians().sin().ln() - law.numbers[0])).exp()
        ),
    };
    let covariate = match law.law {
        Law::Random => "none".to_owned(),
        Law::Zone(z) => format!("surface: {}", ZONE_NAMES[z]),
        Law::Cut | Law::Range => "range_m".into(),
        Law::Incidence => "cos_incidence".into(),
        Law::Signal => "signal".into(),
    };
    let status = if equals.is_empty() { Status::Named } else { Status::Ambiguous };
    let separate_by = (!equals.is_empty()).then(|| {
        "walls, boards or cars at many ranges met squarely: on flat ground range and incidence go together".to_owned()
    });
    Found {
        status,
        causes: std::iter::once(name).chain(equals).collect(),
        family: "detection",
        parameters,
        confidence,
        channel: "hits",
        covariate,
        held_out_gains,
        says,
        separate_by,
        curve: curve(table, law.law, all),
    }
}

fn zone_words(zone: usize) -> &'static str {
    ["the ground", "standing surfaces", "bodies of labelled objects", "the lower corners of labelled objects (wheels)"]
        [zone]
}

/// Share of a number by which a fit of another form may be off.
fn form_error(law: Law) -> f64 {
    match law {
        Law::Random | Law::Cut => 0.01,
        Law::Zone(_) => 0.04,
        _ => 0.04,
    }
}

fn curve(table: &LossTable, law: Law, all: &[FittedLaw]) -> Curve {
    let x_of = |[ln_range, ln_cos]: [f64; 2]| match law {
        Law::Incidence => ln_cos.exp().min(1.0).asin().to_degrees(),
        Law::Signal => ln_cos - 2.0 * ln_range + 2.0 * 250f64.ln(),
        _ => ln_range.exp(),
    };
    let only = |zone: usize| match law {
        Law::Zone(z) => z == zone,
        _ => true,
    };
    let mut rows: Vec<(f64, f64, f64, f64)> = table
        .shares()
        .into_iter()
        .zip(table.kept_shares(all))
        .filter(|((_, zone, ..), _)| only(*zone))
        .map(|((at, _, n, share), kept)| (x_of(at), n, share, kept))
        .collect();
    rows.sort_by(|a, b| a.0.total_cmp(&b.0));
    let per = (rows.iter().map(|r| r.1).sum::<f64>() / 16.0).max(1.0);
    let mut points = Vec::new();
    let mut sum = [0.0f64; 4];
    for (i, (x, n, share, kept)) in rows.iter().enumerate() {
        for (s, v) in sum.iter_mut().zip([1.0, *x, *share, *kept]) {
            *s += n * v;
        }
        if sum[0] >= per || i + 1 == rows.len() && sum[0] > 0.2 * per {
            let [_, x, share, kept] = sum.map(|s| s / sum[0].max(1.0));
            let share_error = (share.clamp(0.0, 1.0) * (1.0 - share.clamp(0.0, 1.0)) / sum[0]).sqrt();
            points.push(CurvePoint { x, measured: share, before: 1.0, after: kept, error: share_error });
            sum = [0.0; 4];
        }
    }
    let x = match law {
        Law::Incidence => "angle between ray and surface, degrees",
        Law::Signal => "u = ln(cos / R^2) - ln(1 / 250^2)",
        _ => "range, m",
    };
    Curve { x: x.into(), y: "share of simulated returns that are measured".into(), points }
}
