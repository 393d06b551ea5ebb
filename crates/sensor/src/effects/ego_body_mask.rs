//! B7: directions hidden by parts of the ego vehicle.

use super::{Draws, FrameContext, Reads, SensorEffect};
use crate::rig;
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::{within, wrong};
use nalgebra::Vector3;
use rand::{Rng, RngExt};
use rand_distr::StandardNormal;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A shot of the sensor that intersects one of `boxes` before its measured range has no return. A shot in one of the
/// `directions` loses its return with the share that stands there.
///
/// Typical: the rear wing of the AV-21, which hides a trapezoid of about 10 x 5 m behind the car (Huch et al. 2023,
/// section IV-A). Its boxes are in `configs/simulate/measured.toml`.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EgoBodyMask {
    /// Name of the sensor from which the parts hide; empty for all.
    pub sensor: String,
    /// Axis-aligned boxes in the cloud's frame, m: minimum x, y, z, then maximum x, y, z.
    pub boxes: Vec<[f64; 6]>,
    /// Hidden directions in the frame of the named sensor: azimuth from and to, elevation from and to, degrees, and the
    /// share of their returns that is lost, 0 to 1.
    pub directions: Vec<[f64; 5]>,
    /// Range of the return of the part itself in each of the directions, m; 0 where there is none. Directions beyond
    /// the end of the list have none.
    pub returns_m: Vec<f64>,
    /// Standard deviation of these ranges, m, in the same order; 0 beyond the end of the list.
    pub returns_std_m: Vec<f64>,
    /// Mean and standard deviation of the intensities of these returns, in units of the cloud and in the same order.
    /// Beyond the end of the list the intensity of the hidden return stays.
    pub returns_intensity: Vec<[f64; 2]>,
}

impl SensorEffect for EgoBodyMask {
    fn check(&self) -> Result<(), KeyError> {
        for (i, b) in self.boxes.iter().enumerate() {
            for (k, v) in b.iter().enumerate() {
                within(&format!("boxes[{i}][{k}]"), *v, -100.0, 100.0)?;
            }
            if (0..3).any(|k| b[k] >= b[k + 3]) {
                return Err(wrong(format!("boxes[{i}]"), "a minimum is not less than its maximum"));
            }
        }
        if self.sensor.is_empty() && !self.directions.is_empty() {
            return Err(wrong("sensor", "is missing: directions are those of one sensor"));
        }
        for (i, d) in self.directions.iter().enumerate() {
            let limits = [180.0, 180.0, 90.0, 90.0].map(|most| [-most - 2.0, most + 2.0]);
            for (k, [low, high]) in limits.into_iter().chain([[0.0, 1.0]]).enumerate() {
                within(&format!("directions[{i}][{k}]"), d[k], low, high)?;
            }
        }
        for (key, ranges) in [("returns_m", &self.returns_m), ("returns_std_m", &self.returns_std_m)] {
            ranges.iter().enumerate().try_for_each(|(i, v)| within(&format!("{key}[{i}]"), *v, 0.0, 100.0))?;
        }
        for (i, of_direction) in self.returns_intensity.iter().enumerate() {
            for (k, v) in of_direction.iter().enumerate() {
                within(&format!("returns_intensity[{i}][{k}]"), *v, 0.0, 1e6)?;
            }
        }
        Ok(())
    }

    fn reads(&self) -> Reads {
        Reads::EMPTY_SHOTS
    }

    fn sensor(&self) -> &str {
        &self.sensor
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let only = frame.rig.find(&self.sensor);
        if only.is_none() && !self.sensor.is_empty() {
            return;
        }
        let boxes: Vec<[f32; 6]> = self.boxes.iter().map(|b| b.map(|v| v as f32)).collect();
        let sensor_from_cloud = only.map(|number| frame.rig.sensors[number].pose().inverse());
        if let Some(number) = only {
            self.add_shots(number, scan, frame);
        }
        let mut random = draws.of_frame();
        for echo in scan.echoes.iter_mut().filter(|e| only.is_none_or(|number| usize::from(e.sensor) == number)) {
            let at = sensor_from_cloud.and_then(|pose| self.direction_of(pose.rotation * own_direction(echo)));
            let share = at.map_or(0.0, |k| self.directions[k][4]);
            let hidden = share > 0.0 && random.random_range(0.0..1.0_f64) < share;
            let shown = at.filter(|k| hidden && self.is_shown(*k));
            if let Some(k) = shown {
                self.show(echo, k, &mut random);
            } else if hidden || boxes.iter().any(|b| passes(echo, b)) {
                echo.lose();
            }
        }
    }
}

