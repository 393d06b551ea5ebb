//! The static mesh, the moving instances, and ray casting against both.

use super::lanes::{Lanes, Portable};
use super::traverse::{Best, MOST_LANES, Packet, lanes_of, traverse};
use super::tree::Tree;
use super::{Hit, Ray};
use rayon::prelude::*;
use std::sync::Arc;

/// A shape with a pose in the scene.
#[derive(Clone, Debug)]
pub struct Instance {
    /// Its mesh, in shape coordinates.
    pub shape: Arc<Tree>,
    /// Rows of the rotation `scene_from_shape`.
    pub rotation: [[f32; 3]; 3],
    /// Position of the shape's origin at time 0, m.
    pub position: [f32; 3],
    /// Velocity during the scan, m/s.
    pub velocity: [f32; 3],
}

/// Instruction set of the traversal.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum InstructionSet {
    /// No instructions beyond the compile target.
    Portable,
    /// AVX2 and FMA: packets of 8 rays.
    Avx2,
    /// AVX-512: packets of 16 rays.
    Avx512,
}

impl InstructionSet {
    /// The widest set supported by this CPU.
    pub fn best() -> Self {
        [InstructionSet::Avx512, InstructionSet::Avx2]
            .into_iter()
            .find(|set| set.is_available())
            .unwrap_or(InstructionSet::Portable)
    }

    /// Whether this CPU supports it.
    pub fn is_available(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        {
            let avx2 = is_x86_feature_detected!("avx2")
                && is_x86_feature_detected!("fma")
                && is_x86_feature_detected!("bmi1")
                && is_x86_feature_detected!("bmi2")
                && is_x86_feature_detected!("popcnt")
                && is_x86_feature_detected!("lzcnt");
            match self {
                InstructionSet::Portable => true,
                InstructionSet::Avx2 => avx2,
                InstructionSet::Avx512 => avx2 && is_x86_feature_detected!("avx512f"),
            }
        }
        #[cfg(not(target_arch = "x86_64"))]
        {
            self == InstructionSet::Portable
        }
    }
}

/// A static mesh and moving instances.
#[derive(Clone, Debug)]
pub struct Scene {
    ground: Arc<Tree>,
    instances: Vec<Placed>,
    instructions: InstructionSet,
}

/// An instance with its bounding box at time 0, m.
#[derive(Clone, Debug)]
struct Placed {
    instance: Instance,
    bounds: [f32; 6],
}

/// Rows of the ray grid per packet.
const PACKET_ROWS: usize = 2;
/// Minimum number of rays per parallel job.
const RAYS_PER_JOB: usize = 4096;

impl Scene {
    /// `ground` is the static mesh.
    pub fn new(ground: Arc<Tree>, instances: Vec<Instance>) -> Scene {
        let instances = instances.into_iter().map(Placed::new).collect();
        Scene { ground, instances, instructions: InstructionSet::best() }
    }

    /// The same scene with another instruction set; falls back to portable if the CPU does not support it.
    pub fn with_instructions(mut self, wanted: InstructionSet) -> Scene {
        self.instructions = if wanted.is_available() { wanted } else { InstructionSet::Portable };
        self
    }

    /// The nearest hit of every ray. Rays form a grid with `columns` columns, row by row, with nearly parallel
    /// neighbours; an unordered list has one row.
    ///
    /// # Shapes
    /// `rays`, `hits`: `[rows * columns]`.
    pub fn cast(&self, rays: &[Ray], columns: usize, hits: &mut [Hit]) {
        assert_eq!(rays.len(), hits.len(), "one hit a ray");
        assert!(columns > 0 && rays.len().is_multiple_of(columns), "{} rays fill no rows of {columns}", rays.len());
        match self.instructions {
            // SAFETY: `with_instructions` and `best` only return sets that this CPU supports.
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx512 => unsafe { cast_avx512(self, rays, columns, hits) },
            #[cfg(target_arch = "x86_64")]
            InstructionSet::Avx2 => unsafe { cast_avx2(self, rays, columns, hits) },
            // SAFETY: the portable lanes have no CPU requirements.
            _ => unsafe { cast_grid::<Portable>(self, rays, columns, hits) },
        }
    }

