//! Roadside objects other than cars.

use crate::street::road::Road;
use crate::street::scene::Taken;
use crate::street::solid::{Material, Slice, Solid};
use data::Stream;
use geometry::Box3;
use rand::RngExt;
use std::f64::consts::PI;

/// Maximum distance of objects, m.
const FAR_M: f64 = 75.0;

fn sign(side: usize) -> f64 {
    if side == 1 { 1.0 } else { -1.0 }
}

/// Houses and garden walls along both sides, with gaps.
pub(crate) fn walls(road: &Road, taken: &mut Taken, random: &mut Stream) -> Vec<Solid> {
    let mut solids = Vec::new();
    for side in [0, 1] {
        let mut along_m = random.random_range(-5.0..5.0);
        while along_m < FAR_M {
            let length_m = random.random_range(6.0..18.0);
            let (depth_m, height_m) = if random.random_bool(0.7) {
                (8.0, random.random_range(4.0..9.0))
            } else {
                (0.3, random.random_range(1.2..2.2))
            };
            let lateral_m = road.wall_m[side] + depth_m / 2.0 + random.random_range(0.0..2.0);
            let material = Material::Wall(random.random_range(0.2..0.6));
            let (place, yaw_rad) = road.place(along_m + length_m / 2.0, sign(side) * lateral_m);
            let house = standing(road, place, [length_m, depth_m, height_m], yaw_rad);
            if taken.try_take(&house, 0.3) {
                solids.push(Solid::cuboid(&house, material));
            }
            along_m += length_m + if random.random_bool(0.4) { random.random_range(1.0..12.0) } else { 0.0 };
        }
    }
    solids
}

/// Lamp posts at the kerb.
pub(crate) fn poles(road: &Road, taken: &mut Taken, random: &mut Stream) -> Vec<Solid> {
    let mut solids = Vec::new();
    for side in [0, 1] {
        let every_m = random.random_range(14.0..28.0);
        let mut along_m = random.random_range(4.0..4.0 + every_m);
        while along_m < FAR_M {
            let (place, _) = road.place(along_m, sign(side) * (road.half_width_m(side) + 0.7));
            let radius_m = random.random_range(0.06..0.14);
            let post = standing(road, place, [2.0 * radius_m, 2.0 * radius_m, random.random_range(4.0..8.0)], 0.0);
            if taken.try_take(&post, 0.2) {
                solids.push(Solid::column(post.center, radius_m, post.size[2], Material::Metal));
            }
            along_m += every_m;
        }
    }
    solids
}

/// Up to `count` objects between the road and the walls that a detector may mistake for a car.
pub(crate) fn distractors(road: &Road, count: u32, taken: &mut Taken, random: &mut Stream) -> Vec<Solid> {
    let mut solids = Vec::new();
    for _ in 0..count {
        let side = usize::from(random.random_bool(0.5));
        let lateral_m = random.random_range(road.half_width_m(side) + 0.4..road.wall_m[side]);
        let (place, _) = road.place(random.random_range(4.0..65.0), sign(side) * lateral_m);
        let yaw_rad = random.random_range(-PI..PI);
        solids.extend(distractor(road, place, yaw_rad, taken, random));
    }
    solids
}

fn distractor(road: &Road, place: [f64; 2], yaw_rad: f64, taken: &mut Taken, random: &mut Stream) -> Vec<Solid> {
    let mut between = |low: f64, high: f64| random.random_range(low..high);
    let kind = between(0.0, 6.0) as u32;
    let size = match kind {
        0 => [between(0.3, 0.9), between(0.3, 0.9), between(1.5, 4.0)], // pillar
        1 => [between(0.6, 1.6), between(0.6, 1.6), between(0.8, 1.8)], // round bush
        2 => [between(1.5, 4.0), between(0.6, 1.2), between(0.9, 1.8)], // hedge
        3 => [between(0.5, 1.1), between(0.5, 0.8), between(0.9, 1.3)], // bin
        4 => [between(5.5, 7.0), 2.4, 2.6],                             // container
        _ => [between(2.0, 4.0), between(2.0, 4.0), between(4.0, 6.0)], // tree
    };
    let stand = standing(road, place, size, yaw_rad);
    if !taken.try_take(&stand, 0.3) {
        return Vec::new();
    }
    let [x, y, _] = stand.center;
    match kind {
        0 => vec![Solid::cuboid(&stand, Material::Wall(between(0.2, 0.6)))],
        1 => vec![Solid::column(stand.center, size[0].min(size[1]) / 2.0, size[2], Material::Leaves)],
        2 => vec![Solid::cuboid(&stand, Material::Leaves)],
        3 => {
            let [low, high] = [1.0, 1.15]
                .map(|k| Slice { x: [-k * size[0] / 2.3, k * size[0] / 2.3], half_width: k * size[1] / 2.3 });
            vec![Solid::frustum(&stand, [low, high], [-size[2] / 2.0, size[2] / 2.0], [Material::Paint(0.3); 2])]
        }
        4 => vec![Solid::cuboid(&stand, Material::Wall(between(0.2, 0.6)))],
        _ => {
            let trunk_m = 1.8;
            let ground_m = stand.z_range().0;
            let trunk = [x, y, ground_m + trunk_m / 2.0];
            let crown = [x, y, ground_m + (trunk_m + size[2]) / 2.0];
            let radius_m = size[0].min(size[1]) / 2.0;
            vec![
                Solid::column(trunk, between(0.1, 0.25), trunk_m, Material::Wall(0.3)),
                Solid::column(crown, radius_m, size[2] - trunk_m, Material::Leaves),
            ]
        }
    }
}

/// A box of this size with its base on the ground.
fn standing(road: &Road, [x, y]: [f64; 2], size: [f64; 3], yaw_rad: f64) -> Box3 {
    Box3 { center: [x, y, road.height_m([x, y]) + size[2] / 2.0], size, yaw_rad }
}
