//! Vehicle trajectories: states from a file or a model, with smooth interpolation.

use data::DataError;
use data::limits::{MOST_TEXT_BYTES, read_file};
use geometry::Pose;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::Path;

/// A longer pause between two states is a gap, s.
const LONGEST_PAUSE_S: f64 = 0.5;
/// Maximum speed, m/s.
const FASTEST_MPS: f64 = 120.0;
/// Maximum distance of a state from the position predicted by the velocities: absolute, m, and relative to the
/// distance driven.
const JUMP: (f64, f64) = (0.5, 0.25);

/// A vehicle state from GPS and IMU, in the world frame: x east, y north, z up.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CarState {
    /// Time, s.
    pub time_s: f64,
    /// East, m.
    pub x_m: f64,
    /// North, m.
    pub y_m: f64,
    /// Up, m.
    pub z_m: f64,
    /// Roll about the car's x axis, positive lifts the left side, rad.
    pub roll_rad: f64,
    /// Pitch about the car's y axis, positive lowers the nose, rad.
    pub pitch_rad: f64,
    /// Heading, counter-clockwise from +x, rad.
    pub yaw_rad: f64,
    /// Velocity east, m/s.
    pub vx_mps: f64,
    /// Velocity north, m/s.
    pub vy_mps: f64,
    /// Velocity up, m/s.
    pub vz_mps: f64,
}

impl CarState {
    fn values(&self) -> [f64; 10] {
        let CarState { time_s, x_m, y_m, z_m, roll_rad, pitch_rad, yaw_rad, vx_mps, vy_mps, vz_mps } = *self;
        [time_s, x_m, y_m, z_m, roll_rad, pitch_rad, yaw_rad, vx_mps, vy_mps, vz_mps]
    }

    /// Position, m.
    pub fn position(&self) -> Vector3<f64> {
        Vector3::new(self.x_m, self.y_m, self.z_m)
    }

    /// Velocity, m/s.
    pub fn velocity(&self) -> Vector3<f64> {
        Vector3::new(self.vx_mps, self.vy_mps, self.vz_mps)
    }

    /// `world_from_car`.
    pub fn pose(&self) -> Pose {
        let rotation = UnitQuaternion::from_euler_angles(self.roll_rad, self.pitch_rad, self.yaw_rad);
        Isometry3::from_parts(Translation3::from(self.position()), rotation)
    }

    /// State from a pose and a velocity (m/s) in the world frame.
    pub fn of(time_s: f64, world_from_car: &Pose, velocity: Vector3<f64>) -> CarState {
        let p = world_from_car.translation.vector;
        let (roll_rad, pitch_rad, yaw_rad) = world_from_car.rotation.euler_angles();
        CarState {
            time_s,
            x_m: p.x,
            y_m: p.y,
            z_m: p.z,
            roll_rad,
            pitch_rad,
            yaw_rad,
            vx_mps: velocity.x,
            vy_mps: velocity.y,
            vz_mps: velocity.z,
        }
    }
}

/// Motion of a car at one moment, in the world frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// `world_from_car`.
    pub pose: Pose,
    /// Velocity, m/s.
    pub velocity: Vector3<f64>,
    /// Angular velocity vector, rad/s.
    pub turn_rate: Vector3<f64>,
}

/// States of a car in ascending time.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory {
    states: Vec<CarState>,
}

impl Trajectory {
    /// Checks the states; `wrong` makes the error of a state (counted from 0) or of the whole trajectory.
    fn checked(
        states: Vec<CarState>,
        wrong: impl Fn(Option<usize>, String) -> DataError,
    ) -> Result<Trajectory, DataError> {
        if states.len() < 2 {
            return Err(wrong(None, format!("has {} states; a trajectory needs 2 at least", states.len())));
        }
        for (i, state) in states.iter().enumerate() {
            if state.values().iter().any(|v| !v.is_finite()) {
                return Err(wrong(Some(i), "a value is not finite".into()));
            }
            let speed = state.velocity().norm();
            if speed > FASTEST_MPS {
                return Err(wrong(
                    Some(i),
                    format!("{speed:.1} m/s is faster than {FASTEST_MPS} m/s: is the unit m/s?"),
                ));
            }
            let Some(before) = i.checked_sub(1).map(|k| &states[k]) else { continue };
            let pause = state.time_s - before.time_s;
            if pause <= 0.0 {
                return Err(wrong(Some(i), format!("time goes from {} s to {} s", before.time_s, state.time_s)));
            }
            if pause > LONGEST_PAUSE_S {
                let message = format!(
                    "a gap of {pause:.2} s after {} s; states must follow within {LONGEST_PAUSE_S} s",
                    before.time_s
                );
                return Err(wrong(Some(i), message));
            }
            let way = state.position() - before.position();
            let expected = (state.velocity() + before.velocity()) * (pause / 2.0);
            if (way - expected).norm() > JUMP.0 + JUMP.1 * expected.norm() {
                let message = format!(
                    "jumps by {:.2} m in {pause:.3} s, where its velocities make {:.2} m",
                    way.norm(),
                    expected.norm()
                );
                return Err(wrong(Some(i), message));
            }
        }
        Ok(Trajectory { states })
    }

    /// A generated trajectory.
    pub(crate) fn from_states(states: Vec<CarState>) -> Trajectory {
        Trajectory { states }
    }

