//! Ego motion from frame to frame, from static edges and the ground of the simulated side.

use crate::pairing::{FramePair, Surface};
use geometry::Box3;
use nalgebra::{Point3, Vector2};
use rayon::prelude::*;
pub use sensor::motion::{CELL_M, Cells, OwnMotion, times_s};
use sensor::motion::{GroundPoint, Standing};

/// The motion at each frame; `None` where it cannot be estimated.
pub fn own_motion(frames: &[FramePair], times: &[f64], origins: &[Point3<f64>]) -> Vec<Option<OwnMotion>> {
    let of_frame =
        |frame: &FramePair| Standing::new(edges(frame, origins), &ground(frame, origins).collect::<Vec<_>>());
    sensor::motion::own_motion(frames.par_iter().map(of_frame).collect(), times)
}

/// Places of static edges: not of the ground, not of objects, not of smooth walls.
fn edges(frame: &FramePair, origins: &[Point3<f64>]) -> Vec<Vector2<f64>> {
    let boxes: Vec<Box3> = frame.objects.iter().filter_map(|o| o.simulated).collect();
    let rays = frame.simulated.iter().filter(|ray| !ray.smooth && ray.surface == Surface::Standing);
    let places = rays.map(|ray| {
        let range_m = ray.own_range_m();
        ((origins[ray.sensor as usize] + ray.direction_vector() * range_m).coords, range_m)
    });
    sensor::motion::static_edges(places, &boxes)
}

/// Points of smooth ground.
fn ground<'a>(frame: &'a FramePair, origins: &'a [Point3<f64>]) -> impl Iterator<Item = GroundPoint> + 'a {
    let rays = frame.simulated.iter().filter(|ray| ray.smooth && ray.surface == Surface::Ground);
    rays.map(|ray| GroundPoint {
        place: ray.predicted_point(&origins[ray.sensor as usize]).coords,
        normal: ray.normal_vector(),
    })
}
