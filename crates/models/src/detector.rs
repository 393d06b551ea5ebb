//! A detector of any kind: from frames to samples to losses or boxes.

use crate::checkpoint::NamedTensors;
use crate::config::DetectorConfig;
use crate::layers::Mode;
use crate::suggest::BoxMatch;
use crate::{LayerFeatures, ModelError, Network, NetworkSample, Preparation, named};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use data::{Detection, Frame, GroundConfig, GroundHeight, Object, Stream, stream};

/// One frame, ready for the network.
#[derive(Clone, Debug)]
pub struct Sample {
    /// What its network reads.
    pub network: NetworkSample,
    /// The ground from which its heights count; `None`: from z = 0 of the LiDAR frame.
    ground: Option<GroundHeight>,
}

impl Sample {
    /// Id of the frame.
    pub fn id(&self) -> &str {
        self.network.input().id()
    }

    /// Whether no point lies within the range.
    pub fn is_empty(&self) -> bool {
        self.network.input().is_empty()
    }

    /// Number of points and number of pillars that the network reads; 0 pillars where it reads points.
    pub fn size(&self) -> [usize; 2] {
        self.network.input().size()
    }

    /// Boxes of the network in the LiDAR frame.
    fn in_lidar_frame(&self, mut found: Vec<Detection>) -> Vec<Detection> {
        if let Some(ground) = &self.ground {
            for [x, y, z] in found.iter_mut().map(|detection| &mut detection.bbox.center) {
                *z += ground.at(*x, *y);
            }
        }
        found
    }
}

/// Makes samples of frames; needs no device, so that loader threads can do it ahead of the trainer.
#[derive(Clone, Debug)]
pub struct Preparer {
    preparation: Preparation,
    ground: Option<GroundConfig>,
}

impl Preparer {
    /// For a detector's configuration.
    pub fn new(config: &DetectorConfig) -> Self {
        Preparer { preparation: Preparation::new(config), ground: config.ground.clone() }
    }

    /// With targets. All random choices, such as the points that a network reads, come from `stream`.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn training(&self, frame: &Frame, stream: &mut Stream) -> Result<Sample, ModelError> {
        self.sample(frame, true, stream)
    }

    /// How the anchors are assigned to the boxes of a frame; none where boxes do not start from anchors. Boxes of other
    /// classes and outside of the range are left out.
    pub fn box_matches(&self, objects: &[Object]) -> Vec<BoxMatch> {
        self.preparation.box_matches(objects)
    }

    /// Without targets; the same cloud always gives the same sample.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn inference(&self, frame: &Frame) -> Result<Sample, ModelError> {
        self.sample(frame, false, &mut stream(0, "points", 0, 0))
    }

    fn sample(&self, frame: &Frame, training: bool, stream: &mut Stream) -> Result<Sample, ModelError> {
        let ground = self.ground.as_ref().map(|config| GroundHeight::of(&frame.cloud, config));
        let network = match &ground {
            Some(ground) => self.preparation.sample(&ground.level(frame), training, stream)?,
            None => self.preparation.sample(frame, training, stream)?,
        };
        Ok(Sample { network, ground })
    }
}

/// The losses of a batch, weighted.
#[derive(Clone, Debug)]
pub struct Losses {
    /// The total loss, `[1]`.
    pub total: Tensor<1>,
    /// Its terms by name, `[1]` each.
    pub parts: Vec<(&'static str, Tensor<1>)>,
}

/// Detections of a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Prediction {
    /// Boxes by falling score.
    pub detections: Vec<Detection>,
    /// All refined regions of a two-stage network with their scores, before score threshold and NMS: the boxes of
    /// OpenPCDet's recall. Empty for other networks.
    pub regions: Vec<Detection>,
}

/// A network with the configuration it was built from.
#[derive(Clone, Debug)]
pub struct Detector {
    /// The trainable part.
    pub network: Network,
    config: DetectorConfig,
    preparation: Preparation,
}

impl Detector {
    /// A network with initial weights from `seed`.
    pub fn new(config: &DetectorConfig, seed: u64, device: &Device) -> Self {
        let network = Network::fresh(config, seed, device);
        Detector { network, config: config.clone(), preparation: Preparation::new(config) }
    }

    /// The configuration it was built from.
    pub fn config(&self) -> &DetectorConfig {
        &self.config
    }

