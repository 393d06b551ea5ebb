//! The two sides of a pair: world, sensors, nuisances and effects.

use crate::effect::Effect;
use crate::scenario::Scenario;
use crate::sensor::{Dither, Mount, Shot};
use crate::setting::Setting;
use crate::solid::{Block, Material};
use crate::town::rolling;
use crate::traffic::Motion;
use crate::vehicle::Place;
use crate::world::{Body, Form, World};
use data::Stream;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use std::f64::consts::TAU;
use std::sync::Arc;

/// Nuisances that are equal on both sides.
#[derive(Clone, Copy, Debug)]
pub struct Nuisances {
    /// Standard deviation of the range noise, m.
    pub noise_m: f64,
    /// Share of returns lost at random.
    pub lost: f64,
    /// Share of shots with a false return.
    pub false_returns: f64,
    /// Signal, ln(rho cos / R^2), at which half of the returns are lost.
    pub weakest: f64,
    /// Mean depth at which leaves return, m.
    pub leaves_m: f64,
    /// Known unsteadiness of the shots.
    pub dither: Dither,
}

impl Nuisances {
    /// Draws nuisances.
    pub fn draw(rng: &mut Stream) -> Nuisances {
        Nuisances {
            noise_m: rng.random_range(0.003..0.015),
            lost: rng.random_range(0.001..0.02),
            false_returns: rng.random_range(0.0..4e-4),
            weakest: rng.random_range(-14.5..-12.5),
            leaves_m: rng.random_range(0.03..0.15),
            dither: Dither {
                random: if rng.random_bool(0.5) { [0.15, 0.04] } else { [0.0; 2] },
                wobble: if rng.random_bool(0.5) { rng.random_range(0.0..0.3) } else { 0.0 },
            },
        }
    }
}

/// Errors of one side alone: small ones that are not to be found, and those of the kinds `pose`.
#[derive(Clone, Debug, Default)]
pub struct OwnErrors {
    /// Error of the ego pose of each frame, in the vehicle frame. Labels do not move with it.
    pub pose: Vec<Isometry3<f64>>,
    /// Displacement of each frame against the log, in the vehicle frame. Labels move with it.
    pub displacement: Vec<Isometry3<f64>>,
    /// What varies from frame to frame.
    pub unsteady: Vec<Unsteady>,
    /// Standard deviation of the error of each label, m. Most of it belongs to the frame, [`TRACK_SHARE`] of it to the
    /// vehicle.
    pub labels_m: f64,
}

/// What varies from frame to frame on both sides, in standard deviations of [`UNSTEADY_STD`].
pub type Unsteady = [f64; 5];

/// Standard deviations of what varies from frame to frame: logarithm of the range noise, logarithm of the random loss,
/// threshold of the signal (in its logarithm), range offset (m), logarithm of the rate of false returns.
pub const UNSTEADY_STD: [f64; 5] = [0.04, 0.2, 0.08, 0.001, 0.25];

/// Standard deviation of the part of a label error that a vehicle has in all frames, as a share of the whole.
pub const TRACK_SHARE: f64 = 0.6;

/// Time in which slow errors forget their value, s.
pub const MEMORY_S: f64 = 0.7;

/// Standard deviation of the small pose errors, m and rad.
pub const POSE_STD: [f64; 2] = [0.003, 1e-4];

impl OwnErrors {
    /// The small errors of a measured side: poses that change slowly, and labels.
    pub fn small(rng: &mut Stream, frames: usize, step_s: f64) -> OwnErrors {
        let [a, b] = POSE_STD;
        let pose = |s: [f64; 6]| isometry([a * s[0], a * s[1], a * s[2]], [b * s[3], b * s[4], b * s[5]]);
        OwnErrors {
            pose: slow(rng, frames, step_s).into_iter().map(pose).collect(),
            displacement: vec![Isometry3::identity(); frames],
            unsteady: slow(rng, frames, step_s),
            labels_m: rng.random_range(0.02..0.05),
        }
    }

