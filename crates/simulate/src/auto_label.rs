//! Automatic labels as made from road recordings: recorded positions of all cars, interpolated to the time of the
//! cloud, become boxes in the ego frame and are shifted to fit the points (Huch et al. 2023, section III-A).

use crate::scenario::{CarState, Trajectory};
use crate::shape_field::ShapeField;
use data::KeyError;
use data::toml_text::within;
use data::{Cloud, stream};
use geometry::{Box3, move_box, points_in_boxes};
use nalgebra::Vector3;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use sensor::car::car_box;
use serde::{Deserialize, Serialize};

/// How positions are recorded and labels are derived from them.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct AutoLabel {
    /// Recording rate per car, Hz.
    pub rate_hz: f64,
    /// Time of the records relative to the middle of a scan, s: positions and clouds are not synchronised.
    pub phase_s: f64,
    /// Standard deviation of the recorded position per axis, m.
    pub position_std_m: f64,
    /// Standard deviation of the recorded heading, degrees.
    pub heading_std_deg: f64,
    /// Standard deviation of the recorded roll and pitch, degrees.
    pub tilt_std_deg: f64,
    /// How boxes are shifted to fit the points.
    pub refine: Refine,
}

/// How the boxes of the records are shifted to fit the points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Refine {
    /// They stay where the records place them.
    None,
    /// The outermost points touch the faces of the box that the sensor sees, as in the paper. A car does not fill its
    /// box: the outermost points that a LiDAR sees are not at its faces, so that labels of near cars are biased by 0.2
    /// to 0.3 m along the car.
    Faces,
    /// The points lie on the surface of the car's model; the shift is weighed against the errors of the records.
    #[default]
    Shape,
}

impl Default for AutoLabel {
    fn default() -> Self {
        AutoLabel {
            rate_hz: 20.0,
            phase_s: 0.017,
            position_std_m: 0.03,
            heading_std_deg: 0.1,
            tilt_std_deg: 0.05,
            refine: Refine::Shape,
        }
    }
}

impl AutoLabel {
    pub(crate) fn check(&self) -> Result<(), KeyError> {
        within("rate_hz", self.rate_hz, 2.0, 1000.0)?;
        within("phase_s", self.phase_s, 0.0, 1.0 / self.rate_hz)?;
        within("position_std_m", self.position_std_m, 0.0, 10.0)?;
        within("heading_std_deg", self.heading_std_deg, 0.0, 45.0)?;
        within("tilt_std_deg", self.tilt_std_deg, 0.0, 45.0)
    }

    /// The records of a car around `time_s`: two before and two after, with noise. The noise depends only on (seed,
    /// purpose, record index), so every caller gets the same.
    fn records(&self, car: &Trajectory, time_s: f64, seed: u64, purpose: &str) -> Option<Trajectory> {
        let number = ((time_s - self.phase_s) * self.rate_hz).floor() as i64;
        let record = |number: i64| {
            let time_s = number as f64 / self.rate_hz + self.phase_s;
            let motion = car.at(time_s)?;
            let mut state = CarState::of(time_s, &motion.pose, motion.velocity);
            let mut random = stream(seed, purpose, 0, number as u64);
            let mut error = |std: f64| {
                let unit: f64 = StandardNormal.sample(&mut random);
                std * unit
            };
            state.x_m += error(self.position_std_m);
            state.y_m += error(self.position_std_m);
            state.z_m += error(self.position_std_m);
            state.yaw_rad += error(self.heading_std_deg.to_radians());
            state.roll_rad += error(self.tilt_std_deg.to_radians());
            state.pitch_rad += error(self.tilt_std_deg.to_radians());
            Some(state)
        };
        let states: Option<Vec<CarState>> = (number - 1..=number + 2).map(record).collect();
        states.map(Trajectory::from_states)
    }

    /// The boxes of `cars` at the time of a cloud, in the frame of `ego`, derived from the records; upright, as labels
    /// are. `None` for a car without records around that time. `purpose` names the random stream of the run.
    pub fn boxes(
        &self,
        ego: &Trajectory,
        cars: &[Trajectory],
        time_s: f64,
        seed: u64,
        purpose: &str,
    ) -> Vec<Option<Box3>> {
        let pose = |car: &Trajectory, number: usize| {
            let records = self.records(car, time_s, seed, &format!("{purpose}/record {number}"))?;
            Some(records.at(time_s)?.pose)
        };
        let own = pose(ego, 0);
        let label = |(i, car): (usize, &Trajectory)| Some(move_box(&(own?.inverse() * pose(car, i + 1)?), &car_box()));
        cars.iter().enumerate().map(label).collect()
    }
}

