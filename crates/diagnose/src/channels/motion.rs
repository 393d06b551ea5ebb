//! Ego motion from frame to frame, from static edges and the ground of the simulated side.

use crate::pairing::{FramePair, Ray, Surface};
use geometry::Box3;
use nalgebra::Point3;
use rayon::prelude::*;
pub use sensor::motion::{CELL_M, Cells, Driven, Ground, OwnMotion, SeenVelocity, times_s};
use sensor::motion::{GroundPoint, Standing};

/// The motion over all frames.
pub fn own_motion(frames: &[FramePair], times: &[f64], origins: &[Point3<f64>]) -> Driven {
    let of_frame = |frame: &FramePair| standing(frame, origins);
    sensor::motion::own_motion(frames.par_iter().map(of_frame).collect(), times)
}

/// What stands still: edges, not of the ground, not of objects, not of smooth walls; and the ground.
fn standing(frame: &FramePair, origins: &[Point3<f64>]) -> Standing {
    let boxes: Vec<Box3> = frame.objects.iter().filter_map(|o| o.simulated).collect();
    let rays = frame.simulated.iter().filter(|ray| !ray.smooth && ray.surface == Surface::Standing);
    let places = rays.map(|ray| (ray.point(&origins[ray.sensor as usize]).coords, ray.own_range_m()));
    Standing::new(places, &boxes, ground(frame, origins))
}

/// Points of smooth ground.
pub fn ground(frame: &FramePair, origins: &[Point3<f64>]) -> Vec<GroundPoint> {
    let rays = frame.simulated.iter().filter(|ray| ray.smooth && ray.surface == Surface::Ground);
    let point = |ray: &Ray| GroundPoint {
        place: ray.predicted_point(&origins[ray.sensor as usize]).coords,
        normal: ray.normal_vector(),
    };
    rays.map(point).collect()
}