    /// The errors of a simulated side: none of poses and labels.
    pub fn none(rng: &mut Stream, frames: usize, step_s: f64) -> OwnErrors {
        let still = vec![Isometry3::identity(); frames];
        let unsteady = slow(rng, frames, step_s);
        OwnErrors { pose: still.clone(), displacement: still, unsteady, labels_m: 0.0 }
    }
}

/// Numbers with mean 0 and variance 1 that change slowly from frame to frame.
fn slow<const N: usize>(rng: &mut Stream, frames: usize, step_s: f64) -> Vec<[f64; N]> {
    let keep = (-step_s / MEMORY_S).exp();
    let mut state = [0.0; N].map(|_: f64| normal(rng));
    let mut next = || {
        state = state.map(|value| keep * value + (1.0 - keep * keep).sqrt() * normal(rng));
        state
    };
    (0..frames).map(|_| next()).collect()
}

/// A standard normal random number.
pub fn normal(rng: &mut Stream) -> f64 {
    StandardNormal.sample(rng)
}

/// A small motion: shift (m) and turns about x, y, z (rad).
pub fn isometry(shift_m: [f64; 3], turn_rad: [f64; 3]) -> Isometry3<f64> {
    Isometry3::from_parts(Translation3::from(shift_m), UnitQuaternion::from_scaled_axis(Vector3::from(turn_rad)))
}

/// What is fixed for a row of a sensor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RowErrors {
    /// Range offset, m.
    pub offset_m: f64,
    /// Elevation error, rad.
    pub elevation_rad: f64,
    /// Logarithm of the gain of the intensity.
    pub ln_gain: f64,
}

/// One side of a pair.
#[derive(Clone, Debug)]
pub struct Side {
    /// Name of its random streams.
    pub name: &'static str,
    /// Seed of the case.
    pub seed: u64,
    /// Setting of the case.
    pub setting: Setting,
    /// The scenario as the log has it.
    pub scenario: Arc<Scenario>,
    /// The world of this side.
    pub world: Arc<World>,
    /// Sensors.
    pub mounts: Arc<Vec<Mount>>,
    /// Nuisances, equal on both sides.
    pub nuisances: Nuisances,
    /// Errors of this side alone.
    pub own: Arc<OwnErrors>,
    /// Hidden effects.
    pub effects: Vec<Effect>,
    /// By sensor and row.
    pub rows: Vec<Vec<RowErrors>>,
    /// Duration of all frames, s.
    pub duration_s: f64,
}

impl Side {
    /// The same side with other effects. Nothing that belongs to the kept effects changes.
    pub fn with_effects(&self, base: &Arc<World>, effects: Vec<Effect>) -> Side {
        let world = world_with(base, &effects, &self.scenario, self.seed, self.duration_s);
        let rows = draw_rows(&self.mounts, &effects, self.seed);
        Side { world, rows, effects, ..self.clone() }
    }

    /// A stream of random numbers of this side.
    pub fn stream(&self, purpose: &str, frame: usize) -> Stream {
        data::stream(self.seed, &format!("town {} {purpose}", self.name), 0, frame as u64)
    }

    /// The shots of a sensor in a frame.
    pub fn shots(&self, sensor: usize, frame: usize) -> Vec<Shot> {
        let rng = &mut self.stream(&format!("shots {sensor}"), frame);
        self.mounts[sensor].shots(sensor, &self.nuisances.dither, rng)
    }
}

/// A uniform random number up to `size`, of either sign.
fn off(rng: &mut Stream, size: f64) -> f64 {
    rng.random_range(-size..size)
}

/// The small errors of a real world against its model: houses, things and cars stand or are a little elsewhere, and the
/// ground is a little uneven.
pub fn real_world(model: &World, rng: &mut Stream) -> World {
    let mut world = model.clone();
    for house in &mut world.houses {
        house.block.center += Vector3::new(off(rng, 0.02), off(rng, 0.02), 0.0);
        house.reflectivity *= off(rng, 0.05).exp();
    }
    for body in &mut world.bodies {
        let by = Vector3::new(off(rng, 0.012), off(rng, 0.012), off(rng, 0.01));
        match &mut body.form {
            Form::Block(block) => block.center += by,
            Form::Post([x, y], ..) => (*x, *y) = (*x + by.x, *y + by.y),
            Form::Ball(center, _) => *center += by,
        }
    }
    for vehicle in &mut world.vehicles {
        if let Motion::Parked(place) = &mut vehicle.motion {
            let [x, y, z] = place.center;
            let heading_rad = place.heading_rad + off(rng, 0.003);
            *place = Place { center: [x + off(rng, 0.015), y + off(rng, 0.015), z], heading_rad };
        }
    }
    for model in &mut world.models {
        model.stretch = model.stretch.map(|s| s * (1.0 + off(rng, 0.005)));
    }
    let waves = rolling(rng, 0.004, [3.0, 12.0], 4);
    world.streets.waves.extend(waves);
    world.index();
    world
}

