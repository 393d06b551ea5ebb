//! `cargo xtask bench-step`: time and memory of a training step by stage, of an inference, and of the slowest layers.

mod layers;

use anyhow::{Result, bail};
use burn::optim::GradientsParams;
use burn::tensor::Device;
use clap::{Args, ValueEnum};
use data::augment::{AugmentConfig, augment, crop_to_range};
use data::{Frame, stream};
use lidarshift::device::DeviceArgs;
use lidarshift::outln;
use models::bev::pillars::{PillarGrid, pillarise};
use models::config::{DetectorConfig, NetworkConfig};
use models::pointpillars::PointPillarsConfig;
use models::{Detector, Preparer, Sample, find_detector, reference_name};
use rand::RngExt;
use schemars::JsonSchema;
use serde::Serialize;
use simulate::{RoadConfig, make_road_frame};
use std::path::PathBuf;
use std::time::Instant;
use train::{Adam, GradientNorm};

/// Measure the time of each stage of a training step, on synthetic road frames with new augmentation in each step.
#[derive(Args, Debug)]
pub struct BenchStepArgs {
    /// Detector: a name or a TOML
    #[arg(long, default_value = "pointpillars_small")]
    detector: String,
    /// Batch size
    #[arg(long, default_value_t = 1)]
    batch: usize,
    /// Number of timed steps, after two warm-up steps
    #[arg(long, default_value_t = 7)]
    steps: usize,
    /// What to measure
    #[arg(long, value_enum, default_value_t)]
    work: Work,
    #[command(flatten)]
    device: DeviceArgs,
    /// Also write the medians as JSON
    #[arg(long, value_name = "FILE")]
    json: Option<PathBuf>,
}

/// What to measure.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ValueEnum, JsonSchema)]
#[serde(rename_all = "kebab-case")]
enum Work {
    /// A whole training step
    #[default]
    Step,
    /// An inference, from clouds in memory to final boxes
    Inference,
    /// The backbone's 3x3 convolutions of stride 1, forward and both gradients (PointPillars, on the CPU)
    Convolutions,
    /// The pillar feature net, forward and gradients (PointPillars, on the CPU)
    PillarNet,
}

