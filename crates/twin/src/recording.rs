//! A recording: scans one after the other with poses, and the boxes of what moved.

mod rows;

pub use rows::{Rows, Shot, shots};

use crate::TwinError;
use crate::odometry::{Odometry, OdometryConfig, RefineConfig, Refined, exp, log, refine};
use data::{Dataset, Moment};
use geometry::Pose;
use nalgebra::Point3;
use sensor::directions::{SensorScan, Steps};
use sensor::rig::Sensor;
use statistics::median_upper;

/// Returns nearer than this are those of the own vehicle, m.
pub const NEAREST_M: f64 = 1.5;

/// Where the poses of a recording come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PoseSource {
    /// The recording has them.
    Recording,
    /// The scans were aligned one after the other.
    Odometry,
}

/// A recording with a pose for every frame.
pub struct Recording {
    dataset: Dataset,
    moments: Vec<Moment>,
    world_from_lidar: Vec<Pose>,
    steps: Steps,
    /// Where the poses come from.
    pub pose_source: PoseSource,
    /// What the refinement of the poses changed; `None` if they are as they were given.
    pub refined: Option<Refined>,
}

/// One scan of a recording, without the returns of the own vehicle.
#[derive(Clone, Debug, Default)]
pub struct RecordedScan {
    /// Its returns by direction, in the LiDAR frame.
    pub returns: SensorScan,
    /// Positions of the returns, LiDAR frame, m.
    pub points: Vec<[f32; 3]>,
    /// Intensity of each return; 0 where the recording has none.
    pub intensity: Vec<f32>,
    /// Time of each return relative to the frame's stamp, s; `None` if it is not known.
    pub time_s: Option<Vec<f32>>,
    /// Whether a return is labelled as part of something that moves; `None` if it is not known.
    pub moving: Option<Vec<bool>>,
    /// The returns by row; `None` if rows are not known.
    pub rows: Option<Rows>,
}

/// How the poses of a recording are found.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PoseOptions {
    /// Aligns the scans even if the recording has poses.
    pub odometry: bool,
    /// Refines the poses against the planes that all scans show.
    pub refine: bool,
}

/// Scans of which the steps of the pattern are estimated.
const SCANS_FOR_STEPS: usize = 5;

impl Recording {
    /// Opens the first `frames` frames of a recording (all, if `None`), and finds their poses.
    pub fn open(dataset: Dataset, frames: Option<usize>, options: PoseOptions) -> Result<Recording, TwinError> {
        let mut ids = dataset.all_ids()?;
        ids.truncate(frames.unwrap_or(usize::MAX));
        if ids.len() < 4 {
            return Err(TwinError::Recording(format!(
                "{}: {} frames; a twin is made of at least 4, as no frame is held against itself",
                dataset.config.root.display(),
                ids.len()
            )));
        }
        let moments = dataset.moments(&ids)?;
        let mut recording = Recording {
            world_from_lidar: vec![Pose::identity(); ids.len()],
            moments,
            steps: Steps { azimuth_rad: 0.0, elevation_rad: 0.0 },
            dataset,
            pose_source: PoseSource::Recording,
            refined: None,
        };
        recording.steps = recording.find_steps()?;
        recording.find_poses(options)?;
        Ok(recording)
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.moments.len()
    }

    /// Whether there is no frame.
    pub fn is_empty(&self) -> bool {
        self.moments.is_empty()
    }

    /// The data set that was opened.
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Ids, stamps and boxes of the frames.
    pub fn moments(&self) -> &[Moment] {
        &self.moments
    }

    /// Pose of the LiDAR at the stamp of each frame.
    pub fn world_from_lidar(&self) -> &[Pose] {
        &self.world_from_lidar
    }

    /// Typical angles between neighbouring shots.
    pub fn steps(&self) -> Steps {
        self.steps
    }

    /// Reads a scan.
    pub fn scan(&self, frame: usize) -> Result<RecordedScan, TwinError> {
        let id = &self.moments[frame].id;
        let cloud = self.dataset.load_cloud(id)?;
        let mut details = self.dataset.point_details(id)?;
        if details.compensated == Some(true) {
            // The points are where they would have been at the stamp.
            details.time_s = None;
        }
        let mut scan = RecordedScan {
            time_s: details.time_s.as_ref().map(|_| Vec::new()),
            moving: details.moving.as_ref().map(|_| Vec::new()),
            ..RecordedScan::default()
        };
        let mut ring = details.ring.as_ref().map(|_| Vec::new());
        for (i, p) in cloud.points().enumerate() {
            let [x, y, z] = [p[0], p[1], p[2]].map(f64::from);
            let [azimuth, elevation, range] = Sensor::spherical(&Point3::new(x, y, z));
            if !(range >= NEAREST_M && range.is_finite()) {
                continue;
            }
            scan.returns.azimuth_rad.push(azimuth as f32);
            scan.returns.elevation_rad.push(elevation as f32);
            scan.returns.range_m.push(range as f32);
            scan.points.push([p[0], p[1], p[2]]);
            scan.intensity.push(p.get(3).copied().unwrap_or(0.0));
            if let (Some(to), Some(from)) = (&mut scan.time_s, &details.time_s) {
                to.push(from[i]);
            }
            if let (Some(to), Some(from)) = (&mut scan.moving, &details.moving) {
                to.push(from[i]);
            }
            if let (Some(to), Some(from)) = (&mut ring, &details.ring) {
                to.push(from[i]);
            }
        }
        scan.rows = match ring {
            Some(ring) => Rows::of_rings(&scan.returns, &ring),
            None => Rows::of_order(&scan.returns),
        };
        Ok(scan)
    }

