//! The points of each level of the backbone, and their neighbours. They depend on coordinates alone, so loader threads
//! compute them.

use super::config::LevelConfig;
use crate::point_ops::{Groups, Interpolation};
use geometry::{TieRule, ball_query, farthest_point_sampling};

/// The levels of one cloud, finest first, and the interpolations between them.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Hierarchy {
    /// Levels of set abstraction.
    pub levels: Vec<Level>,
    /// Feature propagation from level i to level i - 1, or to the cloud.
    pub up: Vec<Interpolation>,
}

/// The points of one level.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Level {
    /// Index of each of them in the next finer level.
    pub picks: Vec<u32>,
    /// Their positions, m, LiDAR frame.
    pub points: Vec<[f32; 3]>,
    /// Neighbours in the next finer level, one entry a scale.
    pub scales: Vec<Groups>,
}

impl Hierarchy {
    /// The levels of a cloud that is not empty.
    pub fn new(points: &[[f32; 3]], config: &[LevelConfig]) -> Self {
        let mut hierarchy = Hierarchy::default();
        let mut above = points;
        for level in config {
            hierarchy.levels.push(Level::new(above, level));
            above = &hierarchy.levels[hierarchy.levels.len() - 1].points;
        }
        let mut above = points;
        for level in &hierarchy.levels {
            hierarchy.up.push(Interpolation::new(above, &level.points));
            above = &level.points;
        }
        hierarchy
    }
}

impl Level {
    fn new(above: &[[f32; 3]], config: &LevelConfig) -> Self {
        let picks = farthest_point_sampling(above, config.centers, TieRule::ReferenceKernel);
        let points: Vec<[f32; 3]> = picks.iter().map(|&i| above[i as usize]).collect();
        let scale = |radius_m: f32, samples: usize| {
            let slots = ball_query(above, &points, radius_m, samples);
            let mut groups = Groups::default();
            for (&center, slots) in points.iter().zip(slots.chunks_exact(samples)) {
                groups.push(center, slots.iter().map(|&i| (i, above[i as usize])), 1.0);
            }
            groups
        };
        let scales = config.scales.iter().map(|s| scale(s.radius_m, s.samples)).collect();
        Level { picks, points, scales }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pointrcnn::config::ScaleConfig;

    #[test]
    fn every_group_counts_as_many_rows_as_the_reference_s() {
        let points: Vec<[f32; 3]> = (0..200).map(|i| [(i % 20) as f32 * 0.3, (i / 20) as f32 * 0.4, 0.0]).collect();
        let scale = |radius_m| ScaleConfig { radius_m, samples: 8, filters: vec![4] };
        let level = |centers, radius_m| LevelConfig { centers, scales: vec![scale(radius_m), scale(3.0 * radius_m)] };
        let hierarchy = Hierarchy::new(&points, &[level(50, 0.35), level(10, 0.7)]);
        assert_eq!(hierarchy.levels[0].picks[0], 0);
        for (level, centers) in hierarchy.levels.iter().zip([50, 10]) {
            for groups in &level.scales {
                assert_eq!(groups.ends.len(), centers);
                assert_eq!(groups.count.iter().sum::<f32>(), 8.0 * centers as f32);
                assert!(groups.source.len() <= 8 * centers);
            }
            assert!(level.scales[0].source.len() < 8 * centers, "repeated neighbours are one row");
        }
        assert_eq!(hierarchy.up.iter().map(|up| up.source.len()).collect::<Vec<_>>(), [200, 50]);
    }

    #[test]
    fn a_cloud_of_equal_points() {
        let level =
            LevelConfig { centers: 4, scales: vec![ScaleConfig { radius_m: 0.5, samples: 4, filters: vec![4] }] };
        let hierarchy = Hierarchy::new(&[[1.0, 2.0, 3.0]; 9], &[level]);
        assert_eq!(hierarchy.levels[0].picks, [0; 4]);
        assert!(hierarchy.up[0].weight.iter().flatten().all(|w| (w - 1.0 / 3.0).abs() < 1e-6));
    }
}
