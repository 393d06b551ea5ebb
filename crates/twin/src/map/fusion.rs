//! Patches of many scans merged into surfels.

use super::patch::Patch;
use nalgebra::Vector3;
use rayon::prelude::*;

/// A piece of surface of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surfel {
    /// Centre, map frame, m.
    pub place: [f32; 3],
    /// Unit normal towards the sensors that saw it.
    pub normal: [f32; 3],
    /// Half axes, m.
    pub axes: [[f32; 3]; 2],
    /// Share of the returns in it that lie on a plane with those around them.
    pub smooth: f32,
    /// Mean intensity, as the recording has it.
    pub intensity: f32,
    /// Returns in it.
    pub returns: u32,
    /// Frames that saw it.
    pub frames: u32,
}

impl Surfel {
    /// Whether it is a piece of a plane; otherwise an edge or foliage.
    pub fn is_smooth(&self) -> bool {
        self.smooth >= 0.5
    }
}

/// How patches are merged.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FusionConfig {
    /// Edge of the cubes in which patches of planes are merged, m.
    pub cube_m: f32,
    /// Edge of the cubes in which other patches are merged, m.
    pub rough_cube_m: f32,
    /// Distance across a surface within which surfels belong to it, m.
    pub thickness_m: f32,
    /// Half axes of a surfel on a plane, in half steps of the scan pattern: neighbours overlap.
    pub cover: f32,
}

impl Default for FusionConfig {
    fn default() -> Self {
        FusionConfig { cube_m: 0.07, rough_cube_m: 0.05, thickness_m: 0.06, cover: 1.8 }
    }
}

/// Standard deviation of a return across its surface: a constant (m) and a part that grows with range (rad), from
/// attitudes and elevations.
const DEVIATION: (f32, f32) = (0.02, 0.001);

/// Smallest half axis of a surfel off a plane, m.
const LEAST_ROUGH_M: f32 = 0.02;

/// Merges the patches of each cube that face the same way.
pub fn fuse(patches: &[Patch], config: &FusionConfig) -> Vec<Surfel> {
    let key_of = |patch: &Patch| match patch.smooth {
        true => key(&patch.place, config.cube_m, facing(&patch.normal)),
        false => key(&patch.place, config.rough_cube_m, ROUGH),
    };
    let mut order: Vec<(u64, u32)> =
        patches.par_iter().enumerate().map(|(i, patch)| (key_of(patch), i as u32)).collect();
    order.par_sort_unstable();
    let groups: Vec<&[(u64, u32)]> = order.chunk_by(|a, b| a.0 == b.0).collect();
    groups.par_iter().with_min_len(256).map(|group| merged(patches, group, config)).collect()
}

/// The place in [`key`] of the side that a normal faces: its dominant axis with its sign.
fn facing(normal: &[f32; 3]) -> u64 {
    let axis = (0..3).max_by(|a, b| normal[*a].abs().total_cmp(&normal[*b].abs())).unwrap_or(0);
    2 * axis as u64 + u64::from(normal[axis] < 0.0)
}

/// The place in [`key`] of patches off a plane.
const ROUGH: u64 = 6;

/// Number of a cube and a side. Cubes of 5 cm are counted over 52 km before they repeat.
fn key(place: &[f32; 3], edge_m: f32, side: u64) -> u64 {
    let [x, y, z] = place.map(|v| ((v / edge_m).floor() as i64 + (1 << 19)) as u64 & 0xf_ffff);
    (x << 40 | y << 20 | z) << 3 | side
}

fn merged(patches: &[Patch], members: &[(u64, u32)], config: &FusionConfig) -> Surfel {
    let (mut place, mut normal) = (Vector3::<f32>::zeros(), Vector3::<f32>::zeros());
    let (mut weights, mut intensity, mut smooth, mut frames, mut last) = (0.0, 0.0, 0, 0, None);
    let mut sharpest = &patches[members[0].1 as usize];
    let first = Vector3::from(sharpest.place);
    for (_, i) in members {
        let patch = &patches[*i as usize];
        let weight = 1.0 / (DEVIATION.0.powi(2) + (DEVIATION.1 * patch.range_m).powi(2));
        // Relative to the first, as sums of places far from the origin lose digits.
        place += (Vector3::from(patch.place) - first) * weight;
        normal += Vector3::from(patch.normal) * weight;
        weights += weight;
        intensity += patch.intensity;
        smooth += u32::from(patch.smooth);
        frames += u32::from(last != Some(patch.frame));
        last = Some(patch.frame);
        if patch.size() < sharpest.size() {
            sharpest = patch;
        }
    }
    let returns = members.len() as f32;
    let normal = normal.try_normalize(1e-6).unwrap_or(Vector3::from(sharpest.normal));
    let smooth = smooth as f32 / returns;
    let (least, cover) = if smooth >= 0.5 { (config.cube_m, config.cover) } else { (LEAST_ROUGH_M, 1.0) };
    let axes = sharpest.axes.map(|axis| {
        // On the plane of the mean normal.
        let axis = Vector3::from(axis) * cover;
        let axis = axis - normal * normal.dot(&axis);
        let length = axis.norm();
        (if length > 1e-6 { axis * (length.max(least) / length) } else { axis }).into()
    });
    Surfel {
        place: (first + place / weights).into(),
        normal: normal.into(),
        axes,
        smooth,
        intensity: intensity / returns,
        returns: members.len() as u32,
        frames,
    }
}
