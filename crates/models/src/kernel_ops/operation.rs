//! A differentiable operation of burn made of a kernel on slices.

use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::NoCheckpointing;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, NodeGuard, Ops, OpsKind};
use burn::backend::flex::FlexTensor;
use burn::backend::tensor::FloatTensor;
use burn::backend::{Autodiff, Flex, TensorMetadata};
use burn::tensor::{Tensor, TensorData};
use std::fmt::Debug;
use std::marker::PhantomData;
use std::sync::Arc;

/// flex with gradients.
type Learning = Autodiff<Flex>;

/// An operation on `N` tensors of f32 in memory.
pub(super) trait Operation<const N: usize>: Clone + Debug + Send + 'static {
    /// What the backward pass needs besides the inputs.
    type State: Debug + Send + Sync + 'static;

    /// The output's values and shape.
    fn forward(&self, inputs: [&[f32]; N]) -> (Vec<f32>, Vec<usize>, Self::State);

    /// The gradients by the inputs that are wanted.
    fn backward(
        &self,
        inputs: [&[f32]; N],
        state: &Self::State,
        gradient: &[f32],
        wanted: [bool; N],
    ) -> [Option<Vec<f32>>; N];
}

/// A tensor on flex, of any rank.
pub(super) enum Argument {
    /// Part of a graph.
    Learning(FloatTensor<Learning>),
    /// Values alone.
    Plain(FlexTensor),
}

impl Argument {
    /// `None` for a tensor on another device, or of another type than f32.
    pub fn of<const D: usize>(tensor: &Tensor<D>) -> Option<Self> {
        let argument = match tensor.clone().try_into_primitive::<Learning>() {
            Ok(primitive) => Argument::Learning(primitive),
            Err(_) => Argument::Plain(tensor.clone().try_into_primitive::<Flex>().ok()?),
        };
        let dtype = match &argument {
            Argument::Learning(primitive) => primitive.dtype(),
            Argument::Plain(primitive) => primitive.dtype(),
        };
        (dtype == burn::tensor::DType::F32).then_some(argument)
    }
}

/// Runs an operation. The state holds what else came out; it is not part of the graph.
///
/// `None` when some of the arguments are part of a graph and others not.
pub(super) fn run<O: Operation<N>, const N: usize, const D: usize>(
    operation: O,
    arguments: [Argument; N],
) -> Option<(Tensor<D>, Arc<O::State>)> {
    let learning = arguments.iter().filter(|a| matches!(a, Argument::Learning(_))).count();
    if learning == 0 {
        let inputs = arguments.map(|argument| match argument {
            Argument::Plain(tensor) => contiguous(tensor),
            Argument::Learning(tensor) => contiguous(tensor.into_parts().0),
        });
        let (values, shape, state) = operation.forward(slices(&inputs));
        return Some((Tensor::from_primitive::<Flex>(tensor(values, shape)), Arc::new(state)));
    }
    if learning < N {
        return None;
    }
    let mut inputs = Vec::with_capacity(N);
    let guards = arguments.map(|argument| match argument {
        Argument::Learning(tensor) => {
            let (primitive, guard) = tensor.into_parts();
            inputs.push(contiguous(primitive));
            guard
        }
        Argument::Plain(_) => unreachable!("counted above"),
    });
    let inputs: [FlexTensor; N] = inputs.try_into().expect("one for each argument");
    Some(record(operation, inputs, guards))
}

fn record<O: Operation<N>, const N: usize, const D: usize>(
    operation: O,
    inputs: [FlexTensor; N],
    guards: [NodeGuard; N],
) -> (Tensor<D>, Arc<O::State>) {
    let (values, shape, state) = operation.forward(slices(&inputs));
    let (output, state) = (tensor(values, shape), Arc::new(state));
    let prepared = Step::<O>(PhantomData).prepare::<NoCheckpointing>(guards).compute_bound().stateful();
    let output = match prepared {
        OpsKind::Tracked(prepared) => prepared.finish(Saved { operation, inputs, state: state.clone() }, output),
        OpsKind::UnTracked(prepared) => prepared.finish(output),
    };
    (Tensor::from_primitive::<Learning>(output), state)
}

/// The step backwards.
struct Step<O>(PhantomData<fn() -> O>);

impl<O> Debug for Step<O> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(std::any::type_name::<O>())
    }
}

/// What it needs. The tensors share their memory with the graph's.
struct Saved<O: Operation<N>, const N: usize> {
    operation: O,
    inputs: [FlexTensor; N],
    state: Arc<O::State>,
}

impl<O: Operation<N>, const N: usize> Clone for Saved<O, N> {
    fn clone(&self) -> Self {
        Saved { operation: self.operation.clone(), inputs: self.inputs.clone(), state: self.state.clone() }
    }
}

impl<O: Operation<N>, const N: usize> Debug for Saved<O, N> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.operation.fmt(f)
    }
}

impl<O: Operation<N>, const N: usize> Backward<Flex, N> for Step<O> {
    type State = Saved<O, N>;

    fn backward(self, ops: Ops<Self::State, N>, gradients: &mut Gradients, _: &mut Checkpointer) {
        let gradient = contiguous(gradients.consume::<Flex>(&ops.node));
        let Saved { operation, inputs, state } = ops.state;
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let results = operation.backward(slices(&inputs), &state, values(&gradient), wanted);
        for ((parent, result), input) in ops.parents.into_iter().zip(results).zip(&inputs) {
            if let (Some(parent), Some(result)) = (parent, result) {
                gradients.register::<Flex>(parent.id, tensor(result, input.shape().to_vec()));
            }
        }
    }
}

/// The same values, one after the other; a view of other values is copied.
fn contiguous(tensor: FlexTensor) -> FlexTensor {
    if tensor.as_slice::<f32>().is_some() { tensor } else { tensor.to_contiguous() }
}

fn values(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice::<f32>().expect("f32, checked when it became an argument, and contiguous")
}

fn slices<const N: usize>(tensors: &[FlexTensor; N]) -> [&[f32]; N] {
    tensors.each_ref().map(values)
}

fn tensor(values: Vec<f32>, shape: Vec<usize>) -> FlexTensor {
    FlexTensor::from_data(TensorData::new(values, shape)) // takes the vector over
}
