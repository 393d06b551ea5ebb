//! The static map: patches of all scans fused into surfels.
//!
//! Why surfels and no mesh: they need no topology, are built scan by scan, keep what each laser saw at its resolution,
//! and end where the returns end. A mesh closes gaps that nobody looked into.
//!
//! A surfel is a flat ellipse with an *opacity*: the share of the shots of the recording that ended at it among those
//! that reached it. Things that moved, the borders of surfels that stick out over an edge, and foliage are seen through
//! by other shots, so that no separate search for ghosts is needed.

mod fusion;
mod opacity;
mod patch;
mod ply;

pub use fusion::{Fusion, FusionConfig, Surfel, fuse};
pub use patch::{Patch, patches};
pub use ply::encode_ply;

use nalgebra::Vector3;
use opacity::{density, kernel};
use simulate::raycast::{Disc, Tree};

/// A shot of the recording, in the frame of the map.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenShot {
    /// Where it started, m.
    pub origin: [f32; 3],
    /// Unit vector.
    pub direction: [f32; 3],
    /// Where it ended, m.
    pub range_m: f32,
}

/// Where a shot into the map ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct End {
    /// m.
    pub range_m: f32,
    /// Intensity of the surface there, as the recording has it.
    pub intensity: f32,
}

/// Surfels with their opacities, prepared for shots.
#[derive(Clone, Debug)]
pub struct SurfelMap {
    surfels: Vec<Surfel>,
    /// -ln(1 - opacity) of each.
    densities: Vec<f32>,
    tree: Tree,
    thickness_m: f32,
}

/// A shot ends where the densities of the surfels before it add up to this: where half of the shots do.
const HALF: f32 = std::f32::consts::LN_2;

/// Density of a surfel that no shot was held against.
const UNTRIED: f32 = 1.5;

/// Surfels with less opacity than this are left out: things that moved.
const LEAST_OPACITY: f32 = 0.1;

/// Smallest cosine of incidence for the depth of a layer along a shot, and the largest such depth, m.
const GRAZING: (f32, f32) = (0.03, 3.0);

/// Farthest end of a shot, m.
pub const FARTHEST_M: f32 = 150.0;

impl SurfelMap {
    /// Fuses patches. `shots` gives the shots of the recording frame by frame; without any, every surfel is opaque.
    pub fn build(patches: &[Patch], shots: impl IntoIterator<Item = Vec<SeenShot>>, config: &FusionConfig) -> Self {
        SurfelMap::of_surfels(fuse(patches, config), shots, config)
    }

    /// The same of surfels that were fused before.
    pub fn of_surfels(
        surfels: Vec<Surfel>,
        shots: impl IntoIterator<Item = Vec<SeenShot>>,
        config: &FusionConfig,
    ) -> Self {
        let tree = tree_of(&surfels);
        let mut map =
            SurfelMap { densities: vec![UNTRIED; surfels.len()], surfels, tree, thickness_m: config.thickness_m };
        if let Some(densities) = density(&map, shots) {
            let opaque = |i: &usize| 1.0 - (-densities[*i]).exp() >= LEAST_OPACITY;
            let kept: Vec<usize> = (0..map.surfels.len()).filter(opaque).collect();
            map.surfels = kept.iter().map(|i| map.surfels[*i]).collect();
            map.densities = kept.iter().map(|i| densities[*i]).collect();
            map.tree = tree_of(&map.surfels);
        }
        map
    }

    /// The surfels.
    pub fn surfels(&self) -> &[Surfel] {
        &self.surfels
    }

    /// Opacity of surfel `i`, 0 to 1.
    pub fn opacity(&self, i: usize) -> f32 {
        1.0 - (-self.densities[i]).exp()
    }

    /// Where a shot ends; `None` where the map has nothing. `met` is scratch space.
    ///
    /// On a surface the range is the mean of the surfels' planes, weighted by their opacity, their returns, and how
    /// near to their centre they are met: the nearest one alone would be too near by the noise.
    pub fn end(&self, origin: [f32; 3], direction: [f32; 3], met: &mut Vec<Met>) -> Option<End> {
        met.clear();
        let along = Vector3::from(direction);
        self.tree.through(origin, direction, FARTHEST_M, |id, range_m, off| {
            let density = kernel(off) * self.densities[id as usize];
            met.push(Met { range_m, density, id });
            if density >= HALF { range_m + 2.0 * self.depth(id, &along) } else { f32::INFINITY }
        });
        met.sort_unstable_by(|a, b| a.range_m.total_cmp(&b.range_m).then(a.id.cmp(&b.id)));
        let mut sum = 0.0;
        let at = met.iter().position(|m| {
            sum += m.density;
            sum >= HALF
        })?;
        let Met { range_m, id, .. } = met[at];
        let own = &self.surfels[id as usize];
        if !own.is_smooth() {
            return Some(End { range_m, intensity: own.intensity });
        }
        let (normal, depth) = (Vector3::from(own.normal), self.depth(id, &along));
        let (mut range, mut intensity, mut weights) = (0.0, 0.0, 0.0);
        for m in met.iter() {
            let s = &self.surfels[m.id as usize];
            if (m.range_m - range_m).abs() <= depth && s.is_smooth() && Vector3::from(s.normal).dot(&normal) > SAME_WAY
            {
                let weight = m.density * (s.returns as f32).min(MOST_RETURNS);
                range += weight * m.range_m;
                intensity += weight * s.intensity;
                weights += weight;
            }
        }
        Some(End { range_m: range / weights, intensity: intensity / weights })
    }

    /// Depth of the layer of a surfel along a shot, m.
    fn depth(&self, id: u32, along: &Vector3<f32>) -> f32 {
        let cos = Vector3::from(self.surfels[id as usize].normal).dot(along).abs();
        (self.thickness_m / cos.max(GRAZING.0)).min(GRAZING.1)
    }
}

/// Smallest cosine between the normals of surfels of one surface.
const SAME_WAY: f32 = 0.8;

/// Returns of a surfel beyond which it has no more weight: its errors are common to all of them.
const MOST_RETURNS: f32 = 50.0;

/// A surfel on the way of a shot.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Met {
    range_m: f32,
    density: f32,
    id: u32,
}

fn tree_of(surfels: &[Surfel]) -> Tree {
    let discs: Vec<Disc> = surfels.iter().map(|s| Disc { centre: s.place, axes: s.axes }).collect();
    Tree::of_discs(&discs)
}

#[cfg(test)]
mod tests;
