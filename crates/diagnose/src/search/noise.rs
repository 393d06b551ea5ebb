//! Noise: are measured returns rougher than simulated ones, and on what does it depend?

mod curve;

use super::unexplained::{Unnamed, mean_by_group, word};
use super::{
    ChannelResult, Context, Found, Z_STAR, confidence, first_demands, parameter, record, trimmed, unless_unsure,
};
use crate::channels::cells::cell;
use crate::channels::groups::{Grouping, PartedFrame, total as group_total};
use crate::channels::mean::usual_noise_m;
use crate::channels::roughness::{RoughFrame, rough_frames, rough_groups, scales, total};
use crate::diagnosis::{Minimum, Status};
use crate::inference::choice::{Demands, Trial, UNNAMED, choose, total_and_z};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::inference::noise::{NOISE_LAWS, NoiseLaw, NoiseTable};
use crate::inference::roles::Role;
use crate::pairing::Ray;

/// Smaller standard deviations along the ray are not spoken of, m.
const FLOOR_M: f64 = 0.003;

/// Nor jitter of directions below this, rad.
const FLOOR_RAD: f64 = 1.7e-4;

/// Nor variances that grow by less than this share over the places that matter.
const FLOOR_SHARE: f64 = 0.1;

/// The search; surfaces met at less than `least_cos` are left out.
pub fn search(context: &Context, least_cos: f64) -> ChannelResult {
    let scales = scales(context.frames);
    let rough = rough_frames(context.frames, &scales);
    let mut result = ChannelResult::default();
    let [select, estimate, hold_out] = [Role::Select, Role::Estimate, Role::HoldOut].map(|r| context.of(r));
    let blocks = context.blocks(&select);
    let table = NoiseTable::new(total(select.iter().map(|&i| &rough[i])), least_cos);
    let linear: Vec<LinearFrame> = select.iter().map(|&i| table.linear(&rough[i], &NOISE_LAWS)).collect();
    let frames: Vec<&LinearFrame> = linear.iter().collect();
    let precision = vec![0.0; NOISE_LAWS.len()];
    let whole = |columns: &[usize]| fit(&frames, &blocks, columns, &precision);
    let trial = |columns: &[usize], before: Option<&[f64]>| {
        let fitted = whole(columns);
        let last = columns.len() - 1;
        let law = NOISE_LAWS[columns[last]];
        let mut gains = cross_gains(&frames, &blocks, columns, &precision);
        if let Some(before) = before {
            gains.iter_mut().zip(before).for_each(|(g, b)| *g -= b);
        }
        Trial {
            candidate: columns[last],
            name: law.name().into(),
            parameters: law.parameters(),
            gains,
            // On top of another law a negative one only mends the form of that.
            above_floor: (last == 0 || fitted.theta[last] > 0.0) && above_floor(&table, law, fitted.theta[last]),
        }
    };
    let demands = first_demands();
    // What depends on the direction has no name.
    let directions = |terms: &[(NoiseLaw, f64)], how: GroupFit| -> Vec<Trial> {
        let expected = |c: usize, ray: &Ray| expected(&table, c, ray, terms);
        let one = |grouping: Grouping| {
            let groups =
                rough_groups(context.frames, context.rig, &scales, grouping, &|c| table.variances(c), &expected);
            let (spread, _) =
                grouped::spread(&group_total(select.iter().flat_map(|&i| &groups[i])), how, trimmed(grouping));
            Trial {
                candidate: NOISE_LAWS.len() + grouping as usize,
                name: UNNAMED.into(),
                parameters: 12,
                gains: grouped::cross_part_gains(&groups, &select, &blocks, how, false),
                above_floor: spread > GROUP_FLOORS[grouping as usize],
            }
        };
        vec![one(Grouping::Row), one(Grouping::Azimuth)]
    };
    let mut trials: Vec<Trial> = (0..NOISE_LAWS.len()).map(|k| trial(&[k], None)).collect();
    let mut choice = choose(&trials, &demands);
    if choice.is_none() {
        trials.extend(directions(&[], GROUPED));
        choice = choose(&trials, &demands);
    }
    let returns = context.returns(&select);
    result.considered = record(&trials, choice.as_ref(), "roughness", returns, &demands);
    let constant = whole(&[0]);
    result.minimum.push((
        "range_noise".into(),
        Minimum {
            parameter: "std_m".into(),
            value: (Z_STAR * constant.error(0)).sqrt().max(FLOOR_M),
            unit: "m".into(),
        },
    ));
    let angular = whole(&[1]);
    result.minimum.push((
        "angular_jitter".into(),
        Minimum {
            parameter: "std_deg".into(),
            value: (Z_STAR * angular.error(0)).sqrt().max(FLOOR_RAD).to_degrees(),
            unit: "deg".into(),
        },
    ));
    let mut chosen = Vec::new();
    let mut stories = Vec::new();
    let mut unnamed = choice
        .as_ref()
        .map(|c| &trials[c.chosen])
        .filter(|t| t.name == UNNAMED)
        .map(|t| (t.candidate, confidence(&trials, &blocks, UNNAMED, &demands)));
    if let Some(first) = choice.as_ref().filter(|_| unnamed.is_none()) {
        let t = &trials[first.chosen];
        chosen.push(t.candidate);
        let equals: Vec<String> = unique(first.equals.iter().map(|&i| trials[i].name.clone()));
        stories.push(unless_unsure(equals, &trials, &blocks, &t.name, &demands));
        let mut gains = t.gains.clone();
        // A second one must be of another kind and bring a good part of what the first brought.
        let (first_gain, _) = total_and_z(&t.gains);
        let second_demands = Demands { nats: (0.05 * first_gain).max(8.0), ..demands };
        let rivals: Vec<Trial> = (0..NOISE_LAWS.len())
            .filter(|&k| NOISE_LAWS[k].name() != NOISE_LAWS[t.candidate].name())
            .map(|k| trial(&[t.candidate, k], Some(&t.gains)))
            .collect();
        let second = choose(&rivals, &second_demands);
        result.considered.extend(record(&rivals, second.as_ref(), "roughness", returns, &second_demands));
        if let Some(second) = second {
            let t = &rivals[second.chosen];
            chosen.push(t.candidate);
            let equals = unique(second.equals.iter().map(|&i| rivals[i].name.clone()));
            stories.push(unless_unsure(equals, &rivals, &blocks, &t.name, &second_demands));
            gains.iter_mut().zip(&t.gains).for_each(|(g, more)| *g += more);
        }
        // Noise along the ray and of its direction together look like one that grows as the signal falls: as a pair they may tell more.
        let along = (0..NOISE_LAWS.len()).filter(|&k| NOISE_LAWS[k].name() == NoiseLaw::Constant.name());
        let pairs = along.map(|k| (k, trial(&[k, ANGULAR], None))).filter(|(k, t)| {
            t.above_floor && above_floor(&table, NOISE_LAWS[*k], whole(&[*k, ANGULAR]).theta[0].max(0.0))
        });
        let best = pairs.max_by(|a, b| total_and_z(&a.1.gains).0.total_cmp(&total_and_z(&b.1.gains).0));
        if let Some((k, pair)) = best.filter(|_| chosen.iter().any(|&c| matches!(NOISE_LAWS[c], NoiseLaw::Signal(_)))) {
            let (more, z) = total_and_z(&pair.gains.iter().zip(&gains).map(|(a, b)| a - b).collect::<Vec<_>>());
            if more > (A_PAIR_SHARE * first_gain).max(demands.nats) && z > 2.0 {
                let both = [pair, Trial { name: NoiseLaw::Signal(1.0).name().into(), gains, ..t.clone() }];
                let confidence = confidence(&both, &blocks, &both[0].name, &demands);
                chosen = vec![k, ANGULAR];
                stories = vec![(vec![], confidence); 2];
                result.considered.extend(record(&both, None, "roughness", returns, &demands));
            }
        }
        // A law that leaves much that depends on the direction is a form, not a name.
        let so_far = whole(&chosen);
        let told: Vec<_> = chosen.iter().zip(so_far.theta.iter()).map(|(&k, &t)| (NOISE_LAWS[k], t)).collect();
        let beside = GroupFit { centred: true, ..GROUPED };
        let tables = directions(&told, beside);
        let remains = choose(&tables, &demands);
        result.considered.extend(record(&tables, remains.as_ref(), "roughness", returns, &demands));
        if let Some(remains) = remains {
            unnamed = Some((tables[remains.chosen].candidate, confidence(&tables, &blocks, UNNAMED, &demands)));
            stories.clear();
        }
    }
    // Parameters from other frames.
    let table_e = NoiseTable::new(total(estimate.iter().map(|&i| &rough[i])), least_cos);
    let linear_e: Vec<LinearFrame> = estimate.iter().map(|&i| table_e.linear(&rough[i], &NOISE_LAWS)).collect();
    let fitted = fit(&linear_e.iter().collect::<Vec<_>>(), &context.blocks(&estimate), &chosen, &precision);
    let table_h = NoiseTable::new(total(hold_out.iter().map(|&i| &rough[i])), least_cos);
    let terms: Vec<(NoiseLaw, f64)> =
        chosen.iter().zip(fitted.theta.iter()).map(|(&k, &t)| (NOISE_LAWS[k], t)).collect();
    for (k, (equals, confidence)) in stories.into_iter().enumerate() {
        let without: Vec<_> = terms.iter().enumerate().filter(|(i, _)| *i != k).map(|(_, t)| *t).collect();
        let gains =
            hold_out.iter().map(|&i| table_h.likelihood(&rough[i], &terms) - table_h.likelihood(&rough[i], &without));
        result.found.push(found(
            NOISE_LAWS[chosen[k]],
            &fitted,
            k,
            equals,
            confidence,
            gains.collect(),
            &table_h,
            &terms,
        ));
    }
    result.distance = hold_out.iter().map(|&i| distance(&table_h, &table_e, &rough[i], &terms)).collect();
    if let Some((candidate, confidence)) = unnamed {
        let grouping = if candidate == NOISE_LAWS.len() { Grouping::Row } else { Grouping::Azimuth };
        let expected = |c: usize, ray: &Ray| expected(&table_e, c, ray, &terms);
        let groups = rough_groups(context.frames, context.rig, &scales, grouping, &|c| table_e.variances(c), &expected);
        let share = |ray: &Ray| Some(expected(cell(ray)?, ray));
        let shares = mean_by_group(estimate.iter().flat_map(|&i| &context.frames[i].measured), grouping, share);
        let roles = [&estimate[..], &hold_out];
        let mut found = unnamed_found(&groups, &shares, grouping, roles, confidence, usual_noise_m(context.frames));
        for (d, g) in result.distance.iter_mut().zip(&found.held_out_gains) {
            d[1] += g;
            d[2] += g.max(0.0);
        }
        // The forms below the table are part of it: they have no name of their own.
        for (g, &i) in found.held_out_gains.iter_mut().zip(&hold_out) {
            *g += table_h.likelihood(&rough[i], &terms) - table_h.likelihood(&rough[i], &[]);
        }
        result.found.push(found);
    }
    result
}

