//! One return with its covariates.

use nalgebra::{Point3, Vector3};
use sensor::signal::{DIAGNOSIS_REFLECTIVITY, signal_index};
use std::f64::consts::TAU;

/// Kind of the simulated surface in the direction of a ray.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Surface {
    /// A level surface below the sensor.
    Ground,
    /// Walls, posts and other standing surfaces.
    Standing,
    /// A labelled object.
    Object,
    /// The simulation has no return around this direction.
    Open,
}

/// Place of a return relative to the simulated returns around its direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Lies {
    /// On their surface, or at an edge on one of the two or between them.
    On,
    /// Nearer.
    InFront,
    /// Farther.
    Behind,
    /// There are none.
    Open,
}

/// A return of either side. Predictions are from the simulated returns around its direction; a simulated return
/// itself is left out, so that both sides are treated alike.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Number of the sensor.
    pub sensor: u8,
    /// Kind of the simulated surface in this direction.
    pub surface: Surface,
    /// Whether the simulation has one smooth surface around this direction, without an edge.
    pub smooth: bool,
    /// Whether it lies in a lower corner of the labelled object's box, where vehicles have wheels.
    pub corner: bool,
    /// Whether it lies in the box of a labelled object or so near to it that it belongs to the object, if that is
    /// larger than its label.
    pub at_object: bool,
    /// Whether the other side has a return in this direction, at any range.
    pub matched: bool,
    /// Number of neighbours of its own side at about its range.
    pub company: u8,
    /// Of a simulated return: whether the measured side has one in this direction at about its range. (For a measured
    /// one, [`Ray::lies`] tells it.)
    pub shown: bool,
    /// Row of the sensor; `u16::MAX` where rows are not known.
    pub row: u16,
    /// Number of the labelled object in the frame; `u16::MAX` for none.
    pub object: u16,
    /// Azimuth in which it was sent, in the sensor's frame, rad.
    pub azimuth_rad: f32,
    /// Elevation in which it was sent, in the sensor's frame, rad.
    pub elevation_rad: f32,
    /// Predicted range, m; the return's own range without a smooth surface.
    pub range_m: f32,
    /// Cosine of the angle of incidence on the predicted surface; 0 without one.
    pub cos_incidence: f32,
    /// Unit vector of the ray in the cloud's frame.
    pub direction: [f32; 3],
    /// Where the return was recorded, from the sensor's origin in the cloud's axes, m: elsewhere than along `direction`
    /// where a displacement was undone. What the sensor does wrong, it does there.
    pub recorded_m: [f32; 3],
    /// Unit normal of the predicted surface in the cloud's frame, towards the sensor.
    pub normal: [f32; 3],
    /// Range minus predicted range, m.
    pub residual_m: f32,
    /// Range of the simulated return closest in direction minus that of the fitted plane, m.
    pub bulge_m: f32,
    /// Variance of the prediction in units of that of one simulated range.
    pub leverage: f32,
    /// Range minus the range predicted from the neighbours of its own side, m; NaN without such a prediction.
    pub roughness_m: f32,
    /// Variance of that prediction in units of that of one range.
    pub roughness_leverage: f32,
    /// Nearest and farthest simulated return around the direction, m; 0 without any.
    pub near_far_m: [f32; 2],
    /// Its intensity; NaN in clouds without the column.
    pub intensity: f32,
    /// Mean intensity of the simulated returns on the surface around its direction, itself left out; NaN without such
    /// returns.
    pub intensity_simulated: f32,
    /// The same of its own side.
    pub intensity_beside: f32,
}

/// Directions about the vehicle, of 45 degrees each.
pub const OCTANTS: usize = 8;

/// The octant of an azimuth, rad.
pub(super) fn octant_of(azimuth_rad: f64) -> usize {
    let turn = (azimuth_rad / TAU).rem_euclid(1.0);
    ((turn * OCTANTS as f64) as usize).min(OCTANTS - 1)
}

impl Ray {
    /// Its own range, m.
    pub fn own_range_m(&self) -> f64 {
        f64::from(self.range_m) + f64::from(self.residual_m)
    }

    /// Whether nothing simulated explains it: it lies before all surfaces, or where the simulation sent a shot that did
    /// not return.
    pub fn is_in_the_air(&self) -> bool {
        match self.lies() {
            Lies::InFront => true,
            // Without rows nothing says that the simulation sent a shot there.
            Lies::Open => self.row != u16::MAX,
            _ => false,
        }
    }

