//! What follows a convolution at inference.

/// What is done to each output before it is stored: what is left of a batch norm and a ReLU at inference.
#[derive(Clone, Copy, Debug, Default)]
pub struct Epilogue<'a> {
    /// Added, `[outputs]`.
    pub bias: Option<&'a [f32]>,
    /// Negative values become zero.
    pub relu: bool,
}

impl Epilogue<'_> {
    #[inline(always)]
    pub(crate) fn apply(&self, channel: usize, values: &mut [f32]) {
        if let Some(bias) = self.bias {
            let bias = bias[channel];
            for value in values.iter_mut() {
                *value += bias;
            }
        }
        if self.relu {
            for value in values.iter_mut() {
                *value = if *value < 0.0 { 0.0 } else { *value }; // NaN stays
            }
        }
    }
}
