//! Objects beside the track: the fence, and buildings, vehicles and poles on both sides.

use super::Track;
use super::surface::{OUTSIDE_LEVEL_M, WALL_GAP_M, WALL_HEIGHT_M, WALL_M, across_at, height_m, strip};
use crate::mesh::{Mesh, cuboid, cylinder, grid};
use data::{Stream, stream};
use geometry::upright_pose;
use rand::RngExt;
use sensor::material::MaterialTable;
use sensor::object::Group;
use std::f64::consts::PI;

/// Spacing of the fence posts, m.
const POST_M: f64 = 6.0;
/// Height of the fence above the wall, m.
const FENCE_M: f64 = 4.5;
/// Heights of the cables above the wall, m.
const CABLES_M: [f64; 6] = [0.5, 1.1, 1.8, 2.6, 3.4, 4.3];
/// Radius of a cable, m.
const CABLE_M: f64 = 0.012;

/// Posts and cables on the outer wall. The wire mesh between them is too fine to return light and is omitted.
pub(super) fn fence(track: &Track) -> Mesh {
    let (steel, wire) = (MaterialTable::built_in("steel"), MaterialTable::built_in("wire"));
    let lap = track.line.length_m();
    let mut mesh = Mesh::default();
    let posts = (lap / POST_M).round() as usize;
    let foot = |way: f64| {
        across_at(track, way, |station| {
            let left = -station.width_right_m - WALL_GAP_M - WALL_M / 2.0;
            vec![(left, height_m(station, -station.width_right_m) + WALL_HEIGHT_M)]
        })[0]
    };
    for i in 0..posts {
        let way = lap * i as f64 / posts as f64;
        let post = cuboid([-0.05, -0.05, -0.1], [0.05, 0.05, FENCE_M], steel);
        mesh.append(&post.moved(&upright_pose(foot(way), track.line.at(way).heading_rad)));
    }
    for above in CABLES_M {
        let band = strip(track, 10.0, |station, _| {
            let left = -station.width_right_m - WALL_GAP_M - WALL_M / 2.0;
            let z = height_m(station, -station.width_right_m) + WALL_HEIGHT_M + above;
            vec![(left, z - CABLE_M), (left, z + CABLE_M)]
        });
        mesh.append(&grid(&band, wire));
    }
    mesh
}

/// Pit boxes and garages along the front stretch; vehicles, containers and light poles in the infield.
pub(super) fn infield_objects(track: &Track) -> Mesh {
    let mut random = stream(track.seed, "track/infield objects", 0, 0);
    let mut mesh = Mesh::default();
    for i in -10..=10 {
        // Between the pit wall and the garages: a pit box every 14 m.
        let (way, left) = (f64::from(i) * 14.0, 30.0 + random.random_range(-0.5..0.5));
        let [x, y, z] = [random.random_range(1.5..3.0), 1.2, random.random_range(1.8..2.8)];
        mesh.append(&block(track, way, left, [x, y, z], 0.0, "plaster"));
    }
    for i in -4..=4 {
        let way = f64::from(i) * 45.0 + random.random_range(-3.0..3.0);
        mesh.append(&block(track, way, 62.0, [36.0, 14.0, random.random_range(5.0..8.0)], 0.0, "plaster"));
    }
    let lap = track.line.length_m();
    for i in 0..(lap / 60.0) as usize {
        let way = 60.0 * i as f64 + random.random_range(-8.0..8.0);
        mesh.append(&pole(track, way, random.random_range(20.0..28.0), random.random_range(8.0..16.0)));
    }
    let scattered = scatter(track, 420, [26.0, 95.0], Group::Infield, &mut random);
    mesh.append(&scattered);
    mesh
}

/// Objects that the paper's simulation lacks: vehicles, containers, signs, trees and light towers behind the wall.
pub(super) fn outside_objects(track: &Track) -> Mesh {
    let mut random = stream(track.seed, "track/outside objects", 0, 0);
    let lap = track.line.length_m();
    let mut mesh = Mesh::default();
    for i in 0..(lap / 40.0) as usize {
        let way = 40.0 * i as f64 + random.random_range(-10.0..10.0);
        if !along_the_stand(track, way) {
            mesh.append(&pole(track, way, -random.random_range(17.0..24.0), random.random_range(10.0..22.0)));
        }
    }
    mesh.append(&scatter(track, 620, [-95.0, -20.0], Group::OutsideGround, &mut random));
    mesh
}

