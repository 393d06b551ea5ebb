//! Patches of many scans merged into surfels.

use super::patch::Patch;
use crate::odometry::voxels::KeyHasher;
use nalgebra::Vector3;
use rayon::prelude::*;
use std::collections::HashMap;
use std::hash::BuildHasherDefault;

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

/// Merges the patches of each cube that face the same way. The patches are given scan by scan and are not kept: memory
/// grows with the surface that was seen, not with the number of scans.
#[derive(Clone, Debug)]
pub struct Fusion {
    config: FusionConfig,
    cubes: HashMap<u64, Gathered, BuildHasherDefault<KeyHasher>>,
}

impl Fusion {
    /// Without patches.
    pub fn new(config: FusionConfig) -> Self {
        Fusion { config, cubes: HashMap::default() }
    }

    /// Adds patches. The sums of a cube have the order in which its patches were added.
    pub fn add(&mut self, patches: &[Patch]) {
        for patch in patches {
            let key = match patch.smooth {
                true => key(&patch.place, self.config.cube_m, facing(&patch.normal)),
                false => key(&patch.place, self.config.rough_cube_m, ROUGH),
            };
            self.cubes.entry(key).or_insert_with(|| Gathered::new(patch)).add(patch);
        }
    }

    /// Memory that the map of these patches takes at most while it is made, bytes.
    pub fn bytes(&self) -> u64 {
        (self.cubes.capacity() * (size_of::<(u64, Gathered)>() + 1) + self.cubes.len() * BYTES_PER_SURFEL) as u64
    }

    /// The surfels, in the order of their cubes.
    pub fn surfels(self) -> Vec<Surfel> {
        let mut order: Vec<(u64, Gathered)> = self.cubes.into_iter().collect();
        order.par_sort_unstable_by_key(|(key, _)| *key);
        order.par_iter().with_min_len(256).map(|(_, gathered)| gathered.surfel(&self.config)).collect()
    }
}

/// Bytes of a surfel with its place in the sorted list, in the map and in the tree of discs.
const BYTES_PER_SURFEL: usize = 360;

/// The surfels of patches.
pub fn fuse(patches: &[Patch], config: &FusionConfig) -> Vec<Surfel> {
    let mut fusion = Fusion::new(*config);
    fusion.add(patches);
    fusion.surfels()
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

/// Sums over the patches of a cube.
#[derive(Clone, Copy, Debug)]
struct Gathered {
    /// Place of the first patch: sums of places far from the origin would lose digits.
    first: Vector3<f32>,
    place: Vector3<f32>,
    normal: Vector3<f32>,
    weights: f32,
    intensity: f32,
    returns: u32,
    smooth: u32,
    frames: u32,
    last: Option<u32>,
    /// The smallest patch: its half axes, its normal, and its size.
    axes: [[f32; 3]; 2],
    sharpest: [f32; 3],
    size: f32,
}

impl Gathered {
    /// Without patches; `first` is to be added.
    fn new(first: &Patch) -> Self {
        Gathered {
            first: Vector3::from(first.place),
            place: Vector3::zeros(),
            normal: Vector3::zeros(),
            weights: 0.0,
            intensity: 0.0,
            returns: 0,
            smooth: 0,
            frames: 0,
            last: None,
            axes: first.axes,
            sharpest: first.normal,
            size: f32::INFINITY,
        }
    }

    fn add(&mut self, patch: &Patch) {
        let weight = 1.0 / (DEVIATION.0.powi(2) + (DEVIATION.1 * patch.range_m).powi(2));
        self.place += (Vector3::from(patch.place) - self.first) * weight;
        self.normal += Vector3::from(patch.normal) * weight;
        self.weights += weight;
        self.intensity += patch.intensity;
        self.returns += 1;
        self.smooth += u32::from(patch.smooth);
        self.frames += u32::from(self.last != Some(patch.frame));
        self.last = Some(patch.frame);
        let size = patch.size();
        if size < self.size {
            (self.axes, self.sharpest, self.size) = (patch.axes, patch.normal, size);
        }
    }

    fn surfel(&self, config: &FusionConfig) -> Surfel {
        let returns = self.returns as f32;
        let normal = self.normal.try_normalize(1e-6).unwrap_or(Vector3::from(self.sharpest));
        let smooth = self.smooth as f32 / returns;
        let (least, cover) = if smooth >= 0.5 { (config.cube_m, config.cover) } else { (LEAST_ROUGH_M, 1.0) };
        let axes = self.axes.map(|axis| {
            // On the plane of the mean normal.
            let axis = Vector3::from(axis) * cover;
            let axis = axis - normal * normal.dot(&axis);
            let length = axis.norm();
            (if length > 1e-6 { axis * (length.max(least) / length) } else { axis }).into()
        });
        Surfel {
            place: (self.first + self.place / self.weights).into(),
            normal: normal.into(),
            axes,
            smooth,
            intensity: self.intensity / returns,
            returns: self.returns,
            frames: self.frames,
        }
    }
}
