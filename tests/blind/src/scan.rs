//! Simulation of one scan: shot directions, ray casting, detection, and the reported points.

use crate::detection::Incidence;
use crate::effect::{Clock, Effect};
use crate::rig::Mount;
use crate::solid::{Form, Hit, Material, Solid};
use crate::strength::Observation;
use crate::variant::Light;
use crate::world::{REACH_M, World};
use data::Stream;
use geometry::Box3;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use score::FrameEvidence;

/// Nuisances that are equal on both sides.
#[derive(Clone, Copy, Debug)]
pub struct Nuisances {
    /// Standard deviation of range noise, m.
    pub noise_m: f64,
    /// Fraction of returns lost at random.
    pub lost: f64,
    /// Fraction of shots with a false return.
    pub false_returns: f64,
    /// Detection threshold: minimum of ln(rho cos / R^2).
    pub weakest: f64,
    /// Dither of the shot directions, as a fraction of the column and row steps. Known to the sensor.
    pub dither: [f64; 2],
}

/// Nuisances of one side only: small errors that are not findings.
#[derive(Clone, Copy, Debug, Default)]
pub struct SideErrors {
    /// Standard deviation of the ego pose error: m, rad.
    pub pose: [f64; 2],
    /// Standard deviation of the label error, m.
    pub labels_m: f64,
}

/// One side of a pair: its world and its sensor model.
pub struct Side<'a> {
    /// Cars, walls and road.
    pub world: &'a World,
    /// Nominal sensor rig.
    pub rig: &'a [Mount],
    /// Nuisances, equal on both sides.
    pub nuisances: Nuisances,
    /// Nuisances of this side.
    pub own: SideErrors,
    /// Hidden effects.
    pub effects: &'a [Effect],
    /// Per sensor and row: range offset, m, and elevation offset, rad.
    pub beams: &'a [Vec<[f64; 2]>],
}

/// Simulated output for one frame.
pub struct Scan {
    /// Points in the ego frame, m, unordered.
    pub points: Vec<[f32; 3]>,
    /// What each point's intensity depends on.
    pub lights: Vec<Light>,
    /// Labels in the ego frame.
    pub boxes: Vec<Box3>,
    /// Sums for the Cramér-Rao bounds.
    pub sums: Sums,
    /// What an oracle sees of the effects.
    pub evidence: FrameEvidence,
}

/// Sums over shots that hit something.
#[derive(Clone, Copy, Debug, Default)]
pub struct Sums {
    /// Number of returns before hidden losses.
    pub returns: f64,
    /// Sum of (R tan(incidence))^2, where below 100 m^2.
    pub lever: f64,
    /// Returns that hidden effects remove, add, or move by more than 0.35 m.
    pub touched: f64,
    /// Number of boxes with at least five points, and the sum of their squared speeds.
    pub boxes: [f64; 2],
}

/// Distance from the surface beyond which a point does not get its intensity, m.
const FALSE_BEYOND_M: f64 = 2.0;

fn normal(rng: &mut Stream) -> f64 {
    StandardNormal.sample(rng)
}

/// Random number with zero mean, unit variance, and lighter tails than the normal distribution.
fn bell(rng: &mut Stream) -> f64 {
    (0..6).map(|_| rng.random::<f64>()).sum::<f64>() * 2f64.sqrt() - 3.0 * 2f64.sqrt()
}

fn small_turn(rad: [f64; 3]) -> UnitQuaternion<f64> {
    UnitQuaternion::from_scaled_axis(Vector3::from(rad))
}