/// Whether a position is along the grandstand.
fn along_the_stand(track: &Track, way_m: f64) -> bool {
    geometry::limit_period(way_m, 0.5, track.line.length_m()).abs() < 320.0
}

/// Boxes, tents and trees at random positions between two distances from the centre line, m (negative: to the right).
fn scatter(track: &Track, count: usize, [low, high]: [f64; 2], side: Group, random: &mut Stream) -> Mesh {
    let mut mesh = Mesh::default();
    for _ in 0..count {
        let way = random.random_range(0.0..track.line.length_m());
        let left = random.random_range(low..high);
        let yaw = random.random_range(-PI..PI);
        let kind = random.random_range(0..10);
        let size: [f64; 3] =
            [random.random_range(0.8..1.2), random.random_range(0.8..1.2), random.random_range(0.8..1.2)];
        if side == Group::OutsideGround && along_the_stand(track, way)
            || side == Group::Infield && left < 80.0 && along_the_stand(track, way)
        {
            continue;
        }
        let scaled = |v: [f64; 3]| std::array::from_fn(|k| v[k] * size[k]);
        mesh.append(&match kind {
            0..=3 => block(track, way, left, scaled([4.6, 1.9, 1.6]), yaw, "paint"),
            4..=5 => block(track, way, left, scaled([8.0, 2.5, 3.4]), yaw, "paint"),
            6 => block(track, way, left, scaled([6.1, 2.4, 2.6]), yaw, "steel"),
            7 => block(track, way, left, scaled([3.0, 3.0, 2.6]), yaw, "fabric"),
            8 => block(track, way, left, scaled([0.3, 4.0, 5.0]), yaw, "plaster"),
            _ => tree(track, way, left, 5.0 * size[0]),
        });
    }
    mesh
}

/// Ground position beside the track; infield and outside are level enough to use the centre line's height.
fn ground_at(track: &Track, way_m: f64, left_m: f64) -> [f64; 3] {
    let [x, y, z] = across_at(track, way_m, |station| vec![(left_m, height_m(station, left_m))])[0];
    [x, y, if left_m < 0.0 { z.max(OUTSIDE_LEVEL_M) } else { z } - 0.15]
}

/// A box of length, width and height, rotated relative to the track.
fn block(track: &Track, way_m: f64, left_m: f64, [l, w, h]: [f64; 3], yaw_rad: f64, material: &str) -> Mesh {
    let box_mesh = cuboid([-l / 2.0, -w / 2.0, 0.0], [l / 2.0, w / 2.0, h], MaterialTable::built_in(material));
    box_mesh.moved(&upright_pose(ground_at(track, way_m, left_m), track.line.at(way_m).heading_rad + yaw_rad))
}

/// A light pole with its lamps.
fn pole(track: &Track, way_m: f64, left_m: f64, height_m: f64) -> Mesh {
    let steel = MaterialTable::built_in("steel");
    let mut mesh = cylinder([0.0; 3], [0.0, 0.0, height_m], 0.15, 8, steel);
    mesh.append(&cuboid([-0.3, -1.2, height_m], [0.3, 1.2, height_m + 0.8], steel));
    mesh.moved(&upright_pose(ground_at(track, way_m, left_m), track.line.at(way_m).heading_rad))
}

/// A tree: trunk and crown.
fn tree(track: &Track, way_m: f64, left_m: f64, height_m: f64) -> Mesh {
    let leaves = MaterialTable::built_in("leaves");
    let mut mesh = cylinder([0.0; 3], [0.0, 0.0, 0.4 * height_m], 0.15, 6, leaves);
    mesh.append(&cylinder([0.0, 0.0, 0.35 * height_m], [0.0, 0.0, height_m], 0.28 * height_m, 8, leaves));
    mesh.moved(&upright_pose(ground_at(track, way_m, left_m), 0.0))
}
