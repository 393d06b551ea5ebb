//! Draws a town: the street grid, houses, pavements, trees, poles, signs and parked cars.

use crate::facade::{House, Windows};
use crate::solid::{Block, Material};
use crate::street::Streets;
use crate::traffic::Motion;
use crate::vehicle::{Model, Place};
use crate::world::{Body, Form, Vehicle, World};
use data::Stream;
use nalgebra::Point3;
use rand::RngExt;
use std::f64::consts::{FRAC_PI_2, TAU};

/// Streets in each direction.
pub const STREETS: usize = 6;

/// Ground around the outermost streets, m.
const AROUND_M: f64 = 30.0;

/// Models of parked and moving cars.
pub const CAR_MODELS: usize = 6;

/// A side of a block of houses: it begins at `begin` and runs along `heading`; the street is to its right.
#[derive(Clone, Copy)]
struct Side {
    begin: [f64; 2],
    heading_rad: f64,
    length_m: f64,
}

impl Side {
    /// A place `along` the side, `left` of it (towards the inside of the block), m.
    fn at(&self, along: f64, left: f64) -> [f64; 2] {
        let (sin, cos) = self.heading_rad.sin_cos();
        [self.begin[0] + along * cos - left * sin, self.begin[1] + along * sin + left * cos]
    }
}

fn draw_streets(rng: &mut Stream) -> Streets {
    let half_road_m = rng.random_range(5.2..6.6);
    let mut lines = || {
        let mut at = 0.0;
        (0..STREETS)
            .map(|_| {
                at += rng.random_range(60.0..92.0);
                at
            })
            .collect::<Vec<f64>>()
    };
    let (at_x, at_y) = (lines(), lines());
    let waves = rolling(rng, 0.25, [45.0, 140.0], 4);
    Streets {
        at_x,
        at_y,
        half_road_m,
        pavement_m: rng.random_range(2.6..4.0),
        kerb_m: rng.random_range(0.08..0.15),
        crown: rng.random_range(0.01..0.03),
        waves,
    }
}

/// Some waves of the ground with a common total amplitude, m, and wavelengths in a range, m.
pub fn rolling(rng: &mut Stream, total_m: f64, [short_m, long_m]: [f64; 2], number: usize) -> Vec<[f64; 4]> {
    let wave = |rng: &mut Stream| {
        let (length, way) = (rng.random_range(short_m..long_m), rng.random_range(0.0..TAU));
        let k = TAU / length;
        [total_m / number as f64, k * way.cos(), k * way.sin(), rng.random_range(0.0..TAU)]
    };
    (0..number).map(|_| wave(rng)).collect()
}

/// Draws a town without moving vehicles. The first [`CAR_MODELS`] models are cars.
pub fn draw_town(rng: &mut Stream) -> World {
    let streets = draw_streets(rng);
    let ground = [rng.random_range(0.1..0.2), rng.random_range(0.25..0.45)];
    let (far_x, far_y) = (streets.at_x[STREETS - 1], streets.at_y[STREETS - 1]);
    let low = [streets.at_x[0] - AROUND_M, streets.at_y[0] - AROUND_M];
    let mut world = World::new(streets, [low, [far_x + AROUND_M, far_y + AROUND_M]], ground);
    world.models = (0..CAR_MODELS).map(|_| Model::car(rng)).collect();
    let (half, pavement) = (world.streets.half_road_m, world.streets.pavement_m);
    let (at_x, at_y) = (world.streets.at_x.clone(), world.streets.at_y.clone());
    let occupied = rng.random_range(0.3..0.8);
    for i in 0..STREETS - 1 {
        for j in 0..STREETS - 1 {
            let [x0, x1] = [at_x[i] + half, at_x[i + 1] - half];
            let [y0, y1] = [at_y[j] + half, at_y[j + 1] - half];
            let sides = [
                Side { begin: [x0, y0], heading_rad: 0.0, length_m: x1 - x0 },
                Side { begin: [x1, y0], heading_rad: FRAC_PI_2, length_m: y1 - y0 },
                Side { begin: [x1, y1], heading_rad: 2.0 * FRAC_PI_2, length_m: x1 - x0 },
                Side { begin: [x0, y1], heading_rad: 3.0 * FRAC_PI_2, length_m: y1 - y0 },
            ];
            for (k, side) in sides.iter().enumerate() {
                // The houses of two sides fill the corners.
                build_row(&mut world, rng, side, pavement, k % 2 == 0);
                furnish(&mut world, rng, side, pavement);
                park(&mut world, rng, side, occupied);
            }
        }
    }
    world.index();
    world
}