/// Moves every house by itself, at most by `most_m` along each axis.
pub fn move_houses(world: &mut World, most_m: f64, rng: &mut Stream) {
    for house in &mut world.houses {
        house.block.center += Vector3::new(rng.random_range(-most_m..most_m), rng.random_range(-most_m..most_m), 0.0);
    }
    world.index();
}

/// The world of a side with those effects that act on it.
fn world_with(base: &Arc<World>, effects: &[Effect], scenario: &Scenario, seed: u64, duration_s: f64) -> Arc<World> {
    let mut world = base.clone();
    for effect in effects {
        let rng = &mut data::stream(seed, &format!("town world {}", effect.cause()), 0, 0);
        match *effect {
            Effect::MissingObject { things, surplus: false } => {
                add_containers(Arc::make_mut(&mut world), scenario, things, duration_s, rng);
            }
            Effect::MissingObject { things, surplus: true } => {
                remove_parked(Arc::make_mut(&mut world), scenario, things, duration_s, rng);
            }
            Effect::WrongShape { length, height } => {
                for model in Arc::make_mut(&mut world).models.iter_mut().filter(|m| m.class == "Car") {
                    model.stretch =
                        [model.stretch[0] * (1.0 + length), model.stretch[1], model.stretch[2] * (1.0 + height)];
                }
            }
            Effect::GroundError { amplitude_m } => {
                let waves = rolling(rng, amplitude_m, [15.0, 45.0], 3);
                Arc::make_mut(&mut world).streets.waves.extend(waves);
            }
            Effect::WavyWalls { amplitude_m, length_m } => {
                for house in &mut Arc::make_mut(&mut world).houses {
                    house.wave = Some([amplitude_m, length_m, rng.random_range(0.0..TAU)]);
                }
            }
            _ => continue,
        }
        Arc::make_mut(&mut world).index();
    }
    world
}

/// Containers on the pavements along the way.
fn add_containers(world: &mut World, scenario: &Scenario, things: usize, duration_s: f64, rng: &mut Stream) {
    let half = world.streets.half_road_m;
    for _ in 0..things {
        let s = scenario.drive.distance_m(duration_s * rng.random::<f64>()) + rng.random_range(-5.0..25.0);
        // Right of the lane, or left of the opposite one.
        let left = if rng.random_bool(0.5) { half + 2.9 } else { -half + 0.5 };
        let ([x, y], heading) = scenario.route.at(s.clamp(2.0, scenario.route.length_m() - 2.0), left);
        let size = [rng.random_range(1.5..5.0), rng.random_range(0.8..1.6), rng.random_range(1.2..2.6)];
        let z = world.streets.height_m(x, y) + size[2] / 2.0;
        let form = Form::Block(Block::new([x, y, z], size, heading));
        world.bodies.push(Body { form, material: Material::Metal, reflectivity: rng.random_range(0.2..0.6) });
    }
}

/// Moves parked cars near the way out of sight: far below the ground.
fn remove_parked(world: &mut World, scenario: &Scenario, things: usize, duration_s: f64, rng: &mut Stream) {
    for _ in 0..things {
        let ([x, y], _) = scenario.route.at(scenario.drive.distance_m(duration_s * rng.random::<f64>()), 0.0);
        let distance = |motion: &Motion| match motion {
            Motion::Parked(place) if place.center[2] > BURIED_M / 2.0 => {
                (place.center[0] - x).hypot(place.center[1] - y)
            }
            _ => f64::INFINITY,
        };
        let nearest = world.vehicles.iter_mut().min_by(|a, b| distance(&a.motion).total_cmp(&distance(&b.motion)));
        if let Some(Motion::Parked(place)) = nearest.map(|v| &mut v.motion) {
            place.center[2] = BURIED_M;
        }
    }
}

