//! Values and gradients of every kernel against those of burn's operations.

use super::*;
use crate::layers::{BatchNorm, Init, Mode, RowCounts, RowsBnRelu, rows_kernel};
use crate::point_ops::{Groups, group_max};
use crate::row_ops;
use burn::module::Module;
use burn::tensor::Device;
use burn::tensor::activation::relu;
use burn::tensor::module::{conv_transpose2d, conv2d};
use burn::tensor::ops::{ConvOptions, ConvTransposeOptions};
use std::sync::Arc;

fn device() -> Device {
    Device::flex().autodiff()
}

/// Values between -1 and 1, determined by the seed.
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
    let largest = theirs.iter().fold(0.5f32, |m, v| m.max(v.abs()));
    let apart = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    assert!(ours.len() == theirs.len() && apart <= 2e-5 * largest, "{what}: {apart} of {largest}");
}

/// Compares values and the gradients of a randomly weighted sum with respect to all inputs.
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
    assert!(
        transposed(&random([1, 1, 2, 2], 1), &random([1, 1, 3, 3], 1), 3).is_none(),
        "there is no kernel for stride 3"
    );
}

#[test]
fn convolution_of_pillars() {
    for (cells, canvas) in [(vec![7u32, 2, 13, 12, 40], [2, 4, 6]), (vec![0], [1, 3, 5]), (vec![14, 4], [1, 3, 5])] {
        let (features, w) = (random([cells.len(), 3], 20), random([4, 3, 3, 3], 21));
        let ours = pillar_conv(&features, &cells, canvas, &w).unwrap();
        let theirs = conv3x3(&scatter(&features, &cells, canvas).unwrap(), &w, 2).unwrap();
        check!(format!("pillars, {canvas:?}"), [features, w], ours, theirs);
        assert!(pillar_conv(&features.inner(), &cells, canvas, &w.inner()).is_none(), "inference folds the norm");
    }
}

