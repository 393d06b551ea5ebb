//! Models of cars, vans and pedestrians. Model frame: x forward, y left, z up, origin at the centre of the box, m.

use crate::solid::{Entry, Hull, Material, Ray, enter_ball, enter_upright_cylinder};
use data::Stream;
use nalgebra::{Point3, Vector3};
use rand::RngExt;

/// Part of a model.
#[derive(Clone, Debug)]
enum Part {
    Hull(Hull),
    /// Centre, radius, half of the width; the axle is along y.
    Wheel(Point3<f64>, f64, f64),
    /// Radius, lowest and highest z.
    Torso(f64, f64, f64),
    /// Height and radius.
    Head(f64, f64),
}

/// A shape of cars or pedestrians.
#[derive(Clone, Debug)]
pub struct Model {
    /// Length, width, height of the labelled box, m.
    pub size_m: [f64; 3],
    /// Class of its labels.
    pub class: &'static str,
    /// Factors on length, width and height of the body, from the middle of the underside. The label keeps its size.
    pub stretch: [f64; 3],
    parts: Vec<Part>,
}

/// A place of a model: centre of its box (world frame, m) and heading (rad).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Centre of the box, m.
    pub center: [f64; 3],
    /// Counter-clockwise from x, rad.
    pub heading_rad: f64,
}

fn plane(normal: [f64; 3], through: [f64; 3], material: Material) -> (Vector3<f64>, f64, Material) {
    let normal = Vector3::from(normal).normalize();
    (normal, normal.dot(&Vector3::from(through)), material)
}

impl Model {
    /// A car, an estate car or a van.
    pub fn car(rng: &mut Stream) -> Model {
        let van = rng.random_bool(0.2);
        let size_m = if van {
            [rng.random_range(4.8..5.6), rng.random_range(1.9..2.05), rng.random_range(1.95..2.3)]
        } else {
            [rng.random_range(3.8..4.8), rng.random_range(1.7..1.9), rng.random_range(1.4..1.65)]
        };
        let [l, w, h] = size_m.map(|v: f64| v / 2.0);
        let (floor, waist, roof) = (-h + 0.18, if van { 0.0 } else { 0.1 * h }, h);
        let (paint, glass) = (Material::Paint, Material::Glass);
        let slope = rng.random_range(0.12..0.3);
        let body = Hull {
            faces: vec![
                plane([1.0, 0.0, slope], [l, 0.0, floor + 0.3], paint),
                plane([-1.0, 0.0, 0.1], [-l, 0.0, floor + 0.3], paint),
                plane([0.0, 1.0, 0.06], [0.0, w - 0.04, floor + 0.3], paint),
                plane([0.0, -1.0, 0.06], [0.0, 0.04 - w, floor + 0.3], paint),
                plane([0.0, 0.0, 1.0], [0.0, 0.0, waist], paint),
                plane([0.0, 0.0, -1.0], [0.0, 0.0, floor], paint),
            ],
        };
        let (front, back) = (if van { 0.75 * l } else { 0.4 * l }, -l * rng.random_range(0.75..0.95));
        let side = if van { 0.1 } else { 0.3 };
        let cabin = Hull {
            faces: vec![
                plane([1.0, 0.0, rng.random_range(0.8..1.3)], [front, 0.0, waist], glass),
                plane([-1.0, 0.0, rng.random_range(0.2..0.8)], [back, 0.0, waist], glass),
                plane([0.0, 1.0, side], [0.0, 0.94 * w, waist], if van { paint } else { glass }),
                plane([0.0, -1.0, side], [0.0, -0.94 * w, waist], if van { paint } else { glass }),
                plane([0.0, 0.0, 1.0], [0.0, 0.0, roof], paint),
                plane([0.0, 0.0, -1.0], [0.0, 0.0, waist], paint),
            ],
        };
        let mut parts = vec![Part::Hull(body), Part::Hull(cabin)];
        // Wheels stand out a little.
        for x in [0.62 * l, -0.58 * l] {
            for y in [w - 0.11, 0.11 - w] {
                parts.push(Part::Wheel(Point3::new(x, y, -h + 0.32), 0.32, 0.11));
            }
        }
        for x in [l - 0.01, 0.01 - l] {
            let faces = (0..3).flat_map(|k| {
                let half = [0.02, 0.26, 0.06];
                let center = [x, 0.0, floor + 0.3];
                [-1.0, 1.0].map(|sign| {
                    let mut normal = [0.0; 3];
                    let mut through = center;
                    (normal[k], through[k]) = (sign, center[k] + sign * half[k]);
                    plane(normal, through, Material::Foil)
                })
            });
            parts.push(Part::Hull(Hull { faces: faces.collect() }));
        }
        Model { size_m, class: "Car", stretch: [1.0; 3], parts }
    }

    /// A standing or walking person.
    pub fn pedestrian(rng: &mut Stream) -> Model {
        let height = rng.random_range(1.55..1.9);
        let radius = rng.random_range(0.2..0.28);
        let shoulder = height / 2.0 - 0.28;
        let parts = vec![Part::Torso(radius, -height / 2.0, shoulder), Part::Head(shoulder + 0.16, 0.12)];
        let size_m = [2.0 * radius, 2.0 * radius, height];
        Model { size_m, class: "Pedestrian", stretch: [1.0; 3], parts }
    }

