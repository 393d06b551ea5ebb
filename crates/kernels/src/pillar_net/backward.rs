//! Gradients with respect to the parameters of the pillar feature net.

use super::{MOST_INPUTS, NOWHERE, PADDING, PARTS, PillarGradients, PillarNet, PillarParameters, PillarState};
use crate::simd::vectorized;
use rayon::prelude::*;

/// Over the rows selected by the maximum: the sum of the gradient, and of the gradient times the row.
#[derive(Clone, Copy)]
struct Taken {
    sum: f64,
    products: [f64; MOST_INPUTS],
}

const NONE: Taken = Taken { sum: 0.0, products: [0.0; MOST_INPUTS] };

pub(super) fn backward(
    net: &PillarNet,
    features: &[f32],
    starts: &[usize],
    parameters: PillarParameters<'_>,
    state: &PillarState,
    dout: &[f32],
) -> PillarGradients {
    let taken = taken(net, features, starts, &state.argmax, dout);
    let mut gradients = PillarGradients { weight: Vec::new(), gamma: Vec::new(), beta: Vec::new() };
    let n = state.count as f64;
    for (channel, taken) in taken.iter().enumerate() {
        let weight = &parameters.weight[channel * net.inputs..][..net.inputs];
        let mean = state.statistics.mean[channel];
        let inverse = 1.0 / (state.statistics.variance[channel] + net.epsilon).sqrt();
        let scale = parameters.gamma[channel] as f64 * inverse;
        // Sum of the gradient times the normalised value of its row.
        let along: f64 = weight.iter().zip(taken.products).map(|(&w, p)| w as f64 * p).sum();
        let gamma = (along - mean * taken.sum) * inverse;
        gradients.gamma.push(gamma as f32);
        gradients.beta.push(taken.sum as f32);
        let products = state.moments.products_along(weight);
        gradients.weight.extend((0..net.inputs).map(|k| {
            if state.count == 0 {
                return 0.0;
            }
            // Sum over all rows of the normalised value times x_k; the padding has x = 0.
            let normalised = inverse * (products[k] - mean * state.moments.sum[k]);
            (scale * (taken.products[k] - taken.sum / n * state.moments.sum[k] - gamma / n * normalised)) as f32
        }));
    }
    gradients
}

/// Sums per channel.
fn taken(net: &PillarNet, features: &[f32], starts: &[usize], argmax: &[u32], dout: &[f32]) -> Vec<Taken> {
    let mut total = vec![NONE; net.outputs];
    if argmax.is_empty() {
        return total;
    }
    let pillars_a_part = (starts.len() - 1).div_ceil(PARTS);
    let elements = pillars_a_part * net.outputs;
    let parts: Vec<Vec<Taken>> = argmax
        .par_chunks(elements)
        .zip(dout.par_chunks(elements))
        .enumerate()
        .map(|(part, (argmax, dout))| {
            let starts = &starts[part * pillars_a_part..];
            vectorized(|| taken_by_part(net, features, starts, argmax, dout))
        })
        .collect();
    for part in &parts {
        for (total, part) in total.iter_mut().zip(part) {
            total.sum += part.sum;
            for (total, part) in total.products.iter_mut().zip(part.products) {
                *total += part;
            }
        }
    }
    total
}

#[inline(always)]
fn taken_by_part(net: &PillarNet, features: &[f32], starts: &[usize], argmax: &[u32], dout: &[f32]) -> Vec<Taken> {
    let mut taken = vec![NONE; net.outputs];
    let mut rows = vec![[0.0; MOST_INPUTS]; net.max_points];
    let pillars = argmax.chunks_exact(net.outputs).zip(dout.chunks_exact(net.outputs));
    for (ends, (argmax, dout)) in starts.windows(2).zip(pillars) {
        let points = features[ends[0] * net.inputs..ends[1] * net.inputs].chunks_exact(net.inputs);
        for (row, point) in rows.iter_mut().zip(points) {
            for (to, &value) in row.iter_mut().zip(point) {
                *to = value as f64;
            }
        }
        for ((taken, &place), &gradient) in taken.iter_mut().zip(argmax).zip(dout) {
            if place == NOWHERE {
                continue;
            }
            taken.sum += gradient as f64;
            if place != PADDING {
                let row = &rows[place as usize - ends[0]];
                for k in 0..MOST_INPUTS {
                    taken.products[k] += gradient as f64 * row[k];
                }
            }
        }
    }
    taken
}
