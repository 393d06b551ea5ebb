//! CenterPoint in the registry of detectors.

use super::config::CenterPointConfig;
use super::{CenterPoint, Preparation, Sample, losses};
use crate::architecture::Architecture;
use crate::bev;
use crate::config::DetectorConfig;
use crate::layers::Mode;
use crate::suggest::{Change, LabelledBoxes, fit_grid};
use crate::{LayerFeatures, Losses, ModelError, Prediction};
use burn::tensor::Device;
use data::{Frame, Stream};

impl Architecture for CenterPoint {
    type Config = CenterPointConfig;
    type Preparation = Preparation;
    type Sample = Sample;

    const OVERFIT_STEPS: usize = 600;

    fn check(net: &CenterPointConfig, detector: &DetectorConfig) -> Result<(), String> {
        net.check(detector)
    }

    fn fit(
        net: &mut CenterPointConfig,
        range: &mut [f32; 6],
        classes: &[String],
        boxes: &LabelledBoxes,
        changes: &mut Vec<Change>,
    ) {
        fit_grid(&mut net.pillars, &net.backbone, range, classes, boxes, changes);
    }

    fn preparation(detector: &DetectorConfig, net: &CenterPointConfig) -> Preparation {
        Preparation::new(detector, net)
    }

    fn sample(preparation: &Preparation, frame: &Frame, training: bool, _: &mut Stream) -> Result<Sample, ModelError> {
        preparation.sample(frame, training)
    }

    fn fresh(detector: &DetectorConfig, net: &CenterPointConfig, seed: u64, device: &Device) -> Self {
        CenterPoint::new(detector, net, seed, device)
    }

    fn losses(
        &self,
        preparation: &Preparation,
        batch: &[&Sample],
        mode: Mode,
        on_stage: &mut dyn FnMut(&'static str),
    ) -> Result<Losses, ModelError> {
        let heads = self.forward(batch, mode, on_stage).heads;
        let losses = losses(&heads, batch, &preparation.loss);
        on_stage("loss");
        Ok(losses)
    }

    fn predictions(&self, preparation: &Preparation, batch: &[&Sample]) -> Result<Vec<Prediction>, ModelError> {
        let found = preparation.detections(&self.forward(batch, Mode::Eval, &mut |_| ()).heads, batch)?;
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
            ["dense_head", "shared_conv", rest @ ..] => conv_name("dense_head.shared_conv", rest),
            ["dense_head", "heads_list", h, branch, "layers", k, kind, rest @ ..] => {
                let layer = format!("dense_head.heads_list.{h}.{branch}.{k}");
                if *kind == "Hidden" { conv_name(&layer, rest) } else { format!("{layer}.{}", rest.join(".")) }
            }
            _ => path.join("."),
        }
    }
}

/// The name of a tensor of a `Sequential` of convolution, normalisation and ReLU.
fn conv_name(prefix: &str, path: &[&str]) -> String {
    match path {
        ["norm", name] => format!("{prefix}.1.{name}"),
        _ => format!("{prefix}.0.{}", path.join(".")),
    }
}