impl EgoBodyMask {
    /// Adds the shots of a finished cloud into the directions of which it has none, where a part returns them: before
    /// the open sky a cloud does not tell that a sensor shoots there. They are as dense as the others.
    fn add_shots(&self, number: usize, scan: &mut Scan, frame: &FrameContext) {
        let Some(sensors) = frame.sensors else { return };
        let (pose, steps) = (frame.rig.sensors[number].pose(), sensors.patterns[number].steps);
        let mut open: Vec<bool> = (0..self.directions.len()).map(|k| self.is_shown(k)).collect();
        for echo in scan.echoes.iter().filter(|e| usize::from(e.sensor) == number) {
            if let Some(k) = self.direction_of(pose.rotation.inverse() * own_direction(echo)) {
                open[k] = false;
            }
        }
        // Shots lie at whole steps.
        let on_steps = |from_deg: f64, to_deg: f64, step_rad: f32| {
            let step_deg = f64::from(step_rad).to_degrees().max(0.01);
            let [first, end] = [from_deg, to_deg].map(|deg| (deg / step_deg).ceil() as i32);
            (first..end).map(move |k| f64::from(k) * step_deg)
        };
        let origin = frame.rig.sensors[number].position.map(|v| v as f32);
        for (d, _) in self.directions.iter().zip(&open).filter(|(_, open)| **open) {
            for elevation in on_steps(d[2], d[3], steps.elevation_rad) {
                scan.echoes.extend(on_steps(d[0], d[1], steps.azimuth_rad).map(|azimuth| {
                    let own = rig::direction(azimuth.to_radians(), elevation.to_radians());
                    let direction = pose.rotation * Vector3::from(own);
                    Echo { sensor: number as u8, ..Echo::nothing(origin, direction.map(|v| v as f32).into()) }
                }));
            }
        }
    }

    /// Whether the part itself is seen in a direction.
    fn is_shown(&self, direction: usize) -> bool {
        self.returns_m.get(direction).is_some_and(|m| *m > 0.0)
    }

    /// Makes a return that of the part in a direction.
    fn show(&self, echo: &mut Echo, direction: usize, random: &mut impl Rng) {
        let mut drawn = |mean: f64, std: f64| mean + std * random.sample::<f64, _>(StandardNormal);
        let range_m = drawn(self.returns_m[direction], self.returns_std_m.get(direction).copied().unwrap_or(0.0));
        (echo.range_m, echo.normal, echo.object) = (range_m.max(0.01) as f32, [0.0; 3], 0);
        if let Some([mean, std]) = self.returns_intensity.get(direction) {
            echo.intensity = drawn(*mean, *std).max(0.0) as f32;
        }
    }

    /// The entry of a direction of the sensor's frame.
    fn direction_of(&self, own: Vector3<f64>) -> Option<usize> {
        if self.directions.is_empty() {
            return None;
        }
        let [azimuth, elevation] = [own.y.atan2(own.x), own.z.atan2(own.x.hypot(own.y))].map(f64::to_degrees);
        let inside = |d: &[f64; 5]| (d[0]..d[1]).contains(&azimuth) && (d[2]..d[3]).contains(&elevation);
        self.directions.iter().position(inside)
    }
}

fn own_direction(echo: &Echo) -> Vector3<f64> {
    Vector3::from(echo.direction.map(f64::from))
}

