//! Durations of the slowest layers of PointPillars.

use super::{Timed, WARM_UP};
use anyhow::Result;
use kernels::{Algorithm, Conv3x3, Epilogue, PillarNet, PillarParameters, Pillars};
use models::config::DetectorConfig;
use models::pointpillars::PointPillarsConfig;
use models::{NetworkSample, Sample};
use rand::{Rng, RngExt};
use std::hint::black_box;
use std::time::Instant;

/// The backbone's 3x3 convolutions with stride 1: forward, gradient with respect to the input, gradient with respect to
/// the weights.
pub(super) fn convolutions(network: &PointPillarsConfig, config: &DetectorConfig, batch: usize, steps: usize) -> Timed {
    let mut random = data::stream(0, "bench convolutions", 0, 0);
    let extent = |i: usize| f64::from(config.range_m[3 + i] - config.range_m[i]) / f64::from(network.pillars.size_m[i]);
    let (mut width, mut height) = (extent(0).round() as usize, extent(1).round() as usize);
    let backbone = &network.backbone;
    let mut convs = Vec::new();
    for (i, &channels) in backbone.filters.iter().enumerate() {
        (width, height) = (width.div_ceil(backbone.strides[i]), height.div_ceil(backbone.strides[i]));
        let (inputs, outputs, algorithm) = (channels, channels, Algorithm::default());
        let conv = Conv3x3 { batch, inputs, outputs, height, width, stride: 1, algorithm };
        let values = [conv.x_len(), conv.weight_len(), conv.y_len()].map(|n| uniform(n, &mut random));
        convs.push((conv, backbone.layers[i], values));
    }
    let (mut y, mut dx) = (Vec::new(), Vec::new());
    let mut timed = Timed::default();
    for step in 0..steps + WARM_UP {
        let mut ms = [0.0; 3];
        for (conv, count, [x, weight, dy]) in &convs {
            for _ in 0..*count {
                ms[0] += time(|| conv.forward(x, &conv.pack(weight), Epilogue::default(), &mut y));
                ms[1] += time(|| conv.data_gradient(dy, weight, &mut dx));
                ms[2] += time(|| conv.weight_gradient(x, dy));
            }
        }
        let [forward, by_data, by_weights] = ms;
        timed.add(
            step,
            vec![("forward", forward), ("by data", by_data), ("by weights", by_weights), ("whole", ms.iter().sum())],
        );
    }
    timed
}

/// The pillar feature net on the pillars of a batch, forward and backward.
pub(super) fn pillar_net(network: &PointPillarsConfig, batch: &[Sample], steps: usize) -> Result<Timed> {
    let mut random = data::stream(0, "bench pillar net", 0, 0);
    let of_pillars = batch.iter().filter_map(|sample| match &sample.network {
        NetworkSample::PointPillars(sample) => Some(sample),
        _ => None,
    });
    let features: Vec<f32> = of_pillars.clone().flat_map(|s| s.input.features.iter().copied()).collect();
    let num_points: Vec<u32> = of_pillars.flat_map(|s| s.input.pillars.num_points.iter().copied()).collect();
    let points = num_points.iter().sum::<u32>() as usize;
    let outputs = network.vfe_filters;
    let inputs = features.len() / points.max(1);
    let net = PillarNet { inputs, outputs, max_points: network.pillars.max_points, epsilon: 1e-3 };
    let weight = uniform(outputs * inputs, &mut random);
    let (gamma, beta) = (vec![1.0; outputs], vec![0.0; outputs]);
    let dout = uniform(num_points.len() * outputs, &mut random);
    let pillars = Pillars { features: &features, num_points: &num_points };
    let parameters = PillarParameters { weight: &weight, gamma: &gamma, beta: &beta };
    let mut out = Vec::new();
    let mut timed = Timed { read: [points, num_points.len()], ..Timed::default() };
    for step in 0..steps + WARM_UP {
        let mut state = None;
        let forward = time(|| state = Some(net.forward_train(pillars, parameters, &mut out)));
        let backward = time(|| state.as_ref().map(|state| net.backward(pillars, parameters, state, &dout)));
        timed.add(step, vec![("forward", forward), ("backward", backward), ("whole", forward + backward)]);
    }
    Ok(timed)
}

fn time<R>(work: impl FnOnce() -> R) -> f64 {
    let begin = Instant::now();
    black_box(work());
    1e3 * begin.elapsed().as_secs_f64()
}

fn uniform(n: usize, random: &mut impl Rng) -> Vec<f32> {
    (0..n).map(|_| random.random_range(-1.0..1.0)).collect()
}
