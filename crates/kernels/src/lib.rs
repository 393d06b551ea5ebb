//! CPU kernels of the networks on slices of f32.
//!
//! Images are `[batch, channels, height, width]`, row-major, as in burn and PyTorch. Results are bit-equal for any
//! number of threads: the division of work depends on its size alone, and partial sums are added in a fixed order. The
//! vector instructions are chosen at run time ([`InstructionSet`]) and may change the last digits.
//!
//! Arguments are checked by assertions, because shapes come from code and not from users.

pub mod adam;
pub mod append_maximum;
mod background;
pub mod batch_norm;
mod blocks;
pub mod canvas;
pub mod conv3x3;
pub mod epilogue;
pub mod focal_loss;
pub mod fold;
pub mod gaussian_focal_loss;
mod images;
mod matrix;
mod output;
pub mod pillar_net;
pub mod pixel_heads;
#[cfg(test)]
mod reference;
mod registers;
mod scheme;
mod scratch;
pub mod shared_mlp;
mod simd;
mod tile;
pub mod transposed;
mod upsampling;
mod weight_gradient;

pub use adam::{AdamStep, GradientNorm, Parameter};
pub use append_maximum::GroupedRows;
pub use batch_norm::{BatchNorm, Statistics};
pub use canvas::Canvas;
pub use conv3x3::{Algorithm, Conv3x3};
pub use epilogue::Epilogue;
pub use focal_loss::sigmoid_focal_loss;
pub use fold::{Folded, NormParameters};
pub use gaussian_focal_loss::gaussian_focal_loss;
pub use pillar_net::{PillarGradients, PillarNet, PillarParameters, PillarState, Pillars};
pub use pixel_heads::{PixelHeadGradients, PixelHeads};
pub use scheme::PackedWeights;
pub use shared_mlp::{MlpGradients, MlpInput, MlpLayer, MlpState, RowGroups, SharedMlp};
pub use simd::{InstructionSet, UnknownInstructionSet, VARIABLE};
pub use transposed::TransposedConv;
