//! The epilogue of a convolution at inference: bias and ReLU.

use pulp::Simd;

/// What is applied to each output before it is stored: the bias of a folded batch norm, and a ReLU.
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue<'a> {
    /// Bias, `[outputs]`.
    pub bias: Option<&'a [f32]>,
    /// Whether a ReLU follows.
    pub relu: bool,
}

impl Epilogue<'_> {
    #[inline(always)]
    pub(crate) fn apply<S: Simd>(&self, simd: S, channel: usize, values: S::f32s) -> S::f32s {
        let values = match self.bias {
            Some(bias) => simd.add_f32s(values, simd.splat_f32s(bias[channel])),
            None => values,
        };
        if !self.relu {
            return values;
        }
        let zero = simd.splat_f32s(0.0);
        simd.select_f32s(simd.less_than_f32s(values, zero), zero, values) // NaN propagates
    }
}
