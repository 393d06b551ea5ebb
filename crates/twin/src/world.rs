//! The world of a job: its map and its objects, and the shots of a frame into it.

use crate::TwinError;
use crate::map::{FARTHEST_M, Fusion, FusionConfig, Met, Patch, SeenShot, SurfelMap, patches};
use crate::objects::{is_in_size, model, pose_of};
use crate::odometry::exp;
use crate::plan::Job;
use crate::recording::{NEAREST_M, RecordedScan, Recording, Shot, shots};
use data::TrackedObject;
use geometry::Pose;
use nalgebra::{Point3, Vector3, Vector6};
use rayon::prelude::*;
use sensor::directions::Steps;
use std::collections::BTreeMap;

/// Half widths of the window in which the surface of a return is looked for, in steps of the pattern.
const WINDOW: [f32; 2] = [2.2, 1.4];

/// A static map and the objects in it, made of the frames of a job.
pub struct World {
    map: SurfelMap,
    objects: BTreeMap<String, SurfelMap>,
    map_from_world: Pose,
}

/// The end of a shot in the twin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shown {
    /// m.
    pub range_m: f32,
    /// As the recording has it.
    pub intensity: f32,
    /// It ends on an object.
    pub object: bool,
}

/// A frame shot again.
pub struct FrameShots {
    /// The scan as it was recorded.
    pub scan: RecordedScan,
    /// Its shots, with and without a return.
    pub shots: Vec<Shot>,
    /// Where each ends in the twin; `None` where the twin has nothing.
    pub shown: Vec<Option<Shown>>,
    /// Whether the recorded return of a shot belongs to an object.
    pub on_object: Vec<bool>,
}

impl World {
    /// Builds the world of a job. The scans are read twice and never held together. `most_bytes` is the memory that the
    /// map may take.
    ///
    /// # Errors
    /// Scans that cannot be read, and a map that needs more memory.
    pub fn build(recording: &Recording, job: &Job, config: &FusionConfig, most_bytes: u64) -> Result<World, TwinError> {
        let middle = job.map[job.map.len() / 2];
        let map_from_world = recording.world_from_lidar()[middle].inverse();
        let steps = recording.steps();
        let window =
            Steps { azimuth_rad: WINDOW[0] * steps.azimuth_rad, elevation_rad: WINDOW[1] * steps.elevation_rad };
        let mut fusion = Fusion::new(*config);
        let mut moving: BTreeMap<String, Vec<Patch>> = BTreeMap::new();
        for frame in &job.map {
            let scan = recording.scan(*frame)?;
            let objects = Placed::of_frame(recording, *frame);
            let map_from_lidar = map_from_world * recording.world_from_lidar()[*frame];
            let mut still = Vec::new();
            let own = patches(&scan.returns, &scan.intensity, steps, window, *frame as u32);
            for (i, patch) in own.iter().enumerate() {
                let stamp_from_time = motion_of(recording, *frame, &scan, i);
                let patch = patch.moved(&stamp_from_time);
                let time_s = scan.time_s.as_ref().map_or(0.0, |times| times[i]);
                match objects.iter().find(|o| o.has(&patch.place, time_s)) {
                    Some(o) => {
                        moving.entry(o.object.track.clone()).or_default().push(patch.moved(&o.box_from_lidar(time_s)))
                    }
                    None if scan.moving.as_ref().is_some_and(|moving| moving[i]) => {}
                    None => still.push(patch.moved(&map_from_lidar)),
                }
            }
            fusion.add(&still);
            within_memory(recording, job, &fusion, most_bytes)?;
        }
        let mut unread = None;
        let shots = job.map.iter().map_while(|frame| match recording.scan(*frame) {
            Ok(scan) => Some(seen_shots(recording, *frame, &scan, &map_from_world)),
            Err(error) => {
                unread = Some(error);
                None
            }
        });
        let map = SurfelMap::of_surfels(fusion.surfels(), shots, config);
        if let Some(error) = unread {
            return Err(error);
        }
        let mut objects = BTreeMap::new();
        for frame in job.shoot.iter().chain(&job.map) {
            for o in &recording.moments()[*frame].objects {
                let none = Vec::new();
                objects
                    .entry(o.track.clone())
                    .or_insert_with(|| model(moving.get(&o.track).unwrap_or(&none), &o.class, o.bbox.size, config));
            }
        }
        Ok(World { map, objects, map_from_world })
    }

    /// The static map.
    pub fn map(&self) -> &SurfelMap {
        &self.map
    }

