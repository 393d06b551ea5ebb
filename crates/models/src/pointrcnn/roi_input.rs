//! Input of the second stage for each region: points in the region frame and their neighbours (OpenPCDet:
//! `PointRCNNHead.roipool3d_gpu`). Runs on the host.
//!
//! The reference repeats the points of a region up to 512, and the centres of a level likewise. Here repeated points
//! are one row with a multiplicity (see [`Groups`]).

use super::config::RoiHeadConfig;
use crate::point_ops::Groups;
use geometry::{Box3, TieRule, ball_query, farthest_point_sampling, roi_points};
use rayon::prelude::*;

/// Number of values of a point besides its features: position, score, distance.
pub const PREFIX: usize = 5;

/// Regions of a batch, with P distinct points in total.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RoiInput {
    /// Position in the region's frame (m), score (0 to 1), distance from the sensor (normalised), `[P]`. Zeros for a
    /// region without points.
    pub prefix: Vec<[f32; PREFIX]>,
    /// Row of each point's features; `None` for that of a region without points. Length P.
    pub source: Vec<Option<u32>>,
    /// Set abstraction, finest level first: rows are those of the level above.
    pub levels: Vec<Groups>,
    /// The points of the last level, grouped by region.
    pub global: Groups,
    /// Row of each point of the reference, repetitions included: the pooled points, then the centres of each level.
    pub dense: Vec<Vec<u32>>,
    /// Index of each centre of a level in the reference's points of the next finer level.
    pub picks: Vec<Vec<u32>>,
    /// Number of distinct points of each region, 0 for an empty one.
    pub count: Vec<u32>,
}

/// The points of one frame from which regions are pooled.
#[derive(Clone, Copy, Debug)]
pub struct Scene<'a> {
    /// Positions, m, LiDAR frame. Length N.
    pub points: &'a [[f32; 3]],
    /// Sigmoid of each point's largest logit. Length N.
    pub scores: &'a [f32],
    /// Row of the features of the first point.
    pub first_row: u32,
}

impl RoiInput {
    /// The input for the regions of one frame.
    pub fn new(scene: Scene<'_>, rois: &[[f32; 7]], config: &RoiHeadConfig) -> Self {
        let rotations: Vec<[f32; 2]> = rois.iter().map(|roi| roi[6].sin_cos().into()).collect();
        RoiInput::rotated(scene, rois, &rotations, config)
    }

    /// The same with given sine and cosine of each region's yaw, for comparison with a reference that rounds them
    /// differently.
    pub fn rotated(scene: Scene<'_>, rois: &[[f32; 7]], rotations: &[[f32; 2]], config: &RoiHeadConfig) -> Self {
        let extra = config.extra_width_m;
        let enlarged = |r: &[f32; 7]| [r[0], r[1], r[2], r[3] + extra[0], r[4] + extra[1], r[5] + extra[2], r[6]];
        let boxes: Vec<Box3> = rois.iter().map(|r| Box3::from_array(enlarged(r).map(f64::from))).collect();
        let pooled = roi_points(scene.points.as_flattened(), 3, &boxes, config.points);
        let regions: Vec<RoiInput> = (0..rois.len())
            .into_par_iter()
            .map(|r| {
                let members = &pooled.index[r * config.points..][..pooled.count[r] as usize];
                RoiInput::of_region(scene, &rois[r], rotations[r], members, config)
            })
            .collect();
        let mut all = RoiInput::empty(config);
        regions.iter().for_each(|region| all.append(region));
        all
    }

    /// The input without regions.
    pub fn empty(config: &RoiHeadConfig) -> Self {
        RoiInput {
            levels: vec![Groups::default(); config.levels.len()],
            dense: vec![Vec::new(); config.levels.len() + 1],
            picks: vec![Vec::new(); config.levels.len()],
            ..RoiInput::default()
        }
    }

    fn of_region(
        scene: Scene<'_>,
        roi: &[f32; 7],
        [sin, cos]: [f32; 2],
        members: &[u32],
        config: &RoiHeadConfig,
    ) -> Self {
        let mut region = RoiInput::empty(config);
        for &i in members {
            let p = scene.points[i as usize];
            let [x, y, z] = [0, 1, 2].map(|axis| p[axis] - roi[axis]);
            let depth_m = (p[0] * p[0] + p[1] * p[1] + p[2] * p[2]).sqrt();
            let depth = depth_m / config.depth_normalizer_m - 0.5;
            // Fused multiply-add as in the reference's matrix product: farthest point sampling may depend on the last
            // digit.
            let (x, y) = (y.mul_add(sin, x * cos), y.mul_add(cos, -(x * sin)));
            region.prefix.push([x, y, z, scene.scores[i as usize], depth]);
            region.source.push(Some(scene.first_row + i));
        }
        region.count.push(members.len() as u32);
        if members.is_empty() {
            region.prefix.push([0.0; PREFIX]);
            region.source.push(None);
        }
        let position = |row: usize| -> [f32; 3] { std::array::from_fn(|axis| region.prefix[row][axis]) };
        // The row of each point of the reference.
        let mut rows: Vec<u32> = (0..region.prefix.len() as u32).cycle().take(config.points).collect();
        let mut points: Vec<[f32; 3]> = rows.iter().map(|&row| position(row as usize)).collect();
        region.dense[0] = rows.clone();
        for (l, level) in config.levels.iter().enumerate() {
            let picks = farthest_point_sampling(&points, level.centers, TieRule::ReferenceKernel);
            // A row that was picked again increases the multiplicity of its centre.
            let (mut centers, mut times, mut picked_rows) = (Vec::<u32>::new(), Vec::<f32>::new(), Vec::new());
            let mut center_of_row = vec![u32::MAX; rows.iter().max().map_or(0, |&row| row as usize + 1)];
            for &pick in &picks {
                let center = &mut center_of_row[rows[pick as usize] as usize];
                if *center == u32::MAX {
                    *center = centers.len() as u32;
                    centers.push(pick);
                    times.push(0.0);
                }
                times[*center as usize] += 1.0;
                picked_rows.push(*center);
            }
            let positions: Vec<[f32; 3]> = centers.iter().map(|&pick| points[pick as usize]).collect();
            let slots = ball_query(&points, &positions, level.radius_m, level.samples);
            for (c, slots) in slots.chunks_exact(level.samples).enumerate() {
                let neighbours = slots.iter().map(|&k| (rows[k as usize], points[k as usize]));
                region.levels[l].push(positions[c], neighbours, times[c]);
            }
            points = picks.iter().map(|&pick| points[pick as usize]).collect();
            rows = picked_rows;
            region.dense[l + 1] = rows.clone();
            region.picks[l] = picks;
        }
        region.global.push([0.0; 3], rows.iter().copied().zip(points), 1.0);
        region
    }