    /// Whether a ray at time 0 meets the bounds of an instance. A ray that does not cannot hit one.
    pub fn may_hit_instance(&self, ray: &Ray) -> bool {
        self.instances.iter().any(|placed| {
            let (mut near, mut far) = (0.0f32, f32::INFINITY);
            for k in 0..3 {
                let inverse = 1.0 / ray.direction[k];
                let [a, b] = [placed.bounds[k], placed.bounds[k + 3]].map(|bound| (bound - ray.origin[k]) * inverse);
                // A ray within a face of the bounds gives NaN, which neither maximum nor minimum takes.
                (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
            }
            near <= far
        })
    }

    /// As [`Scene::cast`], on all threads of the pool; identical results.
    pub fn cast_parallel(&self, rays: &[Ray], columns: usize, hits: &mut [Hit]) {
        let rows = (RAYS_PER_JOB / columns).next_multiple_of(PACKET_ROWS).max(PACKET_ROWS);
        let jobs = rays.par_chunks(rows * columns).zip(hits.par_chunks_mut(rows * columns));
        jobs.for_each(|(rays, hits)| self.cast(rays, columns, hits));
    }
}

impl Placed {
    fn new(instance: Instance) -> Placed {
        let mut bounds =
            [f32::INFINITY, f32::INFINITY, f32::INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY, f32::NEG_INFINITY];
        let (low, high) = (instance.shape.low, instance.shape.high);
        for corner in 0..8 {
            let local: [f32; 3] = std::array::from_fn(|k| if corner >> k & 1 == 0 { low[k] } else { high[k] });
            for k in 0..3 {
                let row = instance.rotation[k];
                let v = row[0] * local[0] + row[1] * local[1] + row[2] * local[2] + instance.position[k];
                bounds[k] = bounds[k].min(v - 0.02);
                bounds[k + 3] = bounds[k + 3].max(v + 0.02);
            }
        }
        Placed { instance, bounds }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn cast_avx512(scene: &Scene, rays: &[Ray], columns: usize, hits: &mut [Hit]) {
    unsafe { cast_grid::<std::arch::x86_64::__m512>(scene, rays, columns, hits) }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,popcnt,lzcnt")]
unsafe fn cast_avx2(scene: &Scene, rays: &[Ray], columns: usize, hits: &mut [Hit]) {
    unsafe { cast_grid::<std::arch::x86_64::__m256>(scene, rays, columns, hits) }
}

/// Splits the grid into packets of two rows; lanes beyond its border repeat the last ray.
#[inline(always)]
unsafe fn cast_grid<L: Lanes>(scene: &Scene, rays: &[Ray], columns: usize, hits: &mut [Hit]) {
    let rows = rays.len() / columns;
    let packet_rows = PACKET_ROWS.min(rows);
    let packet_columns = L::WIDTH / packet_rows;
    for row in (0..rows).step_by(packet_rows) {
        for column in (0..columns).step_by(packet_columns) {
            let mut which = [0_usize; MOST_LANES];
            for (lane, place) in which[..L::WIDTH].iter_mut().enumerate() {
                let (r, c) = (row + lane / packet_columns, column + lane % packet_columns);
                *place = r.min(rows - 1) * columns + c.min(columns - 1);
            }
            unsafe { cast_packet::<L>(scene, rays, &which, hits) }
        }
    }
}

#[inline(always)]
unsafe fn cast_packet<L: Lanes>(scene: &Scene, rays: &[Ray], which: &[usize; MOST_LANES], hits: &mut [Hit]) {
    let mut values = [[0.0_f32; MOST_LANES]; 7];
    for (lane, place) in which[..L::WIDTH].iter().enumerate() {
        let ray = &rays[*place];
        for k in 0..3 {
            values[k][lane] = ray.origin[k];
            values[k + 3][lane] = ray.direction[k];
        }
        values[6][lane] = ray.time_s;
    }
    unsafe {
        let vector = |k: usize| L::load(values[k].as_ptr());
        let origin = [vector(0), vector(1), vector(2)];
        let packet = Packet::new(origin, [vector(3), vector(4), vector(5)]);
        let mut best = Best { range: L::splat(f32::INFINITY), place: [0; MOST_LANES] };
        let mut found = [Hit::MISS; MOST_LANES];
        let improved = traverse(&scene.ground, &packet, &mut best);
        for lane in lanes_of(improved) {
            let place = best.place[lane] as usize;
            let normal = scene.ground.triangles[place].normal;
            found[lane] = Hit { triangle: scene.ground.ids[place], normal, ..Hit::MISS };
        }
        let time = vector(6);
        for (i, Placed { instance, bounds }) in scene.instances.iter().enumerate() {
            // In the instance's moving frame the ray has another origin and the same direction.
            let moved: [L; 3] = std::array::from_fn(|k| origin[k].sub(time.mul(L::splat(instance.velocity[k]))));
            let beside = Packet { origin: moved, ..packet };
            if L::bits(beside.enter(bounds, best.range).1) == 0 {
                continue;
            }
            let from_corner: [L; 3] = std::array::from_fn(|k| moved[k].sub(L::splat(instance.position[k])));
            let local = Packet::new(
                turn_back(&instance.rotation, &from_corner),
                turn_back(&instance.rotation, &packet.direction),
            );
            let improved = traverse(&instance.shape, &local, &mut best);
            for lane in lanes_of(improved) {
                let place = best.place[lane] as usize;
                let normal = turn(&instance.rotation, instance.shape.triangles[place].normal);
                found[lane] = Hit { triangle: instance.shape.ids[place], object: i as u32 + 1, normal, ..Hit::MISS };
            }
        }
        let mut ranges = [0.0; MOST_LANES];
        best.range.store(ranges.as_mut_ptr());
        for (lane, place) in which[..L::WIDTH].iter().enumerate() {
            let hit = Hit { range_m: ranges[lane], ..found[lane] };
            hits[*place] = if hit.is_hit() { facing(hit, rays[*place].direction) } else { Hit::MISS };
        }
    }
}

/// Normalises the hit's normal and flips it to face the ray origin.
fn facing(mut hit: Hit, direction: [f32; 3]) -> Hit {
    let n = hit.normal;
    let length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]).sqrt();
    let along = n[0] * direction[0] + n[1] * direction[1] + n[2] * direction[2];
    let sign = if along > 0.0 { -1.0 } else { 1.0 };
    hit.normal = n.map(|v| sign * v / length);
    hit
}

fn turn(rotation: &[[f32; 3]; 3], v: [f32; 3]) -> [f32; 3] {
    rotation.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
}

/// Applies the transposed rotation: scene to shape.
#[inline(always)]
unsafe fn turn_back<L: Lanes>(rotation: &[[f32; 3]; 3], v: &[L; 3]) -> [L; 3] {
    std::array::from_fn(|k| unsafe {
        let [a, b, c] = [rotation[0][k], rotation[1][k], rotation[2][k]].map(|r| L::splat(r));
        v[2].mul_add(c, v[1].mul_add(b, v[0].mul(a)))
    })
}

#[cfg(test)]
mod tests;
