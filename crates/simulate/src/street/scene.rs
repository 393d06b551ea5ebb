//! A street scene: a road, cars, and other objects.

use crate::street::cars::Car;
use crate::street::road::{LANE_M, PARKING_M, Road};
use crate::street::roadside;
use crate::street::sensor::SensorConfig;
use crate::street::solid::Solid;
use data::KeyError;
use data::Stream;
use data::toml_text::{within, wrong};
use geometry::{Box3, bev_intersection};
use rand::RngExt;
use rand_distr::{Distribution, Normal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::PI;

/// Range of car centres ahead of the sensor, m.
pub const CAR_AHEAD_M: [f64; 2] = [3.0, 60.0];
/// Maximum lateral distance of car centres from the sensor, m.
pub const CAR_ASIDE_M: f64 = 30.0;

/// The road and the objects on it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SceneConfig {
    /// Minimum and maximum number of cars per scene. Cars without a free position are omitted.
    pub cars: [u32; 2],
    /// Fraction of the cars beside the road, with any heading; the others follow the road.
    pub any_heading_share: f64,
    /// Minimum and maximum number of distractors: pillars, bushes, bins, signs, containers, trees.
    pub distractors: [u32; 2],
    /// Maximum slope of the ground, m per m.
    pub max_slope: f64,
    /// Height of the ground waves, m.
    pub roughness_m: f64,
    /// Maximum angle between the sensor's forward axis and the road, degrees.
    pub max_road_yaw_deg: f64,
}

impl Default for SceneConfig {
    fn default() -> Self {
        SceneConfig {
            cars: [3, 8],
            any_heading_share: 0.15,
            distractors: [6, 16],
            max_slope: 0.004,
            roughness_m: 0.01,
            max_road_yaw_deg: 8.0,
        }
    }
}

impl SceneConfig {
    pub(crate) fn check(&self) -> Result<(), KeyError> {
        for (field, [least, greatest]) in [("scene.cars", self.cars), ("scene.distractors", self.distractors)] {
            if least > greatest || greatest > 200 {
                return Err(wrong(field, format!("[{least}, {greatest}] is not a range of numbers up to 200")));
            }
        }
        within("scene.any_heading_share", self.any_heading_share, 0.0, 1.0)?;
        within("scene.max_slope", self.max_slope, 0.0, 0.02)?;
        within("scene.roughness_m", self.roughness_m, 0.0, 0.1)?;
        within("scene.max_road_yaw_deg", self.max_road_yaw_deg, 0.0, 30.0)
    }
}

/// Everything that rays can hit.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Road and ground.
    pub road: Road,
    /// Cars, walls and other objects above the ground.
    pub solids: Vec<Solid>,
    /// True boxes of the cars; [`Solid::car`] is an index into this list.
    pub cars: Vec<Box3>,
}

impl Scene {
    /// Draws a scene in front of `sensor`.
    pub fn make(config: &SceneConfig, sensor: &SensorConfig, random: &mut Stream) -> Scene {
        let road = Road::make(config, sensor.height_m, random);
        let mut taken = Taken::default();
        taken.try_take(&Box3::from_array([0.0, 0.0, 0.0, 6.0, 2.6, 1.0, 0.0]), 0.0);
        let (mut solids, mut cars) = (Vec::new(), Vec::new());
        for _ in 0..random.random_range(config.cars[0]..=config.cars[1]) {
            let Some(car) = place_car(config, sensor, &road, &mut taken, random) else { continue };
            solids.extend(car.solids().map(|solid| solid.of_car(cars.len())));
            cars.push(car.bbox);
        }
        let distractors = random.random_range(config.distractors[0]..=config.distractors[1]);
        solids.extend(roadside::walls(&road, &mut taken, random));
        solids.extend(roadside::poles(&road, &mut taken, random));
        solids.extend(roadside::distractors(&road, distractors, &mut taken, random));
        Scene { road, solids, cars }
    }
}

/// Occupied positions.
#[derive(Default)]
pub(crate) struct Taken(Vec<Box3>);

impl Taken {
    /// Occupies the base of `b` and returns true, unless an object is closer than `gap_m`.
    pub(crate) fn try_take(&mut self, b: &Box3, gap_m: f64) -> bool {
        let wide = Box3 { size: [b.size[0] + 2.0 * gap_m, b.size[1] + 2.0 * gap_m, b.size[2]], ..*b };
        let free = self.0.iter().all(|other| bev_intersection(&wide, other) == 0.0);
        if free {
            self.0.push(*b);
        }
        free
    }
}

