//! Every operation in both forms: the kernel's values and gradients against burn's own.

use super::*;
use burn::tensor::Device;
use burn::tensor::activation::relu;
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};

fn device() -> Device {
    Device::flex().autodiff()
}

/// Values between -1 and 1, the same for a seed.
fn values(count: usize, seed: u32) -> Vec<f32> {
    let mut state = seed.wrapping_mul(2_654_435_761) | 1;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 23) as f32 - 1.0
    };
    (0..count).map(|_| next()).collect()
}

fn random<const D: usize>(shape: [usize; D], seed: u32) -> Tensor<D> {
    let count = shape.iter().product();
    Tensor::<D>::from_data(TensorData::new(values(count, seed), shape), &device()).require_grad()
}

fn host<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_to_vec().unwrap()
}

#[track_caller]
fn assert_close(what: &str, ours: &[f32], theirs: &[f32]) {
    let largest = theirs.iter().fold(1e-3f32, |m, v| m.max(v.abs()));
    let apart = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(ours.len() == theirs.len() && apart <= 2e-5 * largest, "{what}: {apart} of {largest}");
}

/// Compares values, and gradients by all inputs of a sum with random weights.
macro_rules! check {
    ($what:expr, [$($input:ident),+], $ours:expr, $theirs:expr) => {{
        let (ours, theirs) = ($ours, $theirs);
        assert_close(&format!("{}: values", $what), &host(ours.clone()), &host(theirs.clone()));
        let weights = random(theirs.dims(), 99).detach();
        let (a, b) = ((ours * weights.clone()).sum().backward(), (theirs * weights).sum().backward());
        $(assert_close(
            &format!("{}: gradient by {}", $what, stringify!($input)),
            &host($input.grad(&a).unwrap()),
            &host($input.grad(&b).unwrap()),
        );)+
    }};
}

#[test]
fn convolutions() {
    for (stride, shape, outputs) in
        [(1, [2, 5, 9, 12], 4), (2, [2, 5, 9, 12], 7), (2, [1, 1, 10, 7], 33), (1, [1, 3, 1, 1], 1)]
    {
        let (x, w) = (random(shape, 1), random([outputs, shape[1], 3, 3], 2));
        let ours = conv3x3(&x, &w, stride).unwrap();
        let theirs = conv2d(x.clone(), w.clone(), None, ConvOptions::new([stride; 2], [1, 1], [1, 1], 1));
        check!(format!("3x3, stride {stride}, {shape:?}"), [x, w], ours, theirs);
    }
    for stride in [1, 2, 4] {
        let (x, w) = (random([2, 5, 3, 6], 3), random([5, 4, stride, stride], 4));
        let ours = transposed(&x, &w, stride).unwrap();
        let options = ConvTransposeOptions::new([stride; 2], [0, 0], [0, 0], [1, 1], 1);
        check!(
            format!("transposed, stride {stride}"),
            [x, w],
            ours,
            conv_transpose2d(x.clone(), w.clone(), None, options)
        );
    }
    assert!(transposed(&random([1, 1, 2, 2], 1), &random([1, 1, 3, 3], 1), 3).is_none(), "no kernel for a stride of 3");
    let (x, w, b) = (random([2, 6, 5, 3], 5), random([4, 6, 1, 1], 6), random([4], 7));
    let theirs = conv2d(x.clone(), w.clone(), Some(b.clone()), ConvOptions::new([1, 1], [0, 0], [1, 1], 1));
    check!("1x1", [x, w, b], pointwise(&x, &w, &b).unwrap(), theirs);
}

#[test]
fn batch_norm_and_relu() {
    let (x, gamma, beta) = (random([3, 4, 5, 7], 8), random([4], 9), random([4], 10));
    let (ours, statistics) = norm_relu(&x, &gamma, &beta, 1e-3, true).unwrap();
    let theirs = burn::tensor::module::batch_norm_train(x.clone(), gamma.clone(), beta.clone(), 1e-3);
    let mean: Vec<f32> = statistics.mean.iter().map(|&v| v as f32).collect();
    assert_close("mean", &mean, &host(theirs.mean));
    let variance: Vec<f32> = statistics.variance.iter().map(|&v| v as f32).collect();
    assert_close("variance", &variance, &host(theirs.variance));
    check!("batch norm", [x, gamma, beta], ours, relu(theirs.output));
}

#[test]
fn focal_loss_of_all_anchors() {
    let logits = random([50, 3], 11);
    let labels: Vec<i32> = (0..50).map(|i| i % 5 - 1).collect();
    let weights: Vec<f32> = values(50, 12).iter().map(|v| v.abs()).collect();
    let ours = focal_loss_sum(&logits, &labels, &weights).unwrap();
    let one_hot: Vec<f32> =
        labels.iter().flat_map(|&label| (1..=3).map(move |c| if label == c { 1.0 } else { 0.0 })).collect();
    let one_hot = Tensor::<2>::from_data(TensorData::new(one_hot, [50, 3]), &device());
    let rows = Tensor::<2>::from_data(TensorData::new(weights, [50, 1]), &device());
    check!("focal loss", [logits], ours, (crate::loss::sigmoid_focal(logits.clone(), one_hot) * rows).sum());
}

#[test]
fn what_is_no_number_comes_out() {
    let mut x = values(2 * 3 * 4 * 4, 13);
    x[20] = f32::NAN;
    let x = Tensor::<4>::from_data(TensorData::new(x, [2, 3, 4, 4]), &device());
    let y = conv3x3(&x, &random([2, 3, 3, 3], 14), 1).unwrap();
    assert!(host(y.clone()).iter().any(|v| v.is_nan()));
    let (z, _) = norm_relu(&y, &random([2], 15), &random([2], 16), 1e-3, true).unwrap();
    assert!(host(z).iter().any(|v| v.is_nan()));
}

#[test]
fn tensors_elsewhere_have_no_kernel() {
    #[expect(deprecated, reason = "offered as long as burn has it")]
    let elsewhere = Device::ndarray();
    let tensor = |shape: [usize; 4]| Tensor::<4>::zeros(shape, &elsewhere);
    assert!(conv3x3(&tensor([1, 1, 4, 4]), &tensor([1, 1, 3, 3]), 1).is_none());
}
