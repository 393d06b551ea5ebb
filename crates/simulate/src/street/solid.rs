//! Ray casting from the sensor against convex solids.
//!
//! The only primitive is a convex solid, given by half spaces: a ray is inside from the last plane it enters to the
//! first it leaves. Rays start at the origin, where the sensor is.

use geometry::Box3;

/// Surface material; determines intensity and lost returns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Material {
    /// The road.
    Asphalt,
    /// White road markings.
    Marking,
    /// Pavement and grass beside the road.
    Verge,
    /// Plaster, brick or concrete, with its reflectivity.
    Wall(f64),
    /// Car paint, with its reflectivity.
    Paint(f64),
    /// Windows; most light goes through.
    Glass,
    /// Tyres.
    Rubber,
    /// Poles and signs.
    Metal,
    /// Leaves: a surface with random depth.
    Leaves,
}

/// A half space: the points p with `normal . p <= offset`.
#[derive(Clone, Copy, Debug)]
struct Plane {
    normal: [f64; 3],
    offset: f64,
}

/// A convex solid.
#[derive(Clone, Debug)]
pub struct Solid {
    planes: Vec<Plane>,
    /// Bounding circle in bird's eye view: centre and radius, m.
    circle: ([f64; 2], f64),
    /// Material of the sides and of the top.
    pub materials: [Material; 2],
    /// Index of the car it belongs to.
    pub car: Option<usize>,
}

/// Intersection of a ray with a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hit {
    /// Distance from the sensor, m.
    pub range_m: f64,
    /// Cosine of the angle of incidence: 1 at normal incidence.
    pub cos_incidence: f64,
    /// Material.
    pub material: Material,
}

/// A cross-section of a [`Solid::frustum`] at one height: from `x[0]` to `x[1]`, `half_width` to both sides, m.
#[derive(Clone, Copy, Debug)]
pub struct Slice {
    /// Rear and front end.
    pub x: [f64; 2],
    /// Half width to the left and right.
    pub half_width: f64,
}

impl Solid {
    /// A box.
    pub fn cuboid(b: &Box3, material: Material) -> Solid {
        let slice = Slice { x: [-b.size[0] / 2.0, b.size[0] / 2.0], half_width: b.size[1] / 2.0 };
        Solid::frustum(b, [slice, slice], [-b.size[2] / 2.0, b.size[2] / 2.0], [material; 2])
    }

    /// The solid between two rectangles, one above the other, in the frame of the box `frame` (origin at its centre, x
    /// along its heading).
    pub fn frustum(frame: &Box3, [low, high]: [Slice; 2], z: [f64; 2], materials: [Material; 2]) -> Solid {
        let dz = z[1] - z[0];
        let local = [
            ([0.0, 0.0, 1.0], [0.0, 0.0, z[1]]),
            ([0.0, 0.0, -1.0], [0.0, 0.0, z[0]]),
            ([dz, 0.0, low.x[1] - high.x[1]], [low.x[1], 0.0, z[0]]),
            ([-dz, 0.0, high.x[0] - low.x[0]], [low.x[0], 0.0, z[0]]),
            ([0.0, dz, low.half_width - high.half_width], [0.0, low.half_width, z[0]]),
            ([0.0, -dz, low.half_width - high.half_width], [0.0, -low.half_width, z[0]]),
        ];
        let far = low.x[0].abs().max(low.x[1]).max(high.x[0].abs()).max(high.x[1]);
        let radius_m = far.hypot(low.half_width.max(high.half_width));
        Solid::of_planes(frame, &local, radius_m, materials)
    }

    /// An upright prism with eight sides around a circle: poles, trunks, bushes.
    pub fn column(center: [f64; 3], radius_m: f64, height_m: f64, material: Material) -> Solid {
        let frame = Box3 { center, size: [2.0 * radius_m, 2.0 * radius_m, height_m], yaw_rad: 0.0 };
        let half = height_m / 2.0;
        let mut local = vec![([0.0, 0.0, 1.0], [0.0, 0.0, half]), ([0.0, 0.0, -1.0], [0.0, 0.0, -half])];
        for i in 0..8 {
            let (s, c) = (i as f64 * std::f64::consts::FRAC_PI_4).sin_cos();
            local.push(([c, s, 0.0], [radius_m * c, radius_m * s, 0.0]));
        }
        Solid::of_planes(&frame, &local, radius_m * 1.09, [material; 2])
    }

    /// From planes (normal of any length, and a point) in the frame of a box.
    fn of_planes(frame: &Box3, local: &[([f64; 3], [f64; 3])], radius_m: f64, materials: [Material; 2]) -> Solid {
        let (s, c) = frame.yaw_rad.sin_cos();
        let planes = local.iter().map(|(n, point)| {
            let length = dot(*n, *n).sqrt();
            let normal = [(n[0] * c - n[1] * s) / length, (n[0] * s + n[1] * c) / length, n[2] / length];
            Plane { normal, offset: dot(normal, frame.from_local(*point)) }
        });
        Solid { planes: planes.collect(), circle: ([frame.center[0], frame.center[1]], radius_m), materials, car: None }
    }

