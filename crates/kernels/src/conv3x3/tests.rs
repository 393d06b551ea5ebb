//! Comparison with the definition in f64.

use super::*;
use crate::reference::{assert_close, random};

/// y, dx, dw in f64.
pub(crate) fn reference(conv: &Conv3x3, x: &[f32], w: &[f32], dy: &[f32]) -> [Vec<f64>; 3] {
    let (mut y, mut dx, mut dw) = (vec![0.0; conv.y_len()], vec![0.0; x.len()], vec![0.0; w.len()]);
    let (ho, wo) = (conv.out_height(), conv.out_width());
    for n in 0..conv.batch {
        for (o, i) in (0..conv.outputs).flat_map(|o| (0..conv.inputs).map(move |i| (o, i))) {
            for (oy, ox) in (0..ho).flat_map(|oy| (0..wo).map(move |ox| (oy, ox))) {
                for tap in 0..9 {
                    let (iy, ix) = (oy * conv.stride + tap / 3, ox * conv.stride + tap % 3);
                    if iy == 0 || ix == 0 || iy > conv.height || ix > conv.width {
                        continue;
                    }
                    let xi = ((n * conv.inputs + i) * conv.height + iy - 1) * conv.width + ix - 1;
                    let yi = ((n * conv.outputs + o) * ho + oy) * wo + ox;
                    let wi = (o * conv.inputs + i) * 9 + tap;
                    y[yi] += x[xi] as f64 * w[wi] as f64;
                    dx[xi] += dy[yi] as f64 * w[wi] as f64;
                    dw[wi] += dy[yi] as f64 * x[xi] as f64;
                }
            }
        }
    }
    [y, dx, dw]
}

fn shapes() -> Vec<Conv3x3> {
    let mut all = Vec::new();
    for (batch, inputs, outputs, height, width) in [
        (1, 1, 1, 1, 1),
        (1, 1, 3, 2, 1),
        (2, 3, 2, 1, 5),
        (1, 5, 9, 7, 6),
        (3, 2, 8, 3, 3),
        (1, 9, 7, 5, 33),
        (2, 17, 20, 9, 35),
        (1, 4, 6, 12, 70),
        (1, 2, 2, 40, 1),
        (1, 16, 33, 27, 27),
    ] {
        for (stride, algorithm) in
            [(1, Algorithm::WinogradF2), (1, Algorithm::WinogradF4), (1, Algorithm::Direct), (2, Algorithm::default())]
        {
            all.push(Conv3x3 { batch, inputs, outputs, height, width, stride, algorithm });
        }
    }
    all
}

fn all_three(conv: &Conv3x3, x: &[f32], w: &[f32], dy: &[f32]) -> [Vec<f32>; 3] {
    let (mut y, mut dx) = (vec![7.0; 5], Vec::new());
    conv.forward(x, &conv.pack(w), Epilogue::default(), &mut y);
    conv.data_gradient(dy, w, &mut dx);
    [y, dx, conv.weight_gradient(x, dy)]
}

#[test]
fn equals_the_definition() {
    for conv in shapes() {
        let (x, w) = (random(conv.x_len(), 1), random(conv.weight_len(), 2));
        let dy = random(conv.y_len(), 3);
        let tolerance = if conv.algorithm == Algorithm::WinogradF4 { 2e-5 } else { 2e-6 };
        for (name, (got, want)) in
            ["y", "dx", "dw"].iter().zip(all_three(&conv, &x, &w, &dy).iter().zip(&reference(&conv, &x, &w, &dy)))
        {
            assert_close(got, want, tolerance, &format!("{name} of {conv:?}"));
        }
    }
}

/// Blocks of zeros are skipped, and others of the same image are not.
#[test]
fn images_that_are_mostly_zero() {
    for (height, width, few) in [(40, 70, 3), (9, 200, 1), (33, 33, 0)] {
        for (stride, algorithm) in
            [(1, Algorithm::WinogradF2), (1, Algorithm::WinogradF4), (1, Algorithm::Direct), (2, Algorithm::default())]
        {
            let conv = Conv3x3 { batch: 2, inputs: 3, outputs: 9, height, width, stride, algorithm };
            let mut x = vec![0.0; conv.x_len()];
            for k in 0..few {
                x[conv.x_len() / (k + 2) + 5] = 1.5 + k as f32;
            }
            let (w, dy) = (random(conv.weight_len(), 2), random(conv.y_len(), 3));
            let tolerance = if conv.algorithm == Algorithm::WinogradF4 { 2e-5 } else { 2e-6 };
            let [y, _, dw] = all_three(&conv, &x, &w, &dy);
            let [want_y, _, want_dw] = reference(&conv, &x, &w, &dy);
            if few == 0 {
                assert!(y.iter().chain(&dw).all(|v| *v == 0.0), "{conv:?}");
                continue;
            }
            assert_close(&y, &want_y, tolerance, &format!("y of {conv:?}"));
            assert_close(&dw, &want_dw, tolerance, &format!("dw of {conv:?}"));
            assert!(want_y.iter().filter(|v| **v == 0.0).count() > want_y.len() / 2);
        }
    }
}

