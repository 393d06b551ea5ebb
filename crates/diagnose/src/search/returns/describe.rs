//! Findings of returns off the simulated surfaces: parameters, sentences and plots.

use super::false_alarms::{FalseAlarms, false_alarms};
use super::weather::{Weather, lost_with_range, weather};
use super::{NamedParameter, Scenes, Search, cause, is_spray};
use crate::catalogue::{Cause, Channel, Covariate, Quantity};
use crate::channels::free_path::{Shape, bins};
use crate::channels::returns::{self, Odd, OddFrame};
use crate::channels::together::crowding;
use crate::curve::{Curve, CurvePoint};
use crate::diagnosis::{Parameter, Status};
use crate::effects::rounded;
use crate::pairing::Ray;
use crate::search::{Context, Found, Z_STAR, parameter};
use sensor::Effect;
use sensor::effects::RangeLaw;

/// Factor by which the true width of a beam may differ from that of a uniform disc that mixes as many ranges.
const WIDTH_FACTOR: f64 = 5.0;

/// Plausible widths of beams, rad.
const WIDTHS_RAD: std::ops::Range<f64> = 1e-5..0.1;

/// What is said of one kind of returns.
struct Description {
    causes: Vec<Cause>,
    effects: Vec<Effect>,
    covariate: Covariate,
    says: String,
    parameters: Vec<NamedParameter>,
}

/// The finding of an excess of one kind of returns; `share` is the excess, `z` its significance on the selecting
/// frames.
pub(super) fn found(search: &Search, kind: Odd, share: Parameter, held_out_gains: Vec<f64>, z: f64) -> Found {
    let Description { causes, effects, covariate, says, parameters } = match kind {
        Odd::Alone => alone(search, &share),
        Odd::Between => mixed(search, share),
        Odd::GroupInFront => Description {
            causes: vec![cause(kind)],
            effects: vec![],
            covariate: Covariate::Place,
            says: format!(
                "{:.2} % of the measured returns lie together where the simulation has nothing: things are missing in it",
                100.0 * share.estimate
            ),
            parameters: vec![(Quantity::Share.into(), share)],
        },
        Odd::GroupBehind => behind(share),
    };
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
        held_out_gains,
        says,
        curve: curve(search.context, kind, &search.estimate),
    }
}

/// Describes returns that are alone in the air.
fn alone(search: &Search, share: &Parameter) -> Description {
    let alarms = false_alarms(search.context, &search.estimate, search.end_m, search.ghosts);
    // No droplet is seen through a surface: returns behind them as well come from the receiver.
    let description = match (!alarms.instead).then(|| weather_of(search)).flatten() {
        Some(weather) => of_weather(&weather, share),
        None => of_false_alarms(&alarms, share),
    };
    if !crowd(search) {
        return description;
    }
    Description {
        causes: vec![],
        covariate: Covariate::Azimuth,
        says: format!(
            "{:.2} % of the measured returns stand alone where nothing is, in other directions from frame to frame; no \
             cause of the catalogue does that, false alarms and droplets come everywhere",
            100.0 * share.estimate
        ),
        ..description
    }
}

/// Relative variance of the number of lone returns over patches of directions from which on they do not come by chance:
/// that of one half of the patches with three times as many as the other half.
const CROWDED: f64 = 0.25;

/// Whether the lone returns of the estimating frames come in some directions of each frame, others from frame to frame.
fn crowd(search: &Search) -> bool {
    let frames: Vec<_> = search.estimate.iter().map(|&f| &search.context.frames[f]).collect();
    let is_lone = |f: usize, ray: usize| {
        returns::odd(&frames[f].measured[ray]) == Some(Odd::Alone)
            && !is_spray(&search.spray, search.estimate[f], 0, ray)
    };
    let [variance, error] = crowding(&frames, &is_lone);
    variance - Z_STAR * error > CROWDED
}

/// What recording tells fog from rain.
const TELL_WEATHER_BY: &str =
    "a flat wall at two known distances in the same weather: fog weakens its light by far more";

/// The weather that the lone returns of the estimating frames tell.
fn weather_of(search: &Search) -> Option<Weather> {
    let frames: Vec<_> = search.estimate.iter().map(|&f| &search.context.frames[f]).collect();
    let of_spray = |f: usize, side: usize, ray: usize| is_spray(&search.spray, search.estimate[f], side, ray);
    let bins = bins(&frames, search.end_m, &of_spray);
    weather(&bins, |depth_m| match search.scenes {
        Scenes::Same => lost_with_range(&frames, depth_m),
        Scenes::Different => None,
    })
}

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
            Shape::Even(_) | Shape::OfPath => RangeLaw::Uniform,
        },
        reach_m: match weather.shape {
            Shape::Drops(reach_m) | Shape::Even(reach_m) => rounded(reach_m, 3),
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

/// Describes ranges between the two surfaces of an edge. The width of the beam is reported where it is plausible; how
/// a sensor weights what a beam meets is not known.
fn mixed(search: &Search, share: Parameter) -> Description {
    let more = share.estimate;
    let mut parameters = vec![(Quantity::Share.into(), share)];
    let sum = |f: fn(&OddFrame) -> f64| search.estimate.iter().map(|&i| f(&search.odd[i])).sum::<f64>();
    let width = more * sum(|f| f.all[0]) / sum(|f| f.mixed_per_rad);
    let so_wide = if WIDTHS_RAD.contains(&width) {
        let ci95 = [width / WIDTH_FACTOR, width * WIDTH_FACTOR];
        let unit = Quantity::DivergenceRad.unit();
        parameters.push((Quantity::DivergenceRad.into(), Parameter { estimate: width, unit, ci95 }));
        format!(", about {:.1} mrad", 1e3 * width)
    } else {
        String::new()
    };
    Description {
        causes: vec![Cause::MixedPixels],
        effects: vec![],
        covariate: Covariate::Edge,
        says: format!(
            "{:.2} % of the measured returns lie between the two surfaces of an edge: beams have a width{so_wide}, your simulator's are lines",
            100.0 * more
        ),
        parameters,
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
