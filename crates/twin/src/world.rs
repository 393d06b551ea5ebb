//! The world of a job: its map and its objects, and the shots of a frame into it.

use crate::TwinError;
use crate::map::{FARTHEST_M, FusionConfig, Met, Patch, SeenShot, SurfelMap, patches};
use crate::objects::{is_in, model, pose_of};
use crate::plan::Job;
use crate::recording::{NEAREST_M, RecordedScan, Recording, Shot, shots};
use geometry::{Box3, Pose};
use nalgebra::{Point3, Vector3};
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
    /// Builds the world of a job.
    pub fn build(recording: &Recording, job: &Job, config: &FusionConfig) -> Result<World, TwinError> {
        let middle = job.map[job.map.len() / 2];
        let map_from_world = recording.world_from_lidar()[middle].inverse();
        let steps = recording.steps();
        let window =
            Steps { azimuth_rad: WINDOW[0] * steps.azimuth_rad, elevation_rad: WINDOW[1] * steps.elevation_rad };
        let mut still = Vec::new();
        let mut moving: BTreeMap<String, Vec<Patch>> = BTreeMap::new();
        let mut seen = Vec::new();
        for frame in &job.map {
            let scan = recording.scan(*frame)?;
            let objects = &recording.moments()[*frame].objects;
            let map_from_lidar = map_from_world * recording.world_from_lidar()[*frame];
            let own = patches(&scan.returns, &scan.intensity, steps, window, *frame as u32);
            for (i, patch) in own.iter().enumerate() {
                let stamp_from_time = motion_of(recording, *frame, &scan, i);
                let patch = patch.moved(&stamp_from_time);
                match objects.iter().find(|o| is_in(&o.bbox, &patch.place)) {
                    Some(o) => {
                        moving.entry(o.track.clone()).or_default().push(patch.moved(&pose_of(&o.bbox).inverse()))
                    }
                    None if scan.moving.as_ref().is_some_and(|moving| moving[i]) => {}
                    None => still.push(patch.moved(&map_from_lidar)),
                }
            }
            seen.push((*frame, scan));
        }
        let shots = seen.iter().map(|(frame, scan)| seen_shots(recording, *frame, scan, &map_from_world));
        let map = SurfelMap::build(&still, shots, config);
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
        let boxes = &recording.moments()[frame].objects;
        let map_from_lidar = self.map_from_world * recording.world_from_lidar()[frame];
        let placed: Vec<(&Box3, Pose, &SurfelMap, f64)> = boxes
            .iter()
            .filter_map(|o| {
                let reach = Vector3::from(o.bbox.size).norm() / 2.0 + 0.5;
                Some((&o.bbox, pose_of(&o.bbox).inverse(), self.objects.get(&o.track)?, reach))
            })
            .collect();
        let shown = shots.par_iter().with_min_len(512).map_init(Vec::new, |met, shot| {
            let stamp_from_time = recording.motion(frame, shot.time_s);
            let origin = stamp_from_time.translation.vector;
            let direction = stamp_from_time.rotation * Vector3::from(shot.direction.map(f64::from));
            let still = end(&self.map, &map_from_lidar, &origin, &direction, met);
            let mut shown = still.map(|e| Shown { range_m: e.range_m, intensity: e.intensity, object: false });
            for (bbox, box_from_lidar, model, reach) in &placed {
                if !near(&bbox.center.into(), &origin, &direction, *reach) {
                    continue;
                }
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
            boxes.iter().any(|o| is_in(&o.bbox, &at))
        };
        let on_object = shots.iter().map(of_object).collect();
        Ok(FrameShots { scan, shots, shown, on_object })
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