/// A row of houses along a side of a block.
fn build_row(world: &mut World, rng: &mut Stream, side: &Side, pavement: f64, corners: bool) {
    let depth = 11.0;
    let cut = pavement + if corners { 0.0 } else { depth + 0.5 };
    let mut along = cut;
    while along < side.length_m - cut - 6.0 {
        let width = rng.random_range(9.0..22.0f64).min(side.length_m - cut - along);
        let [x, y] = side.at(along + width / 2.0, pavement + depth / 2.0 + rng.random_range(0.0..0.6));
        let height = rng.random_range(6.0..17.0);
        let foot = world.streets.height_m(x, y) - 0.6;
        let jitter = rng.random_range(-0.008..0.008);
        let block = Block::new([x, y, foot + height / 2.0], [width - 0.02, depth, height], side.heading_rad + jitter);
        let pitch_m = [rng.random_range(2.2..4.0), rng.random_range(2.8..3.4)];
        let windows = rng.random_bool(0.85).then(|| Windows {
            pitch_m,
            size_m: [rng.random_range(0.9..1.6), rng.random_range(1.1..1.8)],
            sill_m: rng.random_range(1.3..2.0),
            inset_m: rng.random_range(0.05..0.3),
        });
        let reflectivity = rng.random_range(0.12..0.75);
        if rng.random_bool(0.35) {
            let number = rng.random_range(2..6);
            for _ in 0..number {
                balcony(world, rng, &block, reflectivity);
            }
        }
        world.houses.push(House { block, windows, wave: None, reflectivity });
        along += width + if rng.random_bool(0.12) { rng.random_range(1.5..4.0) } else { 0.0 };
    }
}

/// A balcony on the face of a house towards its street: the face at negative y.
fn balcony(world: &mut World, rng: &mut Stream, house: &Block, reflectivity: f64) {
    let (width, out) = (rng.random_range(1.6..3.2), rng.random_range(0.8..1.3));
    let reach = (house.half.x - width / 2.0 - 0.3).max(0.1);
    let along = rng.random_range(-reach..reach);
    let floors = ((2.0 * house.half.z - 4.0) / 3.0).floor().max(1.0) as u32;
    let z = house.center.z - house.half.z + 3.4 + 3.0 * f64::from(rng.random_range(0..floors));
    let [c, s] = house.turn;
    let left = -house.half.y - out / 2.0;
    let center = [house.center.x + c * along - s * left, house.center.y + s * along + c * left, z + 0.5];
    let block = Block { center: Point3::from(center), half: [width / 2.0, out / 2.0, 0.55].into(), turn: house.turn };
    world.bodies.push(Body { form: Form::Block(block), material: Material::Stone, reflectivity });
}

/// Trees, poles, signs and bollards on a pavement.
fn furnish(world: &mut World, rng: &mut Stream, side: &Side, pavement: f64) {
    let kerbside = 0.5;
    let lit = rng.random_range(18.0..32.0);
    let mut along = rng.random_range(pavement + 2.0..12.0);
    while along < side.length_m - 4.0 {
        post(world, side.at(along, kerbside), rng.random_range(0.06..0.11), [0.0, 6.5], Material::Metal, 0.4);
        along += lit + rng.random_range(-2.0..2.0);
    }
    if rng.random_bool(0.55) {
        let every = rng.random_range(8.0..15.0);
        let mut along = pavement + rng.random_range(4.0..9.0);
        while along < side.length_m - 6.0 {
            tree(world, rng, side.at(along, 0.9));
            along += every * rng.random_range(0.8..1.3);
        }
    }
    for along in [2.5, side.length_m - 2.5] {
        if rng.random_bool(0.6) {
            sign(world, rng, side.at(along, kerbside + 0.3), side.heading_rad);
        }
        if rng.random_bool(0.3) {
            post(world, side.at(along, 0.25), 0.07, [0.0, 1.0], Material::Metal, 0.4);
        }
    }
}