    /// Its place in the cloud's frame, from the sensor's origin.
    pub fn point(&self, origin: &Point3<f64>) -> Point3<f64> {
        origin + self.direction_vector() * self.own_range_m()
    }

    /// The predicted point in the cloud's frame, from the sensor's origin.
    pub fn predicted_point(&self, origin: &Point3<f64>) -> Point3<f64> {
        origin + self.direction_vector() * f64::from(self.range_m)
    }

    /// Number of the eighth of a turn, in the cloud's axes, in which it was recorded.
    pub fn octant(&self) -> usize {
        octant_of(f64::from(self.recorded_m[1]).atan2(f64::from(self.recorded_m[0])))
    }

    /// Where it was recorded, as a vector from the sensor's origin, m.
    pub fn recorded_vector(&self) -> Vector3<f64> {
        Vector3::from(self.recorded_m.map(f64::from))
    }

    /// Range at which the surface would have been recorded, m. At grazing incidence the recorded range contains the
    /// distance that is to be explained.
    pub fn recorded_range_m(&self) -> f64 {
        self.recorded_vector().norm() - f64::from(self.residual_m)
    }

    /// Derivative of the distance across the surface by the recorded range.
    pub fn range_lever(&self) -> f64 {
        let recorded = self.recorded_vector();
        self.normal_vector().dot(&recorded) / recorded.norm().max(1e-3)
    }

    /// The direction as a vector.
    pub fn direction_vector(&self) -> Vector3<f64> {
        Vector3::from(self.direction.map(f64::from))
    }

    /// The normal as a vector.
    pub fn normal_vector(&self) -> Vector3<f64> {
        Vector3::from(self.normal.map(f64::from))
    }

    /// Distance of the return from the predicted surface, across it, m; positive on the sensor's side.
    pub fn across_m(&self) -> f64 {
        -f64::from(self.residual_m) * f64::from(self.cos_incidence)
    }

    /// [`Ray::across_m`] relative to the simulated return closest in direction: without the error of a plane on a
    /// curved surface.
    pub fn across_nearest_m(&self) -> f64 {
        -f64::from(self.residual_m - self.bulge_m) * f64::from(self.cos_incidence)
    }

    /// Its place relative to the simulated returns around its direction.
    pub fn lies(&self) -> Lies {
        if self.near_far_m[1] <= 0.0 {
            return Lies::Open;
        }
        let own = self.own_range_m();
        if self.smooth {
            return match self.residual_m {
                d if self.across_m().abs() < 0.3 || d.abs() < 0.6 => Lies::On,
                d if d < 0.0 => Lies::InFront,
                _ => Lies::Behind,
            };
        }
        let [near, far] = self.near_far_m.map(f64::from);
        let margin = super::gap_margin_m(near);
        match own {
            r if r < near - margin => Lies::InFront,
            r if r > far + margin => Lies::Behind,
            _ => Lies::On,
        }
    }

    /// The signal index of the predicted surface, at the reflectivity that the diagnosis assumes.
    pub fn signal(&self) -> f64 {
        signal_index(DIAGNOSIS_REFLECTIVITY, self.cos_incidence.max(1e-4).into(), self.range_m.max(0.1).into())
    }
}

#[cfg(test)]
impl Ray {
    /// A return of a static surface at a place, m from the sensor, that it faces.
    pub fn standing(at: &Vector3<f64>) -> Ray {
        let direction = at.normalize().cast::<f32>();
        Ray {
            sensor: 0,
            surface: Surface::Standing,
            smooth: true,
            corner: false,
            at_object: false,
            matched: true,
            shown: false,
            company: 5,
            row: 0,
            object: u16::MAX,
            azimuth_rad: at.y.atan2(at.x) as f32,
            elevation_rad: at.z.atan2(at.xy().norm()) as f32,
            range_m: at.norm() as f32,
            cos_incidence: 1.0,
            direction: direction.into(),
            recorded_m: at.cast::<f32>().into(),
            normal: (-direction).into(),
            residual_m: 0.0,
            bulge_m: 0.0,
            leverage: 0.2,
            roughness_m: 0.0,
            roughness_leverage: 0.2,
            near_far_m: [at.norm() as f32; 2],
            intensity: f32::NAN,
            intensity_simulated: f32::NAN,
            intensity_beside: f32::NAN,
        }
    }
}
