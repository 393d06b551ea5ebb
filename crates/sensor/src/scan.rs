//! What comes back of one scan: a list of echoes, one a shot, that the sensor model works on.

use crate::material::MaterialId;
use crate::object::FIRST_CAR;
use crate::signal::returned_light_index;
use data::Cloud;

/// One shot and what came back of it. Positions and directions are what the sensor believes, in the cloud's frame; the true ray may
/// have been another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Echo {
    /// Number of the sensor in its rig.
    pub sensor: u8,
    /// 0: the first return of its shot; 1: the second.
    pub number: u8,
    /// Row of the sensor's pattern; [`Echo::UNKNOWN`] where it has none.
    pub row: u16,
    /// Column of the sensor's pattern; [`Echo::UNKNOWN`] where it has none.
    pub column: u16,
    /// Time of the shot from the middle of the scan, s.
    pub time_s: f32,
    /// Where the shot starts, m.
    pub origin: [f32; 3],
    /// Where it goes, unit vector.
    pub direction: [f32; 3],
    /// Measured distance, m; infinite when nothing came back.
    pub range_m: f32,
    /// Normal of the surface that was hit, towards the sensor; 0 where nothing is known of it.
    pub normal: [f32; 3],
    /// Cosine of the angle of incidence.
    pub cos_incidence: f32,
    /// Reflectivity of the material, head-on, against a white plate.
    pub reflectivity: f32,
    /// Part of the light that came back: reflectivity times the material's law of incidence, times what the way took of it.
    pub returned: f32,
    /// Material that was hit; meaningful where there is a return.
    pub material: MaterialId,
    /// What was hit: a group of the track, or a car; 0 where nothing is known of it.
    pub object: u16,
    /// What the sensor reports, 0 to 1.
    pub intensity: f32,
}

impl Echo {
    /// Row or column of a shot of which nothing is known.
    pub const UNKNOWN: u16 = u16::MAX;

    /// A shot of which nothing came back.
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
            reflectivity: 0.0,
            returned: 0.0,
            material: MaterialId(0),
            object: 0,
            intensity: 0.0,
        }
    }

    /// Whether anything came back.
    pub fn is_return(&self) -> bool {
        self.range_m < f32::INFINITY
    }

    /// Number of the car that was hit.
    pub fn car(&self) -> Option<usize> {
        self.object.checked_sub(FIRST_CAR).map(usize::from)
    }

    /// Nothing comes back of it any more.
    pub fn lose(&mut self) {
        self.range_m = f32::INFINITY;
    }

    /// The measured point, cloud's frame, m.
    pub fn point(&self) -> [f32; 3] {
        std::array::from_fn(|k| self.origin[k] + self.range_m * self.direction[k])
    }

    /// Index of the signal, the logarithm of the light that comes back: `ln(returned / R^2) - ln(0.1 / 250^2)`.
    pub fn signal(&self) -> f32 {
        returned_light_index(self.returned, self.range_m)
    }

    /// Moves the measured point; the shot then points at it.
    pub fn move_point(&mut self, point: [f32; 3]) {
        let way: [f32; 3] = std::array::from_fn(|k| point[k] - self.origin[k]);
        let range_m = dot(way, way).sqrt();
        if range_m > 0.0 {
            self.direction = way.map(|v| v / range_m);
            self.range_m = range_m;
        }
    }
}

/// Scalar product.
pub fn dot(a: [f32; 3], b: [f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// All shots of a scan, sensor after sensor.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct Scan {
    /// One a shot, in the order of the patterns; second returns behind all of them.
    pub echoes: Vec<Echo>,
}

impl Scan {
    /// The echoes that came back.
    pub fn returns(&self) -> impl Iterator<Item = &Echo> {
        self.echoes.iter().filter(|e| e.is_return())
    }

    /// The echoes that came back, to be changed.
    pub fn returns_mut(&mut self) -> impl Iterator<Item = &mut Echo> {
        self.echoes.iter_mut().filter(|e| e.is_return())
    }

    /// Leaves out returns outside of the square of +-`half_m` around the origin, seen from above, and all shots without a return.
    pub fn crop(&mut self, half_m: f32) {
        self.echoes.retain(|echo| {
            let [x, y, _] = echo.point();
            echo.is_return() && x.abs() <= half_m && y.abs() <= half_m
        });
    }

    /// The returns as points x, y, z, intensity.
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
