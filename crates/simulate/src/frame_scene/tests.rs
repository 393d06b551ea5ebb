use super::*;
use crate::mesh::{Mesh, cuboid};
use crate::race_car::race_car;
use geometry::upright_pose;
use sensor::beams::Shutter;
use sensor::rig::{Pattern, Rig, RowBlock};
use std::path::Path;

fn motion(x: f64, y: f64, velocity: [f64; 3]) -> Motion {
    Motion { pose: upright_pose([x, y, 0.198], 0.0), velocity: velocity.into(), turn_rate: Vector3::zeros() }
}

/// Level ground and a wall 30 m to the left, far from the world origin.
fn world() -> World {
    let mut mesh =
        cuboid([4800.0, -200.0, -1.0], [5200.0, 200.0, 0.0], MaterialTable::built_in("asphalt")).of_object(1);
    mesh.append(&cuboid([4800.0, 30.0, -0.5], [5200.0, 31.0, 20.0], MaterialTable::built_in("wall")).of_object(4));
    World::new(&mesh)
}

fn rig(rows: u32, columns: u32) -> Rig {
    let text = "[[sensor]]\nname = \"a\"\nposition = [1.0, 0.0, 0.5]\nhorizontal_fov_deg = 360\n";
    let mut rig = Rig::parse(text, Path::new("r.toml")).unwrap();
    let block = RowBlock { rows, top_deg: 5.0, bottom_deg: -15.0 };
    rig.sensors[0].pattern = Some(Pattern::grid(block, columns, 360.0, 20.0));
    rig
}

#[test]
fn returns_of_cars_are_those_of_the_scan() {
    let (world, car, materials) = (world(), CarShape::new(&race_car()), MaterialTable::default());
    // One car hides another; one is out of the field of view behind the sensor's limits.
    let cars = [(5020.0, 3.0), (5027.0, 4.0), (4985.0, -6.0), (5190.0, 0.0)].map(|(x, y)| motion(x, y, [0.0; 3]));
    let scene = FrameScene::new(&world, &car, &materials, motion(5000.0, 0.0, [0.0; 3]), &cars);
    let beams = Beams::of(&rig(64, 1440));
    let mut counted = vec![0; cars.len()];
    for car in scene.scan(&beams).returns().filter_map(Echo::car) {
        counted[car] += 1;
    }
    assert_eq!(scene.returns_of_cars(&beams, cars.len()), counted);
    assert!(counted[0] > 100 && counted[2] > 100, "{counted:?}");
}

#[test]
fn points_lie_where_the_world_is() {
    let (world, car, materials) = (world(), CarShape::new(&race_car()), MaterialTable::default());
    let scene =
        FrameScene::new(&world, &car, &materials, motion(5000.0, 0.0, [0.0; 3]), &[motion(5020.0, 3.0, [0.0; 3])]);
    let scan = scene.scan(&Beams::of(&rig(40, 720)));
    assert_eq!(scan.echoes.len(), 40 * 720);
    let (mut ground, mut wall, mut on_car) = (0, 0, 0);
    for echo in scan.returns() {
        let [x, y, z] = echo.point();
        match echo.object {
            1 => {
                ground += 1;
                assert!((z + 0.198).abs() < 2e-3 && (echo.normal[2] - 1.0).abs() < 1e-5);
                assert!((echo.cos_incidence + echo.direction[2]).abs() < 1e-5);
            }
            4 => {
                wall += 1;
                assert!((y - 30.0).abs() < 2e-3 || (y - 31.0).abs() < 2e-3 || (z - 19.802).abs() < 2e-3);
            }
            FIRST_CAR => {
                on_car += 1;
                assert!((x - 21.6).abs() < 2.5 && (y - 3.0).abs() < 0.96 && z < 0.99, "{x} {y} {z}");
            }
            other => panic!("object {other}"),
        }
        assert!(echo.returned <= echo.reflectivity + 1e-6 && (0.0..=1.0).contains(&echo.intensity));
    }
    assert!(ground > 5000 && wall > 1000 && on_car > 40, "{ground} {wall} {on_car}");

    let again = scene.cast(&scan.echoes.iter().map(|e| (e.origin, e.direction)).collect::<Vec<_>>());
    for (surface, echo) in again.iter().zip(&scan.echoes).filter(|(_, e)| e.is_return()) {
        assert!((surface.range_m - echo.range_m).abs() < 5e-3 || surface.object != echo.object);
    }
    let same = again.iter().zip(&scan.echoes).filter(|(s, e)| s.object == e.object || !e.is_return()).count();
    assert!(same * 1000 > scan.echoes.len() * 998);
}

