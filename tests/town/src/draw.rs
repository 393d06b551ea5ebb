//! Draws effects with random sizes.

use crate::effect::{Clock, Dark, Effect, Spot};
use crate::sensor::{Layout, Mount};
use crate::setting::Setting;
use data::Stream;
use rand::RngExt;

/// Effects that are named in the catalogue of the diagnosis or are effects of the simulator.
pub const CAUSES: [&str; 40] = [
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
    "heavy_tails",
    "signal_noise",
    "reflectivity_walk",
    "beam_intensity",
    "incidence_noise",
    "ground_error",
    "packet_loss",
    "dirty_window",
    "blooming",
    "bright_target_dropout",
    "ghosts",
    "dual_returns",
    "rain",
    "fog",
    "spray",
    "range_drift",
    "ego_attitude",
    "near_cut",
];

/// Effects that are in no catalogue.
pub const OFF_CATALOGUE: [&str; 8] = [
    "thermal_rows",
    "bursts",
    "encoder_ripple",
    "interference",
    "mount_vibration",
    "wavy_walls",
    "range_ripple",
    "column_loss",
];

/// Whether an effect makes sense in a setting.
pub fn is_possible(cause: &str, setting: &Setting) -> bool {
    let rows = setting.layout != Layout::Rosette;
    let parallel = setting.scene == crate::setting::Scene::Parallel;
    match cause {
        "beam_range_offset" | "beam_elevation_offset" | "thermal_rows" => rows,
        "beam_intensity" => rows && setting.intensity.is_of_surface(),
        "sensor_extrinsics" => setting.layout == Layout::RoofAndGrille,
        "time_offset" | "label_offset" | "wrong_shape" | "material_dropout" => setting.labels,
        "ego_occlusion" => setting.layout != Layout::Rosette,
        "blooming" | "bright_target_dropout" | "ghosts" | "missing_object" => !parallel,
        _ => true,
    }
}

/// Log-uniform random number.
fn log(rng: &mut Stream, low: f64, high: f64) -> f64 {
    low * (high / low).powf(rng.random::<f64>())
}

fn sign(rng: &mut Stream) -> f64 {
    if rng.random_bool(0.5) { 1.0 } else { -1.0 }
}

