//! Predictions of the simulation for a direction: the surface around it, its range, incidence and kind.

use super::of_sensor::{company, company_m};
use super::ray::{Ray, Surface};
use super::roughness::LONE;
use geometry::Box3;
use nalgebra::Vector3;
use sensor::directions::{
    Kind, LocalSurface, Neighbour, SensorScan, Sensors, Surroundings, fit_surface_to, in_or_beside, kind_of,
};

/// Distance from a labelled object within which a return belongs to it: objects may be larger than their labels, m.
const BESIDE_M: f64 = 0.5;

/// Predictor of the simulated side of one sensor.
pub(super) struct Predictor<'a> {
    sensor: usize,
    sensors: &'a Sensors,
    /// Simulated returns by direction.
    pub(super) around: Surroundings,
    boxes: &'a [Box3],
    others: Vec<Box3>,
    intensities: Intensities<'a>,
}

impl<'a> Predictor<'a> {
    /// For the number of a sensor, its simulated returns, and the simulated labels.
    pub(super) fn new(sensors: &'a Sensors, sensor: usize, simulated: &'a SensorScan, boxes: &'a [Box3]) -> Self {
        let origin = sensors.rig.sensors[sensor].pose().translation.vector;
        Predictor {
            sensor,
            sensors,
            others: others(boxes, origin.into()),
            around: Surroundings::new(sensors, sensor, simulated),
            boxes,
            intensities: Intensities::of(simulated),
        }
    }

    /// Distance across a plane from which on a neighbour belongs to another surface, m.
    pub(super) fn edge_m(&self) -> f64 {
        self.sensors.edge_m
    }

    /// A return of the simulated scan itself with what the others say, and their surface where it is a smooth one.
    /// `neighbours` receives the simulated returns around it, and itself.
    pub(super) fn own_ray(
        &self,
        scan: &SensorScan,
        i: usize,
        neighbours: &mut Vec<Neighbour>,
    ) -> (Ray, Option<LocalSurface>) {
        let itself = Some(i as u32);
        let (mut ray, surface) = self.seen(scan, i, itself, neighbours);
        ray.company = company(neighbours, scan.range_m[i], itself);
        ray.intensity_beside = ray.intensity_simulated;
        if ray.smooth && ray.company > LONE {
            (ray.roughness_m, ray.roughness_leverage) = (ray.residual_m, ray.leverage);
        }
        (ray, surface)
    }

    /// A return of a scan of that sensor with the prediction for its direction, and the surface that predicts it where
    /// there is a smooth one. A simulated return is left out of it by its number. `neighbours` receives the simulated
    /// returns around the direction.
    pub(super) fn seen(
        &self,
        scan: &SensorScan,
        i: usize,
        without: Option<u32>,
        neighbours: &mut Vec<Neighbour>,
    ) -> (Ray, Option<LocalSurface>) {
        let (az, el, range) = (scan.azimuth_rad[i], scan.elevation_rad[i], scan.range_m[i]);
        let direction = self.around.direction(az, el);
        let mut ray = Ray {
            sensor: self.sensor as u8,
            surface: Surface::Open,
            smooth: false,
            corner: false,
            at_object: at_object(&self.others, self.around.place(&direction, f64::from(range))),
            matched: false,
            company: 0,
            shown: false,
            row: self.sensors.row(self.sensor, el, range),
            object: u16::MAX,
            azimuth_rad: az,
            elevation_rad: el,
            range_m: range,
            cos_incidence: 0.0,
            direction: direction.cast::<f32>().into(),
            recorded_m: (direction * f64::from(range)).cast::<f32>().into(),
            normal: [0.0; 3],
            residual_m: 0.0,
            bulge_m: 0.0,
            leverage: 0.0,
            roughness_m: f32::NAN,
            roughness_leverage: 0.0,
            near_far_m: [0.0; 2],
            intensity: scan.intensity.get(i).copied().unwrap_or(f32::NAN),
            intensity_simulated: f32::NAN,
            intensity_beside: f32::NAN,
        };
        self.around.index.neighbours(az, el, neighbours);
        let around = self.around.look_at(neighbours, az, el, without);
        ray.near_far_m = around.near_far_m;
        match around.surface {
            Some((surface, normal)) => {
                ray.smooth = true;
                ray.range_m = surface.range_m as f32;
                ray.residual_m = (f64::from(range) - surface.range_m) as f32;
                ray.cos_incidence = surface.cos_incidence as f32;
                ray.leverage = surface.leverage as f32;
                ray.bulge_m = surface.bulge_m as f32;
                ray.normal = normal.cast::<f32>().into();
                ray.intensity_simulated = self.intensities.mean(neighbours, ray.range_m, without);
                self.set_kind(&mut ray, &direction, surface.range_m, Some(normal.z));
            }
            None if ray.near_far_m[1] > 0.0 => self.set_kind(&mut ray, &direction, f64::from(range), None),
            None => {}
        }
        (ray, around.surface.map(|(surface, _)| surface))
    }

