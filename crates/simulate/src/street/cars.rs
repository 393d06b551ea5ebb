//! Cars of the street: boxes to detect, and the solids in them that the LiDAR sees.

use crate::street::solid::{Material, Slice, Solid};
use data::Stream;
use geometry::Box3;
use rand::RngExt;

/// Body style, relative to length and height.
struct Style {
    /// Mean length, width and height, m.
    size_m: [f64; 3],
    /// Height of the lower window edge.
    belt: f64,
    /// Rear and front end of the windows, at the bottom and top, from -0.5 (rear) to 0.5 (front).
    cabin: [[f64; 2]; 2],
    /// Slope of the bonnet towards the front.
    bonnet_drop: f64,
}

/// Hatchback, saloon, SUV and van; the mean size is about 3.9 m x 1.6 m x 1.56 m.
const STYLES: [Style; 4] = [
    Style { size_m: [3.7, 1.60, 1.50], belt: 0.58, cabin: [[-0.48, 0.24], [-0.42, 0.04]], bonnet_drop: 0.06 },
    Style { size_m: [4.2, 1.64, 1.45], belt: 0.60, cabin: [[-0.38, 0.22], [-0.24, 0.04]], bonnet_drop: 0.05 },
    Style { size_m: [4.1, 1.68, 1.68], belt: 0.60, cabin: [[-0.49, 0.24], [-0.46, 0.10]], bonnet_drop: 0.04 },
    Style { size_m: [3.8, 1.62, 1.72], belt: 0.55, cabin: [[-0.50, 0.36], [-0.47, 0.20]], bonnet_drop: 0.08 },
];

/// A car: its tight bounding box and its solids.
#[derive(Clone, Debug)]
pub struct Car {
    /// The true box, with the wheels on the ground.
    pub bbox: Box3,
    style: usize,
    paint: f64,
}

impl Car {
    /// Draws a car's style, size and paint; its box is at the origin until it is [placed](Car::placed).
    pub fn make(random: &mut Stream) -> Car {
        let style = random.random_range(0..STYLES.len());
        let scale = random.random_range(0.94..1.06);
        let size = STYLES[style].size_m.map(|m| m * scale * random.random_range(0.97..1.03));
        let bbox = Box3 { center: [0.0; 3], size, yaw_rad: 0.0 };
        Car { bbox, style, paint: random.random_range(0.15..0.9) }
    }

    /// The car moved to `place` (x, y, z in m) with its wheels on the ground.
    pub fn placed(mut self, [x, y, z]: [f64; 3], yaw_rad: f64) -> Car {
        self.bbox.center = [x, y, z + self.bbox.size[2] / 2.0];
        self.bbox.yaw_rad = yaw_rad;
        self.bbox = self.bbox.with_wrapped_yaw();
        self
    }

    /// Body, bonnet, windows under a roof, and two axles: all convex, inside the box, and touching each of its sides.
    pub fn solids(&self) -> [Solid; 5] {
        let Style { belt, cabin, bonnet_drop, .. } = &STYLES[self.style];
        let [length, width, height] = self.bbox.size;
        let z = |share: f64| (share - 0.5) * height;
        let slice = |[rear, front]: [f64; 2], width_share: f64| Slice {
            x: [rear * length, front * length],
            half_width: width * width_share / 2.0,
        };
        let paint = [Material::Paint(self.paint); 2];
        let bumper = 0.45;
        let solid = |low, high, heights, materials| Solid::frustum(&self.bbox, [low, high], heights, materials);
        [
            solid(slice([-0.5, 0.5], 1.0), slice([-0.5, 0.5], 1.0), [z(0.12), z(bumper)], paint),
            solid(slice([-0.5, 0.49], 1.0), slice([-0.49, cabin[0][1]], 0.98), [z(bumper), z(*belt)], paint),
            solid(
                slice(cabin[0], 0.95),
                slice(cabin[1], 0.78),
                [z(belt - bonnet_drop), z(1.0)],
                [Material::Glass, paint[0]],
            ),
            self.axle(0.31 * length),
            self.axle(-0.31 * length),
        ]
    }

    fn axle(&self, x_m: f64) -> Solid {
        let [_, width, height] = self.bbox.size;
        let tyre = Slice { x: [x_m - 0.3, x_m + 0.3], half_width: 0.48 * width };
        Solid::frustum(&self.bbox, [tyre, tyre], [-0.5 * height, -0.5 * height + 0.5], [Material::Rubber; 2])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_those_of_the_anchor() {
        let mut random = data::stream(0, "cars", 0, 0);
        let cars: Vec<Car> = (0..2000).map(|_| Car::make(&mut random)).collect();
        for (axis, want) in [3.9, 1.6, 1.56].into_iter().enumerate() {
            let mean = cars.iter().map(|c| c.bbox.size[axis]).sum::<f64>() / cars.len() as f64;
            assert!((mean - want).abs() < 0.06, "axis {axis}: {mean} m");
        }
        let lengths = cars.iter().map(|c| c.bbox.size[0]);
        let (short, long) = lengths.fold((f64::MAX, f64::MIN), |(a, b), v| (a.min(v), b.max(v)));
        assert!(short > 3.2 && long < 4.8, "{short} {long}");
    }

    #[test]
    fn what_is_seen_fills_the_box_and_stays_inside() {
        let mut random = data::stream(0, "cars", 0, 1);
        for i in 0..8 {
            let yaw = f64::from(i) * 0.8;
            let car = Car::make(&mut random).placed([12.0, 1.0, -1.73], yaw);
            let solids = car.solids();
            let mut seen = [[f64::MAX, f64::MIN]; 3];
            for a in -400..400 {
                for e in -300..60 {
                    let (azimuth, elevation) = (f64::from(a) * 0.001, f64::from(e) * 0.001);
                    let direction = [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()];
                    let hits = solids.iter().filter_map(|s| s.hit(direction));
                    let Some(hit) = hits.min_by(|a, b| a.range_m.total_cmp(&b.range_m)) else { continue };
                    let local = car.bbox.to_local(direction.map(|d| d * hit.range_m));
                    for k in 0..3 {
                        let share = local[k] / car.bbox.size[k];
                        assert!(share.abs() < 0.5 + 1e-9, "axis {k}: {share}");
                        seen[k] = [seen[k][0].min(share), seen[k][1].max(share)];
                    }
                }
            }
            assert!(seen[2][0] < -0.49 && seen[2][1] > 0.49, "height {:?}", seen[2]);
            assert!(seen[0][0] < -0.48 || seen[0][1] > 0.48, "length {:?}", seen[0]);
            assert!(seen[1][0] < -0.48 || seen[1][1] > 0.48, "width {:?}", seen[1]);
        }
    }
}
