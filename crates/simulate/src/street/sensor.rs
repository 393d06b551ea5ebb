//! A spinning multi-beam LiDAR: its rays and returns.

use crate::street::scene::Scene;
use crate::street::solid::{Hit, Material};
use data::KeyError;
use data::toml_text::{within, wrong};
use data::{Cloud, Stream};
use rand::RngExt;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Detection threshold: reflectivity x cosine of incidence / range squared (1/m2). Asphalt is detected up to about 50
/// m.
const LEAST_LIGHT_PER_M2: f64 = 4e-6;

/// The LiDAR. The default has the elevation range of a Velodyne HDL-64E (2 degrees above to 24.8 below the horizon,
/// the upper of two laser blocks denser) with fewer beams, and covers only the region ahead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SensorConfig {
    /// Height above the road, m.
    pub height_m: f64,
    /// Laser blocks, from the top.
    pub beam_blocks: Vec<BeamBlock>,
    /// Horizontal field of view, centred on the forward axis, degrees.
    pub horizontal_fov_deg: f64,
    /// Azimuth step between columns, degrees.
    pub azimuth_step_deg: f64,
    /// Maximum range, m.
    pub max_range_m: f64,
    /// Standard deviation of the range noise, m.
    pub range_noise_m: f64,
    /// Fraction of the returns lost at random.
    pub dropout: f64,
}

/// Lasers with equal angular spacing.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct BeamBlock {
    /// Number of lasers.
    pub rows: u32,
    /// Elevation of the first laser, degrees above the horizon.
    pub top_deg: f64,
    /// Elevation of the last laser, degrees above the horizon.
    pub bottom_deg: f64,
}

impl Default for SensorConfig {
    fn default() -> Self {
        SensorConfig {
            height_m: 1.73,
            beam_blocks: vec![
                BeamBlock { rows: 26, top_deg: 2.0, bottom_deg: -8.3 },
                BeamBlock { rows: 16, top_deg: -9.0, bottom_deg: -24.8 },
            ],
            horizontal_fov_deg: 96.0,
            azimuth_step_deg: 0.2,
            max_range_m: 100.0,
            range_noise_m: 0.02,
            dropout: 0.03,
        }
    }
}

impl SensorConfig {
    pub(crate) fn check(&self) -> Result<(), KeyError> {
        within("sensor.height_m", self.height_m, 0.3, 5.0)?;
        if self.beam_blocks.is_empty() || self.beam_blocks.iter().any(|b| !(1..=256).contains(&b.rows)) {
            return Err(wrong("sensor.beam_blocks", "there must be a block, and 1 to 256 rows in each"));
        }
        for block in &self.beam_blocks {
            within("sensor.beam_blocks.top_deg", block.top_deg, -89.0, 89.0)?;
            within("sensor.beam_blocks.bottom_deg", block.bottom_deg, -89.0, block.top_deg)?;
        }
        within("sensor.horizontal_fov_deg", self.horizontal_fov_deg, 10.0, 360.0)?;
        within("sensor.azimuth_step_deg", self.azimuth_step_deg, 0.01, 5.0)?;
        within("sensor.max_range_m", self.max_range_m, 10.0, 1000.0)?;
        within("sensor.range_noise_m", self.range_noise_m, 0.0, 1.0)?;
        within("sensor.dropout", self.dropout, 0.0, 0.99)
    }

    /// Whether a position (x, y) is in the horizontal field of view.
    pub fn covers(&self, [x, y]: [f64; 2]) -> bool {
        y.atan2(x).abs().to_degrees() <= self.horizontal_fov_deg / 2.0
    }

    /// Elevation of each row, from the top, rad.
    fn elevations_rad(&self) -> Vec<f64> {
        let of_block = |b: &BeamBlock| {
            let (rows, top, step) = (b.rows, b.top_deg, (b.top_deg - b.bottom_deg) / f64::from((b.rows - 1).max(1)));
            (0..rows).map(move |i| (top - step * f64::from(i)).to_radians())
        };
        self.beam_blocks.iter().flat_map(of_block).collect()
    }

