//! Predictions of the simulation for a direction: the surface around it, its range, incidence and kind.

use super::boxes::in_or_beside;
use super::frame::Sensors;
use super::ray::{Ray, Surface};
use super::scan::{DirectionIndex, SensorScan};
use super::surface::{LocalSurface, fit_surface};
use geometry::Box3;
use nalgebra::{Isometry3, UnitQuaternion, Vector3};

/// Distance from a labelled object within which a return belongs to it: objects may be larger than their labels, m.
const BESIDE_M: f64 = 0.5;

/// Distance from a labelled object within which a simulated surface belongs to it, m.
const OF_OBJECT_M: f64 = 0.2;

/// Predictor of the simulated side of one sensor.
pub(super) struct Predictor<'a> {
    sensor: usize,
    sensors: &'a Sensors,
    cloud_from_sensor: Isometry3<f64>,
    /// Simulated returns by direction.
    pub(super) index: DirectionIndex,
    /// Half widths of the window of neighbours, rad.
    pub(super) window: [f64; 2],
    boxes: &'a [Box3],
    others: Vec<Box3>,
}

impl<'a> Predictor<'a> {
    /// For the number of a sensor, its simulated returns, and the simulated labels.
    pub(super) fn new(sensors: &'a Sensors, sensor: usize, simulated: &SensorScan, boxes: &'a [Box3]) -> Self {
        let mount = &sensors.rig.sensors[sensor];
        let window = sensors.window(sensor);
        Predictor {
            sensor,
            sensors,
            others: others(boxes, mount.pose().translation.vector.into()),
            cloud_from_sensor: mount.pose(),
            index: DirectionIndex::new(simulated, window, mount.is_full_circle()),
            window: [f64::from(window.azimuth_rad), f64::from(window.elevation_rad)],
            boxes,
        }
    }

    /// A return of a scan of that sensor with the prediction for its direction.
    pub(super) fn ray(&self, scan: &SensorScan, i: usize, without_itself: bool) -> Ray {
        let (az, el, range) = (scan.azimuth_rad[i], scan.elevation_rad[i], scan.range_m[i]);
        let direction = unit(&self.cloud_from_sensor.rotation, az, el);
        let row = self.sensors.row(self.sensor, el);
        let mut ray = Ray {
            sensor: self.sensor as u8,
            surface: Surface::Open,
            smooth: false,
            corner: false,
            at_object: at_object(&self.others, self.place(&direction, f64::from(range))),
            matched: false,
            company: 0,
            in_gap: false,
            row,
            object: u16::MAX,
            azimuth_rad: az,
            elevation_rad: el,
            range_m: range,
            cos_incidence: 0.0,
            direction: direction.cast::<f32>().into(),
            normal: [0.0; 3],
            residual_m: 0.0,
            bulge_m: 0.0,
            leverage: 0.0,
            roughness_m: f32::NAN,
            roughness_leverage: 0.0,
            near_far_m: [0.0; 2],
        };
        let others = |e: &super::scan::Entry| !without_itself || e.index != i as u32;
        let Some(surface) = fit_surface(&self.index, self.window, az, el, others) else {
            let mut near_far = [f32::INFINITY, 0.0f32];
            self.index.around(az, el, |e, _, _| {
                if others(e) {
                    near_far = [near_far[0].min(e.range_m), near_far[1].max(e.range_m)];
                }
            });
            if near_far[1] > 0.0 {
                ray.near_far_m = near_far;
                ray.surface = self.surface_at(&direction, f64::from(range), None, &mut ray);
            }
            return ray;
        };
        ray.near_far_m = surface.near_far_m.map(|v| v as f32);
        ray.smooth = surface.smooth(self.sensors.edge_m);
        if !ray.smooth {
            ray.surface = self.surface_at(&direction, f64::from(range), None, &mut ray);
            return ray;
        }
        let normal = self.normal(&surface, az, el);
        ray.range_m = surface.range_m as f32;
        ray.residual_m = (f64::from(range) - surface.range_m) as f32;
        ray.cos_incidence = surface.cos_incidence as f32;
        ray.leverage = surface.leverage as f32;
        ray.bulge_m = surface.bulge_m as f32;
        ray.normal = normal.cast::<f32>().into();
        ray.surface = self.surface_at(&direction, surface.range_m, Some(&normal), &mut ray);
        ray
    }

    /// The point in a direction at a range, in the cloud's frame, m.
    fn place(&self, direction: &Vector3<f64>, range_m: f64) -> [f64; 3] {
        (self.cloud_from_sensor.translation.vector + direction * range_m).into()
    }

    fn normal(&self, surface: &LocalSurface, az: f32, el: f32) -> Vector3<f64> {
        let (az, el) = (f64::from(az), f64::from(el));
        let [along, side, up] = surface.normal();
        let u = Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin());
        let left = Vector3::new(-az.sin(), az.cos(), 0.0);
        let n = u * along + left * side + u.cross(&left) * up;
        self.cloud_from_sensor.rotation * n
    }

    fn surface_at(
        &self,
        direction: &Vector3<f64>,
        range: f64,
        normal: Option<&Vector3<f64>>,
        ray: &mut Ray,
    ) -> Surface {
        let p = self.place(direction, range);
        for (k, b) in self.boxes.iter().enumerate() {
            if in_or_beside(b, p, OF_OBJECT_M) {
                ray.object = k as u16;
                let local = b.to_local(p);
                let beyond = |axis: usize, share: f64| local[axis].abs() > share * b.size[axis];
                ray.corner = beyond(0, 0.18) && beyond(1, 0.3) && local[2] < 0.06 * b.size[2];
                return Surface::Object;
            }
        }
        if normal.is_some_and(|n| n.z > 0.85) { Surface::Ground } else { Surface::Standing }
    }
}

fn unit(turn: &UnitQuaternion<f64>, az: f32, el: f32) -> Vector3<f64> {
    let (az, el) = (f64::from(az), f64::from(el));
    turn * Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin())
}

/// The labelled objects except the ego vehicle, whose box contains the sensor.
fn others(boxes: &[Box3], origin: [f64; 3]) -> Vec<Box3> {
    boxes.iter().filter(|b| !in_or_beside(b, origin, BESIDE_M)).copied().collect()
}

/// Whether a point lies on a labelled object or beside it.
fn at_object(others: &[Box3], place: [f64; 3]) -> bool {
    others.iter().any(|b| in_or_beside(b, place, BESIDE_M))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn points_beside_a_label_belong_to_the_object_and_the_ego_vehicle_is_none() {
        let origin = Vector3::new(0.0, 0.0, 1.0);
        let ahead = |elevation_rad: f64| Vector3::new(elevation_rad.cos(), 0.0, elevation_rad.sin());
        let car = Box3::from_array([20.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0]);
        let own = Box3::from_array([0.0, 0.0, 0.8, 5.0, 2.0, 1.6, 0.0]);
        let at = |b: Box3, range_m: f64, elevation_rad: f64| {
            at_object(&others(&[b], origin.into()), (origin + ahead(elevation_rad) * range_m).into())
        };
        assert!(at(car, 18.0, 0.0) && at(car, 17.7, 0.0), "a vehicle may be longer than its label");
        assert!(!at(car, 17.0, 0.0));
        assert!(!at(car, 20.0, -0.048), "the road below it");
        assert!(!at(own, 1.0, 0.0), "the sensor stands in it");
    }
}
