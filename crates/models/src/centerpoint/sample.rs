//! Network input and targets of a frame, and decoding of the outputs. Runs on the host.

use super::box_coder::CenterGrid;
use super::config::{CenterLossConfig, CenterPointConfig, CenterTargetsConfig};
use super::decode::{CenterBox, DecodeOptions, HeadValues, NonFinite, best_boxes, suppressed};
use super::head::HeadOutputs;
use super::target_assigner::{Targets, assign};
use crate::bev::{PillarPreparation, PillarSample};
use crate::config::DetectorConfig;
use crate::{ModelError, layers};
use data::{Detection, Frame};
use geometry::Box3;
use rayon::prelude::*;

/// One frame, ready for the network.
pub type Sample = PillarSample<Targets>;

/// Pillars, heads, targets and decoding options.
#[derive(Clone, Debug)]
pub struct Preparation {
    pillars: PillarPreparation,
    /// For each head the detector's classes that it finds.
    heads: Vec<Vec<usize>>,
    grid: CenterGrid,
    targets: CenterTargetsConfig,
    decode: DecodeOptions,
    pub(super) loss: CenterLossConfig,
}

impl Preparation {
    /// From the configuration of a detector.
    pub fn new(config: &DetectorConfig, net: &CenterPointConfig) -> Self {
        let [x_min, y_min, ..] = config.range_m;
        let [x_size, y_size, _] = net.pillars.size_m;
        let found = &net.detection;
        Preparation {
            pillars: PillarPreparation::new(config, &net.pillars),
            heads: net.heads(config),
            grid: CenterGrid {
                origin_m: [x_min, y_min],
                pillar_m: [x_size, y_size],
                stride: net.backbone.output_stride(),
                map: net.encoder().map(config),
            },
            targets: net.targets.clone(),
            decode: DecodeOptions {
                max_boxes: found.max_boxes,
                score_threshold: found.score_threshold,
                center_range_m: found.center_range_m.unwrap_or(config.range_m),
                nms_iou: f64::from(found.nms_iou),
                nms_pre: found.nms_pre,
                nms_post: found.nms_post,
            },
            loss: net.loss.clone(),
        }
    }

    /// The feature map of the heads.
    pub fn grid(&self) -> &CenterGrid {
        &self.grid
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
        self.heads.iter().map(|classes| assign(&self.grid, classes, &self.targets, boxes)).collect()
    }

    /// For each frame and head the boxes before suppression and after it, by falling score, with the detector's classes
    /// counted from 0.
    ///
    /// # Errors
    /// Outputs that are not finite, or tensors that are not f32.
    pub fn boxes(&self, heads: &[HeadOutputs], batch: &[&Sample]) -> Result<Vec<Vec<[Vec<CenterBox>; 2]>>, ModelError> {
        let mut frames: Vec<Vec<[Vec<CenterBox>; 2]>> = vec![Vec::new(); batch.len()];
        for (outputs, classes) in heads.iter().zip(&self.heads) {
            let hm = layers::host(outputs.hm.clone())?;
            let code = outputs.code().map(|map| layers::host(map.clone()));
            let code = code.into_iter().collect::<Result<Vec<_>, _>>()?;
            let of_frame = |f: usize| {
                let of = |values: &'_ [f32]| {
                    let length = values.len() / batch.len();
                    f * length..(f + 1) * length
                };
                let code = std::array::from_fn(|branch| &code[branch][of(&code[branch])]);
                let mut best = best_boxes(HeadValues { hm: &hm[of(&hm)], code }, &self.grid, &self.decode)?;
                best.iter_mut().for_each(|found| found.class = classes[found.class]);
                let kept = suppressed(best.clone(), &self.decode);
                Ok([best, kept])
            };
            let found: Vec<_> = (0..batch.len()).into_par_iter().map(of_frame).collect();
            for ((frame, sample), found) in frames.iter_mut().zip(batch).zip(found) {
                frame.push(found.map_err(|e| non_finite(&sample.input.id, e))?);
            }
        }
        Ok(frames)
    }

    /// Detections of a batch.
    ///
    /// # Errors
    /// Outputs that are not finite.
    pub fn detections(&self, heads: &[HeadOutputs], batch: &[&Sample]) -> Result<Vec<Vec<Detection>>, ModelError> {
        let of_frame = |heads: Vec<[Vec<CenterBox>; 2]>| {
            let mut found: Vec<CenterBox> = heads.into_iter().flat_map(|[_, kept]| kept).collect();
            found.sort_by(|a, b| b.score.total_cmp(&a.score)); // stable
            found.iter().map(|found| self.named(found)).collect()
        };
        Ok(self.boxes(heads, batch)?.into_iter().map(of_frame).collect())
    }

    fn named(&self, found: &CenterBox) -> Detection {
        Detection {
            class: self.pillars.classes[found.class].clone(),
            bbox: Box3::from_array(found.bbox.map(f64::from)),
            score: found.score,
        }
    }
}

fn non_finite(id: &str, error: NonFinite) -> ModelError {
    ModelError::NonFinite(format!(
        "frame {id}: the network gives outputs that are not numbers ({error}); its weights are damaged or its training \
         diverged"
    ))
}
