//! Ghost returns in a scene in which additional rays can be cast.

use lidarshift_simulate::frame_scene::FrameScene;
use lidarshift_simulate::mesh::{Mesh, cuboid};
use lidarshift_simulate::scenario::Motion;
use lidarshift_simulate::world::{CarShape, World};
use nalgebra::Vector3;
use sensor::Rig;
use sensor::effects::{Draws, FrameContext, Ghosts, SensorEffect};
use sensor::material::MaterialTable;
use sensor::scan::{Echo, Scan};

#[test]
fn the_range_of_a_ghost_includes_the_path_after_the_reflection() {
    // A metal wall ahead at 10 m, a concrete one behind at -5 m.
    let [metal, concrete] = ["metal", "concrete"].map(MaterialTable::built_in);
    let mut mesh = cuboid([10.0, -50.0, -50.0], [11.0, 50.0, 50.0], metal).of_object(4);
    mesh.append(&cuboid([-6.0, -50.0, -50.0], [-5.0, 50.0, 50.0], concrete).of_object(8));
    let (world, car, materials) = (World::new(&mesh), CarShape::new(&Mesh::default()), MaterialTable::default());
    let still = Motion { pose: geometry::Pose::identity(), velocity: Vector3::zeros(), turn_rate: Vector3::zeros() };
    let scene = FrameScene::new(&world, &car, &materials, still, &[]);
    let echo = Echo {
        range_m: 10.0,
        normal: [-1.0, 0.0, 0.0],
        material: metal,
        returned: 0.5,
        object: 4,
        ..Echo::nothing([0.0; 3], [1.0, 0.0, 0.0])
    };
    let mut after = Scan { echoes: vec![echo; 5000] };
    let effect = Ghosts { probability: 0.5, longest_m: 60.0 };
    let frame = FrameContext {
        seed: 1,
        set: "test",
        index: 0,
        time_s: 0.0,
        rig: &Rig::single(),
        materials: &materials,
        ego_velocity: [0.0; 3],
        ego_turn_rate: [0.0; 3],
        cars: &[],
        sensors: None,
        scene: Some(&scene),
        world_x_rad: 0.0,
    };
    effect.on_scan(&mut after, &frame, &Draws::new(1, "test".into(), 0));
    let ghosts: Vec<&Echo> = after.echoes.iter().filter(|e| e.range_m > 10.5).collect();
    let share = ghosts.len() as f64 / 5000.0;
    let lobe = materials.get(metal).lobe;
    assert!((share - 0.5 * lobe).abs() < 0.03, "{share}");
    assert!(ghosts.iter().all(|e| (e.range_m - 25.0).abs() < 0.03 && e.object == 8), "{:?}", ghosts[0]);
}