    /// The same detector with another state of its network.
    pub fn with_network(self, network: Network) -> Self {
        Detector { network, ..self }
    }

    /// Losses in training mode: batch statistics, and the running ones are updated.
    ///
    /// # Errors
    /// Samples of another kind of network.
    pub fn loss(&self, batch: &[Sample]) -> Result<Losses, ModelError> {
        self.loss_by_stage(batch, &mut |_| ())
    }

    /// The same; `on_stage` is called with the name of each stage of the forward pass after it was launched.
    ///
    /// # Errors
    /// Samples of another kind of network.
    pub fn loss_by_stage(
        &self,
        batch: &[Sample],
        on_stage: &mut dyn FnMut(&'static str),
    ) -> Result<Losses, ModelError> {
        self.network.losses(&self.preparation, batch, Mode::Train, on_stage)
    }

    /// Losses with the running statistics; nothing is updated.
    ///
    /// # Errors
    /// Samples of another kind of network.
    pub fn validation_loss(&self, batch: &[Sample]) -> Result<Losses, ModelError> {
        self.network.valid().losses(&self.preparation, batch, Mode::Eval, &mut |_| ())
    }

    /// Boxes of each sample, by falling score, in the LiDAR frame.
    ///
    /// # Errors
    /// Scores that are not finite, or samples of another kind of network.
    pub fn predict(&self, batch: &[Sample]) -> Result<Vec<Vec<Detection>>, ModelError> {
        Ok(self.predict_with_regions(batch)?.into_iter().map(|found| found.detections).collect())
    }

    /// The same, and the refined regions of a two-stage network.
    ///
    /// # Errors
    /// As [`Detector::predict`].
    pub fn predict_with_regions(&self, batch: &[Sample]) -> Result<Vec<Prediction>, ModelError> {
        let found = self.network.valid().predictions(&self.preparation, batch)?;
        let of_sample = |(found, sample): (Prediction, &Sample)| Prediction {
            detections: sample.in_lidar_frame(found.detections),
            regions: sample.in_lidar_frame(found.regions),
        };
        Ok(found.into_iter().zip(batch).map(of_sample).collect())
    }

    /// The feature vector of each frame, for t-SNE and for distances between data sets: the input of the head, averaged
    /// over all places.
    ///
    /// PointPillars and CenterPoint: the neck's output, mean over the cells of the BEV map (384 values as published).
    /// PointRCNN: the finest feature propagation, mean over the sampled points (128 values); zeros for a frame without
    /// points.
    ///
    /// # Errors
    /// Samples of another kind of network.
    pub fn frame_features(&self, batch: &[Sample]) -> Result<Vec<Vec<f32>>, ModelError> {
        self.network.valid().frame_features(batch)
    }

    /// The outputs of all layers for one frame, first to last; the last is the input of the head. Empty for a frame
    /// without points.
    ///
    /// PointPillars and CenterPoint: the pillar feature net (mean over pillars), each block and the neck (mean over
    /// cells). PointRCNN: each level of set abstraction and of feature propagation (mean over points).
    ///
    /// # Errors
    /// A sample of another kind of network.
    pub fn layer_features(&self, sample: &Sample) -> Result<Vec<LayerFeatures>, ModelError> {
        if sample.is_empty() { Ok(Vec::new()) } else { self.network.valid().layer_features(sample) }
    }

    /// All tensors under OpenPCDet's names, running statistics and counters with them.
    ///
    /// # Errors
    /// Tensors that are not f32.
    pub fn to_named(&self) -> Result<NamedTensors, ModelError> {
        let mut tensors = named::to_named(&self.network)?;
        tensors.insert("global_step".into(), named::counter(0, vec![1]));
        Ok(tensors)
    }

    /// The same network with these weights.
    ///
    /// # Errors
    /// A tensor that is missing, has another shape, or belongs to another network.
    pub fn load_named(self, tensors: &NamedTensors) -> Result<Self, ModelError> {
        let network = named::load_named(self.network.clone(), tensors)?;
        Ok(self.with_network(network))
    }
}

/// Number of learned parameters.
pub fn parameter_count<M: Module>(network: &M) -> usize {
    named::trainable(network).values().map(|shape| shape.iter().product::<usize>()).sum()
}