/// A car at a free position within the sensor's field of view; `None` if none was found after several tries.
fn place_car(
    config: &SceneConfig,
    sensor: &SensorConfig,
    road: &Road,
    taken: &mut Taken,
    random: &mut Stream,
) -> Option<Car> {
    let car = Car::make(random);
    for _ in 0..20 {
        let ([x, y], yaw_rad) = if random.random_bool(config.any_heading_share) {
            beside_the_road(road, random)
        } else {
            along_the_road(road, random)
        };
        let car = car.clone().placed([x, y, road.height_m([x, y])], yaw_rad);
        let inside = (CAR_AHEAD_M[0]..=CAR_AHEAD_M[1]).contains(&x)
            && y.abs() <= CAR_ASIDE_M
            && car.bbox.bev_corners().iter().all(|corner| sensor.covers(*corner));
        if inside && taken.try_take(&car.bbox, 0.4) {
            return Some(car);
        }
    }
    None
}

/// A position in a lane, or at the kerb if cars are parked there; right-hand traffic, parked cars face either way.
fn along_the_road(road: &Road, random: &mut Stream) -> ([f64; 2], f64) {
    let along_m = random.random_range(CAR_AHEAD_M[0]..CAR_AHEAD_M[1]);
    let left = random.random_bool(0.5);
    let strips = road.lanes + u32::from(road.parking[usize::from(left)]);
    let strip = random.random_range(0..strips);
    let parked = strip == road.lanes;
    let middle_m = f64::from(strip) * LANE_M + if parked { PARKING_M } else { LANE_M } / 2.0;
    let swerve = Normal::new(0.0, if parked { 0.04 } else { 0.025 }).expect("a deviation of that size");
    let lateral_m = middle_m + random.random_range(-0.25..0.25);
    let (place, road_yaw) = road.place(along_m, if left { lateral_m } else { -lateral_m });
    let turned = if parked { random.random_bool(0.5) } else { left };
    (place, road_yaw + swerve.sample(random) + if turned { PI } else { 0.0 })
}

/// A position between the road and the walls, with any heading.
fn beside_the_road(road: &Road, random: &mut Stream) -> ([f64; 2], f64) {
    let along_m = random.random_range(CAR_AHEAD_M[0]..CAR_AHEAD_M[1]);
    let side = usize::from(random.random_bool(0.5));
    let lateral_m = random.random_range(road.half_width_m(side)..road.wall_m[side]);
    let (place, _) = road.place(along_m, if side == 1 { lateral_m } else { -lateral_m });
    (place, random.random_range(-PI..PI))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenes() -> impl Iterator<Item = Scene> {
        let (config, sensor) = (SceneConfig::default(), SensorConfig::default());
        (0..60).map(move |i| Scene::make(&config, &sensor, &mut data::stream(5, "scene", 0, i)))
    }

    #[test]
    fn cars_stand_where_they_should() {
        let (mut along, mut all) = (0, 0);
        for scene in scenes() {
            for (i, car) in scene.cars.iter().enumerate() {
                let [x, y, _] = car.center;
                assert!((CAR_AHEAD_M[0]..=CAR_AHEAD_M[1]).contains(&x) && y.abs() <= CAR_ASIDE_M);
                assert!((car.z_range().0 - scene.road.height_m([x, y])).abs() < 1e-9, "wheels on the ground");
                assert!((car.z_range().0 + 1.73).abs() < 0.4);
                assert!((-PI..PI).contains(&car.yaw_rad));
                assert!(scene.cars[..i].iter().all(|other| bev_intersection(car, other) == 0.0));
                along += usize::from(car.yaw_rad.sin().abs() < 0.4);
                all += 1;
            }
        }
        assert!(all > 200, "{all} cars in 60 scenes");
        assert!(along * 10 > all * 7 && along < all, "{along} of {all} along the road");
    }

    #[test]
    fn nothing_stands_in_a_car() {
        for scene in scenes() {
            for solid in scene.solids.iter().filter(|s| s.car.is_none()) {
                let (middle, half) = solid.azimuths();
                assert!(half <= PI && middle.abs() <= PI);
            }
            for (i, car) in scene.cars.iter().enumerate() {
                let [x, y, z] = car.center;
                let range_m = (x * x + y * y + z * z).sqrt();
                let direction = car.center.map(|c| c / range_m);
                let hits = scene.solids.iter().filter_map(|s| Some((s.hit(direction)?, s.car)));
                let inside = hits.filter(|(hit, owner)| *owner != Some(i) && (hit.range_m - range_m).abs() < 0.3);
                assert_eq!(inside.count(), 0, "something stands in car {i}");
            }
        }
    }
}
