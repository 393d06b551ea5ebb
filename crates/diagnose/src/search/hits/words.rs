//! What the search of losses found, in words and numbers.

use crate::channels::cells::{OBJECT, ZONE_NAMES};
use crate::diagnosis::{Curve, CurvePoint, Parameter, Status};
use crate::inference::law::{FittedLaw, Law, in_zone};
use crate::inference::losses::LossTable;
use crate::search::Found;
use sensor::signal::index_offset;

/// Numbers of a law as people read them.
fn reading(law: &FittedLaw) -> Vec<(&'static str, f64, &'static str)> {
    match law.law {
        Law::Random | Law::Zone(_) => vec![("share", law.numbers[0], "1")],
        Law::Range => {
            vec![("half_at_m", law.half().exp(), "m"), ("steepness", law.steepness(), "1"), ("most", law.most(), "1")]
        }
        Law::Incidence => {
            vec![("cos_half", law.half().exp(), "1"), ("steepness", law.steepness(), "1"), ("most", law.most(), "1")]
        }
        // As the signal index at the reflectivity that the diagnosis assumes.
        Law::Signal => vec![
            ("threshold", law.half() + index_offset(), "1"),
            ("steepness", law.steepness(), "1"),
            ("most", law.most(), "1"),
            ("brighter_standing", law.numbers[4], "1"),
            ("brighter_objects", law.numbers[5], "1"),
        ],
    }
}

pub(super) fn found(
    law: &FittedLaw,
    draws: &[FittedLaw],
    equals: Vec<String>,
    confidence: f64,
    held_out_gains: Vec<f64>,
    table: &LossTable,
    all: &[FittedLaw],
) -> Found {
    let values = reading(law);
    let parameters = values
        .iter()
        .enumerate()
        .map(|(k, (name, estimate, unit))| {
            let drawn: Vec<f64> = draws.iter().map(|d| reading(d)[k].1).collect();
            let mean = drawn.iter().sum::<f64>() / drawn.len().max(1) as f64;
            let sd =
                (drawn.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (drawn.len() as f64 - 1.0).max(1.0)).sqrt();
            // The form of the truth may differ, the more so beyond the returns that there are.
            let beyond = match *name {
                "half_at_m" => (estimate - table.farthest_m()).max(0.0),
                "cos_half" => (table.most_grazing() - estimate).max(0.0),
                _ => 0.0,
            };
            let form = if *name == "most" { 0.002 } else { form_error(law.law) * estimate.abs() };
            let half = 2.1 * sd.hypot(form) + beyond;
            // Which of an object's surfaces are of the material is not known: where few are, each of them loses more.
            let few = matches!(law.law, Law::Zone(z) if z >= OBJECT) && *estimate > 0.0;
            let ci95 = [estimate - half, if few { 1.0 } else { estimate + half }];
            ((*name).to_owned(), Parameter { estimate: *estimate, unit: (*unit).into(), ci95 })
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
        Law::Range => {
            // Not what no return shows.
            let at_m = law.half().exp().min(table.farthest_m());
            let lost = 100.0 * (1.0 - law.kept_there(at_m, 1.0));
            format!("returns are lost with range: {lost:.0} % at {at_m:.0} m; your simulator keeps them all")
        }
        Law::Incidence => {
            let cos = law.half().exp().clamp(table.most_grazing(), 1.0);
            format!(
                "returns are lost at grazing angles: {:.0} % at {:.1} degrees from the surface; your simulator keeps them all",
                100.0 * (1.0 - law.kept_there(1.0, cos)),
                cos.asin().to_degrees()
            )
        }
        Law::Signal => format!(
            "returns are lost as the signal falls: 50 % at u = {:.1}, on the road at {:.0} m if it is met at 2 degrees; your simulator keeps them all",
            values[0].1,
            (0.5 * (2f64.to_radians().sin().ln() - law.half())).exp()
        ),
    };
    let covariate = match law.law {
        Law::Random => "none".to_owned(),
        Law::Zone(z) => format!("surface: {}", ZONE_NAMES.get(z).unwrap_or(&"whole_object")),
        Law::Range => "range_m".into(),
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
    [
        "the ground",
        "standing surfaces",
        "bodies of labelled objects",
        "the lower corners of labelled objects (wheels)",
        "labelled objects",
    ][zone]
}

/// Share of a number by which a fit of another form may be off.
fn form_error(law: Law) -> f64 {
    match law {
        Law::Random => 0.01,
        Law::Zone(_) => 0.04,
        Law::Incidence => 0.1,
        _ => 0.05,
    }
}

fn curve(table: &LossTable, law: Law, all: &[FittedLaw]) -> Curve {
    let x_of = |[ln_range, ln_cos]: [f64; 2]| match law {
        Law::Incidence => ln_cos.exp().min(1.0).asin().to_degrees(),
        Law::Signal => ln_cos - 2.0 * ln_range + index_offset(),
        _ => ln_range.exp(),
    };
    let only = |zone: usize| match law {
        Law::Zone(z) => in_zone(z, zone),
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