/// Minimum number of points for a shift.
const FEWEST: usize = 20;
/// Points below this height above the bottom of a box may be ground, m.
const GROUND_M: f64 = 0.15;
/// Maximum shift along and across the box, m.
const FARTHEST_M: [f64; 2] = [1.2, 0.5];
/// Fraction of the points at either end that are treated as outliers.
const TRIMMED: f64 = 0.02;

/// Points in and around a box in the frame of the box, without the ground.
fn points_around(cloud: &Cloud, bbox: &Box3) -> Vec<[f64; 3]> {
    let around = Box3 {
        center: [bbox.center[0], bbox.center[1], bbox.center[2] + GROUND_M],
        size: [bbox.size[0] + 2.0 * FARTHEST_M[0], bbox.size[1] + 2.0 * FARTHEST_M[1], bbox.size[2]],
        ..*bbox
    };
    let found = points_in_boxes(&cloud.values, cloud.channels, &[around], 0.0);
    found[0].iter().map(|i| bbox.to_local(cloud.xyz(*i as usize).map(f64::from))).collect()
}

/// How far points on a car lie from the surface of its model, m: noise of the ranges and errors of the model.
const SURFACE_STD_M: f64 = 0.05;
/// Errors of the records beyond that of their positions, m: interpolation, and the distortion of a moving scan.
const RECORD_STD_M: f64 = 0.1;
/// Points that count in full. Errors of the model are common to neighbouring points, so that more say no more.
const MOST_COUNTED: f64 = 50.0;

/// Shifts a box to where its points most probably lie on the surface of the car: the least sum of squared distances to
/// the surface (capped at 0.2 m, so that other things do not pull) and of the squared shift, each in standard
/// deviations. `shape` has the centre of the box as its origin; `position_std_m` is that of a recorded position. Boxes
/// with few points are not shifted.
pub fn refine_to_shape(cloud: &Cloud, bbox: &Box3, shape: &ShapeField, position_std_m: f64) -> Box3 {
    let local = points_around(cloud, bbox);
    if local.len() < FEWEST {
        return *bbox;
    }
    let weight = (MOST_COUNTED / local.len() as f64).min(1.0) / SURFACE_STD_M.powi(2);
    // Two records, that of the ego vehicle and that of the other car.
    let record = 1.0 / (2.0 * position_std_m.powi(2) + RECORD_STD_M.powi(2));
    let cost = |by: [f64; 2]| {
        let off = |p: &[f64; 3]| shape.at([p[0] - by[0], p[1] - by[1], p[2]]).powi(2);
        weight * local.iter().map(off).sum::<f64>() + record * (by[0] * by[0] + by[1] * by[1])
    };
    let best_around = |center: [f64; 2], step: f64, most: [i32; 2]| {
        let candidates = (-most[0]..=most[0]).flat_map(|i| (-most[1]..=most[1]).map(move |j| [i, j]));
        let candidates = candidates.map(|by| [0, 1].map(|k| center[k] + step * f64::from(by[k])));
        let costs = candidates.map(|by| (cost(by), by));
        costs.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(center, |(_, by)| by)
    };
    let cells = |step: f64| FARTHEST_M.map(|farthest| (farthest / step).floor() as i32);
    let coarse = best_around([0.0; 2], 0.1, cells(0.1));
    let by = best_around(coarse, 0.02, [5, 5]);
    Box3 { center: bbox.from_local([by[0], by[1], 0.0]), ..*bbox }
}

/// Shifts a box so that the points in and around it touch the faces visible to the sensor. Boxes with few points are
/// not shifted, and neither are boxes that would lose points.
pub fn refine_to_faces(cloud: &Cloud, bbox: &Box3) -> Box3 {
    let local = points_around(cloud, bbox);
    if local.len() < FEWEST {
        return *bbox;
    }
    let sensor = bbox.to_local([0.0; 3]);
    let shift = |axis: usize| {
        let mut values: Vec<f64> = local.iter().map(|p| p[axis]).collect();
        values.sort_by(f64::total_cmp);
        let trim = (values.len() as f64 * TRIMMED) as usize;
        let (low, high, half) = (values[trim], values[values.len() - 1 - trim], bbox.size[axis] / 2.0);
        let off = if sensor[axis] < -half {
            low + half
        } else if sensor[axis] > half {
            high - half
        } else if high - low > 1.6 * half {
            (low + high) / 2.0 // both faces are visible
        } else {
            0.0
        };
        off.clamp(-FARTHEST_M[axis], FARTHEST_M[axis])
    };
    let inside = |by: [f64; 2]| {
        let holds = |p: &&[f64; 3]| (0..2).all(|k| (p[k] - by[k]).abs() <= bbox.size[k] / 2.0 + 0.05);
        local.iter().filter(holds).count()
    };
    let by = [shift(0), shift(1)];
    if inside(by) < inside([0.0; 2]) {
        return *bbox;
    }
    Box3 { center: bbox.from_local([by[0], by[1], 0.0]), ..*bbox }
}