    /// The solid as a part of car `index`.
    pub fn of_car(self, index: usize) -> Solid {
        Solid { car: Some(index), ..self }
    }

    /// Entry point of a ray from the origin along the unit vector `direction`.
    pub fn hit(&self, direction: [f64; 3]) -> Option<Hit> {
        let (mut enter, mut leave, mut normal) = (0.0, f64::INFINITY, None);
        for plane in &self.planes {
            let towards = dot(plane.normal, direction);
            if towards < 0.0 {
                let t = plane.offset / towards;
                if t > enter {
                    (enter, normal) = (t, Some(plane.normal));
                }
            } else if towards > 0.0 {
                leave = f64::min(leave, plane.offset / towards);
            } else if plane.offset < 0.0 {
                return None;
            }
            if enter >= leave {
                return None;
            }
        }
        let normal = normal?;
        let material = self.materials[usize::from(normal[2] > 0.8)];
        Some(Hit { range_m: enter, cos_incidence: -dot(normal, direction), material })
    }

    /// Centre and half width of the azimuth interval in which it may be visible, rad; half width pi if it surrounds
    /// the sensor.
    pub fn azimuths(&self) -> (f64, f64) {
        let ([x, y], radius) = self.circle;
        let distance = x.hypot(y);
        let half = if distance > radius { (radius / distance).asin() } else { std::f64::consts::PI };
        (y.atan2(x), half)
    }
}

/// Scalar product.
pub(crate) fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

#[cfg(test)]
mod tests {
    use super::*;

    fn unit(v: [f64; 3]) -> [f64; 3] {
        let length = dot(v, v).sqrt();
        v.map(|c| c / length)
    }

    #[test]
    fn a_box_is_hit_where_it_stands() {
        let solid = Solid::cuboid(&Box3::from_array([10.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0]), Material::Metal);
        let hit = solid.hit([1.0, 0.0, 0.0]).unwrap();
        assert!((hit.range_m - 8.0).abs() < 1e-12 && (hit.cos_incidence - 1.0).abs() < 1e-12);
        assert_eq!(solid.hit([-1.0, 0.0, 0.0]), None);
        assert_eq!(solid.hit([0.0, 0.0, -1.0]), None);
        assert!(solid.hit(unit([8.0, 0.99, 0.0])).is_some());
        assert!(solid.hit(unit([8.0, 1.01, 0.0])).is_none());
    }

    #[test]
    fn every_hit_lies_on_the_surface_of_its_box() {
        let b = Box3::from_array([6.0, 2.0, -0.5, 3.0, 1.5, 1.2, 0.7]);
        let solid = Solid::cuboid(&b, Material::Metal);
        let (middle, half) = solid.azimuths();
        let mut hits = 0;
        for i in 0..200 {
            for j in 0..60 {
                let (azimuth, z) = (-1.0 + i as f64 * 0.01, -0.4 + j as f64 * 0.01);
                let direction = unit([azimuth.cos(), azimuth.sin(), z]);
                let Some(hit) = solid.hit(direction) else { continue };
                hits += 1;
                assert!((azimuth - middle).abs() <= half);
                assert!((0.0..=1.0).contains(&hit.cos_incidence));
                let local = b.to_local(direction.map(|d| d * hit.range_m));
                let outside = (0..3).map(|k| local[k].abs() - b.size[k] / 2.0).fold(f64::MIN, f64::max);
                assert!(outside.abs() < 1e-9, "{outside} m off the surface");
            }
        }
        assert!(hits > 500, "{hits}");
    }

    #[test]
    fn a_slope_and_a_column() {
        let frame = Box3::from_array([10.0, 0.0, 0.0, 4.0, 2.0, 2.0, 0.0]);
        let [low, high] = [2.0, 1.0].map(|x| Slice { x: [-x, x], half_width: 1.0 });
        let solid = Solid::frustum(&frame, [low, high], [-1.0, 1.0], [Material::Glass, Material::Paint(0.5)]);
        let hit = solid.hit([1.0, 0.0, 0.0]).unwrap();
        assert!((hit.range_m - 8.5).abs() < 1e-12, "half way up the slope: {hit:?}");
        assert_eq!(hit.material, Material::Glass);
        assert_eq!(solid.hit(unit([10.0, 0.0, 1.2])), None);

        let column = Solid::column([5.0, 0.0, 0.0], 0.5, 2.0, Material::Metal);
        assert!((column.hit([1.0, 0.0, 0.0]).unwrap().range_m - 4.5).abs() < 1e-12);
        assert!(column.hit(unit([5.0, 0.6, 0.0])).is_none());
    }
}
