//! Simple bodies and where a ray enters them.

use nalgebra::{Point3, Vector3};

/// A ray in some frame. The direction need not have unit length; distances are multiples of it.
#[derive(Clone, Copy, Debug)]
pub struct Ray {
    /// Where it begins, m.
    pub origin: Point3<f64>,
    /// Where it goes.
    pub direction: Vector3<f64>,
}

impl Ray {
    /// The point after `t` directions.
    pub fn at(&self, t: f64) -> Point3<f64> {
        self.origin + self.direction * t
    }
}

/// Where a ray enters a body: multiples of its direction, and the outward normal.
pub type Entry = (f64, Vector3<f64>);

/// Entries nearer than this are taken for the inside of a body.
const NEAREST: f64 = 1e-6;

/// What a surface is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Material {
    /// Carriageway.
    Asphalt,
    /// Pavements, kerbs, balconies.
    Stone,
    /// Walls of houses.
    Plaster,
    /// Windows of houses and cars.
    Glass,
    /// Crowns of trees.
    Leaves,
    /// Trunks.
    Bark,
    /// Bodies of cars.
    Paint,
    /// Tyres.
    Rubber,
    /// Poles, containers, racks.
    Metal,
    /// Retroreflective signs and number plates.
    Foil,
    /// Clothes of pedestrians.
    Cloth,
}

impl Material {
    /// Whether light returns to where it came from, whatever the angle of incidence.
    pub fn is_retroreflective(self) -> bool {
        self == Material::Foil
    }
}

/// An upright box that is turned about the vertical.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// Centre, m.
    pub center: Point3<f64>,
    /// Half of length, width and height, m.
    pub half: Vector3<f64>,
    /// Cosine and sine of its heading.
    pub turn: [f64; 2],
}

impl Block {
    /// From the centre, the size (m) and the heading (rad).
    pub fn new(center: [f64; 3], size: [f64; 3], heading_rad: f64) -> Block {
        let (sin, cos) = heading_rad.sin_cos();
        Block { center: Point3::from(center), half: Vector3::from(size) / 2.0, turn: [cos, sin] }
    }

    /// A ray in the frame of the box.
    pub fn to_local(self, ray: &Ray) -> Ray {
        let [c, s] = self.turn;
        let (o, d) = (ray.origin - self.center, ray.direction);
        Ray {
            origin: Point3::new(c * o.x + s * o.y, c * o.y - s * o.x, o.z),
            direction: Vector3::new(c * d.x + s * d.y, c * d.y - s * d.x, d.z),
        }
    }

    /// A direction of the frame of the box in the outer frame.
    pub fn to_outer(self, v: Vector3<f64>) -> Vector3<f64> {
        let [c, s] = self.turn;
        Vector3::new(c * v.x - s * v.y, s * v.x + c * v.y, v.z)
    }

    /// The part of a ray inside of the box, as multiples of its direction from 0 on.
    pub fn chord(&self, ray: &Ray) -> Option<[f64; 2]> {
        let local = self.to_local(ray);
        let (mut enter, mut leave) = (0.0f64, f64::INFINITY);
        for k in 0..3 {
            let (o, d, half) = (local.origin[k], local.direction[k], self.half[k]);
            let [a, b] = [(-half - o) / d, (half - o) / d];
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter < leave).then_some([enter, leave])
    }

    /// Entry of a ray that is given in the frame of the box: the distance, and the axis of the face.
    pub fn enter_local(&self, local: &Ray) -> Option<(f64, usize)> {
        let (mut enter, mut leave, mut axis) = (NEAREST, f64::INFINITY, 3);
        for k in 0..3 {
            let (o, d, half) = (local.origin[k], local.direction[k], self.half[k]);
            if d.abs() < 1e-12 {
                if o.abs() > half {
                    return None;
                }
                continue;
            }
            let (middle, reach) = (-o / d, half / d.abs());
            if middle - reach > enter {
                (enter, axis) = (middle - reach, k);
            }
            leave = leave.min(middle + reach);
        }
        (axis < 3 && enter < leave).then_some((enter, axis))
    }

    /// Entry of a ray.
    pub fn enter(&self, ray: &Ray) -> Option<Entry> {
        let local = self.to_local(ray);
        let (t, axis) = self.enter_local(&local)?;
        let mut normal = Vector3::zeros();
        normal[axis] = -local.direction[axis].signum();
        Some((t, self.to_outer(normal)))
    }

    /// Smallest and largest x, y, z, m.
    pub fn bounds(&self) -> [[f64; 3]; 2] {
        let [c, s] = self.turn.map(f64::abs);
        let reach = [c * self.half.x + s * self.half.y, s * self.half.x + c * self.half.y, self.half.z];
        [-1.0, 1.0].map(|side| [0, 1, 2].map(|k| self.center[k] + side * reach[k]))
    }
}

/// Entry into a ball.
pub fn enter_ball(ray: &Ray, center: &Point3<f64>, radius_m: f64) -> Option<Entry> {
    let to = ray.origin - center;
    let (a, b, c) = (ray.direction.norm_squared(), to.dot(&ray.direction), to.norm_squared() - radius_m * radius_m);
    let inside = b * b - a * c;
    let t = (-b - inside.max(0.0).sqrt()) / a;
    (inside > 0.0 && t > NEAREST).then(|| (t, (ray.at(t) - center) / radius_m))
}

