//! Cases: a seed, a size, and the hidden effects.

use crate::effect::{Clock, Effect};
use crate::variant::{Intensity, Variant};
use data::Stream;
use rand::RngExt;
use score::CaseSize;
use std::ops::Range;

/// Kind of a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// No hidden effect.
    Null,
    /// One effect of the catalogue, by its index in [`CAUSES`].
    Single(usize),
    /// Two effects of the catalogue.
    Pair(usize, usize),
    /// One effect that is not in the catalogue.
    OffCatalogue(usize),
    /// No hidden effect, but frames are paired wrongly.
    Shuffled,
    /// So many effects at once (2 to 20), all different, up to two of them not in the catalogue.
    Swarm(usize),
}

/// A blind case.
#[derive(Clone, Debug)]
pub struct Case {
    /// Random seed of the case.
    pub seed: u64,
    /// Frames and shots.
    pub size: CaseSize,
    /// Kind of the case.
    pub kind: Kind,
    /// Effects hidden in the measured side.
    pub effects: Vec<Effect>,
    /// Time between frames, s.
    pub step_s: f64,
    /// Number of sensors, intensity column and content of the rig file.
    pub variant: Variant,
}

/// Causes that a case can hide.
pub const CAUSES: [&str; 22] = [
    "range_noise",
    "range_bias",
    "beam_range_offset",
    "beam_elevation_offset",
    "quantisation",
    "angular_jitter",
    "random_dropout",
    "signal_dropout",
    "range_dropout",
    "incidence_dropout",
    "material_dropout",
    "range_cut",
    "ego_occlusion",
    "time_offset",
    "label_offset",
    "sensor_extrinsics",
    "pitch_roll",
    "rolling_shutter",
    "outliers",
    "mixed_pixels",
    "missing_object",
    "wrong_shape",
];

/// Number of effects that were in no catalogue when the generator was written. The last one, a smear on a window, has
/// a name since.
pub const OFF_CATALOGUE: usize = 4;

/// Sizes of the hidden effects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Sizes {
    /// The whole range of each parameter.
    All,
    /// The stronger half of the range (in the logarithm, where it is log-uniform).
    Strong,
}

/// Draws the case of a seed.
pub fn draw_case(seed: u64, kind: Kind, size: CaseSize) -> Case {
    draw(seed, kind, size, Sizes::All, Variant::default())
}

/// Draws a case with an effect of medium to strong size, in a variant.
pub fn draw_strong_case(seed: u64, kind: Kind, size: CaseSize, variant: Variant) -> Case {
    draw(seed, kind, size, Sizes::Strong, variant)
}

fn draw(seed: u64, kind: Kind, size: CaseSize, sizes: Sizes, mut variant: Variant) -> Case {
    let mut rng = data::stream(seed, "blind case", 0, 0);
    let step_s = if rng.random_bool(0.5) { 0.25 } else { 0.05 };
    let effects = match kind {
        Kind::Null | Kind::Shuffled => vec![],
        Kind::Single(i) => vec![draw_effect(i, sizes, &mut rng)],
        Kind::Pair(i, j) => vec![draw_effect(i, sizes, &mut rng), draw_effect(j, sizes, &mut rng)],
        Kind::OffCatalogue(i) => vec![draw_off_catalogue(i, &mut rng)],
        Kind::Swarm(number) => {
            variant = Variant {
                sensors: Some(rng.random_range(1..5)),
                intensity: Intensity::ALL[rng.random_range(0..Intensity::ALL.len())],
                rig_has_pattern: rng.random_bool(0.5),
            };
            draw_swarm(number, variant.sensors == Some(1), &mut rng)
        }
    };
    Case { seed, size, kind, effects, step_s, variant }
}

/// Different effects at once. A single sensor's pose is that of the vehicle, so that only one of the two is hidden.
fn draw_swarm(number: usize, one_sensor: bool, rng: &mut Stream) -> Vec<Effect> {
    let possible = |i: &usize| !(one_sensor && CAUSES[*i] == "sensor_extrinsics");
    let mut nameable: Vec<usize> = (0..CAUSES.len()).filter(possible).collect();
    let mut foreign: Vec<usize> = (0..OFF_CATALOGUE).collect();
    let off = rng.random_range(0..3usize).min(number / 2);
    let take = |list: &mut Vec<usize>, rng: &mut Stream| list.swap_remove(rng.random_range(0..list.len()));
    let draw_one = |k: usize| {
        if k < off {
            draw_off_catalogue(take(&mut foreign, rng), rng)
        } else {
            draw_effect(take(&mut nameable, rng), Sizes::All, rng)
        }
    };
    (0..number.min(CAUSES.len() - 2)).map(draw_one).collect()
}

/// Log-uniform random number.
fn log_uniform(rng: &mut Stream, low: f64, high: f64) -> f64 {
    (low.ln() + (high / low).ln() * rng.random::<f64>()).exp()
}

fn sign(rng: &mut Stream) -> f64 {
    if rng.random_bool(0.5) { 1.0 } else { -1.0 }
}

