//! The pillars of a frame and its boxes, as the networks on pillars read them. Runs on the host.

use super::config::PillarsConfig;
use super::pillars::{PillarGrid, Pillars, decorate, pillarise};
use crate::ModelError;
use crate::architecture::NetworkInput;
use crate::config::DetectorConfig;
use data::{Frame, Object};
use geometry::Box3;

/// The pillars of one frame, ready for the network.
#[derive(Clone, Debug)]
pub struct PillarInput {
    /// Id of the frame.
    pub id: String,
    /// Cells and point counts of its pillars.
    pub pillars: Pillars,
    /// Decorated points, sorted by pillar, `[N, F]`.
    pub features: Vec<f32>,
}

/// One frame with its targets, which are of the type `T`.
#[derive(Clone, Debug)]
pub struct PillarSample<T> {
    /// Its pillars.
    pub input: PillarInput,
    /// Targets of the head; only in training.
    pub targets: Option<T>,
}

impl<T> PillarSample<T> {
    /// The pillars of each sample.
    pub fn inputs<'a>(batch: &[&'a Self]) -> Vec<&'a PillarInput> {
        batch.iter().map(|sample| &sample.input).collect()
    }
}

impl<T> NetworkInput for PillarSample<T> {
    fn id(&self) -> &str {
        &self.input.id
    }

    fn is_empty(&self) -> bool {
        self.input.pillars.num_points.is_empty()
    }

    fn size(&self) -> [usize; 2] {
        let num_points = &self.input.pillars.num_points;
        [num_points.iter().map(|&n| n as usize).sum(), num_points.len()]
    }
}

/// Classes, range and grid of a detector on pillars.
#[derive(Clone, Debug)]
pub struct PillarPreparation {
    /// The detector's classes.
    pub classes: Vec<String>,
    /// Grid and limits of frames that are not for training.
    pub grid: PillarGrid,
    channels: usize,
    max_train: usize,
}

impl PillarPreparation {
    /// From the configuration of a detector.
    pub fn new(detector: &DetectorConfig, pillars: &PillarsConfig) -> Self {
        PillarPreparation {
            classes: detector.classes.clone(),
            grid: PillarGrid {
                range: detector.range_m,
                size: pillars.size_m,
                max_points: pillars.max_points,
                max_pillars: pillars.max_test,
            },
            channels: detector.channels,
            max_train: pillars.max_train,
        }
    }

    /// The network's input for a frame.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn input(&self, frame: &Frame, training: bool) -> Result<PillarInput, ModelError> {
        let id = frame.id.clone();
        if frame.cloud.channels < self.channels {
            let message =
                format!("its points have {} values, the detector reads {}", frame.cloud.channels, self.channels);
            return Err(ModelError::Frame { id, message });
        }
        let narrowed;
        let cloud = if frame.cloud.channels == self.channels {
            &frame.cloud
        } else {
            narrowed = frame.cloud.with_channels(self.channels);
            &narrowed
        };
        let mut grid = self.grid.clone();
        if training {
            grid.max_pillars = self.max_train;
        }
        let pillars = pillarise(&cloud.values, self.channels, &grid);
        let features = decorate(&pillars, &grid);
        Ok(PillarInput { id, pillars, features })
    }

    /// Boxes `[x, y, z, dx, dy, dz, yaw, class]` of the detector's classes whose centre lies within the range, with
    /// classes counted from 1.
    pub fn ground_truth(&self, objects: &[Object]) -> Vec<[f32; 8]> {
        let inside = |b: &Box3| {
            (0..3).all(|i| {
                let (low, high) = (self.grid.range[i], self.grid.range[i + 3]);
                b.center[i] as f32 >= low && b.center[i] as f32 <= high
            })
        };
        let with_class = |o: &Object| {
            let class = self.classes.iter().position(|c| *c == o.class)?;
            let b = o.bbox.with_wrapped_yaw().to_array().map(|v| v as f32);
            inside(&o.bbox).then(|| [b[0], b[1], b[2], b[3], b[4], b[5], b[6], class as f32 + 1.0])
        };
        objects.iter().filter_map(with_class).collect()
    }
}
