//! Car shapes: a few boxes and four wheels. Car frame: x forward, z up, origin at the centre of the bounding box.

use crate::solid::{Form, Material, Solid};
use data::Stream;
use nalgebra::{Isometry3, Vector3};
use rand::RngExt;

/// A car shape.
#[derive(Clone, Debug)]
pub struct CarShape {
    /// Length, width, height of the bounding box, m.
    pub size_m: [f64; 3],
    /// The parts.
    pub parts: Vec<Solid>,
}

/// Draws a car shape. Paint reflectivity is drawn per car elsewhere; other materials have fixed reflectivity.
pub fn draw_shape(rng: &mut Stream) -> CarShape {
    if rng.random_bool(0.6) { open_wheeler(rng) } else { saloon(rng) }
}

fn part(center: [f64; 3], size: [f64; 3], material: Material) -> Solid {
    Solid {
        pose: Isometry3::translation(center[0], center[1], center[2]),
        form: Form::Cuboid(Vector3::from(size) / 2.0),
        material,
    }
}

fn wheels(size: [f64; 3], axles: [f64; 2], radius: f64, width: f64) -> Vec<Solid> {
    let y = size[1] / 2.0 - width / 2.0;
    let at = |x: f64, y: f64| Solid {
        pose: Isometry3::translation(x, y, radius - size[2] / 2.0),
        form: Form::Wheel(radius, width / 2.0),
        material: Material::Rubber,
    };
    axles.iter().flat_map(|&x| [at(x, y), at(x, -y)]).collect()
}

fn open_wheeler(rng: &mut Stream) -> CarShape {
    let [l, w, h] =
        [4.7 + 0.5 * rng.random::<f64>(), 1.85 + 0.15 * rng.random::<f64>(), 1.1 + 0.15 * rng.random::<f64>()];
    let floor = -h / 2.0;
    let mut parts = wheels([l, w, h], [0.33 * l, -0.30 * l], 0.32, 0.33);
    parts.push(part([0.30 * l, 0.0, floor + 0.30], [0.40 * l, 0.34, 0.24], Material::Paint)); // nose
    parts.push(part([-0.03 * l, 0.0, floor + 0.36], [0.36 * l, 0.70, 0.46], Material::Paint)); // tub
    parts.push(part([-0.14 * l, 0.0, floor + 0.26], [0.30 * l, 1.35, 0.34], Material::Paint)); // side pods
    parts.push(part([-0.16 * l, 0.0, floor + 0.72], [0.22 * l, 0.38, 0.50], Material::Paint)); // engine cover
    parts.push(part([0.47 * l, 0.0, floor + 0.14], [0.06 * l, w, 0.08], Material::Carbon)); // front wing
    parts.push(part([-0.46 * l, 0.0, floor + 0.86], [0.08 * l, 0.9 * w, 0.24], Material::Carbon)); // rear wing
    parts.push(part([-0.43 * l, 0.0, floor + 0.5], [0.10 * l, 0.2, 0.6], Material::Carbon)); // rear wing pillar
    parts.push(part([-0.2 * l, 0.0, h / 2.0 - 0.06], [0.3, 0.2, 0.12], Material::Carbon)); // sensor head
    CarShape { size_m: [l, w, h], parts }
}

fn saloon(rng: &mut Stream) -> CarShape {
    let [l, w, h] =
        [4.1 + 0.8 * rng.random::<f64>(), 1.75 + 0.2 * rng.random::<f64>(), 1.35 + 0.25 * rng.random::<f64>()];
    let floor = -h / 2.0;
    let mut parts = wheels([l, w, h], [0.3 * l, -0.3 * l], 0.31, 0.22);
    parts.push(part([0.0, 0.0, floor + 0.5], [l, 0.94 * w, 0.6], Material::Paint));
    parts.push(part([-0.06 * l, 0.0, (floor + 0.8 + h / 2.0) / 2.0], [0.52 * l, 0.86 * w, h - 0.8], Material::Paint));
    CarShape { size_m: [l, w, h], parts }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_lie_inside_of_the_box() {
        for seed in 0..20 {
            let shape = draw_shape(&mut data::stream(seed, "car", 0, 0));
            for p in &shape.parts {
                let half = match p.form {
                    Form::Cuboid(half) => half,
                    Form::Wheel(r, w) => Vector3::new(r, w, r),
                };
                for k in 0..3 {
                    let end = p.pose.translation.vector[k].abs() + half[k];
                    assert!(end <= shape.size_m[k] / 2.0 + 0.02, "axis {k}: {end} of {:?}", shape.size_m);
                }
            }
        }
    }
}
