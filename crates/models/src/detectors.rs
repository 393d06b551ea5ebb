//! The registry of detectors: the macro that makes the list of detectors in `lib.rs` into types.

use crate::ModelError;

/// The samples of one kind in a batch; an error if there is another kind in it.
macro_rules! of_kind {
    ($batch:expr, $kind:ident) => {
        $batch
            .iter()
            .map(|sample| match &sample.network {
                NetworkSample::$kind(sample) => Ok(sample),
                _ => Err(detectors::other_kind()),
            })
            .collect::<Result<Vec<_>, ModelError>>()
    };
}

/// Declares the folder of each detector, and the types that hold a detector of any kind with one variant an entry:
/// `Name(folder::Network),`. The network implements [`crate::Architecture`]. The name in lower case is the `kind` in a
/// TOML.
macro_rules! detectors {
    ($($(#[$doc:meta])* $kind:ident($folder:ident::$network:ident),)+) => {
        $(pub mod $folder;)+

        /// Which network, and its sizes.
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
        #[serde(tag = "kind", rename_all = "lowercase")]
        pub enum NetworkConfig {
            $($(#[$doc])* $kind(<$folder::$network as Architecture>::Config),)+
        }

        /// The trainable part of a detector.
        #[derive(burn::module::Module, Debug)]
        #[expect(clippy::large_enum_variant, reason = "a process has one or two")]
        pub enum Network {
            $($(#[$doc])* $kind($folder::$network),)+
        }

        /// One frame as its network reads it.
        #[derive(Clone, Debug)]
        pub enum NetworkSample {
            $($(#[$doc])* $kind(<$folder::$network as Architecture>::Sample),)+
        }

        /// What samples are made with.
        #[derive(Clone, Debug)]
        pub(crate) enum Preparation {
            $($kind(Box<<$folder::$network as Architecture>::Preparation>),)+
        }

        impl NetworkConfig {
            /// Whether the sizes fit together and to the detector's range and classes.
            ///
            /// # Errors
            /// A message that names the key.
            pub fn check(&self, detector: &config::DetectorConfig) -> Result<(), String> {
                match self {
                    $(NetworkConfig::$kind(net) => $folder::$network::check(net, detector),)+
                }
            }

            /// The anchors, one entry a class; none where boxes do not start from anchors.
            pub fn anchors(&self) -> &[config::AnchorConfig] {
                match self {
                    $(NetworkConfig::$kind(net) => $folder::$network::anchors(net),)+
                }
            }

            pub(crate) fn fit(
                &mut self,
                range: &mut [f32; 6],
                classes: &[String],
                boxes: &suggest::LabelledBoxes,
                changes: &mut Vec<suggest::Change>,
            ) {
                match self {
                    $(NetworkConfig::$kind(net) => $folder::$network::fit(net, range, classes, boxes, changes),)+
                }
            }

            /// Whether a second stage refines regions of interest. Only then [`Prediction::regions`] is filled.
            pub fn is_two_stage(&self) -> bool {
                match self {
                    $(NetworkConfig::$kind(_) => $folder::$network::TWO_STAGE,)+
                }
            }

            /// Training steps after which the network has overfitted a few frames.
            pub fn overfit_steps(&self) -> usize {
                match self {
                    $(NetworkConfig::$kind(_) => $folder::$network::OVERFIT_STEPS,)+
                }
            }
        }

        impl NetworkSample {
            pub(crate) fn input(&self) -> &dyn NetworkInput {
                match self {
                    $(NetworkSample::$kind(sample) => sample,)+
                }
            }
        }

        impl Preparation {
            pub(crate) fn new(detector: &config::DetectorConfig) -> Self {
                match &detector.network {
                    $(NetworkConfig::$kind(net) => {
                        Preparation::$kind(Box::new($folder::$network::preparation(detector, net)))
                    })+
                }
            }

            pub(crate) fn box_matches(&self, objects: &[data::Object]) -> Vec<suggest::BoxMatch> {
                match self {
                    $(Preparation::$kind(preparation) => $folder::$network::box_matches(preparation, objects),)+
                }
            }

            pub(crate) fn sample(
                &self,
                frame: &data::Frame,
                training: bool,
                stream: &mut data::Stream,
            ) -> Result<NetworkSample, ModelError> {
                Ok(match self {
                    $(Preparation::$kind(preparation) => {
                        NetworkSample::$kind($folder::$network::sample(preparation, frame, training, stream)?)
                    })+
                })
            }
        }

        impl Network {
            pub(crate) fn fresh(
                detector: &config::DetectorConfig,
                seed: u64,
                device: &burn::tensor::Device,
            ) -> Self {
                match &detector.network {
                    $(NetworkConfig::$kind(net) => {
                        Network::$kind($folder::$network::fresh(detector, net, seed, device))
                    })+
                }
            }

            pub(crate) fn losses(
                &self,
                preparation: &Preparation,
                batch: &[Sample],
                mode: layers::Mode,
                on_stage: &mut dyn FnMut(&'static str),
            ) -> Result<Losses, ModelError> {
                match (self, preparation) {
                    $((Network::$kind(network), Preparation::$kind(preparation)) => {
                        network.losses(preparation, &of_kind!(batch, $kind)?, mode, on_stage)
                    })+
                    _ => Err(detectors::other_kind()),
                }
            }

            pub(crate) fn predictions(
                &self,
                preparation: &Preparation,
                batch: &[Sample],
            ) -> Result<Vec<Prediction>, ModelError> {
                match (self, preparation) {
                    $((Network::$kind(network), Preparation::$kind(preparation)) => {
                        network.predictions(preparation, &of_kind!(batch, $kind)?)
                    })+
                    _ => Err(detectors::other_kind()),
                }
            }

            pub(crate) fn frame_features(&self, batch: &[Sample]) -> Result<Vec<Vec<f32>>, ModelError> {
                match self {
                    $(Network::$kind(network) => network.frame_features(&of_kind!(batch, $kind)?),)+
                }
            }

            pub(crate) fn layer_features(&self, sample: &Sample) -> Result<Vec<LayerFeatures>, ModelError> {
                match (self, &sample.network) {
                    $((Network::$kind(network), NetworkSample::$kind(sample)) => network.layer_features(sample),)+
                    _ => Err(detectors::other_kind()),
                }
            }
        }

        /// OpenPCDet's name of the tensor at a path of field names. The first part names the variant of [`Network`]; a
        /// path without such a part stays as it is.
        pub(crate) fn tensor_name(path: &[&str]) -> String {
            match path {
                $([kind, rest @ ..] if *kind == stringify!($kind) => $folder::$network::tensor_name(rest),)+
                _ => path.join("."),
            }
        }
    };
}

/// The error of samples or networks of different kinds.
pub(crate) fn other_kind() -> ModelError {
    ModelError::Tensor("the samples were prepared for another kind of network".into())
}
