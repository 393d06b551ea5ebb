//! Findings of returns off the simulated surfaces: parameters, sentences and plots.

use super::false_alarms::{FalseAlarms, false_alarms};
use super::weather::{Weather, lost_with_range};
use super::{NamedParameter, Scenes, Search, air};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::range_laws::Shape;
use crate::channels::returns::{self, Odd};
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Parameter, Status};
use crate::effects::rounded;
use crate::pairing::Ray;
use crate::search::{Context, Found, parameter};
use sensor::Effect;
use sensor::effects::RangeLaw;

/// What is said of one kind of returns.
struct Description {
    causes: Vec<Cause>,
    effects: Vec<Effect>,
    covariate: Covariate,
    says: String,
    parameters: Vec<NamedParameter>,
}

/// The findings of an excess of one kind of returns, one for each of its causes; `share` is the excess, `z` its
/// significance on the selecting frames.
pub(super) fn found(search: &Search, kind: Odd, share: Parameter, held_out_gains: Vec<f64>, z: f64) -> Vec<Found> {
    let described = match kind {
        Odd::Alone => alone(search, &share),
        Odd::GroupInFront => vec![(1.0, in_front(share))],
        Odd::GroupBehind => vec![(1.0, behind(share))],
    };
    let curve = curve(search.context, kind, &search.estimate);
    let finding = |(part, description): (f64, Description)| {
        let Description { causes, effects, covariate, says, parameters } = description;
        Found {
            effects,
            status: match causes.len() {
                0 => Status::Unexplained,
                1 => Status::Named,
                _ => Status::Ambiguous,
            },
            separate_by: (causes.len() > 1).then(|| TELL_WEATHER_BY.into()),
            causes,
            parameters,
            confidence: (z / (z + 1.0)).clamp(0.0, 1.0),
            channel: Channel::Returns,
            covariate,
            held_out_gains: held_out_gains.iter().map(|nats| part * nats).collect(),
            says,
            curve: curve.clone(),
        }
    };
    described.into_iter().map(finding).collect()
}

/// Describes grouped returns in front of simulated surfaces.
fn in_front(share: Parameter) -> Description {
    Description {
        causes: vec![Cause::MissingObject],
        effects: vec![],
        covariate: Covariate::Place,
        says: format!(
            "{:.2} % of the measured returns lie together where the simulation has nothing: things are missing in it",
            100.0 * share.estimate
        ),
        parameters: vec![(Quantity::Share.into(), share)],
    }
}

/// Describes returns that are alone in the air: each of what they come from, with its part of them.
fn alone(search: &Search, share: &Parameter) -> Vec<(f64, Description)> {
    let air = air(search.context, &search.spray, &search.estimate, search.end_m);
    let alarms = false_alarms(search.context, &search.estimate, search.end_m, search.ghosts, &air);
    let frames: Vec<_> = search.estimate.iter().map(|&f| &search.context.frames[f]).collect();
    let lost = |depth_m: f64| match search.scenes {
        Scenes::Same => lost_with_range(&frames, depth_m),
        Scenes::Different => None,
    };
    let of_part = |(place, part): (usize, f64)| {
        let own = scaled(share, part);
        let of_receiver = air.of_receiver().unwrap_or(part).max(part);
        let alarms = FalseAlarms { rate: alarms.rate * part / of_receiver, ..alarms };
        let description = match air.weather(place, lost) {
            _ if air.crowds[place] => of_a_crowd(&alarms, &own),
            Some(weather) if !(alarms.instead && air.is_of_receiver(place)) => of_weather(&weather, &own),
            _ => of_false_alarms(&alarms, &own),
        };
        (part, description)
    };
    // No droplet is seen through a surface: returns behind them as well come from the receiver.
    let of_receiver = !search.ghosts && air.of_receiver().is_none() && air.before_and_behind() > 0.0;
    if of_receiver || air.mixture.parts.is_empty() {
        return vec![(1.0, of_false_alarms(&alarms, share))];
    }
    air.shares().into_iter().enumerate().map(of_part).collect()
}

/// Describes lone returns at some ranges, or in some directions, such as the light of another sensor.
fn of_a_crowd(alarms: &FalseAlarms, share: &Parameter) -> Description {
    Description {
        causes: vec![],
        covariate: Covariate::Azimuth,
        says: format!(
            "{:.2} % of the measured returns stand alone where nothing is, at some ranges or in some directions only; no \
             cause of the catalogue does that, false alarms and droplets come everywhere",
            100.0 * share.estimate
        ),
        ..of_false_alarms(alarms, share)
    }
}

/// A part of a share.
fn scaled(share: &Parameter, part: f64) -> Parameter {
    Parameter { estimate: part * share.estimate, ci95: share.ci95.map(|end| part * end), ..*share }
}

/// What recording tells fog from rain.
const TELL_WEATHER_BY: &str =
    "a flat wall at two known distances in the same weather: fog weakens its light by far more";

