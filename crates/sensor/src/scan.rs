//! Echoes of one scan, which the sensor model changes: one per shot.

use crate::material::MaterialId;
use crate::object::FIRST_CAR;
use crate::signal::returned_light_index;
use data::Cloud;

/// Where the angle of incidence of an echo is from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default)]
pub enum Incidence {
    /// From the surface itself.
    #[default]
    Known,
    /// Of a surface fitted to the returns around it in a finished cloud.
    Estimated,
    /// No surface can be fitted around it, but one of other returns goes on through it.
    Continued,
    /// No surface is known: that of a return beside it, or assumed.
    Assumed,
}

/// One shot and its return. Origin and direction are those that the sensor reports, in the cloud's frame; the true ray
/// can differ.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Echo {
    /// Index of the sensor in its rig.
    pub sensor: u8,
    /// 0: first return of the shot; 1: second.
    pub number: u8,
    /// Row of the sensor's pattern; [`Echo::UNKNOWN`] if it is not known.
    pub row: u16,
    /// Column of the sensor's pattern; [`Echo::UNKNOWN`] if it is not known.
    pub column: u16,
    /// Time of the shot relative to the middle of the scan, s.
    pub time_s: f32,
    /// Origin of the shot, m.
    pub origin: [f32; 3],
    /// Direction of the shot, unit vector.
    pub direction: [f32; 3],
    /// Measured range, m; infinite if there is no return.
    pub range_m: f32,
    /// Unit normal of the surface towards the sensor; 0 if it is not known.
    pub normal: [f32; 3],
    /// Cosine of the angle of incidence.
    pub cos_incidence: f32,
    /// Where normal and incidence are from.
    pub incidence: Incidence,
    /// Reflectivity of the material at normal incidence, relative to a white Lambertian plate.
    pub reflectivity: f32,
    /// Returned light: reflectivity times the material's incidence term times the transmission of the path.
    pub returned: f32,
    /// Material of the surface; meaningful if there is a return.
    pub material: MaterialId,
    /// Track group or car that was hit; 0 if it is not known.
    pub object: u16,
    /// Reported intensity, 0 to 1.
    pub intensity: f32,
    /// Number of the point in the finished cloud that it was read from; [`Echo::NEW`] for others.
    pub source: u32,
}

impl Echo {
    /// Row or column if it is not known.
    pub const UNKNOWN: u16 = u16::MAX;

    /// Source of echoes that were not read from a finished cloud.
    pub const NEW: u32 = u32::MAX;

    /// A shot without a return.
    pub fn nothing(origin: [f32; 3], direction: [f32; 3]) -> Echo {
        Echo {
            sensor: 0,
            number: 0,
            row: Echo::UNKNOWN,
            column: Echo::UNKNOWN,
            time_s: 0.0,
            origin,
            direction,
            range_m: f32::INFINITY,
            normal: [0.0; 3],
            cos_incidence: 1.0,
            incidence: Incidence::Known,
            reflectivity: 0.0,
            returned: 0.0,
            material: MaterialId(0),
            object: 0,
            intensity: 0.0,
            source: Echo::NEW,
        }
    }

    /// Whether there is a return.
    pub fn is_return(&self) -> bool {
        self.range_m < f32::INFINITY
    }

    /// Number of the car that was hit, if any.
    pub fn car(&self) -> Option<usize> {
        self.object.checked_sub(FIRST_CAR).map(usize::from)
    }

    /// Removes the return.
    pub fn lose(&mut self) {
        self.range_m = f32::INFINITY;
    }

    /// Measured point, cloud's frame, m.
    pub fn point(&self) -> [f32; 3] {
        std::array::from_fn(|k| self.origin[k] + self.range_m * self.direction[k])
    }

    /// Signal index `ln(returned / R^2) - ln(0.1 / 250^2)`, see [`crate::signal`].
    pub fn signal(&self) -> f32 {
        returned_light_index(self.returned, self.range_m)
    }

    /// Adds an error to the measured range, m, which stays at least 1 cm. An error of 0 changes nothing.
    pub fn add_range(&mut self, error_m: f32) {
        if error_m != 0.0 {
            self.range_m = (self.range_m + error_m).max(0.01);
        }
    }

    /// Moves the measured point; range and direction change with it.
    pub fn move_point(&mut self, point: [f32; 3]) {
        let offset: [f32; 3] = std::array::from_fn(|k| point[k] - self.origin[k]);
        let range_m = dot(offset, offset).sqrt();
        if range_m > 0.0 {
            self.direction = offset.map(|v| v / range_m);
            self.range_m = range_m;
        }
    }
}

/// Scalar product.
pub fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// All shots of a scan, grouped by sensor.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Scan {
    /// One echo per shot, in the order of the patterns; second returns after all of them.
    pub echoes: Vec<Echo>,
}

impl Scan {
    /// Echoes with a return.
    pub fn returns(&self) -> impl Iterator<Item = &Echo> {
        self.echoes.iter().filter(|e| e.is_return())
    }

    /// Echoes with a return, to be changed.
    pub fn returns_mut(&mut self) -> impl Iterator<Item = &mut Echo> {
        self.echoes.iter_mut().filter(|e| e.is_return())
    }

    /// Removes shots without a return and returns outside of the square |x|, |y| <= `half_m`.
    pub fn crop(&mut self, half_m: f32) {
        self.echoes.retain(|echo| {
            let [x, y, _] = echo.point();
            echo.is_return() && x.abs() <= half_m && y.abs() <= half_m
        });
    }

    /// The returns as a cloud with x, y, z, intensity.
    pub fn cloud(&self) -> Cloud {
        let mut cloud = Cloud::new(4);
        cloud.values.reserve(self.echoes.len() * 4);
        for echo in self.returns() {
            let [x, y, z] = echo.point();
            cloud.values.extend([x, y, z, echo.intensity]);
        }
        cloud
    }
}
