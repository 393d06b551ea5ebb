//! Layers that the networks are built of.

mod batch_norm;
mod conv;
mod host;
mod init;
mod precision;
mod rows;

pub use batch_norm::{BatchNorm, Moments};
pub use conv::{ConvBnRelu, DeconvBnRelu, PointwiseConv};
pub use host::host;
pub use init::Init;
pub use precision::{Precision, choose_precision};
pub use rows::{RowCounts, RowsBnRelu, RowsLinear, rows_kernel};

/// Whether a pass learns (batch statistics, running ones updated) or only looks (running statistics).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Batch statistics; the running ones are updated.
    Train,
    /// Running statistics.
    Eval,
}