impl Side<'_> {
    /// Simulates the scan at time `t`, s.
    pub fn scan(&self, t: f64, rng: &mut Stream) -> Scan {
        let believed = self.world.pose(0, t);
        let mut pose_error = Isometry3::from_parts(
            Translation3::new(
                normal(rng) * self.own.pose[0],
                normal(rng) * self.own.pose[0],
                normal(rng) * self.own.pose[0],
            ),
            small_turn([0, 1, 2].map(|_| normal(rng) * self.own.pose[1])),
        );
        let mut scan_s = 0.0;
        for effect in self.effects {
            match effect {
                Effect::PitchRoll { pitch_rad, roll_rad } => {
                    pose_error *= Isometry3::from_parts(
                        Translation3::identity(),
                        UnitQuaternion::from_euler_angles(*roll_rad, *pitch_rad, 0.0),
                    );
                }
                Effect::RollingShutter { scan_s: s } => scan_s = *s,
                _ => {}
            }
        }
        let slices = if scan_s > 0.0 { 24 } else { 1 };
        let moments: Vec<_> = (0..slices)
            .map(|i| {
                let late = if slices > 1 { ((f64::from(i) + 0.5) / f64::from(slices) - 0.5) * scan_s } else { 0.0 };
                let world_from_ego = if slices > 1 { self.world.pose(0, t + late) } else { believed };
                self.world.moment(t + late, world_from_ego * pose_error)
            })
            .collect();
        let wing = self.effects.iter().find_map(|e| match e {
            Effect::EgoOcclusion { center_m, size_m } => Some(Solid {
                pose: Isometry3::translation(center_m[0], center_m[1], center_m[2]),
                form: Form::Cuboid(Vector3::from(*size_m) / 2.0),
                material: Material::Carbon,
            }),
            _ => None,
        });
        let mut scan = Scan {
            points: Vec::new(),
            lights: Vec::new(),
            boxes: Vec::new(),
            sums: Sums::default(),
            evidence: self.no_evidence(),
        };
        let reshaped = self.effects.iter().any(|e| matches!(e, Effect::WrongShape { .. }));
        let mut on_car = vec![0usize; self.world.drivers.len()];
        let every = self.looks_at_every();
        for (k, mount) in self.rig.iter().enumerate() {
            let believed_pose = mount.pose();
            let mut true_pose = believed_pose;
            for effect in self.effects {
                if let Effect::SensorExtrinsics { sensor, turn_rad, shift_m } = effect
                    && *sensor == k
                {
                    let error = Isometry3::from_parts(Translation3::from(*shift_m), small_turn(*turn_rad));
                    true_pose = believed_pose * error;
                }
            }
            let phase = rng.random::<f64>();
            let (column_step, row_step) = (mount.column_step_rad(), mount.row_step_rad());
            for (row, &elevation) in mount.rows_rad.iter().enumerate() {
                for column in 0..mount.columns {
                    let az = mount.fov_rad / 2.0
                        - (column as f64 + phase + normal(rng) * self.nuisances.dither[0]) * column_step;
                    let el = elevation + normal(rng) * self.nuisances.dither[1] * row_step;
                    let direction = |az: f64, el: f64| Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin());
                    let reported = direction(az, el);
                    let mut shot = direction(az, el + self.beams[k][row][1]);
                    let mut divergence = 0.0;
                    for effect in self.effects {
                        match effect {
                            Effect::AngularJitter { sigma_rad } => {
                                let radius = 2.0 * sigma_rad * rng.random::<f64>().sqrt();
                                let angle = rng.random::<f64>() * std::f64::consts::TAU;
                                // Perpendicular to the shot, not about the sensor axes: a rotation about y does not
                                // move a shot along y.
                                let side = Vector3::new(-az.sin(), az.cos(), 0.0);
                                let up = shot.cross(&side);
                                shot = (shot + (side * angle.cos() + up * angle.sin()) * radius.tan()).normalize();
                            }
                            Effect::MixedPixels { divergence_rad } => divergence = *divergence_rad,
                            _ => {}
                        }
                    }
                    let origin = true_pose * Point3::origin();
                    let ray = true_pose.rotation * shot;
                    let moment = &moments[column * slices as usize / mount.columns];
                    let met = wing.as_ref().and_then(|w| w.cast(&origin, &ray)).map(|(range_m, n)| Hit {
                        range_m,
                        normal: n,
                        material: Material::Carbon,
                        car: None,
                    });
                    scan.sums.touched += f64::from(u8::from(met.is_some()));
                    let met = met.or_else(|| moment.cast(&origin, &ray));
                    let mut mixed_m = 0.0;
                    let hit = met.map(|mut hit| {
                        if divergence > 0.0 && hit.range_m > 1.0 {
                            let sharp = hit.range_m;
                            hit.range_m = blurred(&hit, divergence, &shot, |d| {
                                moment.cast(&origin, &(true_pose.rotation * d)).map(|h| h.range_m)
                            });
                            mixed_m = hit.range_m - sharp;
                            scan.sums.touched += f64::from(u8::from(mixed_m.abs() > 0.35));
                        }
                        hit
                    });
                    if let Some(hit) = &hit {
                        let c = hit.cos_incidence(&ray).max(1e-3);
                        scan.sums.returns += 1.0;
                        scan.sums.lever += (hit.range_m.powi(2) * (1.0 / (c * c) - 1.0)).min(100.0);
                        if let Some(car) = hit.car {
                            on_car[car] += 1;
                        }
                        let other = hit.material == Material::Container || hit.car.is_some() && reshaped;
                        scan.sums.touched += f64::from(u8::from(other));
                    }
                    let angles = [az, el];
                    if let Some(hit) = hit.as_ref().filter(|_| (row + column).is_multiple_of(every)) {
                        let cos = hit.cos_incidence(&ray).clamp(1e-4, 1.0);
                        let at = Incidence { hit, cos, sensor: k, angles, mount };
                        let energy = (self.world.reflectivity(hit) * cos / (hit.range_m * hit.range_m)).ln();
                        let phase = column as f64 / mount.columns as f64 - 0.5;
                        let o = Observation { at, origin, ray, row, phase, energy, mixed_m };
                        self.observe(&o, t, &mut scan.evidence);
                    }
                    let lost = &mut scan.sums.touched;
                    if let Some(range) = self.returned(hit, &ray, k, row, angles, mount, lost, rng) {
                        let p = believed_pose * Point3::from(reported * range);
                        scan.points.push([p.x as f32, p.y as f32, p.z as f32]);
                        // A point elsewhere than its surface is a false return.
                        let seen = hit.filter(|hit| (hit.range_m - range).abs() < FALSE_BEYOND_M);
                        scan.lights.push(seen.map_or_else(Light::default, |hit| Light {
                            reflectivity: self.world.reflectivity(&hit),
                            cos_incidence: hit.cos_incidence(&ray),
                            range_m: hit.range_m,
                        }));
                    }
                }
            }
        }
        for i in (1..scan.points.len()).rev() {
            let j = rng.random_range(0..=i);
            scan.points.swap(i, j);
            scan.lights.swap(i, j);
        }
        self.observe_shots(&mut scan.evidence);
        self.label(t, &believed, &on_car, rng, &mut scan);
        scan
    }

    /// The reported range; `None` if there is no return.
    #[expect(clippy::too_many_arguments, reason = "one shot and all that is known of it")]
    fn returned(
        &self,
        hit: Option<Hit>,
        ray: &Vector3<f64>,
        sensor: usize,
        row: usize,
        [az, el]: [f64; 2],
        mount: &Mount,
        touched: &mut f64,
        rng: &mut Stream,
    ) -> Option<f64> {
        let false_share = self.effects.iter().find_map(|e| match e {
            Effect::Outliers { share } => Some(*share),
            _ => None,
        });
        if rng.random::<f64>() < self.nuisances.false_returns + false_share.unwrap_or(0.0) {
            *touched += f64::from(u8::from(false_share.is_some()));
            return Some(rng.random_range(0.8..REACH_M));
        }
        let hit = hit?;
        let (range, c) = (hit.range_m, hit.cos_incidence(ray).clamp(1e-4, 1.0));
        let energy = (self.world.reflectivity(&hit) * c / (range * range)).ln();
        if rng.random::<f64>() < self.nuisances.lost || energy < self.nuisances.weakest {
            return None;
        }
        let at = Incidence { hit: &hit, cos: c, sensor, angles: [az, el], mount };
        let mut reported = range + normal(rng) * self.nuisances.noise_m + self.beams[sensor][row][0];
        for effect in self.effects {
            let kept = match effect {
                Effect::SignalDropout { half_at, speckle } => {
                    let received = energy + speckle * normal(rng);
                    if received > *half_at { 1.0 } else { 0.0 }
                }
                other => other.kept(&at),
            };
            if rng.random::<f64>() >= kept {
                *touched += 1.0;
                return None;
            }
            match effect {
                Effect::RangeNoise { sigma_m, growth_per_m } => {
                    reported += bell(rng) * sigma_m * (1.0 + growth_per_m * range)
                }
                Effect::RangeBias { offset_m, scale } => reported += offset_m + scale * range,
                Effect::AzimuthRipple { amplitude_m, waves } => reported += amplitude_m * (waves * az).sin(),
                Effect::SidedNoise { sigma_m } => {
                    reported += bell(rng) * sigma_m * (0.5 + az / mount.fov_rad).clamp(0.0, 1.0);
                }
                _ => {}
            }
        }
        for effect in self.effects {
            if let Effect::Quantisation { step_m } = effect {
                reported = (reported / step_m).round() * step_m;
            }
        }
        (reported > 0.5 && reported < REACH_M).then_some(reported)
    }

    fn label(&self, t: f64, believed: &Isometry3<f64>, on_car: &[usize], rng: &mut Stream, scan: &mut Scan) {
        for driver in 1..self.world.drivers.len() {
            let (mut cars_at, mut ego) = (t, *believed);
            for effect in self.effects {
                if let Effect::TimeOffset { seconds, clock } = effect {
                    cars_at = t + seconds;
                    if *clock == Clock::Cloud {
                        ego = self.world.pose(0, t + seconds);
                    }
                }
            }
            let mut pose = ego.inverse() * self.world.pose(driver, cars_at);
            let mut shift = Vector3::from([0, 1, 2].map(|_| normal(rng) * self.own.labels_m));
            for effect in self.effects {
                if let Effect::LabelOffset { offset_m } = effect {
                    shift += Vector3::from(*offset_m);
                }
            }
            pose *= Isometry3::translation(shift.x, shift.y, shift.z);
            let ahead = pose.rotation * Vector3::x();
            let cm = |v: f64| (v * 100.0).round() / 100.0;
            let p = pose.translation.vector;
            let size = self.world.shape(driver).size_m;
            if p.norm() < 100.0 && on_car[driver] >= 3 {
                scan.boxes.push(Box3 {
                    center: [cm(p.x), cm(p.y), cm(p.z)],
                    size: size.map(cm),
                    yaw_rad: cm(ahead.y.atan2(ahead.x)),
                });
                if on_car[driver] >= 5 {
                    self.observe_label(driver, t, &mut scan.evidence);
                    let v = self.world.drivers[driver].speed_m_s(t);
                    scan.sums.boxes[0] += 1.0;
                    scan.sums.boxes[1] += v * v;
                }
            }
        }
    }
}

