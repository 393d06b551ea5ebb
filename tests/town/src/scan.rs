//! One scan: every shot of a frame, the points that are reported, and the labels.

use crate::clutter::NEAREST_M;
use crate::effect::{Clock, Effect};
use crate::frame::{Echo, Frame};
use crate::response::triangular;
use crate::sensor::{Shot, direction};
use crate::side::{TRACK_SHARE, normal};
use crate::world::{Object, REACH_M};
use data::{Object as Label, Stream};
use geometry::Box3;
use nalgebra::{Isometry3, Point3};
use rand::RngExt;

/// What the intensity of a point depends on; a reflectivity of 0 for a return without a surface.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Light {
    /// Reflectivity of the surface.
    pub reflectivity: f64,
    /// Cosine of the angle of incidence.
    pub cos_incidence: f64,
    /// Reported range, m.
    pub range_m: f64,
    /// Gain of the row.
    pub gain: f64,
}

/// What a sensor set delivers of a frame.
#[derive(Clone, Debug, Default)]
pub struct Scan {
    /// Points in the vehicle frame, m, in random order.
    pub points: Vec<[f32; 3]>,
    /// What each point's intensity depends on.
    pub lights: Vec<Light>,
    /// Labelled objects in the vehicle frame.
    pub labels: Vec<Label>,
}

/// Largest distance of a labelled object, m.
const LABELS_M: f64 = 80.0;

/// Fewest points of a labelled object.
const FEWEST_POINTS: usize = 3;

