//! Findings of lost returns: parameters, sentences and plots.

use super::form::Corrections;
use crate::catalogue::{Channel, Covariate, Quantity};
use crate::channels::cells::OBJECT;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Parameter, Status};
use crate::inference::law::{FittedLaw, Law, in_zone};
use crate::inference::losses::LossTable;
use crate::search::{Found, NamedParameter, Selected};
use sensor::signal::index_offset;

/// Parameters of a law, as a finding has them.
fn values(law: &FittedLaw) -> Vec<(Quantity, f64)> {
    let steepness = (Quantity::Steepness, law.steepness());
    let most = (Quantity::Most, law.most());
    match law.law {
        Law::Random | Law::Zone(_) => vec![(Quantity::Share, law.numbers[0])],
        Law::Range => vec![(Quantity::HalfAtM, law.half().exp()), steepness, most],
        Law::Incidence => vec![(Quantity::CosHalf, law.half().exp()), steepness, most],
        // As the signal index at the reflectivity that the diagnosis assumes.
        Law::Signal => vec![
            (Quantity::Threshold, law.half() + index_offset()),
            steepness,
            most,
            (Quantity::BrighterStanding, law.numbers[4]),
            (Quantity::BrighterObjects, law.numbers[5]),
            (Quantity::BrighterWheels, law.numbers[6]),
        ],
    }
}

/// The finding of one law. `draws` are its bootstrap fits, `all` are all laws that were fitted together, with the
/// corrections of this one.
pub(super) fn found(
    law: &FittedLaw,
    draws: &[FittedLaw],
    selected: Selected,
    held_out_gains: Vec<f64>,
    table: &LossTable,
    (all, corrections): (&[FittedLaw], Corrections),
) -> Found {
    let separate_by = (!selected.rivals.is_empty()).then(|| {
        "walls, boards or cars at many ranges met at normal incidence: on flat ground range and incidence go together".to_owned()
    });
    Found {
        effects: corrections.effects(law),
        status: selected.status(),
        confidence: selected.confidence,
        causes: selected.causes(law.law.cause()),
        parameters: parameters(law, draws, table),
        channel: Channel::Hits,
        covariate: covariate(law.law),
        held_out_gains,
        says: says(law, table),
        separate_by,
        curve: curve(table, law.law, all),
    }
}

/// Takes the name of a random loss whose shots are lost column by column.
pub(super) fn of_columns(found: &mut Found) {
    found.status = Status::Unexplained;
    found.causes.clear();
    found.covariate = Covariate::Azimuth;
    found.separate_by = None;
    found.says = format!(
        "{:.1} % of the returns are lost, those of a column together; no cause of the catalogue does that, losses by \
         chance are lost one by one",
        100.0 * found.parameter(Quantity::Share).map_or(0.0, |share| share.estimate)
    );
}

/// Parameters of a law with intervals: 2.1 times the standard deviation of the bootstrap fits and the error of the
/// law's form.
fn parameters(law: &FittedLaw, draws: &[FittedLaw], table: &LossTable) -> Vec<NamedParameter> {
    let parameter = |(k, (quantity, estimate)): (usize, (Quantity, f64))| {
        let drawn: Vec<f64> = draws.iter().map(|d| values(d)[k].1).collect();
        let mean = drawn.iter().sum::<f64>() / drawn.len().max(1) as f64;
        let sd = (drawn.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (drawn.len() as f64 - 1.0).max(1.0)).sqrt();
        // Beyond the ranges and angles of the returns the law is extrapolated.
        let beyond = match quantity {
            Quantity::HalfAtM => (estimate - table.farthest_m()).max(0.0),
            Quantity::CosHalf => (table.most_grazing() - estimate).max(0.0),
            _ => 0.0,
        };
        let form = if quantity == Quantity::Most { 0.002 } else { form_error(law.law) * estimate.abs() };
        let half = 2.1 * sd.hypot(form) + beyond;
        // Which part of an object has the material is not known: where the part is small, it loses more.
        let part = matches!(law.law, Law::Zone(z) if z >= OBJECT) && estimate > 0.0;
        let ci95 = [estimate - half, if part { 1.0 } else { estimate + half }];
        (quantity.into(), Parameter { estimate, unit: quantity.unit(), ci95 })
    };
    values(law).into_iter().enumerate().map(parameter).collect()
}

/// The finding in a sentence.
fn says(law: &FittedLaw, table: &LossTable) -> String {
    match law.law {
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
            // No farther than returns are.
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
            values(law)[0].1,
            (0.5 * (2f64.to_radians().sin().ln() - law.half())).exp()
        ),
    }
}

/// What a law depends on.
fn covariate(law: Law) -> Covariate {
    match law {
        Law::Random => Covariate::None,
        Law::Zone(0) => Covariate::SurfaceGround,
        Law::Zone(1) => Covariate::SurfaceStanding,
        Law::Zone(2) => Covariate::SurfaceObject,
        Law::Zone(3) => Covariate::SurfaceObjectCorner,
        Law::Zone(_) => Covariate::SurfaceWholeObject,
        Law::Range => Covariate::Range,
        Law::Incidence => Covariate::CosIncidence,
        Law::Signal => Covariate::Signal,
    }
}

/// Kinds of surfaces as sentences name them.
fn zone_words(zone: usize) -> &'static str {
    [
        "the ground",
        "standing surfaces",
        "bodies of labelled objects",
        "the lower corners of labelled objects (wheels)",
        "labelled objects",
    ][zone]
}

/// Relative error of the parameters if the sensor has another law than the fitted one.
fn form_error(law: Law) -> f64 {
    match law {
        Law::Random => 0.01,
        Law::Zone(_) => 0.04,
        Law::Incidence => 0.1,
        _ => 0.05,
    }
}

/// Share of the simulated returns that are measured, along the covariate of a law.
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
            points.push(CurvePoint { sensor: 0, x, measured: share, before: 1.0, after: kept, error: share_error });
            sum = [0.0; 4];
        }
    }
    let x = match law {
        Law::Incidence => "angle between ray and surface, degrees",
        Law::Signal => "u = ln(cos / R^2) - ln(1 / 250^2)",
        _ => "range, m",
    };
    Curve { x: x.into(), y: "share of simulated returns that are measured".into(), by_sensor: false, points }
}
