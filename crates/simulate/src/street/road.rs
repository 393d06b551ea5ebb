//! The road under the sensor: lanes, ground material and ground height.

use crate::street::scene::SceneConfig;
use crate::street::solid::{Hit, Material, dot};
use data::Stream;
use rand::RngExt;

/// Width of a lane, m.
pub const LANE_M: f64 = 3.4;
/// Width of a parking strip, m.
pub const PARKING_M: f64 = 2.2;

/// A slightly curved road on slightly uneven ground; the sensor is above its right side.
#[derive(Clone, Debug)]
pub struct Road {
    /// Centre line y = a + b x + c x2, m.
    middle: [f64; 3],
    /// Lanes per direction; right-hand traffic.
    pub lanes: u32,
    /// Whether there are parked cars on the right and on the left side.
    pub parking: [bool; 2],
    /// Distance from the centre line to the walls, right and left, m.
    pub wall_m: [f64; 2],
    ground: Ground,
}

/// z = height + slope . (x, y) + bumps.
#[derive(Clone, Debug)]
struct Ground {
    height_m: f64,
    slope: [f64; 2],
    /// Wave vector (rad/m), phase (rad) and amplitude (m) of each sine wave of the bumps.
    waves: [([f64; 2], f64, f64); 3],
}

impl Road {
    /// Draws a road with the sensor `sensor_height_m` above it.
    pub fn make(config: &SceneConfig, sensor_height_m: f64, random: &mut Stream) -> Road {
        let lanes = random.random_range(1..=2u32);
        let own_lane = random.random_range(0..lanes);
        let from_sensor_to_middle = (f64::from(own_lane) + 0.5) * LANE_M + random.random_range(-0.3..0.3);
        let yaw_rad = config.max_road_yaw_deg.to_radians() * random.random_range(-1.0..1.0);
        let bend_per_m = random.random_range(-1.0..1.0) / 400.0;
        let parking = [random.random_bool(0.5), random.random_bool(0.5)];
        let half_m = |side: usize| f64::from(lanes) * LANE_M + if parking[side] { PARKING_M } else { 0.0 };
        let wall_m = [0, 1].map(|side| half_m(side) + random.random_range(3.0..14.0));
        let slope = [0, 1].map(|_| config.max_slope * random.random_range(-1.0..1.0));
        let waves = [0, 1, 2].map(|_| {
            let (length_m, direction) =
                (random.random_range(3.0..15.0), random.random_range(0.0..std::f64::consts::TAU));
            let k = std::f64::consts::TAU / length_m;
            (
                [k * f64::cos(direction), k * f64::sin(direction)],
                random.random_range(0.0..std::f64::consts::TAU),
                config.roughness_m,
            )
        });
        let ground = Ground { height_m: -sensor_height_m, slope, waves };
        Road { middle: [from_sensor_to_middle, yaw_rad.tan(), bend_per_m / 2.0], lanes, parking, wall_m, ground }
    }

    /// Half width of the road on its right (0) or left (1) side, including parked cars, m.
    pub fn half_width_m(&self, side: usize) -> f64 {
        f64::from(self.lanes) * LANE_M + if self.parking[side] { PARKING_M } else { 0.0 }
    }

    /// Position `lateral_m` to the left of the centre line near x = `along_m`: x, y (m) and heading of the road (rad).
    pub fn place(&self, along_m: f64, lateral_m: f64) -> ([f64; 2], f64) {
        let [a, b, c] = self.middle;
        let yaw_rad = (b + 2.0 * c * along_m).atan();
        let y = a + (b + c * along_m) * along_m;
        ([along_m - lateral_m * yaw_rad.sin(), y + lateral_m * yaw_rad.cos()], yaw_rad)
    }

    /// Lateral offset to the left of the centre line, m.
    pub fn lateral_m(&self, [x, y]: [f64; 2]) -> f64 {
        let [a, b, c] = self.middle;
        (y - a - (b + c * x) * x) * (b + 2.0 * c * x).atan().cos()
    }

    /// Height of the ground without bumps, m.
    pub fn height_m(&self, [x, y]: [f64; 2]) -> f64 {
        let Ground { height_m, slope, .. } = &self.ground;
        height_m + slope[0] * x + slope[1] * y
    }

    /// Intersection of a ray from the origin with the ground.
    pub fn hit(&self, direction: [f64; 3]) -> Option<Hit> {
        let Ground { height_m, slope, waves } = &self.ground;
        let sinking = slope[0] * direction[0] + slope[1] * direction[1] - direction[2];
        if sinking <= 1e-4 {
            return None;
        }
        let mut range_m = -height_m / sinking;
        for _ in 0..2 {
            let [x, y] = [direction[0] * range_m, direction[1] * range_m];
            let bump: f64 =
                waves.iter().map(|(k, phase, amplitude)| amplitude * (k[0] * x + k[1] * y + phase).sin()).sum();
            range_m = (-height_m - bump) / sinking;
        }
        let normal = [-slope[0], -slope[1], 1.0];
        let cos_incidence = -dot(normal, direction) / dot(normal, normal).sqrt();
        let material = self.surface([direction[0] * range_m, direction[1] * range_m]);
        Some(Hit { range_m, cos_incidence, material })
    }

    fn surface(&self, place: [f64; 2]) -> Material {
        let lateral_m = self.lateral_m(place);
        if lateral_m.abs() > self.half_width_m(usize::from(lateral_m > 0.0)) {
            return Material::Verge;
        }
        let lane = (lateral_m.abs() / LANE_M).round();
        let on_line = (lateral_m.abs() - lane * LANE_M).abs() < 0.08 && lane <= f64::from(self.lanes);
        let dashed = lane > 0.0 && lane < f64::from(self.lanes);
        if on_line && (!dashed || place[0].rem_euclid(9.0) < 3.0) { Material::Marking } else { Material::Asphalt }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn roads() -> impl Iterator<Item = Road> {
        let config = SceneConfig::default();
        (0..20).map(move |i| Road::make(&config, 1.73, &mut data::stream(1, "road", 0, i)))
    }

    #[test]
    fn a_place_is_where_it_is_said_to_be() {
        for road in roads() {
            for (along, lateral) in [(0.0, 0.0), (30.0, 5.0), (60.0, -8.0)] {
                let (place, _) = road.place(along, lateral);
                assert!((road.lateral_m(place) - lateral).abs() < 0.2, "{place:?}");
            }
            assert!(road.lateral_m([0.0, 0.0]) < 0.0, "the sensor keeps right");
        }
    }

    #[test]
    fn rays_end_on_the_ground() {
        for road in roads() {
            for pitch_deg in [-2.0f64, -5.0, -20.0] {
                let (sin, cos) = pitch_deg.to_radians().sin_cos();
                let hit = road.hit([cos, 0.0, sin]).unwrap();
                let place = [cos * hit.range_m, 0.0];
                let off = sin * hit.range_m - road.height_m(place);
                assert!(off.abs() < 0.05, "{off} m above the ground at {place:?}");
            }
            assert_eq!(road.hit([1.0, 0.0, 0.1]), None);
        }
    }
}
