use super::*;
use crate::layers::host;
use crate::tests::{gpu, random};
use burn::backend::ops::IntTensorOps;
use burn::tensor::activation::relu;
use burn::tensor::{Device, Tensor, TensorData};
use kernels::{AdamStep, Parameter};

#[track_caller]
fn assert_close(what: &str, ours: &[Vec<f32>], theirs: &[Vec<f32>]) {
    for (k, (ours, theirs)) in ours.iter().zip(theirs).enumerate() {
        assert_eq!(ours.len(), theirs.len(), "{what} {k}");
        let scale = theirs.iter().map(|v| v.abs()).fold(1e-3, f32::max);
        let apart = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / scale;
        assert!(apart < 1e-4, "{what} {k}: {apart}");
    }
}

#[test]
fn adam_equals_that_of_the_cpu() {
    let Some(device) = gpu() else { return };
    for (values, number) in [(1, 1), (255, 2), (70_000, 10)] {
        let tensors = [1, 2, 3, 4].map(|seed| random([values], seed, &device));
        let [value, gradient, mean, square] = tensors.each_ref().map(|t| host(t.clone()).unwrap());
        let square: Vec<f32> = square.iter().map(|v| v.abs()).collect();
        let tensors = [&value, &gradient, &mean, &square]
            .map(|v| Tensor::<1>::from_data(TensorData::new(v.clone(), [values]), &device));
        let step = AdamStep {
            learning_rate: 3e-3,
            beta1: 0.9,
            beta2: 0.99,
            epsilon: 1e-8,
            weight_decay: 0.01,
            step: number,
            gradient_scale: 0.5,
        };
        let ours = adam(tensors, &step).expect("a kernel").map(|t| host(t).unwrap());
        let (mut value, mut exp_avg, mut exp_avg_sq) = (value, mean, square);
        let gradient = Some(gradient.as_slice());
        step.apply(vec![Parameter { value: &mut value, gradient, exp_avg: &mut exp_avg, exp_avg_sq: &mut exp_avg_sq }]);
        assert_close(&format!("{values} values"), &ours, &[value, exp_avg, exp_avg_sq]);
    }
    let flex = Device::flex();
    let step = AdamStep {
        learning_rate: 0.1,
        beta1: 0.9,
        beta2: 0.99,
        epsilon: 1e-8,
        weight_decay: 0.0,
        step: 1,
        gradient_scale: 1.0,
    };
    assert!(adam([1, 2, 3, 4].map(|seed| random([3], seed, &flex)), &step).is_err());
}

#[test]
fn batch_norms_equal_their_definition() {
    let Some(device) = gpu() else { return };
    let (device, cpu) = (device.autodiff(), Device::flex().autodiff());
    for (shape, with_relu) in
        [([2, 3, 4, 5], true), ([1, 1, 2, 3], false), ([3, 5, 70, 60], true), ([2, 2, 300, 300], false)]
    {
        let [_, channels, ..] = shape;
        let inputs = |device: &Device| {
            let x = random(shape, 3, device).require_grad();
            let [gamma, beta] = [4, 5].map(|seed| random([channels], seed, device).require_grad());
            (x, gamma, beta, random(shape, 6, device))
        };
        let (x, gamma, beta, weight) = inputs(&device);
        let (y, moments) = norm_relu(&x, &gamma, &beta, 1e-3, with_relu).expect("a kernel");
        let gradients = (y.clone() * weight).sum().backward();
        let mut ours = vec![host(y).unwrap(), host(moments.mean).unwrap(), host(moments.variance).unwrap()];
        ours.push(host(x.grad(&gradients).unwrap()).unwrap());
        ours.extend([gamma, beta].map(|t| host(t.grad(&gradients).unwrap()).unwrap()));

        let (x, gamma, beta, weight) = inputs(&cpu);
        let mean = |x: Tensor<4>| x.mean_dim(0).mean_dim(2).mean_dim(3);
        let of_channels = |t: &Tensor<1>| t.clone().reshape([1, channels, 1, 1]);
        let centre = mean(x.clone());
        let variance = mean((x.clone() - centre.clone()).square());
        let y =
            (x.clone() - centre.clone()) / (variance.clone() + 1e-3).sqrt() * of_channels(&gamma) + of_channels(&beta);
        let y = if with_relu { relu(y) } else { y };
        let gradients = (y.clone() * weight).sum().backward();
        let mut theirs = vec![host(y).unwrap(), host(centre).unwrap(), host(variance).unwrap()];
        theirs.push(host(x.grad(&gradients).unwrap()).unwrap());
        theirs.extend([gamma, beta].map(|t| host(t.grad(&gradients).unwrap()).unwrap()));
        assert_close(&format!("{shape:?}"), &ours, &theirs);
    }
}

