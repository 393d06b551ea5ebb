//! One frame of a side: true poses over the scan, what is drawn for the frame, and what a shot meets.

use crate::effect::Effect;
use crate::footprint::{Spread, mixed};
use crate::sensor::{Shot, direction};
use crate::side::{Side, UNSTEADY_STD, Unsteady, isometry, normal};
use crate::solid::{Block, Material, Ray};
use crate::world::{Hit, Moment, Object};
use nalgebra::{Isometry3, Point3, UnitQuaternion, Vector3};
use rand::RngExt;
use std::f64::consts::TAU;

/// A part of a scan in which poses count as constant.
struct Slice {
    /// `world_from_vehicle`, as it truly is.
    vehicle: Isometry3<f64>,
    moment: Moment,
}

/// A bright sign as a sensor sees it.
#[derive(Clone, Copy, Debug)]
pub struct Bright {
    /// Direction in the sensor's frame.
    pub direction: Vector3<f64>,
    /// Distance, m.
    pub range_m: f64,
    /// Half of its apparent size, rad.
    pub half_rad: f64,
}

/// A sector in which a burst disturbs: sensor, middle (rad) and half width (rad).
pub type Sector = (usize, f64, f64);

/// A frame of a side.
pub struct Frame<'a> {
    /// The side.
    pub side: &'a Side,
    /// Number of the frame.
    pub index: usize,
    /// Its time, s.
    pub time_s: f64,
    /// True `world_from_vehicle` in the middle of the scan, with which labels move.
    pub believed: Isometry3<f64>,
    slices: Vec<Slice>,
    mounts: Vec<Isometry3<f64>>,
    /// Blocks of columns that are lost, by sensor.
    pub lost: Vec<Vec<bool>>,
    /// A burst of this frame, if any.
    pub burst: Option<Sector>,
    /// Phase of the stripes of interference, rad.
    pub stripes: f64,
    /// Bright signs by sensor; empty without an effect that needs them.
    pub bright: Vec<Vec<Bright>>,
    /// Factor on the random loss that is hidden.
    pub loss_factor: f64,
    rack: Option<(Block, bool)>,
}

/// Distance from which on two surfaces are two returns, m.
const DUAL_PULSE_M: f64 = 1.0;

/// Columns of a packet.
pub const PACKET: usize = 12;

/// What a shot meets.
#[derive(Clone, Copy, Debug)]
pub struct Echo {
    /// Distance, m.
    pub range_m: f64,
    /// Cosine of the angle of incidence.
    pub cos_incidence: f64,
    /// Reflectivity.
    pub reflectivity: f64,
    /// Material.
    pub material: Material,
    /// What it is.
    pub object: Object,
    /// Outward normal in the world.
    pub normal: Vector3<f64>,
    /// Direction of the shot in the world.
    pub ray: Vector3<f64>,
    /// Begin of the shot in the world, m.
    pub origin: Point3<f64>,
}

impl Echo {
    fn new(hit: Hit, ray: &Ray) -> Echo {
        let cos = hit.cos_incidence(&ray.direction);
        Echo {
            range_m: hit.range_m,
            cos_incidence: if hit.material.is_retroreflective() { 1.0 } else { cos },
            reflectivity: hit.reflectivity,
            material: hit.material,
            object: hit.object,
            normal: hit.normal,
            ray: ray.direction,
            origin: ray.origin,
        }
    }

    /// Received signal without attenuation: ln(rho cos / R^2).
    pub fn signal(&self) -> f64 {
        (self.reflectivity * self.cos_incidence / (self.range_m * self.range_m)).ln()
    }
}

/// What a shot meets first, and a second surface behind an edge.
#[derive(Clone, Copy, Debug, Default)]
pub struct Met {
    /// The surface that is reported.
    pub first: Option<Echo>,
    /// Range of a second surface, m.
    pub second_m: Option<f64>,
}

