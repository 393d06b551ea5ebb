//! Boxes and upright cylinders for ray casting.

use nalgebra::{Isometry3, Point3, Vector3};

/// Surface material.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Material {
    /// The road.
    Asphalt,
    /// Walls and grandstands.
    Concrete,
    /// Posts and boards.
    Metal,
    /// Bodywork.
    Paint,
    /// Wings and floors.
    Carbon,
    /// Tyres.
    Rubber,
    /// Objects that only one side has.
    Container,
}

/// Intersection of a ray with a surface, in the frame of the ray.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Distance along the ray, m.
    pub range_m: f64,
    /// Unit normal towards the ray's origin.
    pub normal: Vector3<f64>,
    /// Material.
    pub material: Material,
    /// Index of the car, if a car was hit.
    pub car: Option<usize>,
}

impl Hit {
    /// Cosine of the angle between ray and normal.
    pub fn cos_incidence(&self, direction: &Vector3<f64>) -> f64 {
        self.normal.dot(direction).abs()
    }
}

/// Shape of a part.
#[derive(Clone, Copy, Debug)]
pub enum Form {
    /// Half extents, m.
    Cuboid(Vector3<f64>),
    /// Wheel with its axis along y: radius and half width, m.
    Wheel(f64, f64),
}

/// A part of a car, or an object beside the road.
#[derive(Clone, Copy, Debug)]
pub struct Solid {
    /// Pose of the centre.
    pub pose: Isometry3<f64>,
    /// Shape.
    pub form: Form,
    /// Material.
    pub material: Material,
}

impl Solid {
    /// Range and normal at the first entry of the ray.
    pub fn cast(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<(f64, Vector3<f64>)> {
        let o = self.pose.inverse_transform_point(origin).coords;
        let d = self.pose.rotation.inverse_transform_vector(direction);
        let (t, normal) = match self.form {
            Form::Cuboid(half) => cuboid(&o, &d, &half)?,
            Form::Wheel(radius, half) => wheel(&o, &d, radius, half)?,
        };
        Some((t, self.pose.rotation * normal))
    }

    /// Radius of the bounding sphere around the centre, m.
    pub fn reach_m(&self) -> f64 {
        match self.form {
            Form::Cuboid(half) => half.norm(),
            Form::Wheel(radius, half) => radius.hypot(half),
        }
    }
}

fn cuboid(o: &Vector3<f64>, d: &Vector3<f64>, half: &Vector3<f64>) -> Option<(f64, Vector3<f64>)> {
    let (mut enter, mut leave, mut axis) = (1e-6, f64::INFINITY, usize::MAX);
    for k in 0..3 {
        if d[k].abs() < 1e-12 {
            if o[k].abs() > half[k] {
                return None;
            }
            continue;
        }
        let (a, b) = ((-half[k] - o[k]) / d[k], (half[k] - o[k]) / d[k]);
        let (near, far) = if a < b { (a, b) } else { (b, a) };
        if near > enter {
            (enter, axis) = (near, k);
        }
        leave = leave.min(far);
    }
    if axis == usize::MAX || enter >= leave {
        return None;
    }
    let mut normal = Vector3::zeros();
    normal[axis] = -d[axis].signum();
    Some((enter, normal))
}

fn wheel(o: &Vector3<f64>, d: &Vector3<f64>, radius: f64, half: f64) -> Option<(f64, Vector3<f64>)> {
    let (a, b, c) = (d.x * d.x + d.z * d.z, o.x * d.x + o.z * d.z, o.x * o.x + o.z * o.z - radius * radius);
    let mut best: Option<(f64, Vector3<f64>)> = None;
    if a > 1e-12 && b * b > a * c {
        let t = (-b - (b * b - a * c).sqrt()) / a;
        let p = o + d * t;
        if t > 1e-6 && p.y.abs() <= half {
            best = Some((t, Vector3::new(p.x, 0.0, p.z) / radius));
        }
    }
    if d.y.abs() > 1e-12 {
        let t = (-half * d.y.signum() - o.y) / d.y;
        let p = o + d * t;
        if t > 1e-6 && p.x * p.x + p.z * p.z <= radius * radius && best.is_none_or(|(t0, _)| t < t0) {
            best = Some((t, Vector3::new(0.0, -d.y.signum(), 0.0)));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_meet_what_stands_in_their_way() {
        let at = Isometry3::translation(10.0, 0.0, 0.0);
        let solid = Solid { pose: at, form: Form::Cuboid(Vector3::new(1.0, 2.0, 0.5)), material: Material::Metal };
        let (t, n) = solid.cast(&Point3::origin(), &Vector3::x()).unwrap();
        assert!((t - 9.0).abs() < 1e-12 && (n + Vector3::x()).norm() < 1e-12);
        assert!(solid.cast(&Point3::origin(), &Vector3::new(1.0, 0.0, 0.1).normalize()).is_none());
        let wheel = Solid { form: Form::Wheel(0.3, 0.2), ..solid };
        let (t, n) = wheel.cast(&Point3::origin(), &Vector3::x()).unwrap();
        assert!((t - 9.7).abs() < 1e-12 && (n + Vector3::x()).norm() < 1e-12);
        let (t, n) = wheel.cast(&Point3::new(10.0, -5.0, 0.1), &Vector3::y()).unwrap();
        assert!((t - 4.8).abs() < 1e-12 && (n + Vector3::y()).norm() < 1e-12);
    }
}
