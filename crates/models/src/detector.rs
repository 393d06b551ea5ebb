//! A detector of any kind: from frames to samples to losses or boxes.

use crate::checkpoint::NamedTensors;
use crate::config::{DetectorConfig, NetworkConfig};
use crate::layers::{Mode, host};
use crate::pointpillars::{self, PointPillars};
use crate::pointrcnn::{self, PointRcnn};
use crate::{ModelError, named};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use data::{Detection, Frame, Stream, stream};

/// One frame, ready for the network.
#[derive(Clone, Debug)]
pub enum Sample {
    /// For PointPillars.
    PointPillars(pointpillars::Sample),
    /// For PointRCNN.
    PointRcnn(pointrcnn::Sample),
}

impl Sample {
    /// Id of the frame.
    pub fn id(&self) -> &str {
        match self {
            Sample::PointPillars(sample) => &sample.id,
            Sample::PointRcnn(sample) => &sample.id,
        }
    }

    /// Whether no point lies within the range.
    pub fn is_empty(&self) -> bool {
        match self {
            Sample::PointPillars(sample) => sample.pillars.num_points.is_empty(),
            Sample::PointRcnn(sample) => sample.points.is_empty(),
        }
    }
}

/// Makes samples of frames; needs no device, so that loader threads can do it ahead of the trainer.
#[derive(Clone, Debug)]
pub struct Preparer {
    preparation: Preparation,
}

#[derive(Clone, Debug)]
enum Preparation {
    PointPillars(pointpillars::Preparation),
    PointRcnn(Box<pointrcnn::Preparation>),
}

impl Preparation {
    fn new(config: &DetectorConfig) -> Self {
        match &config.network {
            NetworkConfig::PointPillars(net) => Preparation::PointPillars(pointpillars::Preparation::new(config, net)),
            NetworkConfig::PointRcnn(net) => Preparation::PointRcnn(Box::new(pointrcnn::Preparation::new(config, net))),
        }
    }
}

impl Preparer {
    /// For that detector.
    pub fn new(config: &DetectorConfig) -> Self {
        Preparer { preparation: Preparation::new(config) }
    }

    /// With targets. What is drawn at random, the points and regions of PointRCNN, is a function of `stream` alone.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn training(&self, frame: &Frame, stream: &mut Stream) -> Result<Sample, ModelError> {
        self.sample(frame, true, stream)
    }

    /// Without targets; the same cloud always gives the same sample.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn inference(&self, frame: &Frame) -> Result<Sample, ModelError> {
        self.sample(frame, false, &mut stream(0, "points", 0, 0))
    }

    fn sample(&self, frame: &Frame, training: bool, stream: &mut Stream) -> Result<Sample, ModelError> {
        Ok(match &self.preparation {
            Preparation::PointPillars(preparation) => Sample::PointPillars(preparation.sample(frame, training)?),
            Preparation::PointRcnn(preparation) => Sample::PointRcnn(preparation.sample(frame, training, stream)?),
        })
    }
}

/// The losses of a batch, weighted.
#[derive(Clone, Debug)]
pub struct Losses {
    /// What is minimised, `[1]`.
    pub total: Tensor<1>,
    /// Its summands by name, `[1]` each.
    pub parts: Vec<(&'static str, Tensor<1>)>,
}

/// The trainable part of a detector.
#[derive(Module, Debug)]
pub enum Network {
    /// Lang et al. 2019.
    PointPillars(PointPillars),
    /// Shi et al. 2019.
    PointRcnn(PointRcnn),
}

/// What is found in a frame.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Prediction {
    /// Boxes by falling score.
    pub detections: Vec<Detection>,
    /// Of a two-stage network every refined region with its score, before the score limit and the last suppression: what OpenPCDet's recall
    /// looks at. Empty otherwise.
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
    /// With fresh weights from `seed`.
    pub fn new(config: &DetectorConfig, seed: u64, device: &Device) -> Self {
        let network = match &config.network {
            NetworkConfig::PointPillars(net) => Network::PointPillars(PointPillars::new(config, net, seed, device)),
            NetworkConfig::PointRcnn(net) => Network::PointRcnn(PointRcnn::new(config, net, seed, device)),
        };
        Detector { network, config: config.clone(), preparation: Preparation::new(config) }
    }

