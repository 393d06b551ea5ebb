//! Simulation of one race scan: ray casting only, a frame of `sim`, a frame of `measured`.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use lidarshift_simulate::race::{ConfigFiles, RaceConfig, Simulator};
use sensor::beams::Beams;
use std::hint::black_box;

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

criterion_group!(benches, frames);
criterion_main!(benches);