/// Range of a beam with divergence: energy of nineteen rays over the beam section. Ranges within a pulse length of the
/// strongest group are averaged.
fn blurred(hit: &Hit, divergence: f64, shot: &Vector3<f64>, cast: impl Fn(Vector3<f64>) -> Option<f64>) -> f64 {
    let side = shot.cross(&Vector3::z()).normalize();
    let up = side.cross(shot);
    let mut ranges = vec![hit.range_m];
    for (ring, n) in [(0.5, 6), (1.0, 12)] {
        for i in 0..n {
            let a = std::f64::consts::TAU * f64::from(i) / f64::from(n);
            let d = (shot + (side * a.cos() + up * a.sin()) * (ring * divergence / 2.0)).normalize();
            ranges.extend(cast(d));
        }
    }
    let near = ranges.iter().copied().fold(f64::INFINITY, f64::min);
    let far = ranges.iter().copied().fold(0.0, f64::max);
    // Smooth surfaces do not mix: the inverse ranges on a tilted plane are symmetric about that at the beam centre.
    let uneven = (1.0 / near + 1.0 / far - 2.0 / hit.range_m).abs() > 0.2 * (1.0 / near - 1.0 / far);
    if far - near < 0.25 + 0.1 * near * 0.2 || !uneven {
        return hit.range_m;
    }
    let middle = 0.5 * (near + far);
    let (mut low, mut high) = ((0.0, 0.0), (0.0, 0.0));
    for r in &ranges {
        let group = if *r < middle { &mut low } else { &mut high };
        group.0 += 1.0;
        group.1 += r;
    }
    let (a, b) = (low.1 / f64::max(low.0, 1.0), high.1 / f64::max(high.0, 1.0));
    let share = low.0 / (low.0 + high.0);
    if !(0.12..=0.88).contains(&share) || b - a > 12.0 {
        return if share >= 0.5 { a } else { b };
    }
    share * a + (1.0 - share) * b
}
