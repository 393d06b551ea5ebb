//! Timing of the race's ray casting, compared with Embree if Open3D is installed.
//!
//! ```sh
//! python3 -m venv .venv && .venv/bin/pip install open3d numpy
//! cargo run --release -p lidarshift-simulate --example race_rays -- bench/raycast .venv/bin/python
//! ```
//!
//! Writes triangles and rays of 20 frames to the folder and casts them with each instruction set on one and two
//! threads. Then `embree.py` casts the same rays with Open3D's `RaycastingScene`, followed by another run here, so
//! that both are measured under the same conditions. Our rays are cast against the two-level tree (cars as instances);
//! Embree gets one scene per frame with transformed cars.

#![expect(clippy::print_stdout, reason = "it is what it is for")]

use lidarshift_simulate::mesh::Mesh;
use lidarshift_simulate::race::{ConfigFiles, RaceConfig, Simulator};
use lidarshift_simulate::race_car::race_car;
use lidarshift_simulate::raycast::{Hit, Instance, InstructionSet, Ray, Scene, Tree};
use rayon::prelude::*;
use sensor::beams::Beams;
use sensor::object::Group;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

const FRAMES: usize = 20;
/// Repetitions per frame, for a run time of seconds.
const ROUNDS: usize = 10;

type Corners = [[f32; 3]; 3];

/// One frame: its scene, and its rays as a grid per sensor.
struct Case {
    scene: Scene,
    rays: Vec<Ray>,
    columns: usize,
    /// Triangles of the cars in scene coordinates.
    cars: Vec<Corners>,
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut args = std::env::args().skip(1);
    let folder = PathBuf::from(args.next().unwrap_or_else(|| "bench/raycast".into()));
    let python = args.next();
    fs_err::create_dir_all(&folder)?;

    let files = ConfigFiles::open("race")?.2;
    let mut config = RaceConfig::find("race")?.0;
    config.frames = FRAMES;
    let simulator = Simulator::new(config, &files)?;
    let world = simulator.track.mesh(&Group::ALL, None);
    let ground = Arc::new(world.tree([0.0; 3]));
    let car = race_car();
    let shape = Arc::new(car.tree([0.0; 3]));
    let cases = cases(&simulator, &ground, &shape, &car)?;
    let rays: usize = cases.iter().map(|c| c.rays.len()).sum();
    println!("{} static triangles, {} a car, {rays} rays of {FRAMES} frames", ground.len(), shape.len());
    export(&folder, &world, &cases)?;

    let sets = [InstructionSet::Portable, InstructionSet::Avx2, InstructionSet::Avx512];
    for set in sets.into_iter().filter(|set| set.is_available()) {
        measure(&cases, set, rays)?;
    }
    if let Some(python) = python {
        let script = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/embree.py");
        let status = Command::new(python).args([Path::new(script), &folder]).status()?;
        if !status.success() {
            return Err(format!("embree.py ended with {status}").into());
        }
        measure(&cases, InstructionSet::best(), rays)?;
    }
    Ok(())
}

fn cases(
    simulator: &Simulator,
    ground: &Arc<Tree>,
    shape: &Arc<Tree>,
    car: &Mesh,
) -> Result<Vec<Case>, Box<dyn std::error::Error>> {
    let beams = Beams::of(&simulator.rig);
    let mut cases = Vec::new();
    for key in simulator.keys() {
        let (ego, cars) = simulator.motions(key)?;
        let mut rays = Vec::new();
        for sensor in &beams.sensors {
            let world_from_sensor = ego.pose * sensor.true_mount;
            let origin = world_from_sensor.translation.vector.map(|v| v as f32).into();
            let turn = world_from_sensor.rotation.cast::<f32>();
            rays.extend(sensor.directions().iter().map(|d| {
                let direction = (turn * nalgebra::Vector3::from(*d)).into();
                Ray { origin, direction, time_s: 0.0 }
            }));
        }
        let mut triangles = Vec::new();
        let instances = cars.iter().map(|motion| {
            let moved = car.clone().moved(&motion.pose);
            triangles.extend(corners(&moved));
            let rotation = motion.pose.rotation.to_rotation_matrix();
            Instance {
                shape: shape.clone(),
                rotation: [0, 1, 2].map(|i| [0, 1, 2].map(|k| rotation[(i, k)] as f32)),
                position: motion.pose.translation.vector.map(|v| v as f32).into(),
                velocity: [0.0; 3],
            }
        });
        let scene = Scene::new(ground.clone(), instances.collect());
        cases.push(Case { scene, rays, columns: beams.sensors[0].columns, cars: triangles });
    }
    Ok(cases)
}

fn corners(mesh: &Mesh) -> Vec<Corners> {
    let corner = |i: u32| mesh.vertices[i as usize].map(|v| v as f32);
    mesh.faces.iter().map(|face| face.corners.map(corner)).collect()
}

/// Writes `static.f32`, and for each frame `cars_NN.f32` (triangles), `rays_NN.f32` (origin, direction) and
/// `hits_NN.f32` (ranges).
fn export(folder: &Path, world: &Mesh, cases: &[Case]) -> std::io::Result<()> {
    let write = |name: String, values: Vec<f32>| {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        fs_err::write(folder.join(name), bytes)
    };
    write("static.f32".into(), corners(world).into_iter().flatten().flatten().collect())?;
    for (i, case) in cases.iter().enumerate() {
        write(format!("cars_{i:02}.f32"), case.cars.iter().flatten().flatten().copied().collect())?;
        write(format!("rays_{i:02}.f32"), case.rays.iter().flat_map(|r| [r.origin, r.direction].concat()).collect())?;
        let mut hits = vec![Hit::MISS; case.rays.len()];
        case.scene.cast(&case.rays, case.columns, &mut hits);
        write(format!("hits_{i:02}.f32"), hits.iter().map(|h| h.range_m).collect())?;
    }
    Ok(())
}

/// Million rays per second on one and two threads: the best of three runs after a warm-up.
fn measure(cases: &[Case], set: InstructionSet, rays: usize) -> Result<(), Box<dyn std::error::Error>> {
    let mut line = format!("lidarshift {set:?}:");
    for threads in [1, 2] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let mut best = f64::INFINITY;
        for run in 0..4 {
            let start = Instant::now();
            pool.install(|| {
                for case in cases {
                    let scene = case.scene.clone().with_instructions(set);
                    (0..ROUNDS).into_par_iter().for_each(|_| {
                        let mut hits = vec![Hit::MISS; case.rays.len()];
                        scene.cast_parallel(&case.rays, case.columns, &mut hits);
                        std::hint::black_box(&hits);
                    });
                }
            });
            if run > 0 {
                best = best.min(start.elapsed().as_secs_f64());
            }
        }
        line += &format!(" {:.1} Mrays/s on {threads} threads", (rays * ROUNDS) as f64 / best / 1e6);
    }
    println!("{line}");
    Ok(())
}
