//! The hot operations of the networks on slices of f32.
//!
//! Images are `[batch, channels, height, width]`, row-major, as burn and PyTorch have them. Every result is the same to the bit for any number of
//! threads: work is cut by its size alone and partial sums are added in a fixed order. Which vector instructions run is found at run time
//! ([`InstructionSet`]) and may change the last digits.
//!
//! Arguments are checked by assertions: shapes come from code, not from users.

pub mod adam;
pub mod batch_norm;
mod blocks;
pub mod conv3x3;
pub mod epilogue;
pub mod focal_loss;
pub mod fold;
mod images;
mod line;
mod matrix;
mod output;
pub mod pillar_net;
pub mod pointwise;
#[cfg(test)]
mod reference;
mod scheme;
mod scratch;
pub mod shared_mlp;
mod simd;
mod tile;
pub mod transposed;
mod upsampling;
mod weight_gradient;

pub use adam::{AdamStep, GradientNorm, Parameter};
pub use batch_norm::{BatchNorm, Statistics};
pub use conv3x3::{Algorithm, Conv3x3};
pub use epilogue::Epilogue;
pub use focal_loss::sigmoid_focal_loss;
pub use fold::{Folded, NormParameters};
pub use pillar_net::{PillarGradients, PillarNet, PillarParameters, PillarState, Pillars};
pub use pointwise::Pointwise;
pub use scheme::PackedWeights;
pub use shared_mlp::{MlpGradients, MlpLayer, MlpState, SharedMlp};
pub use simd::{InstructionSet, UnknownInstructionSet, VARIABLE};
pub use transposed::TransposedConv;
