//! Products of the device wgpu with `--precision high` and `f16`. A process of its own: the precision is chosen for a
//! whole process.
#![cfg(feature = "wgpu")]

use burn::tensor::{Device, DeviceKind, DeviceType, Tensor, TensorData};
use lidarshift_models::layers::{Precision, choose_precision, host};
use lidarshift_models::products::{conv3x3, rows_by};
use rand::RngExt;

/// Random numbers from -1 to 1 with a gradient.
fn random<const D: usize>(shape: [usize; D], seed: u64, device: &Device) -> Tensor<D> {
    let mut random = data::stream(seed, "values", 0, 0);
    let values: Vec<f32> = (0..shape.iter().product()).map(|_| random.random_range(-1.0..1.0)).collect();
    Tensor::from_data(TensorData::new(values, shape), device).require_grad()
}

/// Values, and the gradients of a sum of squares by both tensors.
fn facts<const A: usize, const B: usize>(
    (x, weight): (Tensor<A>, Tensor<B>),
    of: impl Fn(Tensor<A>, Tensor<B>) -> Tensor<A>,
) -> [Vec<f32>; 3] {
    let y = of(x.clone(), weight.clone());
    let gradients = (y.clone() * y.clone()).sum().backward();
    [host(y).unwrap(), host(x.grad(&gradients).unwrap()).unwrap(), host(weight.grad(&gradients).unwrap()).unwrap()]
}

/// Sums of two bf16 keep 16 bits, an f16 has 11. Without tensor cores `high` stays in f32, and sums are in f16 as well.
#[test]
fn products_keep_their_digits() {
    if Device::enumerate(DeviceType::Wgpu).is_empty() {
        eprintln!("not tested: no adapter");
        return;
    }
    let device = Device::wgpu(DeviceKind::DefaultDevice).autodiff();
    let all = || {
        let mut all = Vec::new();
        for ([batch, inputs, height, width], outputs, stride) in
            [([2, 3, 5, 4], 2, 1), ([2, 40, 24, 32], 70, 1), ([1, 64, 40, 48], 130, 2)]
        {
            let x = random([batch, inputs, height, width], 3, &device);
            all.extend(facts((x, random([outputs, inputs, 3, 3], 4, &device)), |x, w| conv3x3(x, w, stride)));
        }
        for (rows, inputs, outputs) in [(1, 1, 1), (700, 17, 65), (3000, 128, 40)] {
            let x = random([rows, inputs], 5, &device);
            all.extend(facts((x, random([outputs, inputs], 6, &device)), rows_by));
        }
        all
    };
    let whole = all();
    for (precision, most) in [(Precision::High, 1e-4), (Precision::F16, 0.02)] {
        choose_precision(precision);
        let apart: Vec<f32> = all().iter().zip(&whole).map(|(rounded, whole)| largest_error(rounded, whole)).collect();
        eprintln!("{precision:?}: {apart:.5?}");
        assert!(apart.iter().all(|&apart| apart < most), "{precision:?}: {apart:?}");
    }
}

/// The largest difference, as a share of the largest value.
fn largest_error(values: &[f32], exact: &[f32]) -> f32 {
    let scale = exact.iter().map(|v| v.abs()).fold(1e-3, f32::max);
    let errors =
        values.iter().zip(exact).map(|(a, b)| if a.is_finite() { (a - b).abs() / scale } else { f32::INFINITY });
    errors.fold(0.0, f32::max)
}