#[test]
fn products_equal_burns() {
    let Some(device) = gpu() else { return };
    for (a, b) in [
        ([1, 1, 1, 1], [1, 1, 1, 1]),
        ([1, 1, 70, 30], [1, 1, 30, 200]),
        ([2, 3, 64, 17], [2, 3, 17, 130]),
        ([1, 1, 65, 40], [3, 1, 40, 129]),
        ([2, 5, 130, 33], [1, 1, 33, 9]),
        ([1, 40, 256, 8], [1, 40, 8, 256]),
    ] {
        let (a, b): (Tensor<4>, Tensor<4>) = (random(a, 3, &device), random(b, 4, &device));
        // As they are, and both stored with the other dimension first.
        let turned =
            |t: &Tensor<4>| Tensor::<4>::from_data(t.clone().swap_dims(2, 3).into_data(), &device).swap_dims(2, 3);
        let theirs = host(a.clone().matmul(b.clone())).unwrap();
        for (a, b) in
            [(a.clone(), b.clone()), (turned(&a), b.clone()), (a.clone(), turned(&b)), (turned(&a), turned(&b))]
        {
            let [a, b] = [a, b].map(|t| t.try_into_primitive::<Cube>().unwrap());
            let ours = host(Tensor::<4>::from_primitive::<Cube>(product(&a, &b).expect("a kernel"))).unwrap();
            assert_close(&format!("{:?} {:?}", a.shape(), b.shape()), &[ours], std::slice::from_ref(&theirs));
        }
    }
}

#[test]
fn sums_over_the_first_dimension() {
    let Some(device) = gpu() else { return };
    for shape in [[1, 1], [7, 300], [130, 70_000]] {
        let x: Tensor<2> = random(shape, 3, &device);
        let ours = sum_of_first(&x.clone().try_into_primitive::<Cube>().unwrap()).expect("a kernel");
        let ours = host(Tensor::<2>::from_primitive::<Cube>(ours)).unwrap();
        assert_close(&format!("{shape:?}"), &[ours], &[host(x.sum_dim(0)).unwrap()]);
    }
}

#[test]
fn batch_norms_of_rows_equal_their_definition() {
    let Some(device) = gpu() else { return };
    let (device, cpu) = (device.autodiff(), Device::flex().autodiff());
    for ([rows, channels], with_relu) in [([1, 1], false), ([300, 5], true), ([5000, 33], true), ([9000, 3], false)] {
        let counts: Vec<f32> = (0..rows).map(|row| [1.0, 0.0, 3.0][row % 3]).collect();
        let total = counts.iter().sum::<f32>() as usize;
        let inputs = |device: &Device| {
            let x = random([rows, channels], 3, device).require_grad();
            let [gamma, beta] = [4, 5].map(|seed| random([channels], seed, device).require_grad());
            let counts = Tensor::<1>::from_data(TensorData::new(counts.clone(), [rows]), device);
            (x, gamma, beta, random([rows, channels], 6, device), counts)
        };
        let (x, gamma, beta, weight, of_rows) = inputs(&device);
        let (y, moments) = norm_relu_rows(&x, (&gamma, &beta), (&of_rows, total), 1e-3, with_relu).expect("a kernel");
        let gradients = (y.clone() * weight).sum().backward();
        let mut ours = vec![host(y).unwrap(), host(moments.mean).unwrap(), host(moments.variance).unwrap()];
        ours.push(host(x.grad(&gradients).unwrap()).unwrap());
        ours.extend([gamma, beta].map(|t| host(t.grad(&gradients).unwrap()).unwrap()));

        let (x, gamma, beta, weight, of_rows) = inputs(&cpu);
        let mean = |x: Tensor<2>| (x * of_rows.clone().reshape([rows, 1])).sum_dim(0) / total as f64;
        let centre = mean(x.clone());
        let variance = mean((x.clone() - centre.clone()).square());
        let y = (x.clone() - centre.clone()) / (variance.clone() + 1e-3).sqrt() * gamma.clone().unsqueeze()
            + beta.clone().unsqueeze();
        let y = if with_relu { relu(y) } else { y };
        let gradients = (y.clone() * weight).sum().backward();
        let mut theirs = vec![host(y).unwrap(), host(centre).unwrap(), host(variance).unwrap()];
        theirs.push(host(x.grad(&gradients).unwrap()).unwrap());
        theirs.extend([gamma, beta].map(|t| host(t.grad(&gradients).unwrap()).unwrap()));
        assert_close(&format!("{rows} rows of {channels}"), &ours, &theirs);
    }
}

