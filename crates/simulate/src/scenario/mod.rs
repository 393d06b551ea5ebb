//! Scenarios: runs of an ego vehicle and its rivals, from files or generated.

mod race;
mod trajectory;

pub use race::RaceModel;
pub use trajectory::{CarState, Motion, Trajectory};

use crate::SimulateError;
use crate::track::Track;
use data::DataError;
use geometry::{bev_intersection, move_box};
use nalgebra::Point3;
use schemars::JsonSchema;
use sensor::car::{CAR_SIZE_M, car_box};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Time between two frames of the race, s.
pub const FRAME_S: f64 = 0.05;

/// A run: trajectories of the cars, and the times of the clouds.
#[derive(Clone, Debug, PartialEq)]
pub struct Run {
    /// The ego vehicle, which carries the sensors.
    pub ego: Trajectory,
    /// The other cars.
    pub rivals: Vec<Trajectory>,
    /// Time of the first cloud, s.
    pub first_s: f64,
    /// Number of clouds.
    pub frames: usize,
    /// Time between two clouds, s.
    pub step_s: f64,
}

impl Run {
    /// Time of the middle of a cloud's scan, s.
    pub fn time_s(&self, frame: usize) -> f64 {
        self.first_s + frame as f64 * self.step_s
    }
}

/// Trajectory files of one run, relative to the file that contains these paths.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RunFiles {
    /// CSV of the ego vehicle.
    pub ego: PathBuf,
    /// CSVs of the other cars, with the same clock.
    #[serde(default)]
    pub rivals: Vec<PathBuf>,
}

impl RunFiles {
    /// Reads the run: 20 clouds per second while all cars have states. If `track` is given, cars must stay within its
    /// outer wall.
    pub fn read(&self, folder: &Path, track: Option<&Track>) -> Result<Run, SimulateError> {
        let read = |path: &PathBuf| Trajectory::read(&folder.join(path));
        let ego = read(&self.ego)?;
        let rivals = self.rivals.iter().map(read).collect::<Result<Vec<_>, _>>()?;
        let cars = || std::iter::once(&ego).chain(&rivals);
        // A scan begins before its middle, and automatic labels need records before and after.
        let first_s = cars().map(|c| c.span_s()[0]).fold(f64::MIN, f64::max) + 3.0 * FRAME_S;
        let last_s = cars().map(|c| c.span_s()[1]).fold(f64::MAX, f64::min) - 3.0 * FRAME_S;
        if last_s <= first_s {
            let path = folder.join(&self.ego);
            return Err(DataError::file(&path, "there is no time at which all cars of its run have states").into());
        }
        let frames = ((last_s - first_s) / FRAME_S) as usize + 1;
        let run = Run { ego, rivals, first_s, frames, step_s: FRAME_S };
        self.check_places(&run, folder, track)?;
        Ok(run)
    }

    /// Checks that cars do not intersect each other or the outer wall.
    fn check_places(&self, run: &Run, folder: &Path, track: Option<&Track>) -> Result<(), DataError> {
        let paths: Vec<PathBuf> = std::iter::once(&self.ego).chain(&self.rivals).map(|p| folder.join(p)).collect();
        let cars: Vec<&Trajectory> = std::iter::once(&run.ego).chain(&run.rivals).collect();
        for frame in 0..run.frames {
            let t = run.time_s(frame);
            let poses: Vec<_> =
                cars.iter().map(|car| car.at(t).expect("all cars have states in the run").pose).collect();
            // Line 1 of a file is the header.
            let error = |i: usize, message: String| {
                let line = cars[i].states().partition_point(|s| s.time_s < t) + 2;
                DataError::line(&paths[i], line, message)
            };
            for (i, pose) in poses.iter().enumerate() {
                let inside = |other: usize| {
                    bev_intersection(&move_box(&(pose.inverse() * poses[other]), &car_box()), &car_box()) > 0.0
                };
                if let Some(other) = (0..i).find(|other| inside(*other)) {
                    let message = format!("at {t:.2} s the car intersects the car of {}", paths[other].display());
                    return Err(error(i, message));
                }
                if let Some(beyond) = track.and_then(|track| beyond_the_wall_m(track, pose)) {
                    return Err(error(i, format!("at {t:.2} s the car is {beyond:.2} m inside the outer wall")));
                }
            }
        }
        Ok(())
    }
}

/// Depth by which a car intersects the outer wall, m; `None` if it does not.
fn beyond_the_wall_m(track: &Track, world_from_car: &geometry::Pose) -> Option<f64> {
    let bbox = car_box();
    let [hx, hy] = [CAR_SIZE_M[0] / 2.0, CAR_SIZE_M[1] / 2.0];
    let corners = [[hx, hy], [hx, -hy], [-hx, hy], [-hx, -hy]];
    let beyond = corners.map(|[x, y]| {
        let p = world_from_car * Point3::new(bbox.center[0] + x, bbox.center[1] + y, 0.0);
        let (way, left) = track.line.project([p.x, p.y]);
        track.outer_wall_m(way) - left
    });
    beyond.into_iter().max_by(f64::total_cmp).filter(|b| *b > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::track::las_vegas;

    fn write(folder: &Path, name: &str, trajectory: &Trajectory) -> PathBuf {
        std::fs::write(folder.join(name), trajectory.to_csv()).unwrap();
        name.into()
    }

    #[test]
    fn runs_from_files_are_those_of_the_model() {
        let track = Track { line: las_vegas(), seed: 1 };
        let run = RaceModel { runs: 1, frames: 120, ..RaceModel::default() }.runs(&track, 5).remove(0);
        let folder = tempfile::tempdir().unwrap();
        let ego = write(folder.path(), "ego.csv", &run.ego);
        let rivals: Vec<PathBuf> =
            run.rivals.iter().enumerate().map(|(i, r)| write(folder.path(), &format!("rival{i}.csv"), r)).collect();
        let files = RunFiles { ego: ego.clone(), rivals: rivals.clone() };
        let read = files.read(folder.path(), Some(&track)).unwrap();
        assert_eq!((&read.ego, &read.rivals), (&run.ego, &run.rivals));
        assert!(read.frames >= 118, "{}", read.frames);

        let twice = RunFiles { ego: ego.clone(), rivals: vec![ego] };
        let error = twice.read(folder.path(), None).unwrap_err().to_string();
        assert!(error.contains("ego.csv:") && error.contains("intersects the car of"), "{error}");

        // The same lap on a track whose outer edge is 4 m closer.
        let mut points = track.line.points().to_vec();
        points.iter_mut().for_each(|p| p.width_right_m -= 5.0);
        let narrow = Track { line: crate::track::CentreLine::from_points(points), seed: 1 };
        let error = files.read(folder.path(), Some(&narrow)).unwrap_err().to_string();
        assert!(error.contains(".csv:") && error.contains("m inside the outer wall"), "{error}");
    }
}
