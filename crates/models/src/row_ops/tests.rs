use super::*;
use crate::layers::host;
use crate::tests::{self, devices};
use burn::tensor::{Device, Int, TensorData};

/// Random rows, the same on every device, with a gradient.
fn rows(shape: [usize; 2], device: &Device) -> Tensor<2> {
    tests::random(shape, 3, &device.clone().autodiff()).require_grad()
}

/// Values, and the gradient by `x` of a sum of squares.
fn facts(x: &Tensor<2>, y: Tensor<2>) -> [Vec<f32>; 2] {
    let gradients = (y.clone() * y.clone()).sum().backward();
    [host(y).unwrap(), host(x.grad(&gradients).unwrap()).unwrap()]
}

#[track_caller]
fn assert_close(what: &str, ours: &[Vec<f32>; 2], theirs: &[Vec<f32>; 2]) {
    for (ours, theirs) in ours.iter().zip(theirs) {
        assert_eq!(ours.len(), theirs.len(), "{what}");
        let apart = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs() / (1.0 + b.abs())).fold(0.0, f32::max);
        assert!(apart < 1e-5, "{what}: {apart}");
    }
}

/// A row of zeros, as an operation with a gradient of its own.
fn with_zeros(x: &Tensor<2>) -> Tensor<2> {
    let [_, channels] = x.dims();
    Tensor::cat(vec![x.clone(), Tensor::zeros([1, channels], &x.device())], 0)
}

fn index(count: u32, inputs: u32) -> Vec<u32> {
    let of = |i: u32| (i.wrapping_mul(2_654_435_761) >> 9) % (inputs + 1);
    (0..count).map(of).map(|i| if i == inputs { ZERO } else { i }).collect()
}

#[test]
fn gathers_equal_selects_with_their_gradients() {
    for (name, device) in devices() {
        for (inputs, count, channels) in [(1, 3, 2), (7, 5, 3), (20, 900, 5), (3, 700, 1), (900, 20, 4)] {
            let (x, index) = (rows([inputs, channels], &device), index(count, inputs as u32));
            let places: Vec<i32> = index.iter().map(|&i| if i == ZERO { inputs as i32 } else { i as i32 }).collect();
            let flex = rows([inputs, channels], &Device::flex());
            let places = Tensor::<1, Int>::from_data(TensorData::new(places, [count as usize]), &flex.device());
            let theirs = facts(&flex, with_zeros(&flex).select(0, places));
            let ours = || facts(&x, gather(x.clone(), &index.clone().into()));
            assert_close(&format!("{name}: {count} of {inputs}"), &ours(), &theirs);
            assert_eq!(ours(), ours(), "{name}: the same bits");
        }
    }
}

#[test]
fn nothing_to_gather() {
    for (name, device) in devices() {
        let x = rows([4, 3], &device);
        let y = gather(x.clone(), &Arc::from([ZERO; 2]));
        assert_eq!(host(y).unwrap(), [0.0; 6], "{name}");
        let none = gather(x.clone(), &Arc::from([]));
        assert_eq!(none.dims(), [0, 3], "{name}");
        assert_eq!(group_max(x, &Arc::new(RowGroups::new(&[]))).dims(), [0, 3], "{name}");
    }
}

#[test]
#[should_panic(expected = "an index is not below 4")]
fn an_index_out_of_range() {
    gather(rows([4, 3], &Device::flex()), &Arc::from([0, 4]));
}

#[test]
fn maxima_equal_those_of_the_padded_form_with_their_gradients() {
    let ends = [1u32, 4, 5, 12, 13, 33];
    let groups = Arc::new(RowGroups::new(&ends));
    for (name, device) in devices() {
        // Three rows at the end belong to no group.
        let (x, flex) = (rows([36, 6], &device), rows([36, 6], &Device::flex()));
        let mut begin = 0;
        let of_group = |&end: &u32| {
            let begin = std::mem::replace(&mut begin, end) as usize;
            flex.clone().narrow(0, begin, end as usize - begin).max_dim(0)
        };
        let theirs = facts(&flex, Tensor::cat(ends.iter().map(of_group).collect(), 0));
        assert_close(name, &facts(&x, group_max(x.clone(), &groups)), &theirs);
    }
}

/// Equal rows are common behind a ReLU: one of them gets the gradient, not all.
#[test]
fn the_gradient_of_equal_maxima_goes_to_one_row() {
    for (name, device) in devices() {
        let x = Tensor::<2>::zeros([7, 2], &device.autodiff()).require_grad();
        let y = group_max(x.clone(), &Arc::new(RowGroups::new(&[2, 7])));
        let gradient = host(x.grad(&y.sum().backward()).unwrap()).unwrap();
        let sum = |rows: std::ops::Range<usize>, c: usize| rows.map(|r| gradient[r * 2 + c]).sum::<f32>();
        for c in 0..2 {
            assert_eq!([sum(0..2, c), sum(2..7, c)], [1.0, 1.0], "{name}: {gradient:?}");
        }
    }
}

#[test]
fn values_that_are_no_numbers_stay_where_they_are() {
    for (name, device) in devices() {
        let device = device.autodiff();
        let x = Tensor::<2>::from_floats([[1.0], [f32::NAN], [2.0]], &device).require_grad();
        let y = host(gather(x.clone(), &Arc::from([0, 1, ZERO, 2]))).unwrap();
        assert!(y[1].is_nan() && [y[0], y[2], y[3]] == [1.0, 0.0, 2.0], "{name}: {y:?}");
        let weights = Tensor::<2>::from_floats([[f32::NAN], [1.0], [1.0], [3.0]], &device);
        let y = gather(x.clone(), &Arc::from([0, 1, ZERO, 2])) * weights;
        let gradient = host(x.grad(&y.sum().backward()).unwrap()).unwrap();
        assert!(gradient[0].is_nan() && gradient[1..] == [1.0, 3.0], "{name}: {gradient:?}");
    }
}

/// Without an autodiff graph.
#[test]
fn inference() {
    for (name, device) in devices() {
        let x = rows([5, 2], &device).inner();
        let want = host(x.clone()).unwrap();
        let y = host(gather(x.clone(), &Arc::from([4, 0]))).unwrap();
        assert_eq!(y, [&want[8..], &want[..2]].concat(), "{name}");
        let y = host(group_max(x, &Arc::new(RowGroups::new(&[1, 5])))).unwrap();
        assert_eq!(y[..2], want[..2], "{name}");
    }
}
