use super::*;
use crate::layers::host;
use crate::tests::{self, devices};
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};

/// Random numbers, the same on every device, with a gradient.
fn random<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    tests::random(shape, seed, &device.clone().autodiff()).require_grad()
}

/// Values, and the gradients of a sum of squares by both tensors.
fn facts<const A: usize, const B: usize, const C: usize>(
    (x, weight): (Tensor<A>, Tensor<B>),
    of: impl Fn(Tensor<A>, Tensor<B>) -> Tensor<C>,
) -> [Vec<f32>; 3] {
    let y = of(x.clone(), weight.clone());
    let gradients = (y.clone() * y.clone()).sum().backward();
    [host(y).unwrap(), host(x.grad(&gradients).unwrap()).unwrap(), host(weight.grad(&gradients).unwrap()).unwrap()]
}

#[track_caller]
fn assert_close(what: &str, ours: &[Vec<f32>; 3], theirs: &[Vec<f32>; 3]) {
    for (ours, theirs) in ours.iter().zip(theirs) {
        assert_eq!(ours.len(), theirs.len(), "{what}");
        let scale = theirs.iter().map(|v| v.abs()).fold(1e-3, f32::max);
        let apart = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / scale;
        assert!(apart < 2e-5, "{what}: {apart}");
    }
}

#[test]
fn convolutions_equal_burns() {
    for (name, device) in devices() {
        for ([batch, inputs, height, width], outputs, stride) in [
            ([1, 1, 1, 1], 1, 1),
            ([2, 3, 5, 4], 2, 1),
            ([2, 3, 5, 4], 4, 2),
            ([1, 2, 6, 9], 3, 2),
            ([2, 2, 7, 8], 3, 3),
            ([3, 2, 48, 64], 3, 1),
        ] {
            let x = || random([batch, inputs, height, width], 3, &device);
            let weight = || random([outputs, inputs, 3, 3], 4, &device);
            let ours = facts((x(), weight()), |x, weight| conv3x3(x, weight, stride));
            let options = || ConvOptions::new([stride; 2], [1, 1], [1, 1], 1);
            let theirs = facts((x(), weight()), |x, weight| conv2d(x, weight, None, options()));
            assert_close(&format!("{name} {height}x{width}, stride {stride}"), &ours, &theirs);
        }
    }
}

#[test]
fn transposed_convolutions_equal_burns() {
    for (name, device) in devices() {
        for ([batch, inputs, height, width], outputs, stride) in
            [([1, 1, 1, 1], 1, 1), ([2, 3, 5, 4], 2, 1), ([2, 2, 3, 4], 3, 2), ([1, 2, 16, 24], 3, 4)]
        {
            let x = || random([batch, inputs, height, width], 3, &device);
            let weight = || random([inputs, outputs, stride, stride], 4, &device);
            let ours = facts((x(), weight()), transposed);
            let options = || ConvTransposeOptions::new([stride; 2], [0, 0], [0, 0], [1, 1], 1);
            let theirs = facts((x(), weight()), |x, weight| conv_transpose2d(x, weight, None, options()));
            assert_close(&format!("{name} {height}x{width}, stride {stride}"), &ours, &theirs);
        }
    }
}

#[test]
fn convolutions_with_kernel_and_stride_equal_burns() {
    for (name, device) in devices() {
        for ([batch, inputs, height, width], outputs, stride) in [([2, 3, 6, 4], 2, 2), ([1, 2, 9, 14], 3, 4)] {
            let x = || random([batch, inputs, height, width], 3, &device);
            let weight = || random([outputs, inputs, stride, stride], 4, &device);
            let ours = facts((x(), weight()), strided);
            let options = || ConvOptions::new([stride; 2], [0, 0], [1, 1], 1);
            let theirs = facts((x(), weight()), |x, weight| conv2d(x, weight, None, options()));
            assert_close(&format!("{name} {height}x{width}, stride {stride}"), &ours, &theirs);
        }
    }
}

#[test]
fn biases_equal_burns() {
    for (name, device) in devices() {
        for (rows, channels) in [(1, 3), (2000, 40)] {
            let y = || random([rows, channels], 3, &device);
            let bias = || random([channels], 4, &device);
            let ours = facts((y(), bias()), add_to_rows);
            let theirs = facts((y(), bias()), |y: Tensor<2>, bias: Tensor<1>| y + bias.unsqueeze());
            assert_close(&format!("{name} {rows} rows"), &ours, &theirs);
        }
    }
}

#[test]
fn linear_layers_equal_burns() {
    for (name, device) in devices() {
        // Less rows than a product has terms; a remainder; none.
        for (rows, inputs, outputs) in [(1, 2, 3), (100, 3, 2), (300, 4, 5), (2560, 3, 4), (70_000, 3, 2)] {
            let x = || random([rows, inputs], 3, &device);
            let weight = || random([outputs, inputs], 4, &device);
            let ours = facts((x(), weight()), rows_by);
            let theirs = facts((x(), weight()), |x: Tensor<2>, weight: Tensor<2>| x.matmul(weight.transpose()));
            assert_close(&format!("{name} {rows} rows"), &ours, &theirs);
        }
    }
}

#[test]
fn only_gpus_use_them() {
    for (name, device) in devices() {
        let is_gpu = name == "wgpu";
        assert_eq!(are_used_on(&device), is_gpu);
        assert_eq!(are_used_on(&device.autodiff()), is_gpu);
    }
}
