//! The surface around a direction: its range, incidence, normal and kind.

use super::Sensors;
use super::scan::{DirectionIndex, Neighbour, SensorScan};
use super::surface::{LocalSurface, fit_surface_through, fit_surface_to};
use geometry::Box3;
use nalgebra::{Isometry3, Vector3};

/// Kind of a surface.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// A level surface.
    Ground,
    /// Walls, posts and other standing surfaces.
    Standing,
    /// A labelled object.
    Object {
        /// Its number in the frame.
        number: u16,
        /// Whether the place lies in a lower corner of the object's box, where vehicles have wheels.
        corner: bool,
    },
}

/// Height above the bottom of a box below which a return is of the ground, m.
const FLOOR_M: f64 = 0.12;

/// Distance from a labelled object within which a surface belongs to it, m.
const OF_OBJECT_M: f64 = 0.2;

/// Smallest upward part of the unit normal of ground.
const LEVEL: f64 = 0.85;

/// Whether a point lies in a box or within a margin beside it, above the ground.
pub fn in_or_beside(bbox: &Box3, point: [f64; 3], margin_m: f64) -> bool {
    if bbox.is_far(point, margin_m) {
        return false;
    }
    let local = bbox.to_local(point);
    let near = (0..3).all(|k| local[k].abs() < bbox.size[k] / 2.0 + margin_m);
    near && local[2] > -bbox.size[2] / 2.0 + FLOOR_M
}

/// Whether a surface with that component of its unit normal along z, the cloud's frame, is level as ground is.
pub fn is_level(normal_z: f64) -> bool {
    normal_z > LEVEL
}

/// Kind of the surface at a place, by the labelled boxes and the upward part of its unit normal, where it has one.
pub fn kind_of(boxes: &[Box3], place: [f64; 3], normal_z: Option<f64>) -> Kind {
    for (k, b) in boxes.iter().enumerate() {
        if in_or_beside(b, place, OF_OBJECT_M) {
            let local = b.to_local(place);
            let beyond = |axis: usize, share: f64| local[axis].abs() > share * b.size[axis];
            let corner = beyond(0, 0.18) && beyond(1, 0.3) && local[2] < 0.06 * b.size[2];
            return Kind::Object { number: k as u16, corner };
        }
    }
    if normal_z.is_some_and(is_level) { Kind::Ground } else { Kind::Standing }
}

/// The returns of one sensor by direction, to look around.
pub struct Surroundings {
    /// Returns by direction.
    pub index: DirectionIndex,
    /// Half widths of the window of neighbours, rad.
    pub window: [f64; 2],
    cloud_from_sensor: Isometry3<f64>,
    edge_m: f64,
}

/// What lies around a direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Around {
    /// Nearest and farthest return; zeros without any, m.
    pub near_far_m: [f32; 2],
    /// The plane of the returns, and its unit normal in the cloud's frame, towards the sensor, where they lie on one
    /// smooth surface.
    pub surface: Option<(LocalSurface, Vector3<f64>)>,
}

impl Surroundings {
    /// Of the returns of a sensor.
    pub fn new(sensors: &Sensors, sensor: usize, scan: &SensorScan) -> Self {
        let mount = &sensors.rig.sensors[sensor];
        let window = sensors.window(sensor);
        Surroundings {
            cloud_from_sensor: mount.pose(),
            index: DirectionIndex::new(scan, window, mount.is_full_circle()),
            window: [f64::from(window.azimuth_rad), f64::from(window.elevation_rad)],
            edge_m: sensors.edge_m,
        }
    }

    /// What lies around a direction; a return itself is left out by its number.
    pub fn look(&self, azimuth_rad: f32, elevation_rad: f32, without: Option<u32>) -> Around {
        let mut neighbours = Vec::new();
        self.index.neighbours(azimuth_rad, elevation_rad, &mut neighbours);
        self.look_at(&neighbours, azimuth_rad, elevation_rad, without)
    }

    /// The same with the neighbours of the direction.
    pub fn look_at(
        &self,
        neighbours: &[Neighbour],
        azimuth_rad: f32,
        elevation_rad: f32,
        without: Option<u32>,
    ) -> Around {
        let others = || neighbours.iter().filter(|n| without != Some(n.entry.index));
        let Some(surface) = fit_surface_to(others(), self.window, elevation_rad) else {
            let near_far = others()
                .fold([f32::INFINITY, 0.0f32], |[near, far], n| [near.min(n.entry.range_m), far.max(n.entry.range_m)]);
            let near_far_m = if near_far[1] > 0.0 { near_far } else { [0.0; 2] };
            return Around { near_far_m, surface: None };
        };
        let normal = || self.normal(&surface, azimuth_rad, elevation_rad);
        Around {
            near_far_m: surface.near_far_m.map(|v| v as f32),
            surface: surface.smooth(self.edge_m).then(|| (surface, normal())),
        }
    }

    /// The surface around a direction of one of the returns there, by its number, where surfaces meet or hide each
    /// other, with its normal as in [`Around::surface`].
    pub fn surface_of(
        &self,
        azimuth_rad: f32,
        elevation_rad: f32,
        return_: u32,
    ) -> Option<(LocalSurface, Vector3<f64>)> {
        let surface = fit_surface_through(&self.index, self.window, azimuth_rad, elevation_rad, return_, self.edge_m)?;
        Some((surface, self.normal(&surface, azimuth_rad, elevation_rad)))
    }

    /// The unit vector of a direction in the cloud's frame.
    pub fn direction(&self, azimuth_rad: f32, elevation_rad: f32) -> Vector3<f64> {
        let (az, el) = (f64::from(azimuth_rad), f64::from(elevation_rad));
        self.cloud_from_sensor.rotation * Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin())
    }

    /// The point in a direction at a range, in the cloud's frame, m.
    pub fn place(&self, direction: &Vector3<f64>, range_m: f64) -> [f64; 3] {
        (self.cloud_from_sensor.translation.vector + direction * range_m).into()
    }

    fn normal(&self, surface: &LocalSurface, azimuth_rad: f32, elevation_rad: f32) -> Vector3<f64> {
        let (az, el) = (f64::from(azimuth_rad), f64::from(elevation_rad));
        let [along, side, up] = surface.normal();
        let u = Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin());
        let left = Vector3::new(-az.sin(), az.cos(), 0.0);
        let n = u * along + left * side + u.cross(&left) * up;
        self.cloud_from_sensor.rotation * n
    }
}
