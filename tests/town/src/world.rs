//! The world: ground, houses, other bodies and vehicles, and what a ray meets in it.

use crate::facade::House;
use crate::grid::Grid;
use crate::solid::{Block, Entry, Material, Ray, enter_ball, enter_upright_cylinder};
use crate::street::Streets;
use crate::traffic::Motion;
use crate::vehicle::{Model, Place};
use nalgebra::{Point3, Vector3};

/// Largest range at which anything is met, m.
pub const REACH_M: f64 = 120.0;

/// Shape of a body that is no house.
#[derive(Clone, Debug, PartialEq)]
pub enum Form {
    /// Upright box.
    Block(Block),
    /// Upright cylinder: x and y of the axis, radius, lowest and highest z, m.
    Post([f64; 2], f64, [f64; 2]),
    /// Centre and radius, m.
    Ball(Point3<f64>, f64),
}

/// A body that is no house: a balcony, a pole, a sign, a part of a tree.
#[derive(Clone, Debug, PartialEq)]
pub struct Body {
    /// Shape.
    pub form: Form,
    /// Material.
    pub material: Material,
    /// Reflectivity; above 1 for foil.
    pub reflectivity: f64,
}

/// A car or a pedestrian.
#[derive(Clone, Debug)]
pub struct Vehicle {
    /// Index of its model.
    pub model: usize,
    /// Reflectivity of paint or clothes.
    pub reflectivity: f64,
    /// How it moves.
    pub motion: Motion,
    /// Whether it has labels.
    pub labelled: bool,
}

/// What a ray met.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Object {
    /// The ground.
    Ground,
    /// A house by its number.
    House(u32),
    /// Another body by its number.
    Body(u32),
    /// A vehicle by its number.
    Vehicle(u32),
    /// A part of the ego vehicle.
    Ego,
}

/// Where a ray met a surface.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Distance, m.
    pub range_m: f64,
    /// Outward unit normal, world frame.
    pub normal: Vector3<f64>,
    /// Material.
    pub material: Material,
    /// Reflectivity.
    pub reflectivity: f64,
    /// What it is.
    pub object: Object,
}

impl Hit {
    /// Cosine of the angle of incidence.
    pub fn cos_incidence(&self, direction: &Vector3<f64>) -> f64 {
        self.normal.dot(direction).abs().clamp(1e-3, 1.0)
    }
}

/// The world. Frame: x east, y north, z up, m.
#[derive(Clone, Debug)]
pub struct World {
    /// Ground.
    pub streets: Streets,
    /// Houses.
    pub houses: Vec<House>,
    /// Other bodies.
    pub bodies: Vec<Body>,
    /// Models of vehicles.
    pub models: Vec<Model>,
    /// Vehicles, parked ones first.
    pub vehicles: Vec<Vehicle>,
    /// Reflectivity of carriageways and pavements.
    pub ground_reflectivity: [f64; 2],
    /// Small and large corner, m.
    pub corners: [[f64; 2]; 2],
    grid: Grid,
}

/// Vehicles that move, where they are at one moment.
#[derive(Clone, Debug)]
pub struct Moment {
    moving: Vec<(u32, Place, f64)>,
}

impl Moment {
    /// Numbers and places of the moving vehicles.
    pub fn places(&self) -> impl Iterator<Item = (usize, &Place)> {
        self.moving.iter().map(|(number, place, _)| (*number as usize, place))
    }
}

/// Height of the ground above the highest of nine places of a cell, m: a kerb and the rolling.
const GROUND_MARGIN_M: f64 = 0.2;

/// Reflectivity of the paint of lines on the road.
const PAINTED_LINE: f64 = 0.55;

impl World {
    /// From its parts, ready for ray casting.
    pub fn new(streets: Streets, corners: [[f64; 2]; 2], ground_reflectivity: [f64; 2]) -> World {
        let grid = Grid::over(corners[0], corners[1], |x, y| streets.height_m(x, y), GROUND_MARGIN_M);
        World {
            streets,
            houses: vec![],
            bodies: vec![],
            models: vec![],
            vehicles: vec![],
            ground_reflectivity,
            corners,
            grid,
        }
    }

    /// Makes the grid anew: to be called after any body was added or moved.
    pub fn index(&mut self) {
        let streets = &self.streets;
        self.grid = Grid::over(self.corners[0], self.corners[1], |x, y| streets.height_m(x, y), GROUND_MARGIN_M);
        let mut number = 0;
        let mut add = |bounds: [[f64; 3]; 2]| {
            self.grid.add(number, bounds);
            number += 1;
        };
        self.houses.iter().for_each(|h| add(widened(h.block.bounds(), 0.3)));
        for body in &self.bodies {
            add(match &body.form {
                Form::Block(block) => block.bounds(),
                Form::Post([x, y], radius, [low, high]) => {
                    [[x - radius, y - radius, *low], [x + radius, y + radius, *high]]
                }
                Form::Ball(center, radius) => [-1.0, 1.0].map(|side| [0, 1, 2].map(|k| center[k] + side * radius)),
            });
        }
        for vehicle in &self.vehicles {
            if let Motion::Parked(place) = &vehicle.motion {
                let reach = self.models[vehicle.model].reach_m();
                add([-1.0, 1.0].map(|side| place.center.map(|v| v + side * reach)));
            }
        }
    }

    /// Where a vehicle is at a time, s.
    pub fn place(&self, vehicle: usize, t: f64) -> Place {
        let v = &self.vehicles[vehicle];
        v.motion.place(t, self.models[v.model].size_m[2], &self.streets)
    }