/// Draws an effect by the name of its cause.
pub fn draw_effect(cause: &str, mounts: &[Mount], scan_s: f64, rng: &mut Stream) -> Effect {
    let deg = f64::to_radians;
    match cause {
        "range_noise" => Effect::RangeNoise {
            std_m: log(rng, 0.004, 0.06),
            growth: if rng.random_bool(0.3) { log(rng, 4e-4, 2e-3) } else { 0.0 },
        },
        "range_bias" => Effect::RangeBias {
            offset_m: sign(rng) * log(rng, 0.006, 0.2),
            scale: if rng.random_bool(0.3) { sign(rng) * log(rng, 5e-4, 4e-3) } else { 0.0 },
        },
        "beam_range_offset" => Effect::BeamRangeOffset { std_m: log(rng, 0.004, 0.07) },
        "beam_elevation_offset" => Effect::BeamElevationOffset { std_rad: deg(log(rng, 0.03, 0.2)) },
        "quantisation" => Effect::Quantisation { step_m: log(rng, 0.02, 0.2) },
        "angular_jitter" => Effect::AngularJitter { std_rad: deg(log(rng, 0.01, 0.12)) },
        "random_dropout" => Effect::RandomDropout { share: log(rng, 0.004, 0.3) },
        "signal_dropout" => {
            Effect::SignalDropout { half_at: rng.random_range(-12.0..-8.5), steepness: rng.random_range(1.0..3.0) }
        }
        "range_dropout" => {
            Effect::RangeDropout { half_at_m: rng.random_range(25.0..70.0), softness_m: rng.random_range(4.0..18.0) }
        }
        "incidence_dropout" => {
            Effect::IncidenceDropout { cos_half: log(rng, 0.03, 0.2), power: rng.random_range(0.8..2.0) }
        }
        "material_dropout" => Effect::MaterialDropout {
            dark: if rng.random_bool(0.4) { Dark::Tyres } else { Dark::Bodies },
            share: rng.random_range(0.15..0.9),
        },
        "range_cut" => Effect::RangeCut { max_m: rng.random_range(25.0..75.0) },
        "ego_occlusion" => draw_occlusion(mounts, rng),
        "time_offset" => Effect::TimeOffset {
            seconds: sign(rng) * log(rng, 0.003, 0.08),
            clock: if rng.random_bool(0.7) { Clock::Objects } else { Clock::Cloud },
        },
        "label_offset" => {
            let mut offset_m = [0.0; 3];
            offset_m[rng.random_range(0..3usize)] = sign(rng) * log(rng, 0.015, 0.4);
            Effect::LabelOffset { offset_m }
        }
        "sensor_extrinsics" => {
            let (mut turn_rad, mut shift_m) = ([0.0; 3], [0.0; 3]);
            turn_rad[rng.random_range(0..3usize)] = sign(rng) * deg(log(rng, 0.03, 0.6));
            if rng.random_bool(0.3) {
                shift_m[rng.random_range(0..3usize)] = sign(rng) * log(rng, 0.02, 0.1);
            }
            Effect::SensorExtrinsics { sensor: rng.random_range(0..mounts.len()), turn_rad, shift_m }
        }
        "pitch_roll" => Effect::PitchRoll {
            pitch_rad: sign(rng) * deg(log(rng, 0.02, 0.5)),
            roll_rad: sign(rng) * deg(log(rng, 0.015, 0.4)),
        },
        "rolling_shutter" => Effect::RollingShutter { scan_s: scan_s * rng.random_range(0.4..1.0) },
        "outliers" => Effect::Outliers { share: log(rng, 4e-4, 0.03), reach_m: rng.random_range(60.0..118.0) },
        "mixed_pixels" => Effect::MixedPixels { divergence_rad: log(rng, 1.5e-3, 8e-3), pulse_m: log(rng, 0.4, 4.0) },
        "missing_object" => Effect::MissingObject { things: rng.random_range(2..14), surplus: rng.random_bool(0.4) },
        "wrong_shape" => {
            Effect::WrongShape { length: rng.random_range(0.02..0.15), height: rng.random_range(0.02..0.2) }
        }
        "heavy_tails" => Effect::HeavyTails { share: log(rng, 0.001, 0.05), std_m: log(rng, 0.08, 0.4) },
        "signal_noise" => Effect::SignalNoise { std_m: log(rng, 0.006, 0.04), growth: rng.random_range(0.3..1.0) },
        "reflectivity_walk" => Effect::ReflectivityWalk { walk_m: sign(rng) * log(rng, 0.004, 0.05) },
        "beam_intensity" => Effect::BeamIntensity { std: log(rng, 0.02, 0.3) },
        "incidence_noise" => Effect::IncidenceNoise { angle_rad: log(rng, 3e-4, 2e-3) },
        "ground_error" => Effect::GroundError { amplitude_m: log(rng, 0.015, 0.08) },
        "packet_loss" => Effect::PacketLoss { loss: log(rng, 0.002, 0.06), burst: rng.random_range(0.2..0.8) },
        "dirty_window" => draw_dirt(mounts, rng),
        "blooming" => Effect::Blooming { strength: rng.random_range(0.2..0.9), halo_rad: deg(log(rng, 0.3, 2.0)) },
        "bright_target_dropout" => {
            Effect::BrightTargetDropout { share: rng.random_range(0.3..1.0), halo_rad: deg(log(rng, 0.6, 4.0)) }
        }
        "ghosts" => Effect::Ghosts { probability: log(rng, 0.01, 0.4) },
        "dual_returns" => {
            Effect::DualReturns { divergence_rad: log(rng, 2e-3, 6e-3), share: rng.random_range(0.5..1.0) }
        }
        "rain" => Effect::Rain { drops: log(rng, 4e-4, 0.02), per_m: log(rng, 5e-4, 4e-3) },
        "fog" => Effect::Fog { visibility_m: log(rng, 120.0, 1_500.0), backscatter: log(rng, 0.001, 0.05) },
        "spray" => Effect::Spray { per_m: log(rng, 0.02, 0.3) },
        "range_drift" => Effect::RangeDrift { drift_m: sign(rng) * log(rng, 0.005, 0.12) },
        "ego_attitude" => Effect::EgoAttitude { pitch_rad: sign(rng) * deg(log(rng, 0.03, 0.5)) },
        "near_cut" => Effect::RangeLimits { min_m: rng.random_range(3.5..9.0) },
        "thermal_rows" => Effect::ThermalRows { drift_m: sign(rng) * log(rng, 0.02, 0.1) },
        "bursts" => Effect::Bursts { frames: rng.random_range(0.2..0.6), std_m: log(rng, 0.04, 0.2) },
        "encoder_ripple" => Effect::EncoderRipple {
            amplitude_rad: deg(log(rng, 0.05, 0.3)),
            waves: f64::from(rng.random_range(2..9u32)),
        },
        "interference" => {
            Effect::Interference { share: rng.random_range(0.03..0.3), stripes: rng.random_range(3.0..9.0) }
        }
        "mount_vibration" => {
            Effect::MountVibration { amplitude_rad: deg(log(rng, 0.05, 0.3)), hz: rng.random_range(3.0..17.0) }
        }
        "wavy_walls" => Effect::WavyWalls { amplitude_m: log(rng, 0.03, 0.1), length_m: rng.random_range(4.0..11.0) },
        "range_ripple" => {
            Effect::RangeRipple { amplitude_m: log(rng, 0.015, 0.08), length_m: rng.random_range(0.8..3.0) }
        }
        "column_loss" => Effect::ColumnLoss { share: rng.random_range(0.2..0.8), every: rng.random_range(3..7) },
        other => panic!("no such effect: {other}"),
    }
}

