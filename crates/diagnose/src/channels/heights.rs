//! Heights of the ground over the simulated one, frame by frame: with the pose that each frame has of its own taken
//! out, and what is the same in the vehicle's axes in all frames.

use super::mean::{usable, usual_noise_m, weight};
use super::own_poses::{Mount, OwnPoses, mounts, off_surface_m, own_poses};
use crate::inference::median;
use crate::pairing::{FramePair, Ray, Surface};
use nalgebra::Vector2;
use rayon::prelude::*;
use sensor::Rig;
use std::collections::BTreeMap;

/// Distances of the ground that is compared, m.
const NEAR_FAR_M: [f64; 2] = [3.0, 25.0];

/// Fewest returns of a cell.
const FEWEST: f64 = 4.0;

/// Fewest frames in which a cell of the vehicle's axes is seen, for their mean.
const FEWEST_FRAMES: usize = 5;

/// Standard deviation of small unevenness in a cell, m.
const UNEVEN_M: f64 = 0.003;

/// A cell of the vehicle's axes, by two numbers.
pub type Cell = [i32; 2];

/// Height of the ground in a cell, m, with its variance, m2.
pub type Heights = BTreeMap<Cell, [f64; 2]>;

/// Heights of each frame by the cell of a return and its place in the vehicle's axes, m.
pub fn heights(frames: &[FramePair], rig: &Rig, cell_of: impl Fn(&Ray, &Vector2<f64>) -> Cell + Sync) -> Vec<Heights> {
    let (mounts, noise_m) = (mounts(rig), usual_noise_m(frames));
    let of_frame = |frame: &FramePair| {
        let pose = own_poses(frame, &mounts, noise_m);
        of_frame(frame, &pose, (&mounts, noise_m), &cell_of)
    };
    let mut heights: Vec<Heights> = frames.par_iter().map(of_frame).collect();
    take_out_means(&mut heights);
    heights
}

fn of_frame(
    frame: &FramePair,
    pose: &OwnPoses,
    (mounts, noise_m): (&[Mount], f64),
    cell_of: &impl Fn(&Ray, &Vector2<f64>) -> Cell,
) -> Heights {
    let mut cells = BTreeMap::<Cell, [f64; 3]>::new();
    for ray in frame.measured.iter().filter(|r| usable(r) && r.surface == Surface::Ground) {
        let mount = &mounts[usize::from(ray.sensor)];
        let place = ray.predicted_point(&mount.origin).coords.xy();
        let Some(up_m) = off_surface_m(ray, mount, pose) else { continue };
        if (NEAR_FAR_M[0]..NEAR_FAR_M[1]).contains(&place.norm()) {
            let sums = cells.entry(cell_of(ray, &place)).or_default();
            let w = weight(ray, noise_m);
            (sums[0], sums[1], sums[2]) = (sums[0] + 1.0, sums[1] + w, sums[2] + w * up_m);
        }
    }
    let height = |(cell, [_, w, wy]): (Cell, [f64; 3])| (cell, [wy / w, 1.0 / w + UNEVEN_M * UNEVEN_M]);
    cells.into_iter().filter(|(_, s)| s[0] >= FEWEST).map(height).collect()
}

/// Heights, or tilts, over their usual size from which on they are of things that stand on the ground, not of the
/// ground.
const USUAL: f64 = 5.0;

/// Largest size that belongs to the ground, by the median of some sizes.
pub fn largest_of_ground(sizes: impl Iterator<Item = f64>) -> f64 {
    USUAL / statistics::MEDIAN_OF_NORMAL * median(sizes.map(f64::abs).collect())
}

/// Takes out what a cell of the vehicle's axes has in the mean over the frames.
fn take_out_means(frames: &mut [Heights]) {
    let mut means = BTreeMap::<Cell, (usize, f64)>::new();
    for (cell, [height_m, _]) in frames.iter().flatten() {
        let mean = means.entry(*cell).or_default();
        (mean.0, mean.1) = (mean.0 + 1, mean.1 + height_m);
    }
    for frame in frames {
        frame.retain(|cell, _| means[cell].0 >= FEWEST_FRAMES);
        frame.iter_mut().for_each(|(cell, [height_m, _])| *height_m -= means[cell].1 / means[cell].0 as f64);
    }
}

