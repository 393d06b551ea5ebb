//! Built-in car: an open-wheel racing car with the outer dimensions of the Dallara AV-21.
//!
//! Coordinates are in the car frame, which is also the frame of its clouds: origin at the centre of the rear axle,
//! 0.198 m above the ground (the frame of the published sensor mounts), x forward, y left, z up, m.

use crate::mesh::{Mesh, cuboid, cylinder, loft};
use sensor::car::{CAR_SIZE_M, ORIGIN_ABOVE_GROUND_M, REAR_M};
use sensor::material::{MaterialId, MaterialTable};

/// Wheelbase, m (Dallara IL-15, on which the AV-21 is based).
const WHEELBASE_M: f64 = 2.97;
const WHEEL_RADIUS_M: f64 = 0.33;
const GROUND_M: f64 = -ORIGIN_ABOVE_GROUND_M;

/// A cross-section of the body: x, half width, minimum and maximum z, and superellipse exponent (2 is an ellipse).
struct Section(f64, f64, f64, f64, f64);

/// Nose, tub with the sensor recess, engine cover.
const BODY: [Section; 12] = [
    Section(REAR_M + CAR_SIZE_M[0] - 0.02, 0.05, -0.02, 0.06, 2.5),
    Section(3.80, 0.11, -0.05, 0.14, 2.5),
    Section(3.30, 0.16, -0.08, 0.24, 3.0),
    Section(2.80, 0.21, -0.12, 0.33, 3.0),
    Section(2.40, 0.25, -0.15, 0.38, 3.0),
    Section(1.90, 0.27, -0.16, 0.42, 4.0),
    Section(1.50, 0.24, -0.16, 0.50, 4.0),
    Section(1.20, 0.23, -0.16, 0.80, 3.0),
    Section(0.95, 0.22, -0.16, 0.80, 3.0),
    Section(0.45, 0.20, -0.15, 0.55, 3.0),
    Section(0.00, 0.17, -0.12, 0.38, 3.0),
    Section(-0.45, 0.10, -0.05, 0.22, 3.0),
];

fn ring(&Section(x, half_width, low, high, squareness): &Section) -> Vec<[f64; 3]> {
    let point = |i: u32| {
        let (s, c) = (std::f64::consts::TAU * f64::from(i) / 28.0).sin_cos();
        let power = |v: f64| v.signum() * v.abs().powf(2.0 / squareness);
        [x, half_width * power(c), (low + high) / 2.0 + (high - low) / 2.0 * power(s)]
    };
    (0..28).map(point).collect()
}

/// The car as closed meshes: nose, tub and engine cover, side pods, floor, wheels, suspension, front and rear wing.
pub fn race_car() -> Mesh {
    let [paint, carbon, metal] = ["paint", "carbon", "metal"].map(MaterialTable::built_in);
    let front_m = REAR_M + CAR_SIZE_M[0];
    let top_m = GROUND_M + CAR_SIZE_M[2];
    let mut car = loft(&BODY.iter().map(ring).collect::<Vec<_>>(), paint);
    let mut add = |part: Mesh| car.append(&part);
    add(cuboid([-0.30, -0.72, -0.185], [2.30, 0.72, -0.165], carbon)); // floor
    for side in [-1.0, 1.0] {
        let y = |a: f64, b: f64| if side > 0.0 { [a, b] } else { [-b, -a] };
        let mut block = |x: [f64; 2], across: [f64; 2], z: [f64; 2], material: MaterialId| {
            let [left, right] = y(across[0], across[1]);
            add(cuboid([x[0], left, z[0]], [x[1], right, z[1]], material));
        };
        // Front wing: main plane, flap, end plate. Its foremost and lowest points define the box.
        block([front_m - 0.32, front_m], [0.04, 0.90], [-0.13, -0.10], carbon);
        block([front_m - 0.34, front_m - 0.16], [0.25, 0.90], [-0.07, -0.04], paint);
        block([front_m - 0.45, front_m - 0.02], [0.90, 0.92], [-0.15, 0.02], paint);
        // Rear wing: half of main plane and flap, end plate.
        block([REAR_M + 0.05, REAR_M + 0.38], [0.0, 0.52], [top_m - 0.20, top_m - 0.16], carbon);
        block([REAR_M, REAR_M + 0.20], [0.0, 0.52], [top_m - 0.10, top_m - 0.06], carbon);
        block([REAR_M, REAR_M + 0.45], [0.52, 0.54], [top_m - 0.42, top_m], paint);
        block([REAR_M + 0.10, REAR_M + 0.30], [0.08, 0.10], [0.10, top_m - 0.18], metal); // wing support
        // Suspension arms.
        for x in [-0.12, 0.12, WHEELBASE_M - 0.14, WHEELBASE_M + 0.14] {
            block([x - 0.02, x + 0.02], [0.08, 0.70], [0.08, 0.11], metal);
            block([x - 0.02, x + 0.02], [0.08, 0.70], [0.22, 0.25], metal);
        }
        add(side_pod(side, paint));
        for (x, width) in [(0.0, 0.36), (WHEELBASE_M, 0.28)] {
            add(wheel(x, side, width));
        }
    }
    car
}