/// Height of what is out of sight, m.
const BURIED_M: f64 = -50.0;

/// Errors of the rows of all sensors.
pub fn draw_rows(mounts: &[Mount], effects: &[Effect], seed: u64) -> Vec<Vec<RowErrors>> {
    let mut rows: Vec<Vec<RowErrors>> = mounts.iter().map(|m| vec![RowErrors::default(); m.rows()]).collect();
    for effect in effects {
        let rng = &mut data::stream(seed, &format!("town rows {}", effect.cause()), 0, 0);
        for of_sensor in &mut rows {
            let n = of_sensor.len();
            let smooth: [f64; 2] = [rng.random_range(1.0..2.5), rng.random_range(0.0..TAU)];
            let mut laplace = || {
                let u: f64 = rng.random_range(-0.5..0.5);
                -u.signum() * (1.0 - 2.0 * u.abs()).max(1e-9).ln()
            };
            match *effect {
                Effect::BeamRangeOffset { std_m } => {
                    let values = standardised((0..n).map(|_| laplace()).collect());
                    of_sensor.iter_mut().zip(values).for_each(|(r, v)| r.offset_m = std_m * v);
                }
                Effect::BeamElevationOffset { std_rad } => {
                    let wave = |i: usize| (TAU * smooth[0] * i as f64 / n as f64 + smooth[1]).sin();
                    let values = standardised((0..n).map(|i| wave(i) + 0.6 * laplace()).collect());
                    of_sensor.iter_mut().zip(values).for_each(|(r, v)| r.elevation_rad = std_rad * v);
                }
                Effect::BeamIntensity { std } => {
                    let values = standardised((0..n).map(|_| laplace()).collect());
                    of_sensor.iter_mut().zip(values).for_each(|(r, v)| r.ln_gain = std * v);
                }
                _ => {}
            }
        }
    }
    rows
}

/// Values with mean 0 and standard deviation 1.
fn standardised(values: Vec<f64>) -> Vec<f64> {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt().max(1e-12);
    values.into_iter().map(|v| (v - mean) / std).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::{Layout, draw_mounts};

    #[test]
    fn rows_have_the_standard_deviation_of_their_effect_and_belong_to_it_alone() {
        let (mounts, _) = draw_mounts(&mut data::stream(1, "side", 0, 0), Layout::Roof(32), 20_000, false);
        let offsets = Effect::BeamRangeOffset { std_m: 0.03 };
        let elevations = Effect::BeamElevationOffset { std_rad: 0.002 };
        let both = draw_rows(&mounts, &[offsets.clone(), elevations], 7);
        let one = draw_rows(&mounts, &[offsets], 7);
        let mean_square = |f: &dyn Fn(&RowErrors) -> f64| both[0].iter().map(|r| f(r).powi(2)).sum::<f64>() / 32.0;
        assert!((mean_square(&|r| r.offset_m).sqrt() - 0.03).abs() < 1e-9);
        assert!((mean_square(&|r| r.elevation_rad).sqrt() - 0.002).abs() < 1e-9);
        assert!(one[0].iter().zip(&both[0]).all(|(a, b)| a.offset_m == b.offset_m && a.elevation_rad == 0.0));
    }

    #[test]
    fn small_pose_errors_change_slowly_and_have_their_size() {
        let own = OwnErrors::small(&mut data::stream(2, "side", 0, 0), 2_000, 0.1);
        let x: Vec<f64> = own.pose.iter().map(|p| p.translation.x).collect();
        let square = |v: &[f64]| (v.iter().map(|v| v * v).sum::<f64>() / v.len() as f64).sqrt();
        assert!((square(&x) / POSE_STD[0] - 1.0).abs() < 0.2, "{}", square(&x));
        let steps: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
        assert!(square(&steps) < 0.7 * square(&x));
    }
}
