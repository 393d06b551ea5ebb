//! Network input and targets of a frame. Runs on the host.

use super::config::PointRcnnConfig;
use super::hierarchy::Hierarchy;
use super::point_targets::{PointTargets, assign};
use crate::ModelError;
use crate::config::DetectorConfig;
use data::{Cloud, Frame, Object, Stream};
use rand::RngExt;
use rand::seq::{SliceRandom, index};

/// One frame, ready for the network.
#[derive(Clone, Debug)]
pub struct Sample {
    /// Id of the frame.
    pub id: String,
    /// Positions of the points, m, LiDAR frame; empty if no point is in range.
    pub points: Vec<[f32; 3]>,
    /// Their other values, `[N, C - 3]`.
    pub features: Vec<f32>,
    /// Levels and neighbours; empty without points.
    pub hierarchy: Hierarchy,
    /// Targets; only in training.
    pub targets: Option<SampleTargets>,
}

/// Targets of the two stages for a frame.
#[derive(Clone, Debug)]
pub struct SampleTargets {
    /// Targets of the points.
    pub points: PointTargets,
    /// Boxes `[x, y, z, dx, dy, dz, yaw, class]`, classes from 1.
    pub boxes: Vec<[f32; 8]>,
    /// Seed of the sampling of regions.
    pub roi_seed: u64,
}

/// Configuration for making samples.
#[derive(Clone, Debug)]
pub struct Preparation {
    /// Names of the classes.
    pub classes: Vec<String>,
    channels: usize,
    range_m: [f32; 6],
    /// The network's sizes.
    pub net: PointRcnnConfig,
    /// Mean size of each class: length, width, height, m.
    pub mean_sizes: Vec<[f32; 3]>,
}

impl Preparation {
    /// From the configuration of a detector.
    pub fn new(config: &DetectorConfig, net: &PointRcnnConfig) -> Self {
        Preparation {
            classes: config.classes.clone(),
            channels: config.channels,
            range_m: config.range_m,
            mean_sizes: net.point_head.mean_sizes.iter().map(|m| m.size_m).collect(),
            net: net.clone(),
        }
    }

    /// The network's input for a frame, with targets if `training`. The sampled points are determined by `stream`.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn sample(&self, frame: &Frame, training: bool, stream: &mut Stream) -> Result<Sample, ModelError> {
        if frame.cloud.channels < self.channels {
            let (has, reads) = (frame.cloud.channels, self.channels);
            let message = format!("its points have {has} values, the detector reads {reads}");
            return Err(ModelError::Frame { id: frame.id.clone(), message });
        }
        let usable = self.usable(&frame.cloud);
        let chosen = choose(&frame.cloud, &usable, self.net.sampling.points, self.net.sampling.far_m, stream);
        let boxes = training.then(|| self.ground_truth(&frame.objects));
        Ok(self.of_points(&frame.id, &frame.cloud, &chosen, boxes, stream.random()))
    }

    /// The network's input for chosen points of a cloud.
    pub fn of_points(
        &self,
        id: &str,
        cloud: &Cloud,
        chosen: &[usize],
        boxes: Option<Vec<[f32; 8]>>,
        roi_seed: u64,
    ) -> Sample {
        let points: Vec<[f32; 3]> = chosen.iter().map(|&i| cloud.xyz(i)).collect();
        let values = |i: usize| &cloud.values[i * cloud.channels + 3..i * cloud.channels + self.channels];
        let targets = boxes.map(|boxes| SampleTargets {
            points: assign(&points, &boxes, &self.mean_sizes, self.net.point_head.extra_width_m),
            boxes,
            roi_seed,
        });
        Sample {
            id: id.into(),
            features: chosen.iter().flat_map(|&i| values(i).iter().copied()).collect(),
            hierarchy: if points.is_empty() { Hierarchy::default() } else { Hierarchy::new(&points, &self.net.levels) },
            points,
            targets,
        }
    }

    /// Points whose x and y are in range (the reference's mask ignores z) and whose values are finite.
    fn usable(&self, cloud: &Cloud) -> Vec<usize> {
        let [x0, y0, _, x1, y1, _] = self.range_m;
        let in_range = |p: &[f32]| p[0] >= x0 && p[0] <= x1 && p[1] >= y0 && p[1] <= y1;
        let points = cloud.points().enumerate();
        let usable = points.filter(|(_, p)| in_range(p) && p[..self.channels].iter().all(|v| v.is_finite()));
        usable.map(|(i, _)| i).collect()
    }

    /// Boxes of the detector's classes whose centre lies within the range, with classes counted from 1.
    pub fn ground_truth(&self, objects: &[Object]) -> Vec<[f32; 8]> {
        let with_class = |o: &Object| {
            let class = self.classes.iter().position(|c| *c == o.class)?;
            let b = o.bbox.with_wrapped_yaw().to_array().map(|v| v as f32);
            let inside = (0..3).all(|i| b[i] >= self.range_m[i] && b[i] <= self.range_m[i + 3]);
            inside.then(|| [b[0], b[1], b[2], b[3], b[4], b[5], b[6], class as f32 + 1.0])
        };
        objects.iter().filter_map(with_class).collect()
    }
}

