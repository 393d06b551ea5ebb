//! `lidarshift bench-step`: where the time of one training step goes, and how much memory it takes.

use crate::detectors::find_detector;
use crate::device::DeviceArgs;
use anyhow::Result;
use burn::optim::GradientsParams;
use clap::Args;
use data::augment::{AugmentConfig, augment, crop_to_range};
use data::{Frame, stream};
use models::config::NetworkConfig;
use models::layers::Mode;
use models::pointpillars::pillars::{PillarGrid, pillarise};
use models::pointpillars::{losses, scatter::scatter};
use models::{Detector, Preparer, reference_name};
use rand::RngExt;
use serde::Serialize;
use simulate::{RoadConfig, make_road_frame};
use std::path::PathBuf;
use std::time::Instant;
use train::{Adam, GradientNorm};

/// Times one training step by stage, on made-up road frames that are augmented anew for every step.
#[derive(Args, Debug)]
pub struct BenchStepArgs {
    /// A name or a TOML
    #[arg(long, default_value = "pointpillars_small")]
    detector: String,
    /// Frames a step
    #[arg(long, default_value_t = 1)]
    batch: usize,
    /// Timed steps; two before them warm up
    #[arg(long, default_value_t = 7)]
    steps: usize,
    #[command(flatten)]
    device: DeviceArgs,
    /// Also write the medians as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

#[derive(Serialize)]
struct Report {
    schema: &'static str,
    detector: String,
    device: String,
    batch: usize,
    steps: usize,
    /// Median of each stage and of the whole step, ms.
    median_ms: Vec<(&'static str, f64)>,
    /// Largest resident memory of the process, MiB.
    peak_mib: Option<u64>,
}

const STAGES: [&str; 9] =
    ["data", "encoder", "scatter", "backbone", "head", "loss", "backward", "optimizer", "whole step"];

impl BenchStepArgs {
    /// Prints a table.
    #[expect(clippy::print_stdout, reason = "results go to stdout")]
    pub fn run(self) -> Result<()> {
        let config = find_detector(&self.detector)?;
        let device = self.device.open()?.autodiff();
        let road = RoadConfig::default();
        let frames: Vec<Frame> = (0..self.batch).map(|i| make_road_frame(&road, "train", i)).collect();
        let mut detector = Detector::new(&config, 0, &device);
        let mut adam = Adam::new(config.optimization.weight_decay, reference_name);
        let preparer = Preparer::new(&config);
        let mut times = vec![Vec::new(); STAGES.len()];
        for step in 0..self.steps + 2 {
            let mut marks = vec![Instant::now()];
            let mut mark = || device.sync().map(|()| marks.push(Instant::now()));
            let mut batch = Vec::with_capacity(frames.len());
            for (i, frame) in frames.iter().enumerate() {
                let mut random = stream(0, "bench", step as u64, i as u64);
                let augmented = augment(frame.clone(), &AugmentConfig::default(), None, &mut random);
                batch.push(preparer.training(&crop_to_range(augmented, &config.range_m.map(f64::from)))?);
            }
            mark()?;
            let NetworkConfig::PointPillars(net) = &config.network;
            let network = &detector.network;
            let rows = network.pillar_rows(&batch);
            let pillars = network.vfe.forward(rows, Mode::Train);
            mark()?;
            let (cells, shape) = network.cells(&batch);
            let canvas = scatter(pillars, cells, shape);
            mark()?;
            let features = network.backbone_2d.forward(canvas, Mode::Train).spatial_features_2d;
            mark()?;
            let predictions = network.dense_head.forward(features);
            mark()?;
            let total = losses(&predictions, &batch, &net.loss).total;
            mark()?;
            let gradients = GradientsParams::from_grads(total.backward(), network);
            let norm = GradientNorm::of(network, &gradients, reference_name);
            mark()?;
            let clip = norm.clip_scale(config.optimization.clip_norm);
            detector.network = adam.step(network.clone(), gradients, clip, (1e-4, 0.9));
            mark()?;
            if step >= 2 {
                let seconds = marks.windows(2).map(|pair| pair[1] - pair[0]);
                let whole = *marks.last().expect("eight marks") - marks[0];
                for (stage, time) in times.iter_mut().zip(seconds.chain([whole])) {
                    stage.push(1e3 * time.as_secs_f64());
                }
            }
        }
        let report = Report {
            schema: "lidarshift/bench-step/1",
            median_ms: STAGES.into_iter().zip(times.into_iter().map(median)).collect(),
            peak_mib: crate::memory::peak_mib(),
            detector: config.name.clone(),
            device: self.device.describe(),
            batch: self.batch,
            steps: self.steps,
        };
        println!("pillars of 120,000 points, cells of 0.16 m: {:.1} ms", median(pillarise_ms()));
        println!("{}, batch {}, {}: medians of {} steps", report.detector, report.batch, report.device, report.steps);
        for (stage, ms) in &report.median_ms {
            println!("  {stage:<11} {ms:>9.1} ms");
        }
        if let Some(mib) = report.peak_mib {
            println!("  peak memory {mib:>9} MiB");
        }
        if let Some(path) = &self.json {
            data::write_atomic(path, &serde_json::to_vec_pretty(&report)?)?;
        }
        Ok(())
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// The published grid on a cloud of the size of a whole KITTI scan, all in range; ms of some repetitions.
fn pillarise_ms() -> Vec<f64> {
    let grid = PillarGrid {
        range: [0.0, -39.68, -3.0, 69.12, 39.68, 1.0],
        size: [0.16, 0.16, 4.0],
        max_points: 32,
        max_pillars: 16_000,
    };
    let mut random = stream(0, "bench", 0, 0);
    let point = |_| {
        // As dense near the sensor as a scan is.
        let (range_m, azimuth) = (69.0 * random.random::<f32>().powi(2), random.random_range(-0.5..0.5f32));
        [range_m * azimuth.cos(), range_m * azimuth.sin(), random.random_range(-2.0..0.0), random.random()]
    };
    let points: Vec<f32> = (0..120_000).flat_map(point).collect();
    let once = |_| {
        let begin = Instant::now();
        std::hint::black_box(pillarise(std::hint::black_box(&points), 4, &grid));
        1e3 * begin.elapsed().as_secs_f64()
    };
    (0..15).map(once).collect()
}