    /// Motion of the LiDAR from the stamp of a frame to a time after it, in the LiDAR frame: `stamp_from_time`.
    ///
    /// The twist between this frame and the next (the one before, for the last) is taken to be constant.
    pub fn motion(&self, frame: usize, time_s: f32) -> Pose {
        let (a, b) = if frame + 1 < self.len() { (frame, frame + 1) } else { (frame - 1, frame) };
        let (Some(from), Some(to)) = (self.moments[a].stamp_s, self.moments[b].stamp_s) else {
            return Pose::identity();
        };
        let seconds = to - from;
        if !(seconds > 1e-3) || time_s == 0.0 {
            return Pose::identity();
        }
        let twist = log(&(self.world_from_lidar[a].inverse() * self.world_from_lidar[b]));
        exp(&(twist * (f64::from(time_s) / seconds)))
    }

    fn find_steps(&self) -> Result<Steps, TwinError> {
        let every = (self.len() / SCANS_FOR_STEPS).max(1);
        let scans: Vec<RecordedScan> =
            (0..self.len()).step_by(every).map(|f| self.scan(f)).collect::<Result<_, _>>()?;
        let of_rows: Vec<Steps> =
            scans.iter().filter_map(|s| s.rows.as_ref().and_then(|rows| rows.steps(&s.returns))).collect();
        let median = |values: Vec<f32>| median_upper(values.into_iter().map(f64::from).collect::<Vec<_>>());
        let azimuth = median(of_rows.iter().map(|s| s.azimuth_rad).collect());
        let elevation = median(of_rows.iter().map(|s| s.elevation_rad).collect());
        if let (Some(azimuth), Some(elevation)) = (azimuth, elevation) {
            return Ok(Steps { azimuth_rad: azimuth as f32, elevation_rad: elevation as f32 });
        }
        let returns: Vec<&SensorScan> = scans.iter().map(|s| &s.returns).collect();
        if returns.iter().all(|s| s.is_empty()) {
            let root = self.dataset.config.root.display();
            return Err(TwinError::Recording(format!("{root}: no return is farther than {NEAREST_M} m")));
        }
        Ok(sensor::directions::ScanPattern::of_scans(&returns).steps)
    }

    fn find_poses(&mut self, options: PoseOptions) -> Result<(), TwinError> {
        let given: Option<Vec<Pose>> = self.moments.iter().map(|m| m.world_from_lidar).collect();
        if let Some(bad) = given.iter().flatten().position(|p| p.to_matrix().iter().any(|v| !v.is_finite())) {
            let id = &self.moments[bad].id;
            return Err(TwinError::Recording(format!(
                "frame {id}: its pose is not finite; leave it out, or --odometry"
            )));
        }
        match given.filter(|_| !options.odometry) {
            Some(given) => self.world_from_lidar = given,
            None => {
                self.pose_source = PoseSource::Odometry;
                let mut odometry = Odometry::new(OdometryConfig::default());
                for frame in 0..self.len() {
                    let scan = self.scan(frame)?;
                    self.world_from_lidar[frame] = odometry.add(&scan.points, scan.time_s.as_deref());
                }
            }
        }
        if options.refine {
            let scans: Vec<Vec<[f32; 3]>> = (0..self.len()).map(|f| self.compensated(f)).collect::<Result<_, _>>()?;
            let refined = refine(&scans, &self.world_from_lidar, &RefineConfig::default());
            self.world_from_lidar = refined.poses.clone();
            self.refined = Some(refined);
        }
        Ok(())
    }

    /// Points of a scan, freed of the motion of the sensor, without those in boxes.
    fn compensated(&self, frame: usize) -> Result<Vec<[f32; 3]>, TwinError> {
        let scan = self.scan(frame)?;
        let boxes = &self.moments[frame].objects;
        let still = |p: &[f32; 3]| !boxes.iter().any(|o| crate::objects::is_in(&o.bbox, p));
        let moved = |(i, p): (usize, &[f32; 3])| {
            let Some(times) = &scan.time_s else { return *p };
            let p = self.motion(frame, times[i]) * Point3::from(p.map(f64::from));
            p.coords.map(|v| v as f32).into()
        };
        Ok(scan.points.iter().enumerate().filter(|(_, p)| still(p)).map(moved).collect())
    }
}
