//! What the folder of a detector implements for the rest of the program.

use crate::config::{AnchorConfig, DetectorConfig};
use crate::layers::Mode;
use crate::suggest::{BoxMatch, Change, LabelledBoxes};
use crate::{LayerFeatures, Losses, ModelError, Prediction};
use burn::module::Module;
use burn::tensor::Device;
use data::{Frame, Object, Stream};

/// A kind of detector. The type that implements it is the network, a burn module whose field names are OpenPCDet's.
///
/// The list `detectors!` in `lib.rs` has all of them. Trainer, prediction, parity check, doctor and benchmark reach
/// them through this list only.
pub trait Architecture: Module {
    /// Sizes of the network: the table `[network]` of a detector's TOML without its key `kind`.
    type Config;
    /// Data computed once from the configuration, for making samples and decoding predictions.
    type Preparation;
    /// One frame, ready for the network.
    type Sample: NetworkInput;

    /// Whether a second stage refines regions of interest. Only then [`Prediction::regions`] is filled.
    const TWO_STAGE: bool = false;

    /// Training steps after which the network has overfitted a few frames: the default length of `train --overfit`.
    const OVERFIT_STEPS: usize;

    /// Whether the sizes fit together and to the detector's range and classes.
    ///
    /// # Errors
    /// A message that names the key.
    fn check(net: &Self::Config, detector: &DetectorConfig) -> Result<(), String>;

    /// The anchors, one entry a class; none where boxes do not start from anchors.
    fn anchors(_net: &Self::Config) -> &[AnchorConfig] {
        &[]
    }

    /// Fits range, grid and anchors to labelled boxes; every change is recorded with its reason.
    fn fit(
        net: &mut Self::Config,
        range: &mut [f32; 6],
        classes: &[String],
        boxes: &LabelledBoxes,
        changes: &mut Vec<Change>,
    );

    /// How the anchors are assigned to the boxes of a frame; none where boxes do not start from anchors.
    fn box_matches(_preparation: &Self::Preparation, _objects: &[Object]) -> Vec<BoxMatch> {
        Vec::new()
    }

    /// What samples are made with.
    fn preparation(detector: &DetectorConfig, net: &Self::Config) -> Self::Preparation;

    /// The network's input for one frame, with targets if `training`. All random choices come from `stream`.
    ///
    /// # Errors
    /// A cloud with too few values a point.
    fn sample(
        preparation: &Self::Preparation,
        frame: &Frame,
        training: bool,
        stream: &mut Stream,
    ) -> Result<Self::Sample, ModelError>;

    /// The network with fresh weights from `seed`.
    fn fresh(detector: &DetectorConfig, net: &Self::Config, seed: u64, device: &Device) -> Self;

    /// Weighted losses of a batch. `on_stage` is called with the name of each stage of the pass after it was launched.
    ///
    /// # Errors
    /// Tensors that are not f32.
    fn losses(
        &self,
        preparation: &Self::Preparation,
        batch: &[&Self::Sample],
        mode: Mode,
        on_stage: &mut dyn FnMut(&'static str),
    ) -> Result<Losses, ModelError>;

    /// What is found in each sample, with running statistics.
    ///
    /// # Errors
    /// Scores or boxes that are not finite.
    fn predictions(
        &self,
        preparation: &Self::Preparation,
        batch: &[&Self::Sample],
    ) -> Result<Vec<Prediction>, ModelError>;

    /// The input of the head, averaged over all places: one vector a sample, of the same length for each.
    ///
    /// # Errors
    /// Tensors that are not f32.
    fn frame_features(&self, batch: &[&Self::Sample]) -> Result<Vec<Vec<f32>>, ModelError>;

    /// The output of each layer for one sample that is not empty, averaged over all places, in the order of the forward
    /// pass.
    ///
    /// # Errors
    /// Tensors that are not f32.
    fn layer_features(&self, sample: &Self::Sample) -> Result<Vec<LayerFeatures>, ModelError>;

    /// OpenPCDet's name of the tensor at a path of field names.
    ///
    /// OpenPCDet numbers the entries of a `Sequential`: padding, convolution, normalisation and ReLU count one each.
    fn tensor_name(path: &[&str]) -> String;
}

/// Properties that every kind of sample has.
pub trait NetworkInput {
    /// Id of the frame.
    fn id(&self) -> &str;

    /// Whether no point lies within the range.
    fn is_empty(&self) -> bool;

    /// Number of points and number of pillars (or voxels) that the network reads; 0 pillars where it reads points.
    fn size(&self) -> [usize; 2];
}