    /// Appends other regions.
    pub fn append(&mut self, other: &RoiInput) {
        let mut first_row = self.prefix.len() as u32;
        self.prefix.extend_from_slice(&other.prefix);
        self.source.extend_from_slice(&other.source);
        self.count.extend_from_slice(&other.count);
        for l in 0..=self.levels.len() {
            self.dense[l].extend(other.dense[l].iter().map(|row| row + first_row));
            if l == self.levels.len() {
                self.global.append(&other.global, first_row);
            } else {
                let rows = self.levels[l].ends.len() as u32;
                self.levels[l].append(&other.levels[l], first_row);
                self.picks[l].extend_from_slice(&other.picks[l]);
                first_row = rows;
            }
        }
    }

    /// Number of regions.
    pub fn regions(&self) -> usize {
        self.global.ends.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pointrcnn::config::RoiLevelConfig;

    fn config() -> RoiHeadConfig {
        let level = |centers| RoiLevelConfig { centers, radius_m: 0.5, samples: 4, filters: vec![4] };
        RoiHeadConfig { points: 16, levels: vec![level(8), level(4)], ..RoiHeadConfig::default() }
    }

    fn scene() -> (Vec<[f32; 3]>, Vec<f32>) {
        let points: Vec<[f32; 3]> = (0..60).map(|i| [10.0 + (i % 10) as f32 * 0.3, i as f32 * 0.05, 0.2]).collect();
        let scores = (0..60).map(|i| i as f32 / 60.0).collect();
        (points, scores)
    }

    #[test]
    fn rows_count_as_the_reference_s() {
        let (points, scores) = scene();
        let rois = [[11.0, 1.0, 0.0, 2.0, 1.0, 2.0, 0.4], [90.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0], [0.0; 7]];
        let scene = Scene { points: &points, scores: &scores, first_row: 100 };
        let input = RoiInput::new(scene, &rois, &config());
        assert!(input.count[0] > 4 && input.count[1..] == [0, 0]);
        assert_eq!(input.prefix.len() as u32, input.count[0] + 2);
        assert!(input.source[0].is_some_and(|row| row >= 100) && input.source[input.source.len() - 1].is_none());
        for (groups, rows) in input.levels.iter().zip([8.0, 4.0]) {
            assert_eq!(groups.count.iter().sum::<f32>(), 3.0 * rows * 4.0);
        }
        assert_eq!(input.global.count.iter().sum::<f32>(), 12.0);
        assert_eq!(input.regions(), 3);
        assert_eq!(input.dense.iter().map(Vec::len).collect::<Vec<_>>(), [48, 24, 12]);
        // A region without points has one row at its centre.
        let last = input.levels[0].ends.len() - 1;
        assert_eq!(input.levels[0].count[input.levels[0].ends[last - 1] as usize], 32.0);
        // In the region frame its points lie inside the region.
        let inside = |p: &[f32; PREFIX]| p[0].abs() <= 1.0001 && p[1].abs() <= 0.5001 && p[2].abs() <= 1.0;
        assert!(input.prefix[..input.count[0] as usize].iter().all(inside));
    }

    #[test]
    fn frames_follow_each_other() {
        let (points, scores) = scene();
        let rois = [[11.0, 1.0, 0.0, 2.0, 1.0, 2.0, 0.4], [10.0, 0.5, 0.0, 1.0, 1.0, 2.0, 0.0]];
        let scene = Scene { points: &points, scores: &scores, first_row: 0 };
        let both = RoiInput::new(scene, &rois, &config());
        let mut one = RoiInput::new(scene, &rois[..1], &config());
        one.append(&RoiInput::new(scene, &rois[1..], &config()));
        assert_eq!(one, both);
        for (l, groups) in both.levels.iter().enumerate() {
            let above = if l == 0 { both.prefix.len() } else { both.levels[l - 1].ends.len() };
            assert!(groups.source.iter().all(|&row| (row as usize) < above));
        }
    }
}