    /// Azimuth of each column, from the left, rad.
    fn azimuths_rad(&self) -> Vec<f64> {
        let columns = (self.horizontal_fov_deg / self.azimuth_step_deg).floor() as u32;
        let left_deg = self.azimuth_step_deg * f64::from(columns - 1) / 2.0;
        (0..columns).map(|i| (left_deg - self.azimuth_step_deg * f64::from(i)).to_radians()).collect()
    }
}

/// The scan of one scene.
#[derive(Clone, Debug, PartialEq)]
pub struct Scan {
    /// x, y, z (m, rounded to 1 mm) and intensity (0 to 1, in steps of 0.01, as in KITTI); row by row from the top,
    /// each from left to right.
    pub cloud: Cloud,
    /// Visibility of each car of the scene.
    pub cars: Vec<Sight>,
}

/// Visibility of a car.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub struct Sight {
    /// Points on the car.
    pub points: usize,
    /// Rays that would hit it without occlusion.
    pub rays: usize,
    /// Rays that hit it first.
    pub free_rays: usize,
}

impl Sight {
    /// KITTI's occlusion level: 0 visible, 1 partly occluded, 2 largely occluded.
    pub fn occlusion(&self) -> i32 {
        match self.free_rays as f64 / self.rays.max(1) as f64 {
            free if free > 0.8 => 0,
            free if free > 0.4 => 1,
            _ => 2,
        }
    }
}

/// Simulates one scan.
pub fn scan(scene: &Scene, sensor: &SensorConfig, random: &mut Stream) -> Scan {
    let azimuths = sensor.azimuths_rad();
    let columns: Vec<Vec<usize>> = azimuths.iter().map(|azimuth| in_sight(scene, *azimuth)).collect();
    let mut cloud = Cloud::new(4);
    let mut cars = vec![Sight::default(); scene.cars.len()];
    for elevation in sensor.elevations_rad() {
        for (azimuth, candidates) in azimuths.iter().zip(&columns) {
            let direction = [azimuth.cos() * elevation.cos(), azimuth.sin() * elevation.cos(), elevation.sin()];
            let (hit, car) = cast(scene, candidates, direction, &mut cars);
            let Some([range_m, intensity]) = hit.and_then(|hit| measure(&hit, sensor, random)) else { continue };
            let [x, y, z] = direction.map(|d| ((d * range_m * 1e3).round() / 1e3) as f32);
            cloud.values.extend([x, y, z, ((intensity * 100.0).round() / 100.0) as f32]);
            if let Some(car) = car {
                cars[car].points += 1;
            }
        }
    }
    Scan { cloud, cars }
}

/// Solids that a column of rays may hit.
fn in_sight(scene: &Scene, azimuth_rad: f64) -> Vec<usize> {
    let near = |solid: &crate::street::solid::Solid| {
        let (middle, half) = solid.azimuths();
        geometry::limit_period(azimuth_rad - middle, 0.5, std::f64::consts::TAU).abs() <= half
    };
    scene.solids.iter().enumerate().filter(|(_, solid)| near(solid)).map(|(i, _)| i).collect()
}

/// The nearest surface along a ray and its car; counts the cars that the ray hits.
fn cast(scene: &Scene, candidates: &[usize], direction: [f64; 3], cars: &mut [Sight]) -> (Option<Hit>, Option<usize>) {
    let (mut nearest, mut owner, mut last_counted) = (scene.road.hit(direction), None, None);
    for solid in candidates.iter().map(|i| &scene.solids[*i]) {
        let Some(hit) = solid.hit(direction) else { continue };
        if let Some(car) = solid.car.filter(|car| last_counted != Some(*car)) {
            last_counted = Some(car); // solids of a car are consecutive
            cars[car].rays += 1;
        }
        if nearest.is_none_or(|n| hit.range_m < n.range_m) {
            (nearest, owner) = (Some(hit), solid.car);
        }
    }
    if let Some(car) = owner {
        cars[car].free_rays += 1;
    }
    (nearest, owner)
}