    /// Reads a CSV with the columns of [`CarState`].
    pub fn read(path: &Path) -> Result<Trajectory, DataError> {
        let bytes = read_file(path, MOST_TEXT_BYTES)?;
        let mut reader =
            csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(bytes.as_slice());
        let headers = reader.headers().map_err(|e| DataError::line(path, 1, e.to_string()))?.clone();
        let (mut states, mut lines) = (Vec::new(), Vec::new());
        for record in reader.records() {
            let at = |e: &csv::Error| e.position().map_or(1, |p| p.line() as usize);
            let record = record.map_err(|e| DataError::line(path, at(&e), e.to_string()))?;
            let line = record.position().map_or(1, |p| p.line() as usize);
            states.push(record.deserialize(Some(&headers)).map_err(|e| DataError::line(path, line, e.to_string()))?);
            lines.push(line);
        }
        Trajectory::checked(states, |state, message| match state {
            Some(i) => DataError::line(path, lines[i], message),
            None => DataError::file(path, message),
        })
    }

    /// The trajectory in the CSV format of [`Trajectory::read`].
    pub fn to_csv(&self) -> String {
        let mut text = String::from("time_s,x_m,y_m,z_m,roll_rad,pitch_rad,yaw_rad,vx_mps,vy_mps,vz_mps\n");
        for state in &self.states {
            let values = state.values().map(|v| format!("{v}"));
            let _ = writeln!(text, "{}", values.join(","));
        }
        text
    }

    /// The states.
    pub fn states(&self) -> &[CarState] {
        &self.states
    }

    /// First and last time, s.
    pub fn span_s(&self) -> [f64; 2] {
        [self.states[0].time_s, self.states[self.states.len() - 1].time_s]
    }

    /// The motion at a time, s; `None` outside the time span. Between two states: a cubic through positions and
    /// velocities, and a constant angular velocity.
    pub fn at(&self, time_s: f64) -> Option<Motion> {
        let [first, last] = self.span_s();
        if !(first..=last).contains(&time_s) {
            return None;
        }
        let after = self.states.partition_point(|s| s.time_s <= time_s).clamp(1, self.states.len() - 1);
        let (a, b) = (&self.states[after - 1], &self.states[after]);
        let h = b.time_s - a.time_s;
        let t = (time_s - a.time_s) / h;
        let (p0, p1, m0, m1) = (a.position(), b.position(), a.velocity() * h, b.velocity() * h);
        let (u, v) = (2.0 * p0 - 2.0 * p1 + m0 + m1, 3.0 * (p1 - p0) - 2.0 * m0 - m1);
        let position = ((u * t + v) * t + m0) * t + p0;
        let velocity = ((3.0 * u * t + 2.0 * v) * t + m0) / h;
        let (r0, r1) = (a.pose().rotation, b.pose().rotation);
        let turn = (r1 * r0.inverse()).scaled_axis();
        let rotation = UnitQuaternion::from_scaled_axis(turn * t) * r0;
        let pose = Isometry3::from_parts(Translation3::from(position), rotation);
        Some(Motion { pose, velocity, turn_rate: turn / h })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Along +x at 50 m/s, turning.
    pub(crate) fn made_up() -> Trajectory {
        let state = |i: u32| {
            let t = f64::from(i) * 0.05;
            let (s, c) = (0.2 * t).sin_cos();
            CarState {
                time_s: t,
                x_m: 250.0 * s,
                y_m: 250.0 * (1.0 - c),
                z_m: 1.0,
                roll_rad: 0.1,
                pitch_rad: 0.0,
                yaw_rad: 0.2 * t,
                vx_mps: 50.0 * c,
                vy_mps: 50.0 * s,
                vz_mps: 0.0,
            }
        };
        Trajectory::from_states((0..200).map(state).collect())
    }

    #[test]
    fn motion_between_states() {
        let trajectory = made_up();
        for i in 0..90 {
            let t = 0.013 + f64::from(i) * 0.1;
            let motion = trajectory.at(t).unwrap();
            let (s, c) = (0.2 * t).sin_cos();
            let want = Vector3::new(250.0 * s, 250.0 * (1.0 - c), 1.0);
            assert!((motion.pose.translation.vector - want).norm() < 1e-6);
            assert!((motion.velocity - Vector3::new(50.0 * c, 50.0 * s, 0.0)).norm() < 1e-3);
            assert!((motion.turn_rate - Vector3::new(0.0, 0.0, 0.2)).norm() < 1e-6);
            assert!((geometry::yaw_rad(&motion.pose) - 0.2 * t).abs() < 1e-9);
        }
        assert!(trajectory.at(-0.001).is_none() && trajectory.at(9.951).is_none() && trajectory.at(9.95).is_some());
    }

    #[test]
    fn csv_and_back_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ego.csv");
        std::fs::write(&path, made_up().to_csv()).unwrap();
        assert_eq!(Trajectory::read(&path).unwrap(), made_up());
    }

    #[test]
    fn bad_states_are_refused_by_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ego.csv");
        let good = made_up().to_csv();
        let lines: Vec<&str> = good.lines().collect();
        let replaced = |i: usize, field: usize, value: &str| {
            let mut fields: Vec<&str> = lines[i].split(',').collect();
            fields[field] = value;
            let line = fields.join(",");
            let mut all = lines.clone();
            all[i] = &line;
            all.join("\n")
        };
        let without = |from: usize, to: usize| [&lines[..from], &lines[to..]].concat().join("\n");
        for (text, want) in [
            (replaced(5, 1, "nan"), "ego.csv:6: a value is not finite"),
            (replaced(5, 0, "0.1"), "ego.csv:6: time goes from 0.15"),
            (replaced(5, 2, "9"), "ego.csv:6: jumps by"),
            (replaced(5, 7, "500"), "ego.csv:6: 500.0 m/s is faster"),
            (replaced(5, 7, "fast"), "ego.csv:6"),
            (without(5, 30), "ego.csv:6: a gap of 1.30 s after 0.15"),
            (without(2, lines.len()), "ego.csv: has 1 states"),
            (good.replace("yaw_rad", "yaw_deg"), "unknown field `yaw_deg`"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = Trajectory::read(&path).unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }
}
