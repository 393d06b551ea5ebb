//! A frame of a data set: a point cloud and its labelled objects.

use geometry::Box3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A point cloud: x, y, z (m, LiDAR frame) and optionally intensity (in [0, 1] for KITTI), one point after the other.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Cloud {
    /// `len() * channels` values.
    pub values: Vec<f32>,
    /// 3 (xyz) or 4 (xyz and intensity).
    pub channels: usize,
}

impl Cloud {
    /// An empty cloud with `channels` values per point.
    pub fn new(channels: usize) -> Self {
        Cloud { values: Vec::new(), channels }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.values.len() / self.channels
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// The points, `channels` values each.
    pub fn points(&self) -> std::slice::ChunksExact<'_, f32> {
        self.values.chunks_exact(self.channels)
    }

    /// The points, `channels` values each, mutable.
    pub fn points_mut(&mut self) -> std::slice::ChunksExactMut<'_, f32> {
        self.values.chunks_exact_mut(self.channels)
    }

    /// Position of point `i`, m, LiDAR frame.
    pub fn xyz(&self, i: usize) -> [f32; 3] {
        let p = &self.values[i * self.channels..];
        [p[0], p[1], p[2]]
    }

    /// Keeps the points for which `keep` (called with index and values) is true, in order.
    pub fn retain(&mut self, mut keep: impl FnMut(usize, &[f32]) -> bool) {
        let (channels, mut to) = (self.channels, 0);
        for i in 0..self.len() {
            let from = i * channels;
            if keep(i, &self.values[from..from + channels]) {
                self.values.copy_within(from..from + channels, to);
                to += channels;
            }
        }
        self.values.truncate(to);
    }

    /// The same points with only their first `channels` values. Panics if there are fewer.
    pub fn with_channels(&self, channels: usize) -> Cloud {
        assert!(channels <= self.channels, "a cloud of {} channels has no {channels}", self.channels);
        Cloud { values: self.points().flat_map(|p| p[..channels].iter().copied()).collect(), channels }
    }
}

/// A labelled object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Object {
    /// Class as in the label file.
    pub class: String,
    /// Box in the LiDAR frame, m and rad.
    pub bbox: Box3,
    /// KITTI's truncation, 0 (none) to 1; `None` if not known.
    pub truncation: Option<f64>,
    /// KITTI's occlusion level, 0 (visible) to 3 (unknown); `None` if not labelled.
    pub occlusion: Option<i32>,
    /// Left, top, right, bottom in the image, px.
    pub image_box: Option<[f64; 4]>,
}

/// A frame: one scan and its labelled objects.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The file name without extension.
    pub id: String,
    /// The points, LiDAR frame.
    pub cloud: Cloud,
    /// The labelled objects. DontCare regions are left out.
    pub objects: Vec<Object>,
}

/// A detected object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Detection {
    /// Class name.
    pub class: String,
    /// Box in the LiDAR frame, m and rad.
    pub bbox: Box3,
    /// Confidence; larger is more confident.
    pub score: f32,
}
