//! One moment of a data set: a cloud and the objects in it.

use geometry::Box3;
use serde::{Deserialize, Serialize};

/// Points with `channels` values each (x, y, z in m, LiDAR frame; then intensity in [0, 1] where there is one), one point after the other.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Cloud {
    /// `len() * channels` values.
    pub values: Vec<f32>,
    /// 3 (xyz) or 4 (xyz and intensity).
    pub channels: usize,
}

impl Cloud {
    /// An empty cloud of points with that many values each.
    pub fn new(channels: usize) -> Self {
        Cloud { values: Vec::new(), channels }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.values.len() / self.channels
    }

    /// No point at all.
    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// The points, `channels` values each.
    pub fn points(&self) -> std::slice::ChunksExact<'_, f32> {
        self.values.chunks_exact(self.channels)
    }

    /// The points, to be changed in place.
    pub fn points_mut(&mut self) -> std::slice::ChunksExactMut<'_, f32> {
        self.values.chunks_exact_mut(self.channels)
    }

    /// Position of point `i`, m.
    pub fn xyz(&self, i: usize) -> [f32; 3] {
        let p = &self.values[i * self.channels..];
        [p[0], p[1], p[2]]
    }

    /// Keeps the points for which `keep` holds, in order.
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

    /// The same points with only the first `channels` values of each.
    pub fn with_channels(&self, channels: usize) -> Cloud {
        assert!(channels <= self.channels, "a cloud of {} channels has no {channels}", self.channels);
        Cloud { values: self.points().flat_map(|p| p[..channels].iter().copied()).collect(), channels }
    }
}

/// A labelled object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// Class as the label file writes it.
    pub class: String,
    /// In the LiDAR frame.
    pub bbox: Box3,
    /// KITTI's truncation, 0 (none) to 1; `None` where the label does not say.
    pub truncation: Option<f64>,
    /// KITTI's occlusion level, 0 (visible) to 3 (unknown); `None` where the label does not say.
    pub occlusion: Option<i32>,
    /// Left, top, right, bottom in the image, px.
    pub image_box: Option<[f64; 4]>,
}

/// One moment of a data set.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// The file name without ending.
    pub id: String,
    /// What the sensor saw.
    pub cloud: Cloud,
    /// What is there. DontCare regions are not objects and are left out.
    pub objects: Vec<Object>,
}

/// A box that a network reports.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Detection {
    /// Class name.
    pub class: String,
    /// In the LiDAR frame.
    pub bbox: Box3,
    /// Confidence; larger is surer.
    pub score: f32,
}
