//! Ego motion from frame to frame, from static edges of the simulated side.

use crate::pairing::{FramePair, Surface};
use geometry::Box3;
use nalgebra::{Point3, Vector2};
use rayon::prelude::*;
pub use sensor::motion::{CELL_M, Cells, OwnMotion, times_s};

/// The motion at each frame; `None` where it cannot be estimated.
pub fn own_motion(frames: &[FramePair], times: &[f64], origins: &[Point3<f64>]) -> Vec<Option<OwnMotion>> {
    let edges: Vec<Vec<Vector2<f64>>> = frames.par_iter().map(|frame| edges(frame, origins)).collect();
    sensor::motion::own_motion(edges, times)
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