/// Place of [`NoiseLaw::Angular`] in the list.
const ANGULAR: usize = 1;

/// Share of the first law's gain by which a pair of laws has to be better.
const A_PAIR_SHARE: f64 = 0.003;

/// Added variances of groups of directions in units of the expected one: prior spread of three.
const GROUPED: GroupFit = GroupFit { column: 0, precision: 0.1, centred: false, trust: 0.5 };

/// Spread of them below which nothing is said: rows, which meet ranges and angles of their own, where laws may have another form; azimuths.
const GROUP_FLOORS: [f64; 2] = [0.6, 0.25];

/// Measured variance that laws tell of a ray, in units of the simulated one.
fn expected(table: &NoiseTable, cell: usize, ray: &Ray, terms: &[(NoiseLaw, f64)]) -> f64 {
    let Some([_, vb]) = table.variances(cell) else { return 1.0 };
    let (range, cos) = (f64::from(ray.range_m), f64::from(ray.cos_incidence));
    1.0 + terms.iter().map(|(l, t)| t * l.variance(range, cos)).sum::<f64>() / vb
}

fn unnamed_found(
    groups: &[PartedFrame],
    shares: &std::collections::BTreeMap<u32, f64>,
    grouping: Grouping,
    [estimate, hold_out]: [&[usize]; 2],
    confidence: f64,
    usual_m: f64,
) -> Found {
    let all = group_total(estimate.iter().flat_map(|&i| &groups[i]));
    let told = Unnamed {
        channel: "roughness",
        confidence,
        parameters: vec![parameter("simulated_std_m", usual_m, 0.05 * usual_m, "m")],
        says: format!(
            "measured ranges scatter more in some directions than in others: it depends on the {}, and no cause of the catalogue does that",
            word(grouping)
        ),
        y: "standard deviation in units of the simulated one",
    };
    told.found(&all, GROUPED, grouping, hold_out.iter().map(|&i| &groups[i]), |group, added, std| {
        let share = shares.get(&group).copied().unwrap_or(1.0).sqrt();
        let measured = (1.0 + added).max(0.0).sqrt();
        [share * measured, share * 0.5 * std / measured.max(0.1)]
    })
}