fn draw_effect(i: usize, sizes: Sizes, rng: &mut Stream) -> Effect {
    let deg = f64::to_radians;
    let strong = sizes == Sizes::Strong;
    // Strong effects have parameters in the upper part of a range, or in the lower one where less is stronger.
    let log =
        |rng: &mut Stream, low: f64, high: f64| log_uniform(rng, if strong { (low * high).sqrt() } else { low }, high);
    let upper = |low: f64, high: f64| -> Range<f64> { (if strong { 0.5 * (low + high) } else { low })..high };
    let lower = |low: f64, high: f64| -> Range<f64> { low..(if strong { 0.5 * (low + high) } else { high }) };
    match CAUSES[i] {
        "range_noise" => Effect::RangeNoise {
            sigma_m: log(rng, 0.01, 0.06),
            growth_per_m: if rng.random_bool(0.3) { rng.random_range(0.01..0.05) } else { 0.0 },
        },
        "range_bias" => Effect::RangeBias {
            offset_m: sign(rng) * log(rng, 0.05, 0.25),
            scale: if rng.random_bool(0.3) { sign(rng) * log(rng, 1e-3, 4e-3) } else { 0.0 },
        },
        "beam_range_offset" => Effect::BeamRangeOffset { std_m: log(rng, 0.015, 0.08) },
        "beam_elevation_offset" => Effect::BeamElevationOffset { std_rad: deg(log(rng, 0.04, 0.2)) },
        "quantisation" => Effect::Quantisation { step_m: log(rng, 0.04, 0.2) },
        "angular_jitter" => Effect::AngularJitter { sigma_rad: deg(log(rng, 0.02, 0.1)) },
        "random_dropout" => Effect::RandomDropout { share: log(rng, 0.02, 0.3) },
        "signal_dropout" => {
            Effect::SignalDropout { half_at: rng.random_range(upper(-11.5, -9.0)), speckle: rng.random_range(0.2..0.7) }
        }
        "range_dropout" => Effect::RangeDropout {
            half_at_m: rng.random_range(lower(30.0, 75.0)),
            softness_m: rng.random_range(5.0..20.0),
        },
        "incidence_dropout" => {
            Effect::IncidenceDropout { half_at_cos: log(rng, 0.03, 0.15), power: rng.random_range(1.5..3.5) }
        }
        "material_dropout" => {
            Effect::MaterialDropout { tyres: rng.random_bool(0.5), share: rng.random_range(upper(0.3, 0.9)) }
        }
        "range_cut" => Effect::RangeCut { max_m: rng.random_range(lower(35.0, 90.0)) },
        "ego_occlusion" => {
            let side = sign(rng);
            let size_m =
                [rng.random_range(0.2..0.6), rng.random_range(upper(0.5, 1.1)), rng.random_range(upper(0.1, 0.3))];
            Effect::EgoOcclusion {
                center_m: [-1.9, side * rng.random_range(0.0..0.5), rng.random_range(0.5..0.9)],
                size_m,
            }
        }
        "time_offset" => Effect::TimeOffset {
            seconds: sign(rng) * log(rng, 0.006, 0.04),
            clock: if rng.random_bool(0.7) { Clock::Targets } else { Clock::Cloud },
        },
        "label_offset" => {
            let axis = rng.random_range(0..3usize);
            let mut offset_m = [0.0; 3];
            offset_m[axis] = sign(rng) * log(rng, 0.08, 0.6);
            Effect::LabelOffset { offset_m }
        }
        "sensor_extrinsics" => {
            let mut turn_rad = [0.0; 3];
            turn_rad[rng.random_range(0..3usize)] = sign(rng) * deg(log(rng, 0.15, 0.8));
            Effect::SensorExtrinsics { sensor: 0, turn_rad, shift_m: [0.0; 3] }
        }
        "pitch_roll" => Effect::PitchRoll {
            pitch_rad: sign(rng) * deg(log(rng, 0.1, 0.5)),
            roll_rad: sign(rng) * deg(log(rng, 0.05, 0.4)),
        },
        "rolling_shutter" => Effect::RollingShutter { scan_s: rng.random_range(upper(0.03, 0.1)) },
        "outliers" => Effect::Outliers { share: log(rng, 0.003, 0.03) },
        "mixed_pixels" => Effect::MixedPixels { divergence_rad: log(rng, 2e-3, 8e-3) },
        "missing_object" => Effect::MissingObject { things: rng.random_range(if strong { 13 } else { 6 }..20) },
        _ => Effect::WrongShape {
            length: rng.random_range(upper(0.05, 0.15)),
            height: rng.random_range(upper(0.05, 0.2)),
        },
    }
}

fn draw_off_catalogue(i: usize, rng: &mut Stream) -> Effect {
    let deg = f64::to_radians;
    match i % OFF_CATALOGUE {
        0 => Effect::AzimuthRipple { amplitude_m: log_uniform(rng, 0.04, 0.15), waves: rng.random_range(6..14) as f64 },
        1 => Effect::StripedLoss { share: rng.random_range(0.15..0.5), stripes: rng.random_range(3..7) as f64 },
        2 => Effect::SidedNoise { sigma_m: log_uniform(rng, 0.04, 0.12) },
        _ => Effect::Smear {
            share: rng.random_range(0.3..0.9),
            middle: [rng.random_range(-0.35..0.35), rng.random_range(0.2..0.6)],
            half_rad: [deg(rng.random_range(4.0..10.0)), deg(rng.random_range(2.0..5.0))],
        },
    }
}