    /// Shoots a frame again: the shots of its scan, each from where the sensor was at its time.
    pub fn shoot(&self, recording: &Recording, frame: usize) -> Result<FrameShots, TwinError> {
        let scan = recording.scan(frame)?;
        let shots = shots(&scan);
        let objects = Placed::of_frame(recording, frame);
        let map_from_lidar = self.map_from_world * recording.world_from_lidar()[frame];
        let placed: Vec<(&Placed, &SurfelMap)> =
            objects.iter().filter_map(|o| Some((o, self.objects.get(&o.object.track)?))).collect();
        let shown = shots.par_iter().with_min_len(512).map_init(Vec::new, |met, shot| {
            let stamp_from_time = recording.motion(frame, shot.time_s);
            let origin = stamp_from_time.translation.vector;
            let direction = stamp_from_time.rotation * Vector3::from(shot.direction.map(f64::from));
            let still = end(&self.map, &map_from_lidar, &origin, &direction, met);
            let mut shown = still.map(|e| Shown { range_m: e.range_m, intensity: e.intensity, object: false });
            for (placed, model) in &placed {
                if !near(&placed.object.bbox.center.into(), &origin, &direction, placed.reach_m(shot.time_s)) {
                    continue;
                }
                let box_from_lidar = &placed.box_from_lidar(shot.time_s);
                let nearest = shown.map_or(FARTHEST_M, |s| s.range_m);
                if let Some(e) = end(model, box_from_lidar, &origin, &direction, met).filter(|e| e.range_m < nearest) {
                    shown = Some(Shown { range_m: e.range_m, intensity: e.intensity, object: true });
                }
            }
            shown.filter(|s| f64::from(s.range_m) >= NEAREST_M)
        });
        let shown = shown.collect();
        let of_object = |shot: &Shot| {
            let Some(i) = shot.measured else { return false };
            let at =
                motion_of(recording, frame, &scan, i as usize) * Point3::from(scan.points[i as usize].map(f64::from));
            let at = at.coords.map(|v| v as f32).into();
            objects.iter().any(|o| o.has(&at, shot.time_s))
        };
        let on_object = shots.iter().map(of_object).collect();
        Ok(FrameShots { scan, shots, shown, on_object })
    }
}

fn within_memory(recording: &Recording, job: &Job, fusion: &Fusion, most_bytes: u64) -> Result<(), TwinError> {
    if fusion.bytes() <= most_bytes {
        return Ok(());
    }
    let id = |frame: Option<&usize>| frame.map_or("", |f| recording.moments()[*f].id.as_str());
    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
    Err(TwinError::Recording(format!(
        "the map of {} frames from {} to {} needs more than {} MiB, and {} MiB may be used: give --memory MIB, or make \
         the twin of fewer frames: --frames N",
        job.map.len(),
        id(job.map.first()),
        id(job.map.last()),
        mib(fusion.bytes()),
        mib(most_bytes)
    )))
}

/// An object in a frame, with its motion.
struct Placed<'a> {
    object: &'a TrackedObject,
    /// At the stamp of the frame.
    box_from_lidar: Pose,
    /// Its motion in the frame of its box, a second.
    twist: Vector6<f64>,
}

impl<'a> Placed<'a> {
    fn of_frame(recording: &'a Recording, frame: usize) -> Vec<Self> {
        let place = |object: &'a TrackedObject| Placed {
            object,
            box_from_lidar: pose_of(&object.bbox).inverse(),
            twist: recording.object_twist(frame, &object.track),
        };
        recording.moments()[frame].objects.iter().map(place).collect()
    }

    /// The LiDAR frame at the stamp in the frame of the box at a time (s) after the stamp.
    fn box_from_lidar(&self, time_s: f32) -> Pose {
        if time_s == 0.0 {
            return self.box_from_lidar;
        }
        exp(&(self.twist * -f64::from(time_s))) * self.box_from_lidar
    }

    /// Whether a place (LiDAR frame at the stamp) belongs to the object at a time after the stamp.
    fn has(&self, place: &[f32; 3], time_s: f32) -> bool {
        let place = Point3::from(place.map(f64::from));
        let far = (place.coords - Vector3::from(self.object.bbox.center)).norm() > self.reach_m(time_s);
        !far && is_in_size(self.object.bbox.size, (self.box_from_lidar(time_s) * place).coords.into())
    }

    /// Distance from the centre of the box at the stamp within which the object is at a time after it, m.
    fn reach_m(&self, time_s: f32) -> f64 {
        let moved_m = self.twist.fixed_rows::<3>(0).norm() * f64::from(time_s.abs());
        Vector3::from(self.object.bbox.size).norm() / 2.0 + 0.5 + moved_m
    }
}

/// Whether a ray passes a place within `reach` m.
fn near(place: &Vector3<f64>, origin: &Vector3<f64>, direction: &Vector3<f64>, reach: f64) -> bool {
    let to = place - origin;
    let along = to.dot(direction);
    along > -reach && (to - direction * along).norm_squared() < reach * reach
}

fn end(
    map: &SurfelMap,
    map_from_lidar: &Pose,
    origin: &Vector3<f64>,
    direction: &Vector3<f64>,
    met: &mut Vec<Met>,
) -> Option<crate::map::End> {
    let at = map_from_lidar * Point3::from(*origin);
    let along = map_from_lidar.rotation * direction;
    map.end(at.coords.map(|v| v as f32).into(), along.map(|v| v as f32).into(), met)
}

/// Motion of the sensor from the stamp of the frame to the time of a return.
fn motion_of(recording: &Recording, frame: usize, scan: &RecordedScan, i: usize) -> Pose {
    scan.time_s.as_ref().map_or_else(Pose::identity, |times| recording.motion(frame, times[i]))
}

fn seen_shots(recording: &Recording, frame: usize, scan: &RecordedScan, map_from_world: &Pose) -> Vec<SeenShot> {
    let map_from_lidar = map_from_world * recording.world_from_lidar()[frame];
    let shot = |i: usize| {
        let pose = map_from_lidar * motion_of(recording, frame, scan, i);
        let direction = pose.rotation * Vector3::from(scan.points[i].map(f64::from)).normalize();
        SeenShot {
            origin: pose.translation.vector.map(|v| v as f32).into(),
            direction: direction.map(|v| v as f32).into(),
            range_m: scan.returns.range_m[i],
        }
    };
    (0..scan.points.len()).into_par_iter().with_min_len(1024).map(shot).collect()
}