fn above_floor(table: &NoiseTable, law: NoiseLaw, theta: f64) -> bool {
    // Where the law says most, in units of what is there anyhow.
    let (mut share, mut along, mut n) = (0.0, 0.0, 0.0);
    for (range, cos, returns, [_, vb]) in table.rows() {
        let added = theta.abs() * law.variance(range, cos);
        let w = returns / vb;
        share += returns * (added / vb).min(1.0);
        along += w * added;
        n += returns;
    }
    let typical = table.rows().iter().map(|r| r.2 / r.3[1]).sum::<f64>();
    let enough = match law {
        NoiseLaw::Angular => theta.abs().sqrt() > FLOOR_RAD,
        _ => (along / typical.max(1e-12)).sqrt() > FLOOR_M,
    };
    enough && share / n.max(1.0) > FLOOR_SHARE
}

/// Kullback-Leibler distance of a frame's roughness from the simulation, the gain of laws, and that of the variances of `other` frames.
fn distance(table: &NoiseTable, other: &NoiseTable, frame: &RoughFrame, terms: &[(NoiseLaw, f64)]) -> [f64; 3] {
    let best: f64 = frame
        .iter()
        .filter_map(|(i, cell)| {
            table.variances(*i as usize)?;
            let n = cell.measured.n / 2.0;
            (n > 0.0).then(|| -0.5 * n * (cell.variances()[0].max(1e-12).ln() + 1.0))
        })
        .sum();
    let before = table.likelihood(frame, &[]);
    [best - before, table.likelihood(frame, terms) - before, table.likelihood_by_table(frame, other) - before]
}