    /// Vehicles that move and are within reach of a place, at a time, s.
    pub fn moment(&self, t: f64, near: &Point3<f64>) -> Moment {
        let moving = (0..self.vehicles.len()).filter(|&i| !matches!(self.vehicles[i].motion, Motion::Parked(_)));
        let placed = moving.map(|i| (i as u32, self.place(i, t), self.models[self.vehicles[i].model].reach_m()));
        let close = |p: &Place| (Point3::from(p.center) - near).norm() < REACH_M + 5.0;
        Moment { moving: placed.filter(|(_, place, _)| close(place)).collect() }
    }

    /// The first surface that a ray with a unit direction meets.
    pub fn cast(&self, moment: &Moment, ray: &Ray) -> Option<Hit> {
        let mut best: Option<Hit> = None;
        for (number, place, reach) in &moment.moving {
            let to = Point3::from(place.center) - ray.origin;
            let along = to.dot(&ray.direction);
            if along > -reach && to.norm_squared() - along * along < reach * reach {
                self.meet_vehicle(*number, place, ray, &mut best);
            }
        }
        let rise = ray.direction.z;
        self.grid.walk(&ray.origin, &ray.direction, REACH_M, |cell, from, to| {
            let lowest = ray.origin.z + rise * if rise < 0.0 { to } else { from };
            if lowest < cell.top_m {
                cell.bodies.iter().for_each(|number| self.meet(*number as usize, ray, &mut best));
            }
            let until = best.map_or(to, |hit| hit.range_m.min(to));
            if lowest < cell.ground_m
                && let Some(t) = self.streets.cross(&ray.origin, &ray.direction, from, until)
            {
                best = Some(self.ground_hit(ray, t));
            }
            best.is_some_and(|hit| hit.range_m <= to)
        });
        best.filter(|hit| hit.range_m < REACH_M)
    }

    /// A ground hit after `t`. Where the ray goes into a kerb, that is the kerb's face.
    fn ground_hit(&self, ray: &Ray, t: f64) -> Hit {
        let p = ray.at(t);
        let streets = &self.streets;
        let (before, after) = (ray.at(t - 2e-3), ray.at(t + 2e-3));
        let is_kerb = streets.is_road(before.x, before.y) && !streets.is_road(after.x, after.y);
        let road = streets.is_road(p.x, p.y);
        let normal = if is_kerb {
            // Kerbs run along the axes.
            let across = usize::from(streets.is_road(after.x, before.y));
            let mut normal = Vector3::zeros();
            normal[across] = -ray.direction[across].signum();
            normal
        } else {
            streets.normal(p.x, p.y)
        };
        let (material, reflectivity) = match (is_kerb || !road, streets.is_painted(p.x, p.y)) {
            (true, _) => (Material::Stone, self.ground_reflectivity[1]),
            (false, true) => (Material::Asphalt, PAINTED_LINE),
            (false, false) => (Material::Asphalt, self.ground_reflectivity[0]),
        };
        Hit { range_m: t, normal, material, reflectivity, object: Object::Ground }
    }

    fn meet(&self, number: usize, ray: &Ray, best: &mut Option<Hit>) {
        let houses = self.houses.len();
        if number < houses {
            let house = &self.houses[number];
            if let Some((t, normal, material)) = house.enter(ray) {
                let reflectivity = if material == Material::Glass { GLASS } else { house.reflectivity };
                keep(best, (t, normal), material, reflectivity, Object::House(number as u32));
            }
        } else if number < houses + self.bodies.len() {
            let body = &self.bodies[number - houses];
            let entry = match &body.form {
                Form::Block(block) => block.enter(ray),
                Form::Post([x, y], radius, [low, high]) => {
                    let shifted = Ray { origin: ray.origin - Vector3::new(*x, *y, 0.0), ..*ray };
                    enter_upright_cylinder(&shifted, *radius, *low, *high)
                }
                Form::Ball(center, radius) => enter_ball(ray, center, *radius),
            };
            if let Some(entry) = entry {
                keep(best, entry, body.material, body.reflectivity, Object::Body((number - houses) as u32));
            }
        } else {
            let vehicle = number - houses - self.bodies.len();
            if let Motion::Parked(place) = &self.vehicles[vehicle].motion {
                self.meet_vehicle(vehicle as u32, place, ray, best);
            }
        }
    }

    fn meet_vehicle(&self, number: u32, place: &Place, ray: &Ray, best: &mut Option<Hit>) {
        let vehicle = &self.vehicles[number as usize];
        if let Some((entry, material)) = self.models[vehicle.model].enter(place, ray) {
            let reflectivity = match material {
                Material::Glass => GLASS,
                Material::Rubber => 0.04,
                Material::Foil => PLATE,
                _ => vehicle.reflectivity,
            };
            keep(best, entry, material, reflectivity, Object::Vehicle(number));
        }
    }
}

/// Reflectivity of glass and of number plates.
const GLASS: f64 = 0.09;
const PLATE: f64 = 3.0;

fn keep(best: &mut Option<Hit>, (t, normal): Entry, material: Material, reflectivity: f64, object: Object) {
    if best.is_none_or(|hit| t < hit.range_m) {
        *best = Some(Hit { range_m: t, normal, material, reflectivity, object });
    }
}

/// Bounds with a margin in all directions, m.
fn widened([low, high]: [[f64; 3]; 2], by_m: f64) -> [[f64; 3]; 2] {
    [low.map(|v| v - by_m), high.map(|v| v + by_m)]
}