/// Entry into a cylinder about the z axis of the ray's frame, from `low` to `high`, m.
pub fn enter_upright_cylinder(ray: &Ray, radius_m: f64, low: f64, high: f64) -> Option<Entry> {
    let (o, d) = (ray.origin, ray.direction);
    let (a, b, c) = (d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - radius_m * radius_m);
    let inside = b * b - a * c;
    if inside <= 0.0 && (a > 1e-12 || c > 0.0) {
        return None;
    }
    if a > 1e-12 {
        let t = (-b - inside.sqrt()) / a;
        let p = ray.at(t);
        if t > NEAREST && p.z >= low && p.z <= high {
            return Some((t, Vector3::new(p.x / radius_m, p.y / radius_m, 0.0)));
        }
    }
    // Through one of the ends.
    let end = if d.z < 0.0 { high } else { low };
    let t = (end - o.z) / d.z;
    let p = ray.at(t);
    let through = t.is_finite() && t > NEAREST && p.x * p.x + p.y * p.y <= radius_m * radius_m;
    through.then(|| (t, Vector3::new(0.0, 0.0, -d.z.signum())))
}

/// A convex body: the intersection of half spaces `normal . x <= offset`.
#[derive(Clone, Debug)]
pub struct Hull {
    /// Outward unit normal, offset (m) and material of each face.
    pub faces: Vec<(Vector3<f64>, f64, Material)>,
}

impl Hull {
    /// Entry of a ray and the material of the face.
    pub fn enter(&self, ray: &Ray) -> Option<(Entry, Material)> {
        let (mut enter, mut leave, mut face) = (NEAREST, f64::INFINITY, usize::MAX);
        for (i, (normal, offset, _)) in self.faces.iter().enumerate() {
            let (along, above) = (normal.dot(&ray.direction), normal.dot(&ray.origin.coords) - offset);
            if along.abs() < 1e-12 {
                if above > 0.0 {
                    return None;
                }
                continue;
            }
            let t = -above / along;
            if along < 0.0 && t > enter {
                (enter, face) = (t, i);
            } else if along > 0.0 {
                leave = leave.min(t);
            }
        }
        (face != usize::MAX && enter < leave).then(|| ((enter, self.faces[face].0), self.faces[face].2))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;

    fn ray(origin: [f64; 3], direction: [f64; 3]) -> Ray {
        Ray { origin: Point3::from(origin), direction: Vector3::from(direction).normalize() }
    }

    #[test]
    fn a_turned_block_is_met_on_its_faces() {
        let block = Block::new([10.0, 0.0, 1.0], [2.0, 4.0, 2.0], 0.5);
        let mut rng = data::stream(1, "block", 0, 0);
        let mut met = 0;
        for _ in 0..2_000 {
            let to = [10.0, 0.0, 1.0].map(|v: f64| v + rng.random_range(-3.0..3.0));
            let from = [rng.random_range(-5.0..5.0), rng.random_range(-8.0..8.0), rng.random_range(0.0..4.0)];
            let ray = ray(from, [0, 1, 2].map(|k| to[k] - from[k]));
            let Some((t, normal)) = block.enter(&ray) else { continue };
            met += 1;
            let p = block.to_local(&Ray { origin: ray.at(t), direction: Vector3::x() }).origin;
            let outside: Vec<f64> = (0..3).map(|k| p[k].abs() - block.half[k]).collect();
            assert!(outside.iter().all(|v| *v < 1e-9) && outside.iter().any(|v| v.abs() < 1e-9), "{outside:?}");
            assert!(normal.dot(&ray.direction) < 0.0);
        }
        assert!(met > 500, "{met}");
    }

    #[test]
    fn round_bodies_are_met_at_their_radius() {
        let (t, normal) = enter_ball(&ray([0.0; 3], [1.0, 0.0, 0.0]), &Point3::new(5.0, 0.6, 0.0), 1.0).unwrap();
        assert!((t - 4.2).abs() < 1e-12 && (normal.y + 0.6).abs() < 1e-12);
        let (t, normal) = enter_upright_cylinder(&ray([-5.0, 0.0, 1.0], [1.0, 0.0, 0.0]), 0.5, 0.0, 2.0).unwrap();
        assert!((t - 4.5).abs() < 1e-12 && (normal.x + 1.0).abs() < 1e-12);
        assert!(enter_upright_cylinder(&ray([-5.0, 0.0, 3.0], [1.0, 0.0, 0.0]), 0.5, 0.0, 2.0).is_none());
        let (t, normal) = enter_upright_cylinder(&ray([0.1, 0.0, 5.0], [0.0, 0.0, -1.0]), 0.5, 0.0, 2.0).unwrap();
        assert!((t - 3.0).abs() < 1e-12 && normal.z == 1.0);
    }

    #[test]
    fn a_hull_of_six_planes_is_a_box() {
        let mut faces = Vec::new();
        for k in 0..3 {
            for side in [-1.0, 1.0] {
                let mut normal = Vector3::zeros();
                normal[k] = side;
                faces.push((normal, 1.0 + k as f64, Material::Paint));
            }
        }
        let (hull, block) = (Hull { faces }, Block::new([0.0; 3], [2.0, 4.0, 6.0], 0.0));
        let mut rng = data::stream(2, "hull", 0, 0);
        for _ in 0..500 {
            let ray = ray([-9.0, 1.0, 2.0], [3.0, rng.random_range(-1.0..1.0), rng.random_range(-2.0..1.0)]);
            assert_eq!(
                hull.enter(&ray).map(|(e, _)| (e.0 * 1e9).round()),
                block.enter(&ray).map(|e| (e.0 * 1e9).round())
            );
        }
    }
}
