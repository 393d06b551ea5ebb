//! Network input and targets of a frame, and decoding of the outputs. Runs on the host.

use super::anchors::{AnchorClass, anchors};
use super::config::{LossConfig, PointPillarsConfig};
use super::decode::{DecodeOptions, RawBox, decode};
use super::head::Predictions;
use super::pillars::{PillarGrid, Pillars, decorate, pillarise};
use super::target_assigner::{NearestBev, Targets, assign};
use crate::config::DetectorConfig;
use crate::suggest::BoxMatch;
use crate::{ModelError, layers};
use data::{Detection, Frame, Object};
use geometry::Box3;

/// One frame, ready for the network.
#[derive(Clone, Debug)]
pub struct Sample {
    /// Id of the frame.
    pub id: String,
    /// Cells and point counts of its pillars.
    pub pillars: Pillars,
    /// Decorated points, sorted by pillar, `[N, F]`.
    pub features: Vec<f32>,
    /// Targets of the anchors; only in training.
    pub targets: Option<Targets>,
}

/// Grid, anchors, classes and decoding options.
#[derive(Clone, Debug)]
pub struct Preparation {
    classes: Vec<String>,
    channels: usize,
    grid: PillarGrid,
    max_train: usize,
    anchor_classes: Vec<AnchorClass>,
    anchors: Vec<[f32; 7]>,
    map: [usize; 2],
    decode: DecodeOptions,
    pub(super) loss: LossConfig,
}

impl Preparation {
    /// From the configuration of a detector.
    pub fn new(config: &DetectorConfig, net: &PointPillarsConfig) -> Self {
        let range = config.range_m;
        let stride = net.backbone.strides[0] / net.backbone.upsample_strides[0];
        let [nx, ny, _] = net.grid_size(config);
        let map = [ny / stride, nx / stride];
        let anchor_classes: Vec<AnchorClass> = net
            .anchors
            .iter()
            .map(|a| AnchorClass {
                name: a.class.clone(),
                size: a.size_m,
                bottom: a.bottom_m,
                rotations: a.rotations_rad.clone(),
                matched: a.matched,
                unmatched: a.unmatched,
            })
            .collect();
        Preparation {
            classes: config.classes.clone(),
            channels: config.channels,
            grid: PillarGrid {
                range,
                size: net.pillars.size_m,
                max_points: net.pillars.max_points,
                max_pillars: net.pillars.max_test,
            },
            max_train: net.pillars.max_train,
            anchors: anchors(range, map, &anchor_classes),
            anchor_classes,
            map,
            decode: DecodeOptions {
                score_threshold: net.detection.score_threshold,
                nms_iou: f64::from(net.detection.nms_iou),
                nms_pre: net.detection.nms_pre,
                nms_post: net.detection.nms_post,
                dir_offset: net.head.dir_offset_rad,
                dir_limit_offset: net.head.dir_limit_offset,
            },
            loss: net.loss.clone(),
        }
    }

    /// The anchors, `[y, x, class, rotation]`, boxes `[x, y, z, dx, dy, dz, yaw]`.
    pub fn anchors(&self) -> &[[f32; 7]] {
        &self.anchors
    }

    /// Height and width of the feature map of the anchors.
    pub fn map(&self) -> [usize; 2] {
        self.map
    }

    /// Options of the decoding.
    pub fn decode_options(&self) -> &DecodeOptions {
        &self.decode
    }

    /// The network's input for a frame, with targets if `training`.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn sample(&self, frame: &Frame, training: bool) -> Result<Sample, ModelError> {
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
        let targets = training.then(|| self.targets(&self.ground_truth(&frame.objects)));
        Ok(Sample { id, pillars, features, targets })
    }

    /// Targets of boxes `[x, y, z, dx, dy, dz, yaw, class]`, classes from 1.
    pub fn targets(&self, boxes: &[[f32; 8]]) -> Targets {
        assign(&self.anchors, &self.anchor_classes, self.map, boxes, self.decode.dir_offset)
    }

    /// How the anchors are assigned to the boxes of a frame that lie within the range.
    pub fn box_matches(&self, objects: &[Object]) -> Vec<BoxMatch> {
        let boxes = self.ground_truth(objects);
        let targets = self.targets(&boxes);
        let of_box = |(i, bbox): (usize, &[f32; 8])| {
            let class = bbox[7] as usize - 1;
            let own = targets.positive.iter().filter(|(_, truth)| *truth == i).map(|(anchor, _)| *anchor);
            let overlap = |anchor: usize| NearestBev::new(&self.anchors[anchor]).iou(&NearestBev::new(bbox));
            let overlaps: Vec<f32> = own.map(overlap).collect();
            let forced = overlaps.iter().all(|iou| *iou < self.anchor_classes[class].matched);
            BoxMatch { class, positive: overlaps.len(), forced }
        };
        boxes.iter().enumerate().map(of_box).collect()
    }

    /// Boxes of the detector's classes whose centre lies within the range, with classes counted from 1.
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

    /// Detections of a batch.
    ///
    /// # Errors
    /// Outputs that are not finite.
    pub fn detections(&self, predictions: Predictions, batch: &[&Sample]) -> Result<Vec<Vec<Detection>>, ModelError> {
        let [b, anchors, classes] = predictions.cls.dims();
        let bins = predictions.dir.dims()[2];
        let cls = layers::host(predictions.cls)?;
        let boxes = layers::host(predictions.boxes)?;
        let dir = layers::host(predictions.dir)?;
        let of = |values: &[f32], frame: usize, width: usize| {
            values[frame * anchors * width..(frame + 1) * anchors * width].to_vec()
        };
        (0..b)
            .map(|f| {
                let raw = decode(&of(&cls, f, classes), &of(&boxes, f, 7), &of(&dir, f, bins), &self.anchors, &self.decode)
                    .map_err(|_| {
                        ModelError::NonFinite(format!(
                            "frame {}: the network gives scores that are not numbers; its weights are damaged or its training diverged",
                            batch[f].id
                        ))
                    })?;
                Ok(raw.iter().map(|r| self.named(r)).collect())
            })
            .collect()
    }

    fn named(&self, raw: &RawBox) -> Detection {
        Detection {
            class: self.classes[raw.class].clone(),
            bbox: Box3::from_array(raw.bbox.map(f64::from)),
            score: raw.score,
        }
    }
}
