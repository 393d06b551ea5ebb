//! PointRCNN in the registry of detectors.

use super::config::PointRcnnConfig;
use super::{PointRcnn, Preparation, Sample, detections, losses};
use crate::architecture::{Architecture, NetworkInput};
use crate::config::DetectorConfig;
use crate::layers::{Mode, host};
use crate::suggest::{Change, LabelledBoxes, change, fit_range};
use crate::{LayerFeatures, Losses, ModelError, Prediction};
use burn::tensor::Device;
use data::{Frame, Stream};

impl Architecture for PointRcnn {
    type Config = PointRcnnConfig;
    type Preparation = Preparation;
    type Sample = Sample;

    const TWO_STAGE: bool = true;

    /// The second stage is trained on a few dozen regions a frame, and each step samples different points.
    const OVERFIT_STEPS: usize = 3600;

    fn check(net: &PointRcnnConfig, detector: &DetectorConfig) -> Result<(), String> {
        net.check(detector)
    }

    fn fit(
        net: &mut PointRcnnConfig,
        range: &mut [f32; 6],
        classes: &[String],
        boxes: &LabelledBoxes,
        changes: &mut Vec<Change>,
    ) {
        fit_range(range, &boxes.of_classes(classes), None, changes);
        for mean in net.point_head.mean_sizes.iter_mut() {
            let key = format!("network.point_head.mean_sizes ({}).size_m", mean.class);
            if let Some(size) = boxes.median_size(&mean.class) {
                change(changes, &key, &mut mean.size_m, size, "median of the boxes".into());
            }
        }
    }

    fn preparation(detector: &DetectorConfig, net: &PointRcnnConfig) -> Preparation {
        Preparation::new(detector, net)
    }

    fn sample(
        preparation: &Preparation,
        frame: &Frame,
        training: bool,
        stream: &mut Stream,
    ) -> Result<Sample, ModelError> {
        preparation.sample(frame, training, stream)
    }

    fn fresh(detector: &DetectorConfig, net: &PointRcnnConfig, seed: u64, device: &Device) -> Self {
        PointRcnn::new(detector, net, seed, device)
    }

    fn losses(
        &self,
        preparation: &Preparation,
        batch: &[&Sample],
        mode: Mode,
        on_stage: &mut dyn FnMut(&'static str),
    ) -> Result<Losses, ModelError> {
        let losses = losses(self, batch, preparation, mode)?;
        on_stage("forward");
        Ok(losses)
    }

    fn predictions(&self, preparation: &Preparation, batch: &[&Sample]) -> Result<Vec<Prediction>, ModelError> {
        detections(self, batch, preparation)
    }

    fn frame_features(&self, batch: &[&Sample]) -> Result<Vec<Vec<f32>>, ModelError> {
        let of_frame = |sample: &&Sample| {
            let channels = self.point_head.cls_layers.hidden[0].weight.dims()[1];
            if sample.points.is_empty() {
                return Ok(vec![0.0; channels]);
            }
            host(self.points(&[sample], Mode::Eval).point_features().mean_dim(0))
        };
        batch.iter().map(of_frame).collect()
    }

    fn layer_features(&self, sample: &Sample) -> Result<Vec<LayerFeatures>, ModelError> {
        let backbone = self.points(&[sample], Mode::Eval).backbone;
        let mut layers = Vec::new();
        for (i, level) in backbone.set_abstraction.into_iter().enumerate() {
            layers.push(LayerFeatures::mean(format!("set abstraction {}", i + 1), level)?);
        }
        for (i, level) in backbone.propagation.into_iter().enumerate().rev() {
            layers.push(LayerFeatures::mean(format!("propagation {}", i + 1), level)?);
        }
        Ok(layers)
    }

    fn tensor_name(path: &[&str]) -> String {
        sequential_name(path).unwrap_or_else(|| path.join("."))
    }
}

/// The name of a tensor inside a `Sequential`, where linear layer, normalisation, ReLU and dropout count one each.
fn sequential_name(path: &[&str]) -> Option<String> {
    let at = |prefix: String, first: usize, rest: &[&str]| match rest {
        ["norm", name] => format!("{prefix}.{}.{name}", first + 1),
        _ => format!("{prefix}.{first}.{}", rest.join(".")),
    };
    Some(match *path {
        [part @ ("backbone_3d" | "roi_head"), "sa_modules", i, "mlps", g, "layers", j, ref rest @ ..] => {
            at(format!("{part}.SA_modules.{i}.mlps.{g}"), 3 * j.parse::<usize>().ok()?, rest)
        }
        ["backbone_3d", "fp_modules", i, "mlp", j, ref rest @ ..] => {
            at(format!("backbone_3d.FP_modules.{i}.mlp"), 3 * j.parse::<usize>().ok()?, rest)
        }
        ["point_head", chain, "hidden", j, ref rest @ ..] => {
            at(format!("point_head.{chain}"), 3 * j.parse::<usize>().ok()?, rest)
        }
        ["point_head", chain, "last", name] => format!("point_head.{chain}.6.{name}"),
        ["roi_head", chain, "hidden", j, ref rest @ ..] => {
            at(format!("roi_head.{chain}"), 4 * j.parse::<usize>().ok()?, rest)
        }
        ["roi_head", chain, "last", name] => format!("roi_head.{chain}.7.{name}"),
        ["roi_head", "xyz_up_layer", j, name] => {
            format!("roi_head.xyz_up_layer.{}.{name}", 2 * j.parse::<usize>().ok()?)
        }
        _ => return None,
    })
}

impl NetworkInput for Sample {
    fn id(&self) -> &str {
        &self.id
    }

    fn is_empty(&self) -> bool {
        self.points.is_empty()
    }

    fn size(&self) -> [usize; 2] {
        [self.points.len(), 0]
    }
}
