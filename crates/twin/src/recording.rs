//! A recording: scans one after the other with poses, and the boxes of what moved.

mod rows;

pub use rows::{Rows, Shot, shots};

use crate::TwinError;
use crate::objects::pose_of;
use crate::odometry::{Odometry, OdometryConfig, RefineConfig, Refined, exp, log, refine};
use crate::poses::{Found, PoseFinding, Verdict, check_moments, compared, find_convention, mend, most_said};
use data::{Dataset, Moment};
use geometry::Pose;
use nalgebra::{Point3, Vector6};
use schemars::JsonSchema;
use sensor::directions::{SensorScan, Steps};
use sensor::rig::Sensor;
use statistics::median_upper;

/// Returns nearer than this are those of the own vehicle, m.
pub const NEAREST_M: f64 = 1.5;

/// Where the poses of a recording come from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize, JsonSchema)]
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
    /// What was wrong with the frames, their stamps or their poses, and what was done about it.
    pub findings: Vec<String>,
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
    /// Opens the first `frames` frames of a recording (all, if `None`), and finds their poses. `sequence` names the
    /// sequence of a data set that has several.
    ///
    /// Frames are put in the order of their stamps, each stamp once. Frames without a pose are left out where others
    /// have one. Poses that follow another convention are converted, unless they are to be kept. [`Self::findings`] has
    /// what was done.
    ///
    /// # Errors
    /// Several sequences and no name of one, fewer than two frames, poses that are not finite or fit no convention, and
    /// files that cannot be read.
    pub fn open(
        dataset: Dataset,
        sequence: Option<&str>,
        frames: Option<usize>,
        options: PoseOptions,
    ) -> Result<Recording, TwinError> {
        let mut ids = of_sequence(&dataset, sequence)?;
        ids.truncate(frames.unwrap_or(usize::MAX));
        let root = dataset.config.root.display().to_string();
        few(&root, ids.len(), "")?;
        let Found { moments, said } = mend(dataset.moments(&ids)?, options.odometry);
        few(&root, moments.len(), &said.join("; "))?;
        let mut recording = Recording {
            world_from_lidar: vec![Pose::identity(); moments.len()],
            findings: said,
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

    /// Motion of a tracked object from the stamp of a frame on, in the frame of its box: the twist (m and rad) per
    /// second between the frames before and after this one, or this one where it is the first or last of the track.
    /// Zero where stamps or other boxes are not known, and where boxes turn by more than a radian: labels that were
    /// turned round.
    pub fn object_twist(&self, frame: usize, track: &str) -> Vector6<f64> {
        let at = |frame: usize| {
            let object = self.moments.get(frame)?.objects.iter().find(|o| o.track == track)?;
            Some((self.moments[frame].stamp_s?, self.world_from_lidar[frame] * pose_of(&object.bbox)))
        };
        let before = frame.checked_sub(1).and_then(at).or_else(|| at(frame));
        let Some(((from_s, from), (to_s, to))) = before.zip(at(frame + 1).or_else(|| at(frame))) else {
            return Vector6::zeros();
        };
        let moved = from.inverse() * to;
        if to_s - from_s < 1e-3 || moved.rotation.angle() > 1.0 {
            return Vector6::zeros();
        }
        log(&moved) / (to_s - from_s)
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
        let finite = |f: &&PoseFinding| matches!(f, PoseFinding::NotFinite { .. });
        if let Some(bad) = check_moments(&self.moments).iter().find(finite).filter(|_| !options.odometry) {
            let root = self.dataset.config.root.display();
            return Err(TwinError::Recording(format!("{root}: {bad}: --odometry")));
        }
        match given.filter(|_| !options.odometry) {
            Some(given) => {
                self.world_from_lidar = self.in_convention(given, options)?;
                for (moment, pose) in self.moments.iter_mut().zip(&self.world_from_lidar) {
                    moment.world_from_lidar = Some(*pose);
                }
            }
            None => {
                self.pose_source = PoseSource::Odometry;
                let mut odometry = Odometry::new(OdometryConfig::default());
                for frame in 0..self.len() {
                    let scan = self.scan(frame)?;
                    self.world_from_lidar[frame] = odometry.add(&scan.points, scan.time_s.as_deref());
                }
            }
        }
        let known = self.moments.iter().map(|m| match self.pose_source {
            PoseSource::Recording => m.clone(),
            PoseSource::Odometry => Moment { world_from_lidar: None, ..m.clone() },
        });
        self.findings.extend(most_said(&check_moments(&known.collect::<Vec<_>>())));
        if options.refine {
            let scans: Vec<Vec<[f32; 3]>> = (0..self.len()).map(|f| self.compensated(f)).collect::<Result<_, _>>()?;
            let refined = refine(&scans, &self.world_from_lidar, &RefineConfig::default());
            self.world_from_lidar = refined.poses.clone();
            self.refined = Some(refined);
        }
        Ok(())
    }

    /// The poses of the recording as `world_from_lidar`: as they are, or converted from the convention under which the
    /// scans coincide.
    fn in_convention(&mut self, given: Vec<Pose>, options: PoseOptions) -> Result<Vec<Pose>, TwinError> {
        let frames = compared(&given);
        let scans: Vec<_> = frames.iter().map(|f| Ok(self.scan(*f)?.points)).collect::<Result<_, TwinError>>()?;
        let poses: Vec<Pose> = frames.iter().map(|f| given[*f]).collect();
        let report = find_convention(&scans, &poses);
        match report.verdict {
            Verdict::AsGiven | Verdict::Unknown => Ok(given),
            Verdict::Other(_) if !options.refine => {
                self.findings.push(format!("{report}; they are kept as they are"));
                Ok(given)
            }
            Verdict::Other(convention) => {
                self.findings.push(format!("{report}; the twin is made with converted poses"));
                Ok(convention.world_from_lidar(&given))
            }
            Verdict::None if !options.refine => {
                self.findings.push(format!("{report}; they are kept as they are"));
                Ok(given)
            }
            Verdict::None => {
                let root = self.dataset.config.root.display();
                Err(TwinError::Recording(format!("{root}: {report}: --odometry; or keep them: --keep-poses")))
            }
        }
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

/// The frames of the sequence of this name, or of the only one.
fn of_sequence(dataset: &Dataset, name: Option<&str>) -> Result<Vec<String>, TwinError> {
    let mut sequences = dataset.sequences()?;
    let names: Vec<String> = sequences.iter().map(|s| s.name.clone()).collect();
    let refused = |message: String| TwinError::Recording(format!("{}: {message}", dataset.config.root.display()));
    let at = match name {
        None if sequences.len() > 1 => {
            let (some, count) = (names.iter().take(10).cloned().collect::<Vec<_>>().join(", "), names.len());
            return Err(refused(format!("has {count} sequences; give --sequence NAME: {some}")));
        }
        None => 0,
        Some(name) => names
            .iter()
            .position(|known| known == name)
            .ok_or_else(|| refused(format!("has no sequence {name:?}, only {}", names.join(", "))))?,
    };
    Ok(if at < sequences.len() { sequences.swap_remove(at).ids } else { Vec::new() })
}

/// Fewest frames: one that is shot, and one that its map is made of.
const FEWEST: usize = 2;

/// Refuses too few frames. `why` says what became of the others.
fn few(root: &str, frames: usize, why: &str) -> Result<(), TwinError> {
    if frames >= FEWEST {
        return Ok(());
    }
    let why = if why.is_empty() { String::new() } else { format!(" ({why})") };
    Err(TwinError::Recording(format!(
        "{root}: {frames} frames{why}; a twin is made of at least {FEWEST}, as no frame is held against itself"
    )))
}
