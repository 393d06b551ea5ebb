//! Network input and targets of a frame, and decoding of the outputs. Runs on the host.

use super::anchors::{AnchorClass, anchors};
use super::config::{LossConfig, PointPillarsConfig};
use super::decode::{DecodeOptions, RawBox, decode};
use super::head::Predictions;
use super::target_assigner::{NearestBev, Targets, assign};
use crate::bev::{PillarPreparation, PillarSample};
use crate::config::DetectorConfig;
use crate::suggest::BoxMatch;
use crate::{ModelError, layers};
use data::{Detection, Frame, Object};
use geometry::Box3;
use rayon::prelude::*;

/// One frame, ready for the network.
pub type Sample = PillarSample<Targets>;

/// Pillars, anchors and decoding options.
#[derive(Clone, Debug)]
pub struct Preparation {
    pillars: PillarPreparation,
    anchor_classes: Vec<AnchorClass>,
    anchors: Vec<[f32; 7]>,
    map: [usize; 2],
    decode: DecodeOptions,
    pub(super) loss: LossConfig,
}

impl Preparation {
    /// From the configuration of a detector.
    pub fn new(config: &DetectorConfig, net: &PointPillarsConfig) -> Self {
        let map = net.encoder().map(config);
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
            pillars: PillarPreparation::new(config, &net.pillars),
            anchors: anchors(config.range_m, map, &anchor_classes),
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
        let input = self.pillars.input(frame, training)?;
        let targets = training.then(|| self.targets(&self.pillars.ground_truth(&frame.objects)));
        Ok(Sample { input, targets })
    }

    /// Targets of boxes `[x, y, z, dx, dy, dz, yaw, class]`, classes from 1.
    pub fn targets(&self, boxes: &[[f32; 8]]) -> Targets {
        assign(&self.anchors, &self.anchor_classes, self.map, boxes, self.decode.dir_offset)
    }

    /// How the anchors are assigned to the boxes of a frame that lie within the range.
    pub fn box_matches(&self, objects: &[Object]) -> Vec<BoxMatch> {
        let boxes = self.pillars.ground_truth(objects);
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
        let of_frame = |f: usize| {
            let rows = f * anchors..(f + 1) * anchors;
            let of = |width: usize| rows.start * width..rows.end * width;
            decode(&cls[of(classes)], &boxes[of(7)], &dir[of(bins)], &self.anchors, &self.decode)
        };
        let frames: Vec<_> = (0..b).into_par_iter().map(of_frame).collect();
        let named = |(raw, sample): (Result<Vec<RawBox>, _>, &&Sample)| {
            let raw = raw.map_err(|_| {
                ModelError::NonFinite(format!(
                    "frame {}: the network gives scores that are not numbers; its weights are damaged or its training diverged",
                    sample.input.id
                ))
            })?;
            Ok(raw.iter().map(|r| self.named(r)).collect())
        };
        frames.into_iter().zip(batch).map(named).collect()
    }

    fn named(&self, raw: &RawBox) -> Detection {
        Detection {
            class: self.pillars.classes[raw.class].clone(),
            bbox: Box3::from_array(raw.bbox.map(f64::from)),
            score: raw.score,
        }
    }
}