fn side_pod(side: f64, paint: MaterialId) -> Mesh {
    let sections =
        [(2.05, 0.30, 0.58, 0.14), (1.80, 0.22, 0.72, 0.26), (0.80, 0.20, 0.72, 0.26), (0.25, 0.15, 0.45, 0.12)];
    let ring = |(x, inner, outer, high): (f64, f64, f64, f64)| {
        let points = [
            (inner, -0.16),
            (outer, -0.16),
            (outer + 0.02, 0.0),
            (outer, high - 0.06),
            (outer - 0.1, high),
            (inner, high),
        ];
        points.map(|(y, z)| [x, side * y, z]).to_vec()
    };
    loft(&sections.map(ring), paint)
}

/// A tyre with a rim; its outer face is on the side of the box, its lowest point on the ground.
fn wheel(x: f64, side: f64, width: f64) -> Mesh {
    const SIDES: u32 = 32;
    let outer = CAR_SIZE_M[1] / 2.0;
    let profile = [
        (0.20, 0.01),
        (0.29, 0.0),
        (WHEEL_RADIUS_M, 0.04),
        (WHEEL_RADIUS_M, width - 0.04),
        (0.29, width),
        (0.20, width - 0.01),
    ];
    let ring = |(radius, inwards): (f64, f64)| {
        let point = |i: u32| {
            // Rotated by a quarter of a side, so that a corner touches the ground.
            let (s, c) = (std::f64::consts::TAU * f64::from(i) / f64::from(SIDES)).sin_cos();
            [x + radius * s, side * (outer - inwards), GROUND_M + WHEEL_RADIUS_M - radius * c]
        };
        (0..SIDES).map(point).collect()
    };
    let mut wheel = loft(&profile.map(ring), MaterialTable::built_in("rubber"));
    let centre = |inwards: f64| [x, side * (outer - inwards), GROUND_M + WHEEL_RADIUS_M];
    wheel.append(&cylinder(centre(0.005), centre(width - 0.02), 0.19, 20, MaterialTable::built_in("metal")));
    wheel
}

#[cfg(test)]
mod tests {
    use super::*;
    use sensor::car::car_box;

    #[test]
    fn the_mesh_fills_the_box_of_the_car() {
        let car = race_car();
        let [low, high] = car.bounds().unwrap();
        let bbox = car_box();
        for k in 0..3 {
            assert!((low[k] - (bbox.center[k] - bbox.size[k] / 2.0)).abs() < 1e-9, "low {k}: {low:?}");
            assert!((high[k] - (bbox.center[k] + bbox.size[k] / 2.0)).abs() < 1e-9, "high {k}: {high:?}");
        }
        assert_eq!(car.open_edges(), 0);
        assert!((1_500..6_000).contains(&car.faces.len()), "{}", car.faces.len());
    }

    #[test]
    fn the_published_mounts_are_outside_of_the_body() {
        for [x, y, z] in [[2.342, 0.0, 0.448], [1.549, 0.267, 0.543], [1.549, -0.267, 0.543]] {
            let i = BODY.iter().position(|s| s.0 < x).unwrap();
            let (a, b) = (&BODY[i - 1], &BODY[i]);
            let part = (a.0 - x) / (a.0 - b.0);
            let [width, high] = [a.1 + part * (b.1 - a.1), a.3 + part * (b.3 - a.3)];
            assert!(z > high || y.abs() > width, "({x}, {y}, {z}): body up to {high}, half width {width}");
        }
    }

    #[test]
    fn every_part_has_its_material() {
        let car = race_car();
        for name in ["paint", "carbon", "rubber", "metal"] {
            let id = MaterialTable::built_in(name);
            assert!(car.faces.iter().filter(|f| f.material == id).count() > 50, "{name}");
        }
    }
}