fn post(
    world: &mut World,
    [x, y]: [f64; 2],
    radius: f64,
    [low, high]: [f64; 2],
    material: Material,
    reflectivity: f64,
) {
    let foot = world.streets.height_m(x, y);
    let form = Form::Post([x, y], radius, [foot + low - 0.2, foot + high]);
    world.bodies.push(Body { form, material, reflectivity });
}

/// A trunk and a crown of balls.
fn tree(world: &mut World, rng: &mut Stream, [x, y]: [f64; 2]) {
    let stem = rng.random_range(2.2..3.2);
    post(world, [x, y], rng.random_range(0.1..0.22), [0.0, stem + 0.5], Material::Bark, 0.25);
    let foot = world.streets.height_m(x, y);
    let reflectivity = rng.random_range(0.3..0.5);
    for _ in 0..rng.random_range(6..11) {
        let (way, out) = (rng.random_range(0.0..TAU), rng.random_range(0.2..1.3));
        let z = foot + stem + rng.random_range(0.4..2.6);
        let center = Point3::new(x + out * way.cos(), y + out * way.sin(), z);
        let form = Form::Ball(center, rng.random_range(0.5..1.0));
        world.bodies.push(Body { form, material: Material::Leaves, reflectivity });
    }
}

/// A traffic sign that faces along the street.
fn sign(world: &mut World, rng: &mut Stream, [x, y]: [f64; 2], heading_rad: f64) {
    post(world, [x, y], 0.03, [0.0, 2.8], Material::Metal, 0.4);
    let z = world.streets.height_m(x, y) + rng.random_range(2.2..2.5);
    let size = [0.02, rng.random_range(0.5..0.75), rng.random_range(0.5..0.75)];
    let block = Block::new([x, y, z], size, heading_rad + rng.random_range(-0.15..0.15));
    let reflectivity = rng.random_range(4.0..12.0);
    world.bodies.push(Body { form: Form::Block(block), material: Material::Foil, reflectivity });
}

/// Parked cars along the kerb.
fn park(world: &mut World, rng: &mut Stream, side: &Side, occupied: f64) {
    let mut along = rng.random_range(9.0..12.0);
    while along < side.length_m - 10.0 {
        if rng.random_bool(occupied) {
            let model = rng.random_range(0..CAR_MODELS);
            let [x, y] = side.at(along, -1.15 + rng.random_range(-0.1..0.1));
            let turn = if rng.random_bool(0.9) { 0.0 } else { TAU / 2.0 };
            let z = world.streets.height_m(x, y) + world.models[model].size_m[2] / 2.0;
            let heading_rad = side.heading_rad + turn + rng.random_range(-0.03..0.03);
            world.vehicles.push(Vehicle {
                model,
                reflectivity: rng.random_range(0.06..0.7),
                motion: Motion::Parked(Place { center: [x, y, z], heading_rad }),
                labelled: true,
            });
        }
        along += rng.random_range(6.2..8.0);
    }
}

/// Draws a straight street between two smooth walls, without any depth structure. It runs along x.
pub fn draw_corridor(rng: &mut Stream, length_m: f64) -> World {
    let half = rng.random_range(5.0..7.0);
    let streets = Streets {
        at_x: vec![],
        at_y: vec![0.0],
        half_road_m: 40.0,
        pavement_m: 0.0,
        kerb_m: 0.0,
        crown: rng.random_range(0.005..0.02),
        waves: vec![],
    };
    let ground = [rng.random_range(0.1..0.2), 0.3];
    let mut world = World::new(streets, [[-150.0, -30.0], [length_m + 150.0, 30.0]], ground);
    world.models = (0..CAR_MODELS).map(|_| Model::car(rng)).collect();
    let (height, reflectivity) = (rng.random_range(5.0..9.0), rng.random_range(0.3..0.6));
    for side in [-1.0, 1.0] {
        let center = [length_m / 2.0, side * (half + 1.0), height / 2.0 - 1.0];
        let block = Block::new(center, [length_m + 300.0, 2.0, height], 0.0);
        world.houses.push(House { block, windows: None, wave: None, reflectivity });
    }
    world.index();
    world
}