/// Standard deviation of what two observations agree on, with its error by the scatter of blocks: the root of a sum of
/// products over a sum of weights, both by frame with its block.
pub fn common_std(frames: impl Iterator<Item = (usize, [f64; 2])>) -> [f64; 2] {
    let mut by_block = BTreeMap::<usize, [f64; 2]>::new();
    for (block, [weight, product]) in frames {
        let sums = by_block.entry(block).or_default();
        *sums = [sums[0] + weight, sums[1] + product];
    }
    let [weight, product] = by_block.values().fold([0.0; 2], |s, b| [s[0] + b[0], s[1] + b[1]]);
    let (weight, blocks) = (weight.max(1e-12), by_block.len() as f64);
    let mean = product / weight;
    let scatter: f64 = by_block.values().map(|[weight, product]| (product - mean * weight).powi(2)).sum();
    let error = (scatter * blocks / (blocks - 1.0).max(1.0)).sqrt() / weight;
    let std = mean.max(0.0).sqrt();
    [std, error / (2.0 * std).max(1e-6)]
}

#[cfg(test)]
pub(crate) mod testing {
    use super::*;
    use crate::channels::motion::OwnMotion;
    use crate::inference::roles::roles;
    use crate::search::{ChannelResult, Context};
    use nalgebra::{Rotation2, Vector3};

    /// What a search finds on ground of some height, by the place in the world and by that in the vehicle's axes, in a
    /// frame. The vehicle drives 1.5 m from frame to frame and turns slowly.
    pub fn found_in(
        search: fn(&Context) -> ChannelResult,
        height_m: impl Fn(Vector2<f64>, Vector2<f64>, usize) -> f64,
    ) -> ChannelResult {
        let (frames, speed, turn, dt) = (60, 15.0, 0.1, 0.1);
        let (mut at, mut heading) = (Vector2::zeros(), 0.0);
        let mut recorded = Vec::new();
        for f in 0..frames {
            let mut rays = Vec::new();
            for k in 0..6000 {
                let (azimuth, distance) = (2.4 * f64::from(k), 4.0 + 18.0 * f64::from(k) / 6000.0);
                let own = Vector2::new(azimuth.cos(), azimuth.sin()) * distance;
                let up_m = height_m(at + Rotation2::new(heading) * own, own, f);
                let place = Vector3::new(own.x, own.y, -2.0);
                let cos = 2.0 / place.norm();
                rays.push(Ray {
                    surface: Surface::Ground,
                    normal: [0.0, 0.0, 1.0],
                    cos_incidence: cos as f32,
                    residual_m: (-up_m / cos) as f32,
                    ..Ray::standing(&place)
                });
            }
            recorded.push(FramePair::of_rays(f.to_string(), rays, vec![]));
            at += Rotation2::new(heading + 0.5 * turn * dt) * Vector2::new(speed * dt, 0.0);
            heading += turn * dt;
        }
        let turn_rate_rad_s = Vector3::new(0.0, 0.0, turn);
        let own = OwnMotion { velocity_m_s: Vector3::new(speed, 0.0, 0.0), turn_rate_rad_s };
        let context = Context {
            rig: &Rig::single(),
            frames: &recorded,
            roles: roles(frames),
            times: Some((0..frames).map(|f| dt * f as f64).collect()),
            motion: None,
            to_next: vec![Some(own); frames - 1],
        };
        search(&context)
    }

    /// Ground that rolls by 1 cm.
    pub fn wave(place: Vector2<f64>) -> f64 {
        0.02 * (0.35 * place.x).sin() * (0.25 * place.y + 1.0).cos()
    }
}