/// Range (m) and intensity returned by a surface, or `None`.
fn measure(hit: &Hit, sensor: &SensorConfig, random: &mut Stream) -> Option<[f64; 2]> {
    let (lost, depth, noise): (f64, f64, [f64; 2]) =
        (random.random(), random.random(), [0, 1].map(|_| StandardNormal.sample(random)));
    let reflectivity = match hit.material {
        Material::Asphalt => 0.25,
        Material::Marking => 0.7,
        Material::Verge => 0.35,
        Material::Wall(reflectivity) | Material::Paint(reflectivity) => reflectivity,
        Material::Glass => 0.1,
        Material::Rubber => 0.1,
        Material::Metal => 0.6,
        Material::Leaves => 0.4,
    };
    let through = if hit.material == Material::Glass { 0.5 } else { 0.0 };
    let light = reflectivity * hit.cos_incidence / (hit.range_m * hit.range_m);
    if lost < 1.0 - (1.0 - sensor.dropout) * (1.0 - through) || light < LEAST_LIGHT_PER_M2 {
        return None;
    }
    let into_leaves_m = if hit.material == Material::Leaves { 0.3 * depth } else { 0.0 };
    let range_m = hit.range_m + into_leaves_m + sensor.range_noise_m * noise[0];
    let intensity = reflectivity * (0.3 + 0.7 * hit.cos_incidence) + 0.02 * noise[1];
    (0.5..=sensor.max_range_m).contains(&range_m).then_some([range_m, intensity.clamp(0.0, 1.0)])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::scene::SceneConfig;

    fn scans() -> impl Iterator<Item = (Scene, Scan)> {
        let (config, sensor) = (SceneConfig::default(), SensorConfig::default());
        (0..12).map(move |i| {
            let scene = Scene::make(&config, &sensor, &mut data::stream(2, "scene", 0, i));
            let scan = scan(&scene, &sensor, &mut data::stream(2, "sensor", 0, i));
            (scene, scan)
        })
    }

    #[test]
    fn clouds_are_like_those_of_a_lidar() {
        for (scene, scan) in scans() {
            let points = scan.cloud.len();
            assert!((13_000..=20_200).contains(&points), "{points} points");
            let ground = scan.cloud.points().filter(|p| {
                let place = [f64::from(p[0]), f64::from(p[1])];
                (f64::from(p[2]) - scene.road.height_m(place)).abs() < 0.1
            });
            let share = ground.count() as f64 / points as f64;
            assert!((0.3..0.9).contains(&share), "{share} of the points on the ground");
            for p in scan.cloud.points() {
                let azimuth_deg = p[1].atan2(p[0]).to_degrees();
                assert!(azimuth_deg.abs() <= 48.1 && p[0] > 0.0 && (0.0..=1.0).contains(&p[3]));
            }
        }
    }

    #[test]
    fn points_of_a_car_lie_in_its_box() {
        let mut most_visible = 0;
        for (scene, scan) in scans() {
            for (bbox, sight) in scene.cars.iter().zip(&scan.cars) {
                let inside = scan.cloud.points().filter(|p| {
                    let local = bbox.to_local([f64::from(p[0]), f64::from(p[1]), f64::from(p[2])]);
                    (0..3).all(|k| local[k].abs() <= bbox.size[k] / 2.0 + 0.1)
                });
                assert!(inside.count() as f64 >= sight.points as f64 * 0.99);
                assert!(sight.points <= sight.free_rays && sight.free_rays <= sight.rays);
                most_visible += usize::from(sight.occlusion() == 0);
            }
        }
        assert!(most_visible > 20, "{most_visible}");
    }

    #[test]
    fn a_wide_sensor_turns_all_the_way() {
        let sensor = SensorConfig { horizontal_fov_deg: 360.0, azimuth_step_deg: 1.0, ..SensorConfig::default() };
        let azimuths = sensor.azimuths_rad();
        assert_eq!(azimuths.len(), 360);
        assert!((azimuths[0] + azimuths[359]).abs() < 1e-12);
        assert!(sensor.covers([-5.0, 0.0]));
        assert_eq!(SensorConfig::default().elevations_rad().len(), 42);
    }
}
