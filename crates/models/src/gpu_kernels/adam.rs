//! A step of Adam with decoupled weight decay.

use super::{UNITS, argument, cubes, is_plain, unset_like};
use burn::backend::{Cube, TensorMetadata};
use burn::tensor::Tensor;
use cubecl::prelude::*;
use kernels::AdamStep;

#[cube(launch)]
fn adam_kernel(
    value: &[f32],
    gradient: &[f32],
    mean: &[f32],
    square: &[f32],
    moved: &mut [f32],
    new_mean: &mut [f32],
    new_square: &mut [f32],
    gradient_scale: f32,
    beta1: f32,
    beta2: f32,
    epsilon: f32,
    keep: f32,
    rate: f32,
    square_scale: f32,
) {
    let i = ABSOLUTE_POS;
    if i < value.len() {
        let g = gradient[i] * gradient_scale;
        let m = mean[i] * beta1 + g * (1.0 - beta1);
        let v = square[i] * beta2 + g * g * (1.0 - beta2);
        new_mean[i] = m;
        new_square[i] = v;
        moved[i] = value[i] * keep - m / (v.sqrt() * square_scale + epsilon) * rate;
    }
}

/// New value and moments from value, gradient and moments, in one kernel; the inputs as error where there is none.
///
/// # Shapes
/// All: `[N]`.
#[expect(clippy::result_large_err, reason = "the tensors are returned if there is no kernel")]
pub fn adam(tensors: [Tensor<1>; 4], step: &AdamStep) -> Result<[Tensor<1>; 3], [Tensor<1>; 4]> {
    let primitives = tensors.each_ref().map(|tensor| tensor.clone().try_into_primitive::<Cube>().ok());
    let [Some(value), Some(gradient), Some(mean), Some(square)] = primitives else { return Err(tensors) };
    if ![&value, &gradient, &mean, &square].into_iter().all(is_plain) {
        return Err(tensors);
    }
    let outputs: [_; 3] = std::array::from_fn(|_| unset_like(&value));
    let correction = |beta: f64| 1.0 - beta.powf(step.step as f64);
    adam_kernel::launch(
        &value.client,
        cubes(value.shape().num_elements()),
        CubeDim::new_1d(UNITS),
        argument(&value),
        argument(&gradient),
        argument(&mean),
        argument(&square),
        argument(&outputs[0]),
        argument(&outputs[1]),
        argument(&outputs[2]),
        step.gradient_scale as f32,
        step.beta1 as f32,
        step.beta2 as f32,
        step.epsilon as f32,
        (1.0 - step.learning_rate * step.weight_decay) as f32,
        (step.learning_rate / correction(step.beta1)) as f32,
        (1.0 / correction(step.beta2).sqrt()) as f32,
    );
    Ok(outputs.map(Tensor::from_primitive::<Cube>))
}
