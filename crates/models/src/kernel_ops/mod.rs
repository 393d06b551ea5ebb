//! The operations of crate `kernels` as differentiable operations of burn.
//!
//! The functions return `None` if the tensors are not on the CPU device `flex`. The layers then use burn's operations.

mod append_maximum;
mod canvas;
mod convolution;
mod focal_loss;
mod gaussian_focal_loss;
mod norm_relu;
mod pillar_net;
mod pixel_heads;
mod shared_mlp;
mod values;

pub use append_maximum::append_maximum;
pub use canvas::{pillar_conv, scatter};
pub use convolution::{conv3x3, folded_conv3x3, folded_transposed, transposed};
pub use focal_loss::focal_loss_sum;
pub use gaussian_focal_loss::gaussian_focal_loss;
pub use norm_relu::norm_relu;
pub use pillar_net::{pillar_net, pillar_net_inference};
pub use pixel_heads::pixel_heads;
pub use shared_mlp::{MlpGroups, MlpParameters, MlpRows, shared_mlp, shared_mlp_inference};
pub use values::FlexValues;

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Flex, TensorMetadata};
use burn::tensor::{DType, Tensor, TensorData};
use std::fmt::Debug;
use std::sync::atomic::{AtomicU8, Ordering};

type Ad = Autodiff<Flex>;

/// The implementation of the operations on the CPU device `flex`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Kernels {
    /// The crate `kernels`, convolutions by Winograd's F(2x2, 3x3).
    #[default]
    Auto,
    /// The same, convolutions by F(4x4, 3x3): faster, rounding error about ten times larger.
    AutoF4,
    /// burn's operations.
    Burn,
}

static CHOSEN: AtomicU8 = AtomicU8::new(0);

/// Sets the choice for this process; call it before the first forward pass.
pub fn choose_kernels(kernels: Kernels) {
    CHOSEN.store(kernels as u8, Ordering::Relaxed);
}

/// The choice of this process.
pub fn chosen_kernels() -> Kernels {
    match CHOSEN.load(Ordering::Relaxed) {
        0 => Kernels::Auto,
        1 => Kernels::AutoF4,
        _ => Kernels::Burn,
    }
}

/// An operation on slices with its gradient; `N` inputs may require a gradient.
trait Kernel<const N: usize>: Clone + Debug + Send + 'static {
    /// State of the forward pass that the gradient needs.
    type State: Clone + Debug + Send + 'static;

    fn forward(&self, inputs: [&[f32]; N]) -> (Vec<f32>, Self::State);

    /// Gradients with respect to the requested inputs, from the gradient with respect to the result.
    fn backward(
        &self,
        inputs: [&[f32]; N],
        state: &Self::State,
        dy: &[f32],
        wanted: [bool; N],
    ) -> [Option<Vec<f32>>; N];

    fn shape(&self) -> Vec<usize>;
}

/// An f32 tensor on `flex`, with or without autodiff graph.
enum Input {
    Tracked(FloatTensor<Ad>),
    Plain(FlexTensor),
}

/// The tensor as `flex` tensor, if kernels are enabled and it is on that device.
fn input<const D: usize>(tensor: &Tensor<D>) -> Option<Input> {
    if chosen_kernels() == Kernels::Burn || tensor.dtype() != DType::F32 {
        return None;
    }
    match tensor.clone().try_into_primitive::<Ad>() {
        Ok(tracked) => Some(Input::Tracked(tracked)),
        Err(_) => tensor.clone().try_into_primitive::<Flex>().ok().map(|plain| Input::Plain(contiguous(plain))),
    }
}

/// Runs the kernel if all inputs are on `flex`, either all with autodiff graph or all without.
fn apply<K: Kernel<N>, const N: usize, const D: usize>(
    kernel: K,
    inputs: [Option<Input>; N],
) -> Option<(Tensor<D>, K::State)> {
    let (mut tracked, mut plain) = (Vec::with_capacity(N), Vec::with_capacity(N));
    for input in inputs {
        match input? {
            Input::Tracked(tensor) => tracked.push(tensor),
            Input::Plain(tensor) => plain.push(tensor),
        }
    }
    if let Ok(tracked) = <[FloatTensor<Ad>; N]>::try_from(tracked) {
        let (y, state) = apply_tracked(kernel, tracked);
        return Some((Tensor::from_primitive::<Ad>(y), state));
    }
    let plain = <[FlexTensor; N]>::try_from(plain).ok()?;
    let (y, state) = kernel.forward(slices(&plain));
    Some((Tensor::from_primitive::<Flex>(tensor(y, kernel.shape())), state))
}

fn apply_tracked<K: Kernel<N>, const N: usize>(kernel: K, inputs: [FloatTensor<Ad>; N]) -> (FloatTensor<Ad>, K::State) {
    let parts = inputs.map(|input| input.into_parts());
    let primitives = std::array::from_fn(|i| contiguous(parts[i].0.clone()));
    let nodes = parts.map(|(_, node)| node);
    let (y, state) = kernel.forward(slices(&primitives));
    let y = tensor(y, kernel.shape());
    let y = match Gradient(kernel.clone()).prepare::<NoCheckpointing>(nodes).compute_bound().stateful() {
        OpsKind::Tracked(prepared) => prepared.finish((primitives, state.clone()), y),
        OpsKind::UnTracked(prepared) => prepared.finish(y),
    };
    (y, state)
}

/// The backward pass of a kernel.
#[derive(Clone, Debug)]
struct Gradient<K>(K);

impl<K: Kernel<N>, const N: usize> Backward<Flex, N> for Gradient<K> {
    type State = ([FlexTensor; N], K::State);

    fn backward(self, ops: Ops<Self::State, N>, grads: &mut Gradients, _: &mut Checkpointer) {
        let dy = contiguous(grads.consume::<Flex>(&ops.node));
        let (inputs, state) = &ops.state;
        let wanted = std::array::from_fn(|i| ops.parents[i].is_some());
        let found = self.0.backward(slices(inputs), state, slice(&dy), wanted);
        for ((parent, gradient), input) in ops.parents.iter().zip(found).zip(inputs) {
            if let (Some(parent), Some(gradient)) = (parent, gradient) {
                grads.register::<Flex>(parent.id, tensor(gradient, input.shape().to_vec()));
            }
        }
    }
}

/// Makes views contiguous, so that they have a slice.
fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn slice(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice::<f32>().expect("a contiguous tensor of single precision")
}

fn slices<const N: usize>(tensors: &[FlexTensor; N]) -> [&[f32]; N] {
    std::array::from_fn(|i| slice(&tensors[i]))
}

/// A tensor that owns the values without a copy.
fn tensor(values: Vec<f32>, shape: Vec<usize>) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape))
}

#[cfg(test)]
mod tests;