    /// Whether the other simulated returns around one lie on one smooth surface. `neighbours` is overwritten.
    pub(super) fn is_smooth(&self, simulated: &SensorScan, i: usize, neighbours: &mut Vec<Neighbour>) -> bool {
        self.surface(simulated, i, Some(i as u32), neighbours).is_some()
    }

    /// Distance of a return of a scan of that sensor from the simulated surface, across it, m; `None` without a smooth
    /// one. `neighbours` is overwritten.
    pub(super) fn across_m(&self, scan: &SensorScan, i: usize, neighbours: &mut Vec<Neighbour>) -> Option<f64> {
        let surface = self.surface(scan, i, None, neighbours)?;
        Some((f64::from(scan.range_m[i]) - surface.range_m).abs() * surface.cos_incidence)
    }

    fn surface(
        &self,
        scan: &SensorScan,
        i: usize,
        without: Option<u32>,
        neighbours: &mut Vec<Neighbour>,
    ) -> Option<LocalSurface> {
        self.around.index.neighbours(scan.azimuth_rad[i], scan.elevation_rad[i], neighbours);
        let others = neighbours.iter().filter(|n| without != Some(n.entry.index));
        fit_surface_to(others, self.around.window, scan.elevation_rad[i]).filter(|s| s.smooth(self.edge_m()))
    }

    /// Sets the kind of the surface in a direction at a range.
    fn set_kind(&self, ray: &mut Ray, direction: &Vector3<f64>, range_m: f64, normal_z: Option<f64>) {
        ray.surface = match kind_of(self.boxes, self.around.place(direction, range_m), normal_z) {
            Kind::Ground => Surface::Ground,
            Kind::Standing => Surface::Standing,
            Kind::Object { number, corner } => {
                (ray.object, ray.corner) = (number, corner);
                Surface::Object
            }
        };
    }
}

/// Standard deviation of ln(intensity) up to which a surface is evenly bright.
const EVEN: f64 = 0.2;

/// Intensities of the returns of a scan, and their logarithms; empty without the column.
pub(super) struct Intensities<'a> {
    own: &'a [f32],
    ln: Vec<f64>,
}

impl<'a> Intensities<'a> {
    /// Those of a scan.
    pub(super) fn of(scan: &'a SensorScan) -> Self {
        Intensities { own: &scan.intensity, ln: scan.intensity.iter().map(|v| f64::from(*v).ln()).collect() }
    }

    /// Mean intensity of some returns of the scan at about a range, m; NaN where there is none, or where they are not
    /// evenly bright: the mean does not tell what another return there would have. A return itself is left out by its
    /// number.
    pub(super) fn mean(&self, neighbours: &[Neighbour], range_m: f32, without: Option<u32>) -> f32 {
        if self.own.is_empty() {
            return f32::NAN;
        }
        let reach_m = company_m(f64::from(range_m)) as f32;
        let [mut n, mut sum, mut ln, mut square] = [0.0f64; 4];
        for Neighbour { entry, .. } in neighbours {
            if without != Some(entry.index) && (entry.range_m - range_m).abs() < reach_m {
                let own_ln = self.ln[entry.index as usize];
                (n, sum) = (n + 1.0, sum + f64::from(self.own[entry.index as usize]));
                (ln, square) = (ln + own_ln, square + own_ln.powi(2));
            }
        }
        // A dark return makes the logarithms infinite, and the deviation no number.
        let even = square / n - (ln / n).powi(2) < EVEN * EVEN;
        if even { (sum / n) as f32 } else { f32::NAN }
    }
}

/// The labelled objects except the ego vehicle, whose box contains the sensor.
fn others(boxes: &[Box3], origin: [f64; 3]) -> Vec<Box3> {
    boxes.iter().filter(|b| !in_or_beside(b, origin, BESIDE_M)).copied().collect()
}

/// Whether a point lies on a labelled object or beside it.
pub fn at_object(others: &[Box3], place: [f64; 3]) -> bool {
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