#[test]
fn a_deskewed_scan_shows_the_world_at_rest_and_smears_what_moves() {
    let (world, car, materials) = (world(), CarShape::new(&race_car()), MaterialTable::default());
    let ego = motion(5000.0, 0.0, [60.0, 0.0, 0.0]);
    let mut turning = ego;
    turning.turn_rate = Vector3::new(0.0, 0.0, 0.3);
    let scan = |ego: Motion, car_speed: f64, shutter: Option<Shutter>| {
        let scene = FrameScene::new(&world, &car, &materials, ego, &[motion(5012.0, 4.0, [car_speed, 0.0, 0.0])]);
        scene.scan(&Beams { shutter, ..Beams::of(&rig(40, 720)) })
    };
    let deskewed = scan(turning, 60.0, Some(Shutter { deskewed: true }));
    for echo in deskewed.returns().filter(|e| e.object == 4) {
        let [_, y, z] = echo.point();
        assert!((y - 30.0).abs() < 5e-3 || (y - 31.0).abs() < 5e-3 || (z - 19.8).abs() < 5e-3, "{y}");
    }
    // Rows are shot from the top: a shot 20 ms after the middle of the scan sees the rival 1.2 m farther ahead.
    let shift = |scan: &Scan| {
        let mut sum = (0.0, 0);
        for echo in scan.returns().filter(|e| e.object == FIRST_CAR && e.cos_incidence > 0.5 && e.normal[0] < -0.9) {
            sum = (sum.0 + f64::from(echo.point()[0] - 60.0 * echo.time_s), sum.1 + 1);
        }
        sum.0 / f64::from(sum.1)
    };
    let still = scan(ego, 60.0, None);
    let at_rest = still.returns().filter(|e| e.object == FIRST_CAR && e.cos_incidence > 0.5 && e.normal[0] < -0.9);
    let at_rest: Vec<f64> = at_rest.map(|e| e.point()[0].into()).collect();
    let at_rest = at_rest.iter().sum::<f64>() / at_rest.len() as f64;
    assert!((shift(&scan(ego, 60.0, Some(Shutter { deskewed: true }))) - at_rest).abs() < 0.15);
    // Without motion compensation, a rival with the ego vehicle's speed appears static.
    let raw = scan(ego, 60.0, Some(Shutter { deskewed: false }));
    let moved = raw.echoes.iter().zip(&still.echoes).filter(|(a, b)| a.object == FIRST_CAR && b.object == FIRST_CAR);
    for (a, b) in moved {
        assert!((a.range_m - b.range_m).abs() < 2e-3);
    }
}

#[test]
fn the_true_mount_determines_the_surface_and_the_nominal_one_the_point() {
    let (world, car, materials) = (world(), CarShape::new(&race_car()), MaterialTable::default());
    let scene = FrameScene::new(&world, &car, &materials, motion(5000.0, 0.0, [0.0; 3]), &[]);
    let mut beams = Beams::of(&rig(20, 360));
    beams.sensors[0].true_mount.translation.z += 0.1;
    let scan = scene.scan(&beams);
    let ground: Vec<&Echo> = scan.returns().filter(|e| e.object == 1).collect();
    assert!(ground.len() > 1000 && ground.iter().all(|e| (e.point()[2] + 0.298).abs() < 2e-3));
    let lifted = scene.scan(&Beams { ego_heave_m: 0.1, ..Beams::of(&rig(20, 360)) });
    for (a, b) in scan.echoes.iter().zip(&lifted.echoes) {
        assert!((a.range_m - b.range_m).abs() < 1e-3 || a.range_m == b.range_m, "{a:?} {b:?}");
    }
}

#[test]
fn wide_beams_mix_what_is_near_and_what_is_far() {
    // A post 6 cm wide, 4 m in front of a wall; the pulse is 1 m, then 10 m long.
    let mut mesh = cuboid([50.0, -40.0, -20.0], [51.0, 40.0, 20.0], MaterialTable::built_in("concrete")).of_object(4);
    mesh.append(&cuboid([46.0, -0.03, -20.0], [46.02, 0.03, 20.0], MaterialTable::built_in("concrete")).of_object(5));
    let (world, car, materials) = (World::new(&mesh), CarShape::new(&Mesh::default()), MaterialTable::default());
    let scene = FrameScene::new(&world, &car, &materials, motion(0.0, 0.0, [0.0; 3]), &[]);
    let text = "[[sensor]]\nname = \"a\"\nhorizontal_fov_deg = 2\n";
    let mut rig = Rig::parse(text, Path::new("r.toml")).unwrap();
    rig.sensors[0].pattern = Some(Pattern::grid(RowBlock { rows: 1, top_deg: 0.0, bottom_deg: 0.0 }, 200, 2.0, 20.0));
    let width = BeamWidth { divergence_rad: 0.003, rays: 19, pulse_m: 1.0, pick: Pick::Strongest, second: true };
    let scan = |width| scene.scan(&Beams { width: Some(width), ..Beams::of(&rig) });
    let between = |scan: &Scan| scan.returns().filter(|e| (46.3..49.7).contains(&e.range_m)).count();
    let short = scan(width);
    assert_eq!(between(&short), 0);
    let seconds: Vec<&Echo> = short.echoes.iter().filter(|e| e.number == 1).collect();
    assert!(!seconds.is_empty() && short.echoes[..200].iter().all(|e| e.number == 0));
    let long = scan(BeamWidth { pulse_m: 10.0, second: false, ..width });
    assert!(between(&long) > 3, "mixed pixels");
    let lines = scene.scan(&Beams::of(&rig));
    let on_post = |scan: &Scan| scan.returns().filter(|e| e.object == 5).count();
    let first = scan(BeamWidth { pick: Pick::First, second: false, ..width });
    assert!(on_post(&first) > on_post(&lines), "the post looks wider");
    let last = scan(BeamWidth { pick: Pick::Last, second: false, ..width });
    assert!(on_post(&last) < on_post(&lines));
    // A beam that hits a single surface returns the same light as a single ray.
    for (a, b) in lines.echoes.iter().zip(&last.echoes).take(20) {
        assert!((a.returned - b.returned).abs() < 1e-4 && (a.range_m - b.range_m).abs() < 2e-3);
    }
}