/// Whether a shot intersects a box before its return.
fn passes(echo: &Echo, b: &[f32; 6]) -> bool {
    let (mut near, mut far) = (0.0, echo.range_m);
    for k in 0..3 {
        if echo.direction[k] == 0.0 {
            if !(b[k]..=b[k + 3]).contains(&echo.origin[k]) {
                return false;
            }
            continue;
        }
        let (a, z) = ((b[k] - echo.origin[k]) / echo.direction[k], (b[k + 3] - echo.origin[k]) / echo.direction[k]);
        near = f32::max(near, a.min(z));
        far = f32::min(far, a.max(z));
    }
    near < far
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;
    use crate::cloud_scan::{CloudReader, Surfaces};
    use data::Cloud;

    #[test]
    fn returns_behind_the_box_are_lost_in_every_frame() {
        let before = scene();
        // A board 2 m ahead, 0.4 m wide, around the sensor's horizon.
        let effect = EgoBodyMask { boxes: vec![[2.0, -0.2, -0.1, 2.1, 0.2, 0.1]], ..EgoBodyMask::default() };
        let after = applied_in(9, &effect, &before);
        assert_eq!(after, applied(&effect, &before));
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return()) {
            let [x, y, z] = a.direction;
            let (across, up) = ((2.0 * y / x).abs(), (2.0 * z / x).abs());
            if across < 0.18 && up < 0.09 {
                assert!(!b.is_return());
            }
            if across > 0.25 || up > 0.13 {
                assert!(b.is_return());
            }
        }
        assert!(lost(&before, &after) > 0.002);
    }

    #[test]
    fn returns_before_the_box_stay() {
        let before = plate(10, 1.5, 0.5);
        let effect = EgoBodyMask { boxes: vec![[2.0, -0.2, -0.1, 2.1, 0.2, 0.1]], ..EgoBodyMask::default() };
        assert_eq!(lost(&before, &applied(&effect, &before)), 0.0);
        assert!(EgoBodyMask { boxes: vec![[1.0, 0.0, 0.0, 0.5, 1.0, 1.0]], ..EgoBodyMask::default() }.check().is_err());
    }

    #[test]
    fn directions_hide_from_their_sensor_alone() {
        let before = crate::effects::testing::scene();
        let mask = |sensor: &str| EgoBodyMask {
            sensor: sensor.into(),
            directions: vec![[-10.0, 20.0, -15.5, -5.0, 1.0]],
            ..EgoBodyMask::default()
        };
        let hidden = |e: &Echo| {
            let [x, y, z] = e.direction.map(f64::from);
            let (azimuth, elevation) = (y.atan2(x).to_degrees(), z.atan2(x.hypot(y)).to_degrees());
            (-10.0..20.0).contains(&azimuth) && (-15.5..-5.0).contains(&elevation)
        };
        let after = applied(&mask("front"), &before);
        assert_eq!(after.returns().count(), before.returns().filter(|e| !hidden(e)).count());
        assert!(after.returns().all(|e| !hidden(e)));
        assert_eq!(applied(&mask("left"), &before), before);
        assert!(mask("").check().unwrap_err().to_string().contains("those of one sensor"));
    }

    /// A finished cloud without returns above the horizon does not tell that the sensor shoots there. A part that shows
    /// itself before the open sky has as many returns as the sensor has shots.
    #[test]
    fn a_part_is_shown_before_the_open_sky() {
        let mask = EgoBodyMask {
            sensor: "lidar".into(),
            directions: vec![[30.0, 50.0, 2.0, 6.0, 1.0], [50.0, 60.0, 2.0, 6.0, 0.5], [60.0, 70.0, 2.0, 6.0, 1.0]],
            returns_m: vec![3.0, 3.0],
            ..EgoBodyMask::default()
        };
        // The ground, by rows of 0.5 degrees and columns of 0.4.
        let (rig, mut cloud) = (rig::Rig::single(), Cloud::new(3));
        for (row, column) in (0..30).flat_map(|row| (0..900).map(move |column| (row, column))) {
            let d = rig::direction((0.4 * f64::from(column)).to_radians(), (-18.0 + 0.5 * f64::from(row)).to_radians());
            cloud.values.extend(d.map(|v| (v * 1.7 / -d[2]) as f32));
        }
        let reader = CloudReader::of(&rig, std::slice::from_ref(&cloud), mask.reads());
        let mut scan = reader.scan(&cloud, &Surfaces::default());
        let before = scan.returns().count();
        with_frame(0, |frame, draws| {
            let frame = FrameContext { rig: &rig, sensors: Some(reader.sensors()), ..*frame };
            mask.on_scan(&mut scan, &frame, draws);
        });
        let shown: Vec<&Echo> = scan.returns().filter(|e| e.direction[2] > 0.0).collect();
        // 8 rows; 50 columns all of which are hidden, 25 of which half are.
        assert!((460..=540).contains(&shown.len()), "{}", shown.len());
        assert!(shown.iter().all(|e| e.range_m == 3.0));
        assert_eq!(scan.returns().count() - shown.len(), before);
    }

    #[test]
    fn a_part_returns_light_with_its_own_spread() {
        let mask = EgoBodyMask {
            sensor: "front".into(),
            directions: vec![[-10.0, 20.0, -15.5, -5.0, 1.0]],
            returns_m: vec![0.8],
            returns_std_m: vec![0.02],
            returns_intensity: vec![[0.3, 0.01]],
            ..EgoBodyMask::default()
        };
        let (before, after) = (scene(), applied(&mask, &scene()));
        assert_eq!(before.returns().count(), after.returns().count());
        let of = |value: fn(&Echo) -> f32| -> Vec<f64> {
            let shown = after.echoes.iter().zip(&before.echoes).filter(|(a, b)| a.range_m != b.range_m);
            shown.map(|(a, _)| f64::from(value(a))).collect()
        };
        for (values, mean, std) in [(of(|e| e.range_m), 0.8, 0.02), (of(|e| e.intensity), 0.3, 0.01)] {
            let chance = 4.0 * std / (values.len() as f64).sqrt();
            assert!(values.len() > 100, "{}", values.len());
            assert!((statistics::mean(&values) - mean).abs() < chance, "{}", statistics::mean(&values));
            assert!((statistics::deviation(&values) - std).abs() < chance, "{}", statistics::deviation(&values));
        }
        let negative = EgoBodyMask { returns_intensity: vec![[0.3, -1.0]], ..mask };
        assert!(negative.check().unwrap_err().to_string().contains("returns_intensity[0][1]"));
    }
}