#[test]
fn heads_of_an_image() {
    for shape in [[2, 6, 5, 3], [1, 1, 1, 1], [1, 40, 20, 19]] {
        let (x, channels) = (random(shape, 5), shape[1]);
        let (w1, b1) = (random([4, channels, 1, 1], 6), random([4], 7));
        let (w2, b2) = (random([7, channels, 1, 1], 8), random([7], 9));
        let ours = Tensor::cat(pixel_heads(&x, [(&w1, &b1), (&w2, &b2)]).unwrap().to_vec(), 1);
        let burns = |w: &Tensor<4>, b: &Tensor<1>| {
            let y = conv2d(x.clone(), w.clone(), Some(b.clone()), ConvOptions::new([1, 1], [0, 0], [1, 1], 1));
            let [n, k, h, w] = y.dims();
            y.permute([0, 2, 3, 1]).reshape([n * h * w, k])
        };
        let theirs = Tensor::cat(vec![burns(&w1, &b1), burns(&w2, &b2)], 1);
        check!(format!("heads, {shape:?}"), [x, w1, b1, w2, b2], ours, theirs);
    }
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

/// Groups of 1 to `largest` rows gathered from `points` points; rows that the reference repeats have a multiplicity
/// above 1.
fn groups(count: usize, largest: usize, points: usize) -> Groups {
    let mut groups = Groups::default();
    let mut row = 0;
    for g in 0..count {
        let slots = (0..1 + g * 5 % largest).map(|_| {
            row += 1;
            let at = values(3, row as u32);
            ((row * 7 % points) as u32, [at[0], at[1], at[2]])
        });
        groups.push([0.1, -0.2, 0.3], slots, (1 + g % 3) as f32);
    }
    groups
}

/// Layers with the names that key their initial weights.
fn mlp(channels: &[usize]) -> Vec<RowsBnRelu<4>> {
    let device = device();
    let init = Init { seed: 3, device: &device };
    let layer = |(l, c): (usize, &[usize])| {
        let mut norm = BatchNorm::new(c[1], 0.1, 1e-5, &init);
        norm.weight = init.uniform(&format!("{l}.gamma"), [c[1]], 1);
        norm.bias = init.uniform(&format!("{l}.beta"), [c[1]], 1);
        RowsBnRelu::new(&format!("{l}.weight"), [c[0], c[1]], norm, &init)
    };
    channels.windows(2).enumerate().map(layer).collect()
}

/// Compares both implementations of a net: values, gradients with respect to rows and parameters, running statistics.
fn check_mlp(
    what: &str,
    channels: &[usize],
    rows: Tensor<2>,
    ours: impl Fn(&[RowsBnRelu<4>], Tensor<2>) -> Option<Tensor<2>>,
    theirs: impl Fn(&[RowsBnRelu<4>], Tensor<2>) -> Tensor<2>,
) {
    let (a, b) = (mlp(channels), mlp(channels));
    let (mine, burns) = (ours(&a, rows.clone()).unwrap(), theirs(&b, rows.clone()));
    assert_eq!(mine.dims(), burns.dims(), "{what}");
    assert_close(&format!("{what}: values"), &host(mine.clone()), &host(burns.clone()));
    let weights = random(burns.dims(), 99).detach();
    let gradients = ((mine * weights.clone()).sum().backward(), (burns * weights).sum().backward());
    let close = |name: &str, mine: Option<Vec<f32>>, burns: Option<Vec<f32>>| {
        assert_close(&format!("{what}: {name}"), &mine.unwrap(), &burns.unwrap());
    };
    close("gradient with respect to the rows", rows.grad(&gradients.0).map(host), rows.grad(&gradients.1).map(host));
    for (l, (a, b)) in a.iter().zip(&b).enumerate() {
        let gradient = |layer: &RowsBnRelu<4>, from| layer.weight.val().grad(from).map(host);
        close(&format!("weight {l}"), gradient(a, &gradients.0), gradient(b, &gradients.1));
        for (name, a, b) in [("gamma", &a.norm.weight, &b.norm.weight), ("beta", &a.norm.bias, &b.norm.bias)] {
            close(&format!("{name} {l}"), a.val().grad(&gradients.0).map(host), b.val().grad(&gradients.1).map(host));
        }
        for (a, b) in [(&a.norm.running_mean, &b.norm.running_mean), (&a.norm.running_var, &b.norm.running_var)] {
            close(&format!("statistics {l}"), Some(host(a.value())), Some(host(b.value())));
        }
    }
}

#[test]
fn shared_mlp_over_groups_of_neighbours() {
    for (count, largest, channels) in
        [(1, 1, vec![7, 5, 3]), (9, 7, vec![5, 9, 17]), (60, 33, vec![19, 16, 16, 33]), (500, 4, vec![4, 32, 40, 64])]
    {
        let groups = Arc::new(groups(count, largest, 11));
        let (on_device, features) = (groups.to_device(&device()), random([11, channels[0] - 3], 21));
        let ours = |layers: &[RowsBnRelu<4>], x: Tensor<2>| {
            let rows = MlpRows::Gathered(layers[0].project(x, 3));
            rows_kernel(layers, &rows, Some(&groups), Mode::Train)
        };
        let theirs = |layers: &[RowsBnRelu<4>], x: Tensor<2>| {
            let y = layers[0].project(on_device.offset.clone(), 0);
            let y = y + row_ops::gather(layers[0].project(x, 3), &on_device.source);
            let x = layers[0].norm_relu(y, &on_device.counts, Mode::Train);
            group_max(layers[1..].iter().fold(x, |x, l| l.forward(x, &on_device.counts, Mode::Train)), &on_device)
        };
        check_mlp(&format!("gathered, {channels:?}"), &channels, features, ours, theirs);

        let channels = [&[3], &channels[1..]].concat();
        let ours = |layers: &[RowsBnRelu<4>], x| rows_kernel(layers, &MlpRows::Rows(x), Some(&groups), Mode::Train);
        let theirs = |layers: &[RowsBnRelu<4>], x: Tensor<2>| {
            let [n, filled] = [x.dims()[0], on_device.offset.dims()[0]];
            let x = Tensor::cat(vec![x, Tensor::zeros([filled - n, 3], &device())], 0);
            group_max(layers.iter().fold(x, |x, l| l.forward(x, &on_device.counts, Mode::Train)), &on_device)
        };
        check_mlp(&format!("rows, {channels:?}"), &channels, groups.offsets(&device()).require_grad(), ours, theirs);
    }
}

#[test]
fn shared_mlp_over_single_rows() {
    for (rows, channels) in [(2, vec![1, 1]), (3, vec![5, 7, 2]), (300, vec![17, 33, 16]), (1030, vec![6, 8, 9, 10])] {
        let counts = RowCounts::once(rows, &device());
        let all = |layers: &[RowsBnRelu<4>], x| layers.iter().fold(x, |x, l| l.forward(x, &counts, Mode::Train));
        let ours = |layers: &[RowsBnRelu<4>], x| rows_kernel(layers, &MlpRows::Rows(x), None, Mode::Train);
        check_mlp(&format!("{rows} rows, {channels:?}"), &channels, random([rows, channels[0]], 22), ours, all);
        let ours = |layers: &[RowsBnRelu<4>], x| {
            rows_kernel(layers, &MlpRows::Projected(layers[0].project(x, 0)), None, Mode::Train)
        };
        check_mlp(&format!("{rows} projected, {channels:?}"), &channels, random([rows, channels[0]], 23), ours, all);
    }
}

#[test]
fn shared_mlp_at_inference() {
    let layers = mlp(&[6, 9, 5]);
    let layers: Vec<_> = layers.into_iter().map(|layer| layer.valid()).collect();
    let (device, groups) = (Device::flex(), Arc::new(groups(20, 6, 11)));
    let features = random([11, 3], 24).inner();
    let ours = MlpRows::Gathered(layers[0].project(features.clone(), 3));
    let ours = rows_kernel(&layers, &ours, Some(&groups), Mode::Eval).unwrap();
    let on_device = groups.to_device(&device);
    let y = layers[0].project(on_device.offset.clone(), 0)
        + row_ops::gather(layers[0].project(features, 3), &on_device.source);
    let x = layers[0].norm_relu(y, &on_device.counts, Mode::Eval);
    let theirs = group_max(layers[1].forward(x, &on_device.counts, Mode::Eval), &on_device);
    assert_close("inference", &host(ours), &host(theirs));
}

#[test]
fn shared_mlp_without_rows_and_with_what_is_no_number() {
    let layers = mlp(&[4, 6, 5]);
    let none = |groups: Option<&Arc<Groups>>, rows| rows_kernel(&layers, &rows, groups, Mode::Train).unwrap();
    let empty = || Tensor::<2>::zeros([0, 4], &device());
    assert_eq!(none(None, MlpRows::Rows(empty())).dims(), [0, 5]);
    assert_eq!(none(Some(&Arc::new(Groups::default())), MlpRows::Rows(empty())).dims(), [0, 5]);

    let mut features = values(11 * 6, 25);
    features[8] = f32::NAN;
    let features = Tensor::<2>::from_data(TensorData::new(features, [11, 6]), &device()).require_grad();
    let y = none(Some(&Arc::new(groups(20, 6, 11))), MlpRows::Gathered(features.clone()));
    assert!(host(y.clone()).iter().all(|v| v.is_nan()));
    let gradient = host(features.grad(&y.sum().backward()).unwrap());
    assert!(gradient.iter().any(|v| v.is_nan()));
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
fn focal_loss_of_heat_maps() {
    let logits = Tensor::<4>::from_data(TensorData::new(values(120, 17), [2, 3, 4, 5]), &device()) * 11.0;
    let logits = logits.detach().require_grad();
    let heat_map: Vec<f32> = values(120, 18).iter().map(|&v| if v > 0.7 { 1.0 } else { v.max(0.0) }).collect();
    let ours = gaussian_focal_loss(&logits, &heat_map, 0.25).unwrap();
    let theirs = {
        let p = burn::tensor::activation::sigmoid(logits.clone()).clamp(1e-4, 1.0 - 1e-4);
        let h = Tensor::<4>::from_data(TensorData::new(heat_map, [2, 3, 4, 5]), &device());
        let q = -p.clone() + 1.0;
        let is_peak = h.clone().equal_elem(1.0).float();
        let peak = p.clone().log() * q.clone().powi_scalar(2) * is_peak.clone();
        let other = q.log() * p.powi_scalar(2) * (-h + 1.0).powi_scalar(4) * (-is_peak + 1.0);
        (peak + other).sum() * -0.25
    };
    check!("focal loss of heat maps", [logits], ours, theirs);
}

#[test]
fn appended_maximum() {
    let groups = Arc::new(groups(9, 7, 11));
    let x = random([groups.source.len(), 5], 19);
    let on_device = groups.to_device(&device());
    let of_row: Vec<u32> = {
        let mut begin = 0;
        let of_group = |(g, &end): (usize, &u32)| vec![g as u32; (end - std::mem::replace(&mut begin, end)) as usize];
        groups.ends.iter().enumerate().flat_map(of_group).collect()
    };
    let of_row = row_ops::gather(group_max(x.clone(), &on_device), &of_row.into());
    let theirs = Tensor::cat(vec![x.clone(), of_row], 1);
    check!("appended maximum", [x], append_maximum(&x, &groups).unwrap(), theirs);
}

#[test]
fn nan_propagates() {
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
    #[expect(deprecated, reason = "supported as long as burn has it")]
    let elsewhere = Device::ndarray();
    let tensor = |shape: [usize; 4]| Tensor::<4>::zeros(shape, &elsewhere);
    assert!(conv3x3(&tensor([1, 1, 4, 4]), &tensor([1, 1, 3, 3]), 1).is_none());
}
