//! Gradients of the point operations against central differences.

use burn::tensor::{Device, Tensor, TensorData};
use data::stream;
use lidarshift_models as models;
use models::layers::{BatchNorm, Init, Mode, RowCounts, RowsBnRelu, host};
use models::point_ops::{Groups, Interpolation, group_max, interpolate};
use models::row_ops::gather;
use rand::RngExt;

fn random(count: usize, seed: u64) -> Vec<f32> {
    let mut random = stream(seed, "values", 0, 0);
    (0..count).map(|_| random.random_range(-1.0..1.0)).collect()
}

/// Compares the gradient of a weighted sum of `operation`'s output with central differences, value by value.
#[track_caller]
fn check(input: [usize; 2], operation: impl Fn(Tensor<2>) -> Tensor<2>) {
    let device = Device::flex().autodiff();
    let start = random(input[0] * input[1], 1);
    let tensor = |values: Vec<f32>| Tensor::<2>::from_data(TensorData::new(values, input), &device);
    let value = |x: Tensor<2>| {
        let y = operation(x);
        let [rows, columns] = y.dims();
        let weights = TensorData::new(random(rows * columns, 2), [rows, columns]);
        (y * Tensor::from_data(weights, &device)).sum()
    };
    let x = tensor(start.clone()).require_grad();
    let gradient = host(x.grad(&value(x.clone()).backward()).unwrap()).unwrap();
    let step = 2e-3;
    let mut wrong = 0;
    for (i, gradient) in gradient.iter().enumerate() {
        let moved = |by: f32| {
            let mut values = start.clone();
            values[i] += by;
            f64::from(host(value(tensor(values))).unwrap()[0])
        };
        let slope = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        // At a kink of a maximum or a ReLU the difference quotient is not the gradient.
        wrong += usize::from((slope - f64::from(*gradient)).abs() > 5e-3 * (1.0 + slope.abs()));
    }
    assert!(wrong <= 1 + gradient.len() / 50, "{wrong} of {} gradients differ", gradient.len());
}

fn groups() -> Groups {
    let points: Vec<[f32; 3]> = random(60, 3).as_chunks::<3>().0.to_vec();
    let mut groups = Groups::default();
    for (g, slots) in [vec![0, 3, 5, 0, 0], vec![7], vec![1, 2, 4, 8, 19, 1], vec![5, 6, 5]].into_iter().enumerate() {
        groups.push(points[g], slots.into_iter().map(|i: u32| (i, points[i as usize])), 1.0 + g as f32);
    }
    groups
}

#[test]
fn gathering_and_maximum() {
    let groups = groups().to_device(&Device::flex().autodiff());
    check([20, 3], |x| group_max(gather(x, &groups.source), &groups));
}

#[test]
fn interpolation() {
    let known: Vec<[f32; 3]> = random(30, 4).as_chunks::<3>().0.to_vec();
    let unknown: Vec<[f32; 3]> = random(75, 5).as_chunks::<3>().0.to_vec();
    let from = Interpolation::new(&unknown, &known).to_device(&Device::flex().autodiff());
    check([10, 4], |known| interpolate(known, &from));
}

#[test]
fn normalisation_with_counts() {
    let device = Device::flex().autodiff();
    let init = Init { seed: 6, device: &device };
    let counts: Vec<f32> = (0..12).map(|i| (i % 4) as f32).collect();
    for mode in [Mode::Train, Mode::Eval] {
        let layer: RowsBnRelu<4> = RowsBnRelu::new("layer", [3, 5], BatchNorm::new(5, 0.1, 1e-5, &init), &init);
        let counts = RowCounts::new(counts.clone(), &device);
        check([12, 3], |x| layer.forward(x, &counts, mode));
    }
}
