//! PointPillars in the registry of detectors.

use super::config::PointPillarsConfig;
use super::{PointPillars, Preparation, Sample, losses};
use crate::architecture::Architecture;
use crate::bev;
use crate::config::{AnchorConfig, DetectorConfig};
use crate::layers::Mode;
use crate::suggest::{BoxMatch, Change, LabelledBoxes, fit_anchors, fit_grid};
use crate::{LayerFeatures, Losses, ModelError, Prediction};
use burn::tensor::Device;
use data::{Frame, Object, Stream};

impl Architecture for PointPillars {
    type Config = PointPillarsConfig;
    type Preparation = Preparation;
    type Sample = Sample;

    const OVERFIT_STEPS: usize = 400;

    fn check(net: &PointPillarsConfig, detector: &DetectorConfig) -> Result<(), String> {
        net.check(detector)
    }

    fn anchors(net: &PointPillarsConfig) -> &[AnchorConfig] {
        &net.anchors
    }

    fn fit(
        net: &mut PointPillarsConfig,
        range: &mut [f32; 6],
        classes: &[String],
        boxes: &LabelledBoxes,
        changes: &mut Vec<Change>,
    ) {
        fit_grid(&mut net.pillars, &net.backbone, range, classes, boxes, changes);
        fit_anchors(&mut net.anchors, boxes, changes);
    }

    fn box_matches(preparation: &Preparation, objects: &[Object]) -> Vec<BoxMatch> {
        preparation.box_matches(objects)
    }

    fn preparation(detector: &DetectorConfig, net: &PointPillarsConfig) -> Preparation {
        Preparation::new(detector, net)
    }

    fn sample(preparation: &Preparation, frame: &Frame, training: bool, _: &mut Stream) -> Result<Sample, ModelError> {
        preparation.sample(frame, training)
    }

    fn fresh(detector: &DetectorConfig, net: &PointPillarsConfig, seed: u64, device: &Device) -> Self {
        PointPillars::new(detector, net, seed, device)
    }

    fn losses(
        &self,
        preparation: &Preparation,
        batch: &[&Sample],
        mode: Mode,
        on_stage: &mut dyn FnMut(&'static str),
    ) -> Result<Losses, ModelError> {
        let predictions = self.forward_by_stage(batch, mode, on_stage).predictions;
        let losses = losses(&predictions, batch, &preparation.loss);
        on_stage("loss");
        Ok(losses)
    }

    fn predictions(&self, preparation: &Preparation, batch: &[&Sample]) -> Result<Vec<Prediction>, ModelError> {
        let found = preparation.detections(self.forward(batch, Mode::Eval).predictions, batch)?;
        Ok(found.into_iter().map(|detections| Prediction { detections, regions: Vec::new() }).collect())
    }

    fn frame_features(&self, batch: &[&Sample]) -> Result<Vec<Vec<f32>>, ModelError> {
        self.encoder.frame_features(&Sample::inputs(batch))
    }

    fn layer_features(&self, sample: &Sample) -> Result<Vec<LayerFeatures>, ModelError> {
        self.encoder.layer_features(&sample.input)
    }

    fn tensor_name(path: &[&str]) -> String {
        match path {
            ["encoder", rest @ ..] => bev::tensor_name(rest),
            _ => path.join("."),
        }
    }
}
