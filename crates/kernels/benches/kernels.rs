//! Times of the kernels at the sizes of the published PointPillars, batch 1: median and minimum of several runs, ms.
//!
//! Arguments select benchmarks by parts of their names: `cargo bench -p lidarshift-kernels -- conv stride2`.

#![expect(clippy::print_stdout, reason = "results go to stdout")]

use lidarshift_kernels::{
    Algorithm, BatchNorm, Conv3x3, Epilogue, InstructionSet, PillarNet, PillarParameters, Pillars, PixelHeads,
    TransposedConv,
};
use std::hint::black_box;
use std::time::Instant;

const RUNS: usize = 9;

struct Bench {
    wanted: Vec<String>,
}

impl Bench {
    fn time(&self, name: &str, operations: f64, mut work: impl FnMut()) {
        if !self.wanted.is_empty() && !self.wanted.iter().any(|w| name.contains(w.as_str())) {
            return;
        }
        work();
        let mut times_ms: Vec<f64> = (0..RUNS)
            .map(|_| {
                let start = Instant::now();
                work();
                start.elapsed().as_secs_f64() * 1e3
            })
            .collect();
        times_ms.sort_by(f64::total_cmp);
        let rate =
            if operations > 0.0 { format!("{:6.0} GFLOP/s", operations / times_ms[0] / 1e6) } else { String::new() };
        println!("{name:60} {:8.2} {:8.2}  {rate}", times_ms[RUNS / 2], times_ms[0]);
    }
}

fn values(n: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let next = |_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    (0..n).map(next).collect()
}

fn convolutions(bench: &Bench) {
    for (inputs, outputs, height, width, stride) in [
        (64, 64, 248, 216, 1),
        (128, 128, 124, 108, 1),
        (256, 256, 62, 54, 1),
        (64, 64, 496, 432, 2),
        (64, 128, 248, 216, 2),
        (128, 256, 124, 108, 2),
    ] {
        for algorithm in [Algorithm::WinogradF2, Algorithm::WinogradF4, Algorithm::Direct] {
            if stride == 2 && algorithm != Algorithm::Direct {
                continue;
            }
            let conv = Conv3x3 { batch: 1, inputs, outputs, height, width, stride, algorithm };
            let (x, w, dy) = (values(conv.x_len(), 1), values(conv.weight_len(), 2), values(conv.y_len(), 3));
            let operations = 2.0 * (conv.y_len() * inputs * 9) as f64;
            let (mut y, mut dx) = (Vec::new(), Vec::new());
            let name = |what: &str| {
                format!("conv3x3 {inputs}->{outputs} {height}x{width} stride{stride} {algorithm:?} {what}")
            };
            bench.time(&name("forward"), operations, || {
                conv.forward(&x, &conv.pack(&w), Epilogue::default(), &mut y);
            });
            bench.time(&name("data"), operations, || conv.data_gradient(&dy, &w, &mut dx));
            bench.time(&name("weight"), operations, || {
                black_box(conv.weight_gradient(&x, &dy));
            });
            if algorithm != Algorithm::Direct {
                bench.time(&name("pack"), 0.0, || {
                    black_box(conv.pack(&w));
                });
            }
        }
    }
}

fn products(bench: &Bench) {
    for (inputs, height, width, stride) in [(64, 248, 216, 1), (128, 124, 108, 2), (256, 62, 54, 4)] {
        let conv = TransposedConv { batch: 1, inputs, outputs: 128, height, width, stride };
        let (x, w, dy) = (values(conv.x_len(), 1), values(conv.weight_len(), 2), values(conv.y_len(), 3));
        let operations = 2.0 * (conv.y_len() * inputs) as f64;
        let (mut y, mut dx) = (Vec::new(), Vec::new());
        let name = |what: &str| format!("transposed {inputs}->128 {height}x{width} stride{stride} {what}");
        bench.time(&name("forward"), operations, || conv.forward(&x, &conv.pack(&w), Epilogue::default(), &mut y));
        bench.time(&name("data"), operations, || conv.data_gradient(&dy, &w, &mut dx));
        bench.time(&name("weight"), operations, || {
            black_box(conv.weight_gradient(&x, &dy));
        });
    }
    let heads = PixelHeads { batch: 1, inputs: 384, pixels: 248 * 216, outputs: vec![18, 42, 12] };
    let (x, w, dy) = (values(384 * heads.pixels, 1), values(384 * 72, 2), values(72 * heads.pixels, 3));
    let operations = 2.0 * (heads.pixels * 384 * 72) as f64;
    let (bias, mut y) = (values(72, 4), Vec::new());
    bench.time("heads 384->18, 42, 12 248x216 forward", operations, || heads.forward(&x, &w, &bias, &mut y));
    bench.time("heads 384->18, 42, 12 248x216 backward", 2.0 * operations, || {
        black_box(heads.backward(&x, &w, &dy));
    });
}

fn norms(bench: &Bench) {
    for (batch, channels, pixels) in [(1, 64, 248 * 216), (1, 128, 124 * 108), (1, 256, 62 * 54), (16384, 256, 1)] {
        let norm = BatchNorm { batch, channels, pixels, epsilon: 1e-3, relu: true };
        let (x, dy) = (values(norm.len(), 1), values(norm.len(), 2));
        let (gamma, beta) = (vec![1.0; channels], vec![0.1; channels]);
        let (mut y, mut dx) = (Vec::new(), Vec::new());
        let statistics = norm.forward_train(&x, &gamma, &beta, &mut y);
        let name = |what: &str| format!("batch norm [{batch}, {channels}, {pixels}] {what}");
        bench.time(&name("forward"), 0.0, || {
            black_box(norm.forward_train(&x, &gamma, &beta, &mut y));
        });
        bench.time(&name("backward"), 0.0, || {
            black_box(norm.backward((&x, &dy), (&gamma, &beta), &statistics, &mut dx));
        });
        bench.time(&name("inference"), 0.0, || norm.forward(&x, &gamma, &beta, &statistics, &mut y));
    }
}

fn pillars(bench: &Bench) {
    let net = PillarNet { inputs: 10, outputs: 64, max_points: 32, epsilon: 1e-3 };
    let num_points: Vec<u32> =
        values(6000, 5).iter().map(|v| 1 + ((v * 0.5 + 0.5).powi(6) * 32.0).min(31.0) as u32).collect();
    let n = num_points.iter().sum::<u32>() as usize;
    let (features, dout) = (values(n * 10, 1), values(6000 * 64, 6));
    let (weight, gamma, beta) = (values(640, 2), vec![1.0; 64], values(64, 4));
    let pillars = Pillars { features: &features, num_points: &num_points };
    let parameters = PillarParameters { weight: &weight, gamma: &gamma, beta: &beta };
    let mut out = Vec::new();
    let state = net.forward_train(pillars, parameters, &mut out);
    bench.time(&format!("pillar net 6000 pillars, {n} points forward"), 0.0, || {
        black_box(net.forward_train(pillars, parameters, &mut out));
    });
    bench.time(&format!("pillar net 6000 pillars, {n} points backward"), 0.0, || {
        black_box(net.backward(pillars, parameters, &state, &dout));
    });
}

fn main() {
    let bench = Bench { wanted: std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect() };
    println!(
        "{:?}, {} threads; median and fastest of {RUNS} in ms",
        InstructionSet::in_use(),
        rayon::current_num_threads()
    );
    convolutions(&bench);
    products(&bench);
    norms(&bench);
    pillars(&bench);
}
