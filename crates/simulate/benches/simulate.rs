//! Simulation of one race scan: ray casting only, a frame of `sim`, a frame of `measured`. Effects on a finished cloud
//! of 102,400 points, whose sensor is not known, as the Python package applies them.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use data::Cloud;
use lidarshift_simulate::race::{ConfigFiles, RaceConfig, Simulator};
use sensor::beams::Beams;
use sensor::clouds::CloudEffects;
use sensor::{EffectList, Rig};
use std::hint::black_box;
use std::path::Path;

fn frames(criterion: &mut Criterion) {
    let (mut config, files): (RaceConfig, ConfigFiles) = RaceConfig::find("race").expect("it comes with the program");
    config.frames = 60;
    let simulator = Simulator::new(config, &files).expect("it is sound");
    let key = &simulator.keys()[30];
    let mut group = criterion.benchmark_group("simulate");
    group.throughput(Throughput::Elements(simulator.shots() as u64));
    for set in &simulator.config.datasets {
        let prepared = simulator.set(set, &files).expect("its effects are sound");
        if set.name == "sim" {
            let scene = simulator.scene(&prepared, key).expect("there are states at every frame");
            let beams = Beams::of(&simulator.rig);
            group.bench_function("rays of a scan", |b| b.iter(|| black_box(scene.scan(&beams))));
        }
        group.bench_function(format!("frame of {}", set.name), |b| {
            b.iter(|| black_box(simulator.make(&prepared, key).expect("there are states at every frame")));
        });
    }
}

/// The five effects that are used most. None of them reads more than points.
const COMMON: &str = r#"
[[effect]]
kind = "range_noise"
std_m = 0.02
[[effect]]
kind = "range_bias"
offset_m = 0.03
[[effect]]
kind = "random_dropout"
share = 0.1
[[effect]]
kind = "range_quantisation"
step_m = 0.002
[[effect]]
kind = "range_dropout"
range_m = [0.0, 50.0]
share = [0.0, 0.3]
"#;

/// Changes nothing and reads surfaces, rows and shots without a return.
const READS_ALL: &str = "[[effect]]\nkind = \"angular_jitter\"\n";

/// Walls and ground around the sensor: 64 rows, 1,600 columns.
fn room() -> Cloud {
    let mut cloud = Cloud::new(4);
    for row in 0..64 {
        for column in 0..1600 {
            let azimuth = (column as f32 * 0.225).to_radians();
            let elevation = (row as f32 * 0.4 - 22.0).to_radians();
            let wall = 30.0 / azimuth.cos().abs().max(azimuth.sin().abs());
            let flat = if elevation < 0.0 { wall.min(1.8 / -elevation.tan()) } else { wall };
            cloud.values.extend([flat * azimuth.cos(), flat * azimuth.sin(), flat * elevation.tan(), 0.25]);
        }
    }
    cloud
}

fn effects(criterion: &mut Criterion) {
    let cloud = room();
    let mut group = criterion.benchmark_group("effects");
    group.throughput(Throughput::Elements(cloud.len() as u64)).sample_size(20);
    for (name, text) in [("five common", COMMON.to_owned()), ("five common, all read", format!("{COMMON}{READS_ALL}"))]
    {
        let list = EffectList::parse(&text, Path::new("effects.toml")).expect("it is sound");
        let one_cloud = std::slice::from_ref(&cloud);
        group.bench_function(format!("{name}, patterns included"), |b| {
            b.iter(|| CloudEffects::new(list.clone(), Rig::single(), one_cloud).apply(black_box(&cloud), 1, 0));
        });
        let known = CloudEffects::new(list.clone(), Rig::single(), one_cloud);
        group.bench_function(name, |b| b.iter(|| known.apply(black_box(&cloud), 1, 0)));
    }
}

criterion_group!(benches, frames, effects);
criterion_main!(benches);