#[derive(Serialize, JsonSchema)]
struct Report {
    schema: &'static str,
    work: Work,
    detector: String,
    device: String,
    batch: usize,
    steps: usize,
    /// Points (in pillars, or sampled) and pillars of the last batch.
    read: [usize; 2],
    /// Duration of each timed step, ms. The device is waited for after each stage.
    whole_ms: Vec<f64>,
    /// Duration of each of as many steps on a batch in memory, ms. The device is waited for at their end alone. Empty
    /// on the CPU and for other work than steps.
    in_memory_ms: Vec<f64>,
    /// Median duration of each stage and of the whole step, ms.
    median_ms: Vec<(&'static str, f64)>,
    /// Peak resident memory of the process, MiB.
    peak_mib: Option<u64>,
    /// Memory that the device has reserved at the end, MiB; `None` on the CPU.
    device_mib: Option<u64>,
    config: DetectorConfig,
}

impl BenchStepArgs {
    /// Measures and prints a table.
    pub fn run(self) -> Result<()> {
        let config = find_detector(&self.detector)?;
        let device = self.device.open()?.autodiff();
        let road = RoadConfig::default();
        let frames: Vec<Frame> = (0..self.batch).map(|i| make_road_frame(&road, "train", i)).collect();
        let timed = match self.work {
            Work::Step => self.training_steps(&config, &device, &frames)?,
            Work::Inference => self.inferences(&config, &device, &frames)?,
            Work::Convolutions => layers::convolutions(pointpillars(&config)?, &config, self.batch, self.steps),
            Work::PillarNet => layers::pillar_net(pointpillars(&config)?, &samples(&config, &frames, 0)?, self.steps)?,
        };
        let report = Report {
            schema: "lidarshift/bench-step/4",
            work: self.work,
            read: timed.read,
            whole_ms: timed.stages.last().map(|(_, whole)| whole.clone()).unwrap_or_default(),
            in_memory_ms: timed.in_memory_ms,
            median_ms: timed.stages.into_iter().map(|(stage, ms)| (stage, median(ms))).collect(),
            peak_mib: train::memory::peak_mib(),
            device_mib: device.memory_pool_usage().map(|usage| usage.bytes_reserved >> 20),
            detector: config.name.clone(),
            device: self.device.describe(),
            batch: self.batch,
            steps: self.steps,
            config,
        };
        if self.work == Work::Step {
            outln!("pillars of 120,000 points, cells of 0.16 m: {:.1} ms", median(pillarise_ms()));
        }
        outln!(
            "{}, batch {}, {}: medians of {} times in ms",
            report.detector,
            report.batch,
            report.device,
            report.steps
        );
        for (stage, ms) in &report.median_ms {
            outln!("  {stage:<11} {ms:>9.1} ms");
        }
        if !report.in_memory_ms.is_empty() {
            let ms = median(report.in_memory_ms.clone());
            outln!("  in memory   {ms:>9.1} ms (without waiting between stages)");
        }
        if let Some(mib) = report.peak_mib {
            outln!("  peak memory {mib:>9} MiB");
        }
        if let Some(mib) = report.device_mib {
            outln!("  on device   {mib:>9} MiB");
        }
        if let Some(path) = &self.json {
            data::write_json(path, &report)?;
        }
        Ok(())
    }
}

impl BenchStepArgs {
    fn training_steps(&self, config: &DetectorConfig, device: &Device, frames: &[Frame]) -> Result<Timed> {
        let mut detector = Detector::new(config, 0, device);
        let mut adam = Adam::new(config.optimization.weight_decay, reference_name);
        let mut timed = Timed::default();
        for step in 0..self.steps + WARM_UP {
            let mut clock = Clock::start(device);
            let batch = samples(config, frames, step)?;
            timed.read = read_of(&batch);
            clock.mark("data")?;
            let mut synced = Ok(());
            training_step(&mut detector, &mut adam, &batch, config, &mut |stage| {
                if synced.is_ok() {
                    synced = clock.mark(stage);
                }
            })?;
            synced?;
            timed.add(step, clock.stages());
        }
        if models::products::are_used_on(device) {
            let batch = samples(config, frames, 0)?;
            for step in 0..self.steps + WARM_UP_IN_MEMORY {
                let begin = Instant::now();
                training_step(&mut detector, &mut adam, &batch, config, &mut |_| ())?;
                device.sync()?;
                if step >= WARM_UP_IN_MEMORY {
                    timed.in_memory_ms.push(1e3 * begin.elapsed().as_secs_f64());
                }
            }
        }
        Ok(timed)
    }

