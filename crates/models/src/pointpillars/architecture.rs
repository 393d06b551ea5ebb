//! PointPillars in the registry of detectors.

use super::config::PointPillarsConfig;
use super::scatter::scatter;
use super::{PointPillars, Preparation, Sample, losses};
use crate::architecture::{Architecture, NetworkInput};
use crate::config::{AnchorConfig, DetectorConfig};
use crate::layers::{Mode, host};
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
        let stride = net.backbone.strides[0] / net.backbone.upsample_strides[0];
        fit_grid(&mut net.pillars.size_m, range, stride, &net.backbone.strides, classes, boxes, changes);
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
        let pillars = self.vfe.forward(self.pillar_rows(batch), mode);
        on_stage("encoder");
        let (cells, shape) = self.cells(batch);
        let canvas = scatter(pillars, &cells, shape);
        on_stage("scatter");
        let features = self.backbone_2d.forward(canvas, mode).spatial_features_2d;
        on_stage("backbone");
        let predictions = self.dense_head.forward(features);
        on_stage("head");
        let losses = losses(&predictions, batch, &preparation.loss);
        on_stage("loss");
        Ok(losses)
    }

    fn predictions(&self, preparation: &Preparation, batch: &[&Sample]) -> Result<Vec<Prediction>, ModelError> {
        let found = preparation.detections(self.forward(batch, Mode::Eval).predictions, batch)?;
        Ok(found.into_iter().map(|detections| Prediction { detections, regions: Vec::new() }).collect())
    }

    fn frame_features(&self, batch: &[&Sample]) -> Result<Vec<Vec<f32>>, ModelError> {
        let map = self.forward(batch, Mode::Eval).backbone.spatial_features_2d;
        let [frames, channels, height, width] = map.dims();
        let mean = map.reshape([frames, channels, height * width]).mean_dim(2); // [B, C, 1]
        Ok(host(mean)?.chunks_exact(channels).map(<[f32]>::to_vec).collect())
    }

    fn layer_features(&self, sample: &Sample) -> Result<Vec<LayerFeatures>, ModelError> {
        let stages = self.forward(&[sample], Mode::Eval);
        let mut layers = vec![LayerFeatures::mean("pillar features", stages.pillar_features)?];
        for (i, block) in stages.backbone.blocks.into_iter().enumerate() {
            layers.push(LayerFeatures::map_mean(format!("block {}", i + 1), block)?);
        }
        layers.push(LayerFeatures::map_mean("neck", stages.backbone.spatial_features_2d)?);
        Ok(layers)
    }

    fn tensor_name(path: &[&str]) -> String {
        match path {
            ["vfe", "weight"] => "vfe.pfn_layers.0.linear.weight".into(),
            ["vfe", "norm", name] => format!("vfe.pfn_layers.0.norm.{name}"),
            ["backbone_2d", "blocks", i, "convs", j, rest @ ..] => {
                let first = 1 + 3 * j.parse::<usize>().unwrap_or(0);
                match rest {
                    ["norm", name] => format!("backbone_2d.blocks.{i}.{}.{name}", first + 1),
                    _ => format!("backbone_2d.blocks.{i}.{first}.{}", rest.join(".")),
                }
            }
            ["backbone_2d", "deblocks", i, "norm", name] => format!("backbone_2d.deblocks.{i}.1.{name}"),
            ["backbone_2d", "deblocks", i, name] => format!("backbone_2d.deblocks.{i}.0.{name}"),
            _ => path.join("."),
        }
    }
}

impl NetworkInput for Sample {
    fn id(&self) -> &str {
        &self.id
    }

    fn is_empty(&self) -> bool {
        self.pillars.num_points.is_empty()
    }

    fn size(&self) -> [usize; 2] {
        let num_points = &self.pillars.num_points;
        [num_points.iter().map(|&n| n as usize).sum(), num_points.len()]
    }
}