#[test]
fn focal_losses_equal_those_of_the_cpu() {
    let Some(device) = gpu() else { return };
    for (rows, classes, frames) in [(1, 1, 1), (30, 3, 2), (9_999, 2, 3)] {
        let labels: Vec<i32> = (0..rows).map(|i| (i * 7 % (classes + 2)) as i32 - 1).collect();
        let weights: Vec<f32> = (0..frames).map(|f| 0.5 + f as f32).collect();
        let run = |device: &Device| {
            let logits: Tensor<2> = (random([rows, classes], 3, device) * 4.0).require_grad();
            let loss = crate::loss::sigmoid_focal_sum(logits.clone(), &labels, &weights);
            let gradients = (loss.clone() * 3.0).backward();
            [host(loss).unwrap(), host(logits.grad(&gradients).unwrap()).unwrap()]
        };
        let device = device.clone().autodiff();
        assert!(focal_loss_sum(&random([rows, classes], 3, &device), &labels, &weights).is_some());
        assert_close(&format!("{rows} {classes}"), &run(&device), &run(&Device::flex().autodiff()));
    }
}

#[test]
fn running_statistics_and_sums_of_squares() {
    let Some(device) = gpu() else { return };
    let [mean, variance, of_batch, variance_of_batch]: [Tensor<1>; 4] = [1, 2, 3, 4].map(|s| random([300], s, &device));
    let ours = blend([&mean, &variance], [&of_batch, &variance_of_batch], 0.1, 1.5).expect("a kernel");
    let theirs = [mean * 0.9 + of_batch * 0.1, variance * 0.9 + variance_of_batch * 0.15];
    assert_close("running", &ours.map(|t| host(t).unwrap()), &theirs.map(|t| host(t).unwrap()));

    let tensors: Vec<Tensor<1>> = [1, 300, 5_000, 200_000].map(|n| random([n], n as u64, &device)).into();
    let ours = host(sums_of_squares(&tensors).expect("a kernel")).unwrap();
    let square = |t: &Tensor<1>| host(t.clone()).unwrap().iter().map(|v| f64::from(*v).powi(2)).sum::<f64>() as f32;
    for (ours, theirs) in ours.iter().zip(tensors.iter().map(square)) {
        assert!((ours / theirs - 1.0).abs() < 1e-5, "{ours} {theirs}");
    }
    assert!(sums_of_squares(&[random([3], 1, &Device::flex())]).is_none());
}

#[test]
fn rows_go_to_their_places() {
    let Some(device) = gpu() else { return };
    let x: Tensor<2> = random([4, 3], 5, &device);
    let ints = |values: &[i32]| Cube::int_from_data(TensorData::new(values.to_vec(), [values.len()]), &x_device(&x));
    let placed = place_rows(&x.clone().try_into_primitive::<Cube>().unwrap(), [&ints(&[2, 0]), &ints(&[1, 5])], 7);
    let placed = host(Tensor::<2>::from_primitive::<Cube>(placed.expect("a kernel"))).unwrap();
    let x = host(x).unwrap();
    let mut want = vec![0.0; 21];
    want[3..6].copy_from_slice(&x[6..9]);
    want[15..18].copy_from_slice(&x[..3]);
    assert_eq!(placed, want);
}

fn x_device(x: &Tensor<2>) -> <Cube as burn::backend::BackendTypes>::Device {
    x.clone().try_into_primitive::<Cube>().unwrap().device
}