    /// What it was built from.
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
        self.losses(&self.network, batch, Mode::Train)
    }

    /// Losses with the running statistics; nothing is updated.
    ///
    /// # Errors
    /// Samples of another kind of network.
    pub fn validation_loss(&self, batch: &[Sample]) -> Result<Losses, ModelError> {
        self.losses(&self.network.valid(), batch, Mode::Eval)
    }

    fn losses(&self, network: &Network, batch: &[Sample], mode: Mode) -> Result<Losses, ModelError> {
        match (network, &self.preparation, &self.config.network) {
            (Network::PointPillars(network), _, NetworkConfig::PointPillars(net)) => {
                let batch = of_pillars(batch)?;
                Ok(pointpillars::losses(&network.forward(&batch, mode).predictions, &batch, &net.loss))
            }
            (Network::PointRcnn(network), Preparation::PointRcnn(preparation), _) => {
                pointrcnn::losses(network, &of_points(batch)?, preparation, mode)
            }
            _ => Err(other_kind()),
        }
    }

    /// Boxes of each sample, by falling score, in the LiDAR frame.
    ///
    /// # Errors
    /// Scores that are not numbers, or samples of another kind of network.
    pub fn predict(&self, batch: &[Sample]) -> Result<Vec<Vec<Detection>>, ModelError> {
        Ok(self.predict_with_regions(batch)?.into_iter().map(|found| found.detections).collect())
    }

    /// The same, with all refined regions of a two-stage network beside it.
    ///
    /// # Errors
    /// As [`Detector::predict`].
    pub fn predict_with_regions(&self, batch: &[Sample]) -> Result<Vec<Prediction>, ModelError> {
        match (self.network.valid(), &self.preparation) {
            (Network::PointPillars(network), Preparation::PointPillars(preparation)) => {
                let batch = of_pillars(batch)?;
                let found = preparation.detections(network.forward(&batch, Mode::Eval).predictions, &batch)?;
                Ok(found.into_iter().map(|detections| Prediction { detections, regions: Vec::new() }).collect())
            }
            (Network::PointRcnn(network), Preparation::PointRcnn(preparation)) => {
                pointrcnn::detections(&network, &of_points(batch)?, preparation, &self.config.classes)
            }
            _ => Err(other_kind()),
        }
    }

    /// The feature vector of each frame, for pictures and similarities of whole data sets: what the head reads, averaged over all places.
    ///
    /// PointPillars: the neck's output, mean over the cells of the bird's eye map (384 values as published). PointRCNN: the finest feature
    /// propagation, mean over the sampled points (128 values); zeros for a frame without points.
    ///
    /// # Errors
    /// Samples of another kind of network.
    pub fn frame_features(&self, batch: &[Sample]) -> Result<Vec<Vec<f32>>, ModelError> {
        match self.network.valid() {
            Network::PointPillars(network) => {
                let batch = of_pillars(batch)?;
                let map = network.forward(&batch, Mode::Eval).backbone.spatial_features_2d;
                let [frames, channels, height, width] = map.dims();
                let mean = map.reshape([frames, channels, height * width]).mean_dim(2); // [B, C, 1]
                Ok(host(mean)?.chunks_exact(channels).map(<[f32]>::to_vec).collect())
            }
            Network::PointRcnn(network) => {
                let of_frame = |sample: &&pointrcnn::Sample| {
                    let channels = network.point_head.cls_layers.hidden[0].weight.dims()[1];
                    if sample.points.is_empty() {
                        return Ok(vec![0.0; channels]);
                    }
                    host(network.points(&[sample], Mode::Eval).point_features().mean_dim(0))
                };
                of_points(batch)?.iter().map(of_frame).collect()
            }
        }
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

fn of_pillars(batch: &[Sample]) -> Result<Vec<&pointpillars::Sample>, ModelError> {
    let mut samples = Vec::new();
    for sample in batch {
        let Sample::PointPillars(sample) = sample else { return Err(other_kind()) };
        samples.push(sample);
    }
    Ok(samples)
}

fn of_points(batch: &[Sample]) -> Result<Vec<&pointrcnn::Sample>, ModelError> {
    let mut samples = Vec::new();
    for sample in batch {
        let Sample::PointRcnn(sample) = sample else { return Err(other_kind()) };
        samples.push(sample);
    }
    Ok(samples)
}

fn other_kind() -> ModelError {
    ModelError::Tensor("the samples were prepared for another kind of network".into())
}

/// Number of learned values.
pub fn parameter_count<M: Module>(network: &M) -> usize {
    named::trainable(network).values().map(|shape| shape.iter().product::<usize>()).sum()
}