#[test]
fn the_result_is_bit_equal_for_any_number_of_threads() {
    for algorithm in [Algorithm::WinogradF2, Algorithm::WinogradF4, Algorithm::Direct] {
        for stride in [1, 2] {
            let conv = Conv3x3 { batch: 2, inputs: 12, outputs: 20, height: 50, width: 61, stride, algorithm };
            let (x, w) = (random(conv.x_len(), 4), random(conv.weight_len(), 5));
            let dy = random(conv.y_len(), 6);
            crate::reference::assert_same_for_threads(|| all_three(&conv, &x, &w, &dy));
        }
    }
}

#[test]
fn bias_and_relu_behind_the_sum() {
    for conv in shapes() {
        let (x, w, bias) = (random(conv.x_len(), 1), random(conv.weight_len(), 2), random(conv.outputs, 3));
        let mut plain = Vec::new();
        let mut both = Vec::new();
        conv.forward(&x, &conv.pack(&w), Epilogue::default(), &mut plain);
        conv.forward(&x, &conv.pack(&w), Epilogue { bias: Some(&bias), relu: true }, &mut both);
        let plane = conv.out_height() * conv.out_width();
        for (i, (&a, &b)) in plain.iter().zip(&both).enumerate() {
            assert_eq!((a + bias[i / plane % conv.outputs]).max(0.0), b);
        }
    }
}

#[test]
fn nan_propagates() {
    for conv in shapes() {
        let (mut x, w) = (random(conv.x_len(), 1), random(conv.weight_len(), 2));
        let mut dy = random(conv.y_len(), 3);
        (x[conv.x_len() / 2], dy[conv.y_len() / 2]) = (f32::NAN, f32::NAN);
        for (got, want) in all_three(&conv, &x, &w, &dy).iter().zip(&reference(&conv, &x, &w, &dy)) {
            assert!(want.iter().any(|v| v.is_nan()));
            assert!(got.iter().zip(want).all(|(got, want)| got.is_nan() || !want.is_nan()), "{conv:?}");
        }
        let mut y = Vec::new();
        conv.forward(&x, &conv.pack(&w), Epilogue { bias: None, relu: true }, &mut y);
        assert!(y.iter().any(|v| v.is_nan()), "a ReLU propagates NaN");
    }
}

/// The bits of the gradient at all pixels.
#[test]
fn gradient_at_some_pixels() {
    for conv in shapes().into_iter().filter(|conv| conv.stride == 2) {
        let (w, dy) = (random(conv.weight_len(), 2), random(conv.y_len(), 3));
        let pixels = conv.height * conv.width;
        let (mut all, mut at) = (Vec::new(), vec![7.0; 5]);
        conv.data_gradient(&dy, &w, &mut all);
        for step in [1, 3, conv.batch * pixels + 1] {
            // Falling, so that they are not sorted.
            let cells: Vec<u32> = (0..(conv.batch * pixels) as u32).rev().step_by(step).collect();
            conv.data_gradient_at(&dy, &w, &cells, &mut at);
            let of_cell = |&cell: &u32| {
                let first = cell as usize / pixels * conv.inputs * pixels + cell as usize % pixels;
                (0..conv.inputs).map(move |channel| first + channel * pixels)
            };
            let want: Vec<f32> = cells.iter().flat_map(of_cell).map(|place| all[place]).collect();
            assert!(at == want, "{conv:?}, every {step} pixel");
            crate::reference::assert_same_for_threads(|| {
                let mut at = Vec::new();
                conv.data_gradient_at(&dy, &w, &cells, &mut at);
                [at]
            });
        }
        conv.data_gradient_at(&dy, &w, &[], &mut at);
        assert!(at.is_empty());
    }
}

#[test]
fn an_empty_batch_is_empty() {
    for stride in [1, 2] {
        let conv = Conv3x3 { batch: 0, inputs: 3, outputs: 2, height: 4, width: 4, stride, ..shapes()[0] };
        let w = random(conv.weight_len(), 2);
        let [y, dx, dw] = all_three(&conv, &[], &w, &[]);
        assert_eq!((y.len(), dx.len()), (0, 0));
        assert!(dw.len() == 54 && dw.iter().all(|&v| v == 0.0));
    }
}