fn unique(names: impl Iterator<Item = String>) -> Vec<String> {
    let mut all: Vec<String> = names.collect();
    all.sort();
    all.dedup();
    all
}

#[expect(clippy::too_many_arguments, reason = "the parts of a finding")]
fn found(
    law: NoiseLaw,
    fitted: &LinearFit,
    k: usize,
    equals: Vec<String>,
    confidence: f64,
    held_out_gains: Vec<f64>,
    table: &NoiseTable,
    terms: &[(NoiseLaw, f64)],
) -> Found {
    let (theta, error) = (fitted.theta[k], fitted.error(k));
    let sigma = theta.signum() * theta.abs().sqrt();
    // The form of the truth may differ: three per cent of the value on top.
    let sigma_error = (error / (2.0 * theta.abs().sqrt()).max(1e-9)).hypot(0.03 * sigma);
    let mut parameters = Vec::new();
    let (covariate, says) = match law {
        NoiseLaw::Constant => {
            parameters.push(parameter("std_m", sigma, sigma_error, "m"));
            parameters.push(parameter("per_m", 0.0, 1e-4, "m/m"));
            (
                "none".to_owned(),
                format!(
                    "measured ranges scatter by {:.1} cm more than simulated ones, everywhere alike",
                    sigma * 100.0
                ),
            )
        }
        NoiseLaw::Growing(g) => {
            parameters.push(parameter("std_m", sigma, sigma_error.hypot(0.15 * sigma), "m"));
            parameters.push(parameter("per_m", g * sigma, 0.3 * g * sigma, "m/m"));
            let at = |r: f64| sigma * (1.0 + g * r) * 100.0;
            (
                "range_m".into(),
                format!(
                    "measured ranges scatter more than simulated ones, and more with range: by {:.1} cm at 10 m, {:.1} cm at 50 m",
                    at(10.0),
                    at(50.0)
                ),
            )
        }
        NoiseLaw::Signal(gamma) => {
            parameters.push(parameter("std_m", sigma, sigma_error.hypot(0.1 * sigma), "m"));
            parameters.push(parameter("exponent", 0.5 * gamma, 0.15 * gamma, "1"));
            (
                "signal".into(),
                format!("measured ranges scatter more where the signal is weak: by {:.1} cm at u = 4", sigma * 100.0),
            )
        }
        NoiseLaw::Angular => {
            let deg = f64::to_degrees;
            parameters.push(parameter("std_deg", deg(sigma), deg(sigma_error), "deg"));
            (
                "range_m * tan(incidence)".into(),
                format!(
                    "the light goes elsewhere than the sensor says, by {:.3} degrees: grazing surfaces scatter, squarely met ones do not",
                    deg(sigma)
                ),
            )
        }
    };
    let name = law.name().to_owned();
    let status = if equals.is_empty() { Status::Named } else { Status::Ambiguous };
    let separate_by = (!equals.is_empty()).then(|| "surfaces met squarely and at grazing angles at the same range (a wall or a board beside the road, near and far)".to_owned());
    Found {
        status,
        causes: std::iter::once(name).chain(equals).collect(),
        family: "range_error",
        parameters,
        confidence,
        channel: "roughness",
        covariate,
        held_out_gains,
        says,
        separate_by,
        curve: curve::curve(table, law, terms),
    }
}