/// A bar or box near one of the sensors, within its field of view.
fn draw_occlusion(mounts: &[Mount], rng: &mut Stream) -> Effect {
    let mount = &mounts[rng.random_range(0..mounts.len())];
    let away = rng.random_range(0.5..1.3);
    let azimuth = mount.yaw_rad + mount.fov_rad * rng.random_range(-0.4..0.4);
    let [low, high] = mount.elevations_rad();
    let elevation = low + (high - low) * rng.random_range(0.0..0.7);
    let p = mount.position_m;
    let center_m = [p[0] + away * azimuth.cos(), p[1] + away * azimuth.sin(), p[2] + away * elevation.tan()];
    let size_m = [0.05 + 0.25 * rng.random::<f64>(), 0.05 + 0.25 * rng.random::<f64>(), rng.random_range(0.05..0.25)];
    Effect::EgoOcclusion { center_m, size_m, returns: rng.random_bool(0.5) }
}

/// Dirt on the window of one of the sensors.
fn draw_dirt(mounts: &[Mount], rng: &mut Stream) -> Effect {
    let sensor = rng.random_range(0..mounts.len());
    let mount = &mounts[sensor];
    let [low, high] = mount.elevations_rad();
    let center = [mount.fov_rad * rng.random_range(-0.35..0.35), low + (high - low) * rng.random_range(0.1..0.8)];
    let radius = [rng.random_range(3.0..14.0f64).to_radians(), rng.random_range(2.0..6.0f64).to_radians()];
    let spot = Spot { sensor, center, radius };
    Effect::DirtyWindow { spot, share: rng.random_range(0.2..0.9), noise_m: rng.random_range(0.0..0.05) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::draw_mounts;
    use std::collections::BTreeSet;

    #[test]
    fn every_cause_is_drawn_under_its_own_name() {
        let mut rng = data::stream(1, "draw", 0, 0);
        let (mounts, _) = draw_mounts(&mut rng, Layout::RoofAndGrille, 20_000, false);
        let all: BTreeSet<&str> = CAUSES.into_iter().chain(OFF_CATALOGUE).collect();
        assert_eq!(all.len(), CAUSES.len() + OFF_CATALOGUE.len());
        for cause in all {
            let effect = draw_effect(cause, &mounts, 0.1, &mut rng);
            assert_eq!(effect.cause(), cause);
            assert!(!effect.parameters().is_empty());
            assert!(!(OFF_CATALOGUE.contains(&cause) && effect.in_catalogue()));
        }
    }
}