    /// Radius of a ball about the centre of the box that holds the body, m.
    pub fn reach_m(&self) -> f64 {
        let [l, w, h] = [0, 1, 2].map(|k| self.size_m[k] * self.stretch[k]);
        0.5 * (l * l + w * w + (2.0 * h).powi(2)).sqrt()
    }

    /// Entry of a ray in the world, with the normal in the world and the material.
    pub fn enter(&self, place: &Place, ray: &Ray) -> Option<(Entry, Material)> {
        let (sin, cos) = place.heading_rad.sin_cos();
        let to = ray.origin - Point3::from(place.center);
        let into = |v: &Vector3<f64>| Vector3::new(cos * v.x + sin * v.y, cos * v.y - sin * v.x, v.z);
        // Stretched from the middle of the underside.
        let under = self.size_m[2] / 2.0;
        let (mut origin, mut direction) = (into(&to), into(&ray.direction));
        origin.z += under;
        for k in 0..3 {
            origin[k] /= self.stretch[k];
            direction[k] /= self.stretch[k];
        }
        origin.z -= under;
        let local = Ray { origin: Point3::from(origin), direction };
        let mut best: Option<(Entry, Material)> = None;
        for part in &self.parts {
            let met = match part {
                Part::Hull(hull) => hull.enter(&local),
                Part::Wheel(center, radius, half) => {
                    // About y: the axes are turned so that the axle is upright.
                    let turned = |v: Vector3<f64>| Vector3::new(v.x, -v.z, v.y);
                    let about =
                        Ray { origin: Point3::from(turned(local.origin - center)), direction: turned(local.direction) };
                    let entry = enter_upright_cylinder(&about, *radius, -half, *half);
                    entry.map(|(t, n)| ((t, Vector3::new(n.x, n.z, -n.y)), Material::Rubber))
                }
                Part::Torso(radius, low, high) => {
                    enter_upright_cylinder(&local, *radius, *low, *high).map(|entry| (entry, Material::Cloth))
                }
                Part::Head(height, radius) => {
                    enter_ball(&local, &Point3::new(0.0, 0.0, *height), *radius).map(|entry| (entry, Material::Cloth))
                }
            };
            if let Some(((t, _), _)) = met
                && best.as_ref().is_none_or(|b| t < b.0.0)
            {
                best = met;
            }
        }
        best.map(|((t, n), material)| {
            let n = Vector3::new(n.x / self.stretch[0], n.y / self.stretch[1], n.z / self.stretch[2]).normalize();
            ((t, Vector3::new(cos * n.x - sin * n.y, sin * n.x + cos * n.y, n.z)), material)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn from_side(model: &Model, from: [f64; 3], direction: [f64; 3]) -> Option<(f64, Material)> {
        let place = Place { center: [0.0, 0.0, model.size_m[2] / 2.0], heading_rad: 0.0 };
        let ray = Ray { origin: Point3::from(from), direction: Vector3::from(direction) };
        model.enter(&place, &ray).map(|((t, _), material)| (t, material))
    }

    #[test]
    fn cars_have_bodies_wheels_and_number_plates_inside_of_their_box() {
        for seed in 0..10 {
            let model = Model::car(&mut data::stream(seed, "car", 0, 0));
            let [l, w, h] = model.size_m;
            let (t, material) = from_side(&model, [20.0, 0.0, 0.48], [-1.0, 0.0, 0.0]).unwrap();
            assert!(material == Material::Foil && (t - (20.0 - l / 2.0)).abs() < 0.05);
            let (t, material) = from_side(&model, [0.31 * l, 20.0, 0.2], [0.0, -1.0, 0.0]).unwrap();
            assert!(material == Material::Rubber && (t - (20.0 - w / 2.0)).abs() < 0.05, "{t}");
            let (t, material) = from_side(&model, [-0.2 * l, 0.0, 20.0], [0.0, 0.0, -1.0]).unwrap();
            assert!(material == Material::Paint && (t - (20.0 - h)).abs() < 1e-9);
            assert!(from_side(&model, [20.0, 0.0, h + 0.1], [-1.0, 0.0, 0.0]).is_none());
        }
    }

    #[test]
    fn a_stretched_car_stands_on_the_ground_and_is_longer_and_higher() {
        let mut model = Model::car(&mut data::stream(3, "car", 0, 0));
        model.stretch = [1.1, 1.0, 1.2];
        let (t, _) = from_side(&model, [20.0, 0.0, 0.576], [-1.0, 0.0, 0.0]).unwrap();
        assert!((t - (20.0 - 0.55 * model.size_m[0])).abs() < 0.05);
        let (t, _) = from_side(&model, [-0.2 * model.size_m[0], 0.0, 20.0], [0.0, 0.0, -1.0]).unwrap();
        assert!((t - (20.0 - 1.2 * model.size_m[2])).abs() < 1e-9);
    }
}
