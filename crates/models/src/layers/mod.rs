//! Layers of the networks.

mod batch_norm;
mod conv;
mod host;
mod init;
mod precision;
mod resampling;
mod rows;

pub use batch_norm::{BatchNorm, Moments};
pub use conv::{Conv, ConvBnRelu, PointwiseConv};
pub use host::host;
pub use init::Init;
pub use precision::{Precision, choose_precision};
pub use resampling::{ResampleBnRelu, Resampling};
pub use rows::{RowCounts, RowsBnRelu, RowsLinear, rows_kernel};

/// Mode of batch norms in a forward pass.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Training: batch statistics, and the running statistics are updated.
    Train,
    /// Evaluation: running statistics.
    Eval,
}