    fn inferences(&self, config: &DetectorConfig, device: &Device, frames: &[Frame]) -> Result<Timed> {
        let detector = Detector::new(config, 0, device);
        let preparer = Preparer::new(config);
        let mut timed = Timed::default();
        for step in 0..self.steps + WARM_UP {
            let mut clock = Clock::start(device);
            let batch = frames.iter().map(|frame| preparer.inference(frame)).collect::<Result<Vec<_>, _>>()?;
            timed.read = read_of(&batch);
            clock.mark("data")?;
            std::hint::black_box(detector.predict(&batch)?);
            clock.mark("network")?;
            timed.add(step, clock.stages());
        }
        Ok(timed)
    }
}

/// A step on a batch; `mark` is called with the name of each stage after it was launched.
fn training_step(
    detector: &mut Detector,
    adam: &mut Adam,
    batch: &[Sample],
    config: &DetectorConfig,
    mark: &mut dyn FnMut(&'static str),
) -> Result<()> {
    let total = detector.loss_by_stage(batch, mark)?.total;
    let gradients = GradientsParams::from_grads(total.backward(), &detector.network);
    let norm = GradientNorm::of(&detector.network, &gradients, reference_name);
    mark("backward");
    let clip = norm.clip_scale(config.optimization.clip_norm);
    detector.network = adam.step(detector.network.clone(), gradients, clip, (1e-4, 0.9));
    mark("optimizer");
    Ok(())
}

/// Number of warm-up steps.
const WARM_UP: usize = 2;

/// The same of steps on a batch in memory. Kernels for other shapes are compiled in them: regions change with the
/// weights.
const WARM_UP_IN_MEMORY: usize = 8;

/// Measured durations.
#[derive(Default)]
struct Timed {
    /// Points and pillars of the last batch.
    read: [usize; 2],
    /// Durations of the stages of each timed step, the whole step last, ms.
    stages: Vec<(&'static str, Vec<f64>)>,
    /// Durations of steps on a batch in memory, ms.
    in_memory_ms: Vec<f64>,
}

impl Timed {
    fn add(&mut self, step: usize, stages: Vec<(&'static str, f64)>) {
        if step < WARM_UP {
            return;
        }
        for (i, (stage, ms)) in stages.into_iter().enumerate() {
            if self.stages.len() == i {
                self.stages.push((stage, Vec::new()));
            }
            self.stages[i].1.push(ms);
        }
    }
}

fn pointpillars(config: &DetectorConfig) -> Result<&PointPillarsConfig> {
    let NetworkConfig::PointPillars(network) = &config.network else {
        bail!("{} is not a PointPillars; use --work step or --work inference", config.name);
    };
    Ok(network)
}

/// The augmented batch of a step.
fn samples(config: &DetectorConfig, frames: &[Frame], step: usize) -> Result<Vec<Sample>> {
    let preparer = Preparer::new(config);
    let sample = |(i, frame): (usize, &Frame)| {
        let mut random = stream(0, "bench", step as u64, i as u64);
        let augmented = augment(frame.clone(), &AugmentConfig::default(), None, &mut random)?;
        let cropped = crop_to_range(augmented, &config.range_m.map(f64::from));
        Ok(preparer.training(&cropped, &mut random)?)
    };
    frames.iter().enumerate().map(sample).collect()
}

/// Numbers of points and pillars of a batch.
fn read_of(batch: &[Sample]) -> [usize; 2] {
    batch.iter().map(Sample::size).fold([0, 0], |sum, sample| [0, 1].map(|i| sum[i] + sample[i]))
}

/// End times of the stages of a step, after synchronisation with the device.
struct Clock<'a> {
    device: &'a Device,
    marks: Vec<(&'static str, Instant)>,
}

impl<'a> Clock<'a> {
    fn start(device: &'a Device) -> Self {
        Clock { device, marks: vec![("", Instant::now())] }
    }

    fn mark(&mut self, stage: &'static str) -> Result<()> {
        self.device.sync()?;
        self.marks.push((stage, Instant::now()));
        Ok(())
    }

    /// Durations of each stage and of the whole step, ms.
    fn stages(&self) -> Vec<(&'static str, f64)> {
        let ms = |from: Instant, to: Instant| 1e3 * (to - from).as_secs_f64();
        let (begin, end) = (self.marks[0].1, self.marks[self.marks.len() - 1].1);
        let stages = self.marks.windows(2).map(|pair| (pair[1].0, ms(pair[0].1, pair[1].1)));
        stages.chain([("whole", ms(begin, end))]).collect()
    }
}

fn median(values: Vec<f64>) -> f64 {
    statistics::median_upper(values).unwrap_or(f64::NAN)
}

/// Durations of pillarisation with the published grid, on a cloud with the size of a whole KITTI scan within the range,
/// ms.
fn pillarise_ms() -> Vec<f64> {
    let grid = PillarGrid {
        range: [0.0, -39.68, -3.0, 69.12, 39.68, 1.0],
        size: [0.16, 0.16, 4.0],
        max_points: 32,
        max_pillars: 16_000,
    };
    let mut random = stream(0, "bench", 0, 0);
    let point = |_| {
        // Denser near the sensor, like a scan.
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