impl Frame<'_> {
    /// Takes the scan.
    pub fn scan(&self) -> Scan {
        let side = self.side;
        let rng = &mut side.stream("scan", self.index);
        let mut scan = Scan::default();
        let mut on_vehicle = vec![0; side.world.vehicles.len()];
        for (k, mount) in side.mounts.iter().enumerate() {
            let pose = mount.pose();
            for shot in &side.shots(k, self.index) {
                self.shoot(shot, &pose, rng, &mut scan, &mut on_vehicle);
            }
        }
        for i in (1..scan.points.len()).rev() {
            let j = rng.random_range(0..=i);
            scan.points.swap(i, j);
            scan.lights.swap(i, j);
        }
        if side.setting.labels {
            self.label(&on_vehicle, rng, &mut scan);
        }
        scan
    }

    fn shoot(
        &self,
        shot: &Shot,
        reported_pose: &Isometry3<f64>,
        rng: &mut Stream,
        scan: &mut Scan,
        on_vehicle: &mut [usize],
    ) {
        let side = self.side;
        let mut jitter = [0.0; 2];
        for effect in &side.effects {
            if let Effect::AngularJitter { std_rad } = *effect {
                jitter = [std_rad * triangular(rng), std_rad * triangular(rng)];
            }
        }
        let met = self.trace(shot, jitter);
        let reported = direction(shot.azimuth_rad, shot.elevation_rad);
        let mut report = |range: f64, echo: Option<&Echo>, rng: &mut Stream| {
            let range = self.rounded(range, rng);
            if range > NEAREST_M && range < REACH_M {
                let p = reported_pose * Point3::from(reported * range);
                scan.points.push([p.x as f32, p.y as f32, p.z as f32]);
                scan.lights.push(Light {
                    reflectivity: echo.map_or(0.0, |e| e.reflectivity),
                    cos_incidence: echo.map_or(0.0, |e| e.cos_incidence),
                    range_m: range,
                    gain: side.rows[shot.sensor][shot.row].ln_gain.exp(),
                });
            }
        };
        let packet_lost = self.lost[shot.sensor][shot.column / crate::frame::PACKET];
        for way in std::iter::once(self.usual_clutter()).chain(self.clutter(shot, met.first.as_ref())) {
            if rng.random::<f64>() < way.rate {
                let range = way.law.draw(rng);
                // No droplet is seen through a surface.
                if way.law.is_of_droplets() && met.first.as_ref().is_some_and(|echo| echo.range_m < range) {
                    continue;
                }
                if !packet_lost {
                    report(range, None, rng);
                }
                return;
            }
        }
        if let Some(echo) = &met.first
            && rng.random::<f64>() < self.kept(shot, echo)
        {
            if let Object::Vehicle(number) = echo.object {
                on_vehicle[number as usize] += 1;
            }
            let error = self.shift_m(shot, echo) + self.scatter(shot, echo).draw(rng);
            report(echo.range_m + error, Some(echo), rng);
        }
        if let Some(second_m) = met.second_m
            && rng.random::<f64>() < self.second_share()
            && !packet_lost
        {
            report(second_m + side.nuisances.noise_m * normal(rng), met.first.as_ref(), rng);
        }
    }

    /// Probability that a second surface is reported.
    pub fn second_share(&self) -> f64 {
        let share = |effect: &Effect| match *effect {
            Effect::DualReturns { share, .. } => share,
            _ => 0.0,
        };
        self.side.effects.iter().map(share).fold(0.0, f64::max)
    }

    /// A range as it is rounded: three in a hundred are interpolated, not rounded.
    fn rounded(&self, range_m: f64, rng: &mut Stream) -> f64 {
        let mut range = range_m;
        for effect in &self.side.effects {
            if let Effect::Quantisation { step_m } = *effect
                && rng.random::<f64>() >= 0.03
            {
                range = step_m * (range / step_m + 0.5).floor();
            }
        }
        range
    }

    /// Offset of the time and of the place of labels: time of the objects and of the ego vehicle (s), and offset in the
    /// object's frame (m).
    pub fn label_error(&self) -> ([f64; 2], [f64; 3]) {
        let (mut times, mut shift) = ([self.time_s; 2], [0.0; 3]);
        for effect in &self.side.effects {
            match *effect {
                Effect::TimeOffset { seconds, clock } => {
                    times[0] += seconds;
                    if clock == Clock::Cloud {
                        times[1] += seconds;
                    }
                }
                Effect::LabelOffset { offset_m } => shift = [0, 1, 2].map(|k| shift[k] + offset_m[k]),
                _ => {}
            }
        }
        (times, shift)
    }

    /// Box of a vehicle in the frame of the ego vehicle, with an additional error in its own frame, m.
    pub fn label_box(&self, vehicle: usize, error_m: [f64; 3]) -> Box3 {
        let (times, offset) = self.label_error();
        let shift = [0, 1, 2].map(|k| offset[k] + error_m[k]);
        let world = &self.side.world;
        let place = world.place(vehicle, times[0]);
        let ego = if times[1] == self.time_s {
            self.believed
        } else {
            self.side.scenario.ego(times[1]) * self.side.own.displacement[self.index]
        };
        let (sin, cos) = place.heading_rad.sin_cos();
        let [x, y, z] = place.center;
        let [f, l, u] = shift;
        let center = ego.inverse() * Point3::new(x + f * cos - l * sin, y + f * sin + l * cos, z + u);
        let ahead = ego.inverse_transform_vector(&nalgebra::Vector3::new(cos, sin, 0.0));
        Box3 {
            center: center.into(),
            size: world.models[world.vehicles[vehicle].model].size_m,
            yaw_rad: ahead.y.atan2(ahead.x),
        }
    }

    fn label(&self, on_vehicle: &[usize], rng: &mut Stream, scan: &mut Scan) {
        let world = &self.side.world;
        let std = self.side.own.labels_m;
        for (number, vehicle) in world.vehicles.iter().enumerate() {
            // Drawn for every vehicle, so that a lost point changes one label alone.
            let own = [(); 4].map(|()| normal(rng));
            let track = &mut self.side.stream("track", number);
            let fixed = [(); 4].map(|()| normal(track));
            let mix = [TRACK_SHARE, (1.0 - TRACK_SHARE * TRACK_SHARE).sqrt()];
            let error = [0, 1, 2, 3].map(|k| std * (mix[0] * fixed[k] + mix[1] * own[k]));
            if !vehicle.labelled || on_vehicle[number] < FEWEST_POINTS {
                continue;
            }
            let exact = self.label_box(number, [error[0], error[1], error[2]]);
            let center = exact.center;
            if center.iter().map(|v| v * v).sum::<f64>().sqrt() > LABELS_M {
                continue;
            }
            let rounded = |v: f64| (v * 100.0).round() / 100.0;
            let bbox = Box3 {
                center: center.map(rounded),
                size: exact.size.map(rounded),
                yaw_rad: rounded(exact.yaw_rad + 0.1 * error[3]),
            };
            let class = world.models[vehicle.model].class.to_owned();
            scan.labels.push(Label { class, bbox, truncation: None, occlusion: None, image_box: None });
        }
    }
}