/// Describes droplets. `extended.toml` has the droplets alone: what the light of surfaces loses is a law of its own.
fn of_weather(weather: &Weather, share: &Parameter) -> Description {
    let [depth_m, low, high] = weather.depth_m;
    let within = |quantity: Quantity, [estimate, low, high]: [f64; 3]| {
        (quantity.into(), Parameter { estimate, ci95: [low, high], unit: quantity.unit() })
    };
    let more = share.estimate.abs().max(1e-9);
    let form = ((share.ci95[1] - share.ci95[0]) / 2.0 / 1.96 / more).hypot(0.1);
    let droplets = sensor::effects::FalseAlarms {
        rate: rounded(weather.rate.min(1.0), 7),
        depth_m: rounded(depth_m, 3),
        law: match weather.shape {
            Shape::Exponential(_) => RangeLaw::Exponential,
            Shape::Gamma(_) => RangeLaw::Gamma,
            Shape::Drops(_) => RangeLaw::Inverse,
            Shape::Even(..) | Shape::OfPath | Shape::Band(..) => RangeLaw::Uniform,
        },
        reach_m: match weather.shape {
            Shape::Drops(reach_m) | Shape::Even(reach_m, _) | Shape::Band(_, reach_m) => rounded(reach_m, 3),
            _ => rounded(8.0 * depth_m, 3).min(1000.0),
        },
        ..Default::default()
    };
    let mut parameters =
        vec![parameter(Quantity::Rate, weather.rate, form * weather.rate), within(Quantity::DepthM, weather.depth_m)];
    let name = match weather.causes[0] {
        Cause::Fog => {
            let visibility = weather.visibility_m();
            parameters.push(within(Quantity::VisibilityM, visibility));
            format!("fog with a visibility of {:.0} to {:.0} m", visibility[1], visibility[2])
        }
        Cause::Rain => "rain".to_owned(),
        _ => "fog that reaches beyond the sensor's range, or false alarms".to_owned(),
    };
    Description {
        causes: weather.causes.clone(),
        effects: vec![Effect::FalseAlarms(droplets)],
        covariate: Covariate::Range,
        says: format!(
            "{:.2} % of the shots return from droplets, {depth_m:.0} m ({low:.0} to {high:.0}) away in the mean, where \
             the simulation has nothing: {name}",
            100.0 * weather.rate
        ),
        parameters,
    }
}

/// Describes lone returns.
fn of_false_alarms(alarms: &FalseAlarms, share: &Parameter) -> Description {
    let (more, error) = (share.estimate, (share.ci95[1] - share.ci95[0]) / 2.0 / 1.96);
    let FalseAlarms { rate, reach_m, instead } = *alarms;
    let form = (error / more.abs().max(1e-9)).hypot(0.06);
    let alarms = sensor::effects::FalseAlarms {
        rate: rounded(rate, 7),
        reach_m: rounded(reach_m.max(1.0), 3),
        instead,
        ..Default::default()
    };
    Description {
        causes: vec![Cause::Outliers],
        effects: vec![Effect::FalseAlarms(alarms)],
        covariate: Covariate::None,
        says: format!(
            "{:.2} % of the measured returns stand alone where nothing is: false alarms, of {:.2} % of the shots, that your simulator does not make",
            100.0 * more,
            100.0 * rate
        ),
        parameters: vec![
            parameter(Quantity::Rate, rate, form * rate),
            parameter(Quantity::ReachM, reach_m, 0.05 * reach_m),
        ],
    }
}

/// Describes grouped returns behind simulated surfaces: objects that only the simulation has, a negative share of
/// missing ones.
fn behind(share: Parameter) -> Description {
    let [low, high] = share.ci95;
    Description {
        causes: vec![Cause::MissingObject],
        effects: vec![],
        covariate: Covariate::Place,
        says: format!(
            "{:.2} % of the measured returns lie together behind what the simulation has there: it has things that are not on the road",
            100.0 * share.estimate
        ),
        parameters: vec![(
            Quantity::Share.into(),
            Parameter { estimate: -share.estimate, ci95: [-high, -low], ..share },
        )],
    }
}

/// Share of such returns by range.
fn curve(context: &Context, kind: Odd, frames: &[usize]) -> Curve {
    const BINS: usize = 12;
    let bin = |r: &Ray| ((r.own_range_m() / 10.0) as usize).min(BINS - 1);
    let mut counts = [[0.0f64; BINS]; 4];
    for &f in frames {
        for (side, rays) in [&context.frames[f].measured, &context.frames[f].simulated].into_iter().enumerate() {
            for ray in rays {
                counts[2 * side][bin(ray)] += 1.0;
                if returns::odd(ray) == Some(kind) {
                    counts[2 * side + 1][bin(ray)] += 1.0;
                }
            }
        }
    }
    let total: [f64; 2] = [0, 2].map(|k: usize| counts[k].iter().sum::<f64>().max(1.0));
    let points = (0..BINS).map(|b| CurvePoint {
        sensor: 0,
        x: 10.0 * b as f64 + 5.0,
        measured: counts[1][b] / total[0],
        before: counts[3][b] / total[1],
        after: counts[1][b] / total[0],
        error: counts[1][b].sqrt() / total[0],
    });
    Curve { x: "range, m".into(), y: "share of all returns".into(), by_sensor: false, points: points.collect() }
}