impl<'a> Frame<'a> {
    /// Frame `index` of a side.
    pub fn new(side: &'a Side, index: usize) -> Frame<'a> {
        let t = index as f64 * side.setting.step_s();
        let (mut scan_s, mut nod) = (0.0, None);
        let mut attitude = Isometry3::identity();
        let mut rack = None;
        for effect in &side.effects {
            match *effect {
                Effect::RollingShutter { scan_s: s } => scan_s = s,
                Effect::MountVibration { amplitude_rad, hz } => nod = Some((amplitude_rad, hz)),
                Effect::PitchRoll { pitch_rad, roll_rad } => {
                    let turn = UnitQuaternion::from_euler_angles(roll_rad, pitch_rad, 0.0);
                    attitude *= Isometry3::from_parts(Default::default(), turn);
                }
                Effect::EgoAttitude { pitch_rad } => {
                    let speed = side.scenario.drive.speed_m_s(t);
                    attitude *= isometry([0.0; 3], [0.0, pitch_rad * (speed / 10.0).powi(2), 0.0]);
                }
                Effect::EgoOcclusion { center_m, size_m, returns } => {
                    rack = Some((Block::new(center_m, size_m, 0.0), returns));
                }
                _ => {}
            }
        }
        let number = if scan_s != 0.0 || nod.is_some() { 32 } else { 1 };
        let own = side.own.displacement[index];
        let slices = (0..number).map(|i| {
            let phase = (f64::from(i) + 0.5) / f64::from(number) - 0.5;
            let late = scan_s * mirror(phase);
            let vibrating = nod.map_or_else(Isometry3::identity, |(amplitude, hz)| {
                let now = t + phase / side.setting.rate_hz;
                isometry([0.0; 3], [0.0, amplitude * (TAU * hz * now).sin(), 0.0])
            });
            let log = side.scenario.ego(t + late);
            let vehicle = log * own * side.own.pose[index] * attitude * vibrating;
            let moment = side.world.moment(t + late, &Point3::from(vehicle.translation.vector));
            Slice { vehicle, moment }
        });
        let slices = slices.collect();
        let believed = side.scenario.ego(t) * own;
        let mut frame = Frame {
            side,
            index,
            time_s: t,
            believed,
            slices,
            mounts: true_mounts(side),
            lost: side.mounts.iter().map(|m| vec![false; m.columns().div_ceil(PACKET)]).collect(),
            burst: None,
            stripes: 0.0,
            bright: vec![Vec::new(); side.mounts.len()],
            loss_factor: 1.0,
            rack,
        };
        frame.draw();
        frame
    }

    /// Draws what the effects have for each frame.
    fn draw(&mut self) {
        let side = self.side;
        for effect in &side.effects {
            let rng = &mut side.stream(&format!("frame {}", effect.cause()), self.index);
            match *effect {
                Effect::PacketLoss { loss, burst } => {
                    // Bursts end after 1 / (1 - burst) packets on average; `loss` is the share of lost packets.
                    let begin = loss * (1.0 - burst) / (1.0 - loss);
                    for lost in &mut self.lost {
                        let mut now = rng.random_bool(loss);
                        for packet in lost {
                            *packet = now;
                            now = rng.random_bool(if now { burst } else { begin });
                        }
                    }
                }
                Effect::Bursts { frames, .. } if rng.random_bool(frames) => {
                    let sensor = rng.random_range(0..side.mounts.len());
                    let fov = side.mounts[sensor].fov_rad;
                    let half = rng.random_range(0.03..0.08) * fov;
                    self.burst = Some((sensor, fov * rng.random_range(-0.4..0.4), half));
                }
                Effect::Interference { .. } => self.stripes = rng.random_range(0.0..TAU),
                Effect::RandomDropout { .. } => self.loss_factor = (0.06 * normal(rng)).exp(),
                Effect::Blooming { .. } | Effect::BrightTargetDropout { .. } if self.bright[0].is_empty() => {
                    self.bright = (0..side.mounts.len()).map(|k| self.signs(k)).collect();
                }
                _ => {}
            }
        }
    }

    /// Bright signs that a sensor sees.
    fn signs(&self, sensor: usize) -> Vec<Bright> {
        let slice = &self.slices[self.slices.len() / 2];
        let pose = slice.vehicle * self.mounts[sensor];
        let origin = pose * Point3::origin();
        let mut found = Vec::new();
        for (number, body) in self.side.world.bodies.iter().enumerate().filter(|b| b.1.material.is_retroreflective()) {
            let crate::world::Form::Block(block) = &body.form else { continue };
            let to = block.center - origin;
            let range_m = to.norm();
            if range_m > 70.0 {
                continue;
            }
            let ray = Ray { origin, direction: to / range_m };
            let hit = self.side.world.cast(&slice.moment, &ray);
            if hit.is_some_and(|h| h.object == Object::Body(number as u32)) {
                let half_rad = block.half.y / range_m;
                found.push(Bright { direction: pose.inverse_transform_vector(&ray.direction), range_m, half_rad });
            }
        }
        found
    }

    fn slice(&self, shot: &Shot) -> &Slice {
        let n = self.slices.len();
        &self.slices[(((shot.phase + 0.5) * n as f64) as usize).min(n - 1)]
    }

    /// The true ray of a shot in the world, with an additional error of its azimuth and elevation (rad), and the same
    /// ray in the vehicle frame.
    fn rays(&self, shot: &Shot, jitter: [f64; 2]) -> (Ray, Ray) {
        let side = self.side;
        let mut azimuth = shot.azimuth_rad;
        for effect in &side.effects {
            if let Effect::EncoderRipple { amplitude_rad, waves } = *effect {
                azimuth += amplitude_rad * (waves * shot.azimuth_rad + 0.7).sin();
            }
        }
        let elevation = shot.elevation_rad + side.rows[shot.sensor][shot.row].elevation_rad;
        let straight = direction(azimuth, elevation);
        // Across the shot, so that the error does not depend on the elevation.
        let beside = Vector3::new(-azimuth.sin(), azimuth.cos(), 0.0);
        let above = straight.cross(&beside);
        let shot_in_sensor = (straight + beside * jitter[0] + above * jitter[1]).normalize();
        let mount = self.mounts[shot.sensor];
        let in_vehicle = Ray { origin: mount * Point3::origin(), direction: mount.rotation * shot_in_sensor };
        let vehicle = self.slice(shot).vehicle;
        let in_world = Ray { origin: vehicle * in_vehicle.origin, direction: vehicle.rotation * in_vehicle.direction };
        (in_world, in_vehicle)
    }

    /// What a shot meets, with an additional error of its direction, rad.
    pub fn trace(&self, shot: &Shot, jitter: [f64; 2]) -> Met {
        let (ray, in_vehicle) = self.rays(shot, jitter);
        if let Some((rack, returns)) = &self.rack
            && let Some((t, normal)) = rack.enter(&in_vehicle)
        {
            let normal = self.slice(shot).vehicle.rotation * normal;
            let reflectivity = 0.3;
            let hit = Hit { range_m: t, normal, material: Material::Metal, reflectivity, object: Object::Ego };
            return Met { first: returns.then(|| Echo::new(hit, &ray)), second_m: None };
        }
        let moment = &self.slice(shot).moment;
        let cast = |ray: &Ray| self.side.world.cast(moment, ray);
        let center = cast(&ray);
        let mut met = Met { first: center.map(|hit| Echo::new(hit, &ray)), second_m: None };
        for effect in &self.side.effects {
            match *effect {
                Effect::MixedPixels { divergence_rad, pulse_m } => {
                    let beam = mixed(&ray, center, &Spread { full_width_rad: divergence_rad, pulse_m }, cast);
                    met.first = beam.first.map(|hit| Echo::new(hit, &ray));
                }
                Effect::DualReturns { divergence_rad, .. } => {
                    let spread = Spread { full_width_rad: divergence_rad, pulse_m: DUAL_PULSE_M };
                    met.second_m = mixed(&ray, center, &spread, cast).second_m;
                }
                _ => {}
            }
        }
        met
    }

    /// Length of the way from a mirroring surface to the next one, if there is one, m.
    pub fn mirrored_m(&self, shot: &Shot, echo: &Echo) -> Option<f64> {
        let along = echo.ray - echo.normal * (2.0 * echo.ray.dot(&echo.normal));
        let origin = echo.origin + echo.ray * echo.range_m + echo.normal * 1e-3;
        let hit = self.side.world.cast(&self.slice(shot).moment, &Ray { origin, direction: along })?;
        Some(hit.range_m)
    }

    /// The vehicle before a plume on the way of a shot, where that way begins and ends in it before `until_m`, m, and
    /// the density over that behind a car at 8 m/s.
    pub fn plume_m(&self, shot: &Shot, until_m: f64) -> Option<(usize, [f64; 2], f64)> {
        let (ray, _) = self.rays(shot, [0.0; 2]);
        let world = &self.side.world;
        for (vehicle, place) in self.slice(shot).moment.places() {
            let size = world.models[world.vehicles[vehicle].model].size_m;
            if size[0] < 2.0 {
                continue;
            }
            let motion = &world.vehicles[vehicle].motion;
            let speed = motion.velocity_m_s(self.time_s, &world.streets).norm();
            let (sin, cos) = place.heading_rad.sin_cos();
            let behind = size[0] / 2.0 + 4.0;
            let [x, y, z] = place.center;
            let center = [x - behind * cos, y - behind * sin, z - size[2] / 2.0 + 0.6];
            let plume = Block::new(center, [7.5, size[1] + 0.5, 1.2], place.heading_rad);
            if let Some([enter, leave]) = plume.chord(&ray) {
                let leave = leave.min(until_m);
                if leave > enter {
                    return Some((vehicle, [enter, leave], (speed / 8.0).powi(2)));
                }
            }
        }
        None
    }

    /// What varies from frame to frame: see [`UNSTEADY_STD`], with its units.
    pub fn unsteady(&self) -> Unsteady {
        let state = self.side.own.unsteady[self.index];
        [0, 1, 2, 3, 4].map(|k| state[k] * UNSTEADY_STD[k])
    }

    /// The true pose of a sensor in the world in the middle of the scan.
    pub fn sensor_pose(&self, sensor: usize) -> Isometry3<f64> {
        self.slices[self.slices.len() / 2].vehicle * self.mounts[sensor]
    }
}

/// Time of a mirror that swings unevenly as a fraction of the scan, for a phase from -1/2 to 1/2.
fn mirror(phase: f64) -> f64 {
    phase + 0.05 * (TAU * phase).sin()
}

/// True poses of the sensors in the vehicle.
fn true_mounts(side: &Side) -> Vec<Isometry3<f64>> {
    let mut mounts: Vec<Isometry3<f64>> = side.mounts.iter().map(|m| m.pose()).collect();
    for effect in &side.effects {
        if let Effect::SensorExtrinsics { sensor, turn_rad, shift_m } = *effect {
            mounts[sensor] *= isometry(shift_m, turn_rad);
        }
    }
    mounts
}