/// `count` of the usable points, in random order (OpenPCDet: `sample_points`). If there are more, all far points and a
/// random sample of the near ones; if there are fewer, all points and random repetitions. Without usable points the
/// result is empty.
fn choose(cloud: &Cloud, usable: &[usize], count: usize, far_m: f32, stream: &mut Stream) -> Vec<usize> {
    if usable.is_empty() {
        return Vec::new();
    }
    let mut chosen: Vec<usize>;
    if usable.len() > count {
        let is_far = |i: &usize| {
            let [x, y, z] = cloud.xyz(*i);
            x * x + y * y + z * z >= far_m * far_m
        };
        let (far, near): (Vec<usize>, Vec<usize>) = usable.iter().partition(|i| is_far(i));
        let (kept, from) = if far.len() < count { (far, near) } else { (Vec::new(), usable.to_vec()) };
        let drawn = index::sample(stream, from.len(), count - kept.len());
        chosen = drawn.iter().map(|i| from[i]).collect();
        chosen.extend(kept);
    } else {
        chosen = usable.to_vec();
        while chosen.len() < count {
            let missing = (count - chosen.len()).min(usable.len());
            chosen.extend(index::sample(stream, usable.len(), missing).iter().map(|i| usable[i]));
        }
    }
    chosen.shuffle(stream);
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::stream;

    /// 30 near points and 10 far ones.
    fn cloud() -> Cloud {
        let x = |i: usize| if i < 30 { 1.0 + i as f32 } else { 10.0 + i as f32 };
        Cloud { values: (0..40).flat_map(|i| [x(i), 0.0, 0.0]).collect(), channels: 3 }
    }

    fn chosen(count: usize, seed: u64) -> Vec<usize> {
        choose(&cloud(), &(0..40).collect::<Vec<_>>(), count, 40.0, &mut stream(seed, "points", 0, 0))
    }

    #[test]
    fn far_points_are_kept() {
        for seed in 0..20 {
            let mut some = chosen(25, seed);
            assert_eq!(some.iter().filter(|&&i| i >= 30).count(), 10);
            some.sort_unstable();
            some.dedup();
            assert_eq!(some.len(), 25);
        }
        assert_eq!(chosen(8, 1).len(), 8, "more far points than wanted");
    }

    #[test]
    fn few_points_are_repeated() {
        let many = chosen(100, 1);
        let times = |i: usize| many.iter().filter(|&&k| k == i).count();
        assert!(many.len() == 100 && (0..40).all(|i| (2..=3).contains(&times(i))));
        assert!(choose(&cloud(), &[], 100, 40.0, &mut stream(1, "points", 0, 0)).is_empty());
        assert_eq!(chosen(25, 7), chosen(25, 7));
        assert_ne!(chosen(25, 7), chosen(25, 8));
    }
}