/// Range sections of the paper, m.
pub const SECTIONS_M: [[f64; 2]; 3] = [[0.0, 33.3], [33.3, 66.6], [66.6, 100.0]];

/// Label errors in one range section.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, Default, JsonSchema)]
pub struct LabelError {
    /// Lower and upper bound, m.
    pub range_m: [f64; 2],
    /// Number of labels.
    pub labels: usize,
    /// RMS error along the true heading, across it, and up, m.
    pub rms_m: [f64; 3],
    /// Mean error along the true heading, across it, and up, m.
    pub mean_m: [f64; 3],
    /// RMS heading error, degrees.
    pub yaw_rms_deg: f64,
    /// Fraction of the labels with a 3D IoU below 0.7.
    pub below_iou_0_7: f64,
}

/// Label errors by range section, from pairs of label and true box.
pub fn label_errors(pairs: impl Iterator<Item = (Box3, Box3)>) -> Vec<LabelError> {
    let mut sums = [[0.0; 8]; 3];
    let mut counts = [0_usize; 3];
    for (label, truth) in pairs {
        let range = truth.center[0].hypot(truth.center[1]);
        let Some(section) = SECTIONS_M.iter().position(|[low, high]| (*low..*high).contains(&range)) else { continue };
        counts[section] += 1;
        let off = Vector3::from(truth.to_local(label.center));
        let turn = geometry::limit_period(label.yaw_rad - truth.yaw_rad, 0.5, std::f64::consts::TAU);
        let missed = f64::from(u8::from(geometry::iou_3d(&label, &truth) < 0.7));
        let values = [off.x, off.y, off.z, off.x * off.x, off.y * off.y, off.z * off.z, turn * turn, missed];
        sums[section].iter_mut().zip(values).for_each(|(sum, v)| *sum += v);
    }
    let error = |i: usize| {
        let mean = sums[i].map(|v| v / counts[i].max(1) as f64);
        LabelError {
            range_m: SECTIONS_M[i],
            labels: counts[i],
            mean_m: [mean[0], mean[1], mean[2]],
            rms_m: [mean[3].sqrt(), mean[4].sqrt(), mean[5].sqrt()],
            yaw_rms_deg: mean[6].sqrt().to_degrees(),
            below_iou_0_7: mean[7],
        }
    };
    (0..3).map(error).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame_scene::FrameScene;
    use crate::mesh::cuboid;
    use crate::race_car::race_car;
    use crate::scenario::Motion;
    use crate::world::{CarShape, World};
    use sensor::material::MaterialTable;
    use sensor::rig::{Pattern, Rig, RowBlock};
    use std::path::Path;

    fn straight(x: f64, y: f64, speed: f64) -> Trajectory {
        let state = |i: i32| {
            let t = f64::from(i) * 0.05;
            let pose = geometry::upright_pose([x + speed * t, y, 0.198], 0.0);
            CarState::of(t, &pose, Vector3::new(speed, 0.0, 0.0))
        };
        Trajectory::from_states((-20..2100).map(state).collect())
    }

    #[test]
    fn records_without_errors_give_the_true_boxes() {
        let exact = AutoLabel { position_std_m: 0.0, heading_std_deg: 0.0, tilt_std_deg: 0.0, ..AutoLabel::default() };
        let (ego, cars) = (straight(0.0, 0.0, 50.0), [straight(30.0, 4.0, 55.0)]);
        for i in 0..20 {
            let t = 0.05 * f64::from(i);
            let label = exact.boxes(&ego, &cars, t, 1, "run 0")[0].unwrap();
            let truth = move_box(&geometry::upright_pose([30.0 + 5.0 * t, 4.0, 0.0], 0.0), &car_box());
            assert!(
                label.to_array().iter().zip(truth.to_array()).all(|(a, b)| (a - b).abs() < 1e-9),
                "{label:?} {truth:?}"
            );
        }
        assert_eq!(exact.boxes(&ego, &[straight(0.0, 5.0, 50.0)], 500.0, 1, "run 0"), [None]);
    }

    #[test]
    fn errors_have_the_size_of_the_records() {
        let auto = AutoLabel { position_std_m: 0.1, heading_std_deg: 0.0, tilt_std_deg: 0.0, ..AutoLabel::default() };
        let (ego, cars) = (straight(0.0, 0.0, 50.0), [straight(30.0, 4.0, 50.0)]);
        let truth = move_box(&geometry::upright_pose([30.0, 4.0, 0.0], 0.0), &car_box());
        let pairs = (0..2000).map(|i| (auto.boxes(&ego, &cars, 0.05 * f64::from(i), 1, "run 0")[0].unwrap(), truth));
        let errors = label_errors(pairs);
        assert_eq!(errors.iter().map(|e| e.labels).collect::<Vec<_>>(), [2000, 0, 0]);
        // Two cars; between two records (17 of 50 ms after the first) errors are averaged: cubic weights 0.74 and
        // 0.26.
        for (rms, mean) in errors[0].rms_m.iter().zip(errors[0].mean_m) {
            assert!((0.08..0.14).contains(rms) && mean.abs() < 0.01, "{errors:?}");
        }
        assert_eq!(errors[0].yaw_rms_deg, 0.0);
    }

    /// Cloud and box of a car on level ground, in the ego frame.
    fn cloud_of(x: f64, y: f64, yaw: f64) -> (Cloud, Box3) {
        let ground = cuboid([-200.0, -200.0, -2.0], [200.0, 200.0, 0.0], MaterialTable::built_in("asphalt"));
        let (world, car, materials) = (World::new(&ground), CarShape::new(&race_car()), MaterialTable::default());
        let still = |x, y, yaw| Motion {
            pose: geometry::upright_pose([x, y, 0.198], yaw),
            velocity: Vector3::zeros(),
            turn_rate: Vector3::zeros(),
        };
        let scene = FrameScene::new(&world, &car, &materials, still(0.0, 0.0, 0.0), &[still(x, y, yaw)]);
        let mut rig = Rig::parse("[[sensor]]\nname = \"a\"\nposition = [0, 0, 0.6]\n", Path::new("r.toml")).unwrap();
        rig.sensors[0].pattern =
            Some(Pattern::grid(RowBlock { rows: 64, top_deg: 5.0, bottom_deg: -19.0 }, 1440, 360.0, 20.0));
        let cloud = scene.scan(&sensor::beams::Beams::of(&rig)).cloud();
        (cloud, move_box(&geometry::upright_pose([x, y, 0.0], yaw), &car_box()))
    }

    #[test]
    fn boxes_are_shifted_to_the_points() {
        for (x, y, yaw) in [(20.0, 5.0, 0.0), (-28.0, -5.0, 0.02), (12.0, -4.0, -0.1), (35.0, 5.0, 0.1)] {
            let (cloud, truth) = cloud_of(x, y, yaw);
            let off = |b: &Box3| truth.to_local(b.center);
            // At larger distances fewer points are on the edges of a car.
            let allowed = if x < 30.0 { 0.25 } else { 0.45 };
            for shift in [[0.7, 0.1], [-0.7, -0.1], [0.4, -0.25]] {
                let wrong = Box3 { center: truth.from_local([shift[0], shift[1], 0.0]), ..truth };
                let [along, across, _] = off(&refine_to_faces(&cloud, &wrong));
                assert!(along.abs() < allowed && across.abs() < 0.2, "({x}, {y}) {shift:?}: {along} {across}");
            }
            let [along, across, _] = off(&refine_to_faces(&cloud, &truth));
            assert!(along.abs() < allowed && across.abs() < 0.15, "a right box stays about right: {along} {across}");
        }
    }

    #[test]
    fn the_shape_places_boxes_without_the_bias_of_the_faces() {
        let shape = ShapeField::new(&race_car(), car_box().center);
        let mut sums = [0.0; 2];
        for (x, y, yaw) in [(20.0, 5.0, 0.0), (-28.0, -5.0, 0.02), (12.0, -4.0, -0.1), (35.0, 5.0, 0.1)] {
            let (cloud, truth) = cloud_of(x, y, yaw);
            let off = |b: &Box3| truth.to_local(b.center);
            for shift in [[0.15, 0.05], [-0.15, -0.05], [0.0, 0.1]] {
                let wrong = Box3 { center: truth.from_local([shift[0], shift[1], 0.0]), ..truth };
                let [along, across, _] = off(&refine_to_shape(&cloud, &wrong, &shape, 0.03));
                assert!(along.abs() < 0.12 && across.abs() < 0.08, "({x}, {y}) {shift:?}: {along} {across}");
            }
            sums[0] += off(&refine_to_shape(&cloud, &truth, &shape, 0.03))[0].abs();
            sums[1] += off(&refine_to_faces(&cloud, &truth))[0].abs();
        }
        assert!(sums[0] < 0.3 * sums[1], "{sums:?}");
    }

    #[test]
    fn a_box_without_points_stays() {
        let (cloud, _) = cloud_of(20.0, 5.0, 0.0);
        let alone = Box3::from_array([60.0, -20.0, 0.4, 4.88, 1.9, 1.18, 0.0]);
        assert_eq!(refine_to_faces(&cloud, &alone), alone);
    }
}
