//! A detector of any kind: from frames to samples to losses or boxes.

use crate::checkpoint::NamedTensors;
use crate::config::{DetectorConfig, NetworkConfig};
use crate::layers::Mode;
use crate::pointpillars::{PointPillars, Preparation, losses};
use crate::{ModelError, named};
use burn::module::Module;
use burn::tensor::{Device, Tensor};
use data::{Detection, Frame};

pub use crate::pointpillars::Sample;

/// Makes samples of frames; needs no device, so that loader threads can do it ahead of the trainer.
#[derive(Clone, Debug)]
pub struct Preparer {
    preparation: Preparation,
}

impl Preparer {
    /// For that detector.
    pub fn new(config: &DetectorConfig) -> Self {
        let NetworkConfig::PointPillars(net) = &config.network;
        Preparer { preparation: Preparation::new(config, net) }
    }

    /// With targets.
    ///
    /// # Errors
    /// A cloud with too few values a point, or no point within the range.
    pub fn training(&self, frame: &Frame) -> Result<Sample, ModelError> {
        self.preparation.sample(frame, true)
    }

    /// Without targets.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    pub fn inference(&self, frame: &Frame) -> Result<Sample, ModelError> {
        self.preparation.sample(frame, false)
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

/// A network with the configuration it was built from.
#[derive(Clone, Debug)]
pub struct Detector {
    /// The trainable part.
    pub network: PointPillars,
    config: DetectorConfig,
    preparation: Preparation,
}

impl Detector {
    /// With fresh weights from `seed`.
    pub fn new(config: &DetectorConfig, seed: u64, device: &Device) -> Self {
        let NetworkConfig::PointPillars(net) = &config.network;
        Detector {
            network: PointPillars::new(config, net, seed, device),
            config: config.clone(),
            preparation: Preparation::new(config, net),
        }
    }

    /// What it was built from.
    pub fn config(&self) -> &DetectorConfig {
        &self.config
    }

    /// The same detector with another state of its network.
    pub fn with_network(self, network: PointPillars) -> Self {
        Detector { network, ..self }
    }

    /// Losses in training mode: batch statistics, and the running ones are updated.
    pub fn loss(&self, batch: &[Sample]) -> Losses {
        let NetworkConfig::PointPillars(net) = &self.config.network;
        losses(&self.network.forward(batch, Mode::Train).predictions, batch, &net.loss)
    }

    /// Losses with the running statistics; nothing is updated.
    pub fn validation_loss(&self, batch: &[Sample]) -> Losses {
        let NetworkConfig::PointPillars(net) = &self.config.network;
        losses(&self.network.valid().forward(batch, Mode::Eval).predictions, batch, &net.loss)
    }

    /// Boxes of each sample, by falling score, in the LiDAR frame.
    ///
    /// # Errors
    /// Scores that are not numbers.
    pub fn predict(&self, batch: &[Sample]) -> Result<Vec<Vec<Detection>>, ModelError> {
        let predictions = self.network.valid().forward(batch, Mode::Eval).predictions;
        self.preparation.detections(predictions, batch)
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

/// Number of learned values.
pub fn parameter_count(network: &PointPillars) -> usize {
    named::trainable(network).values().map(|shape| shape.iter().product::<usize>()).sum()
}
