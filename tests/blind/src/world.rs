//! The scene (road, walls, roadside objects, moving cars) and ray casting.

use crate::car::{CarShape, draw_shape};
use crate::solid::{Form, Hit, Material, Solid};
use crate::track::Track;
use data::Stream;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;

/// Maximum range, m.
pub const REACH_M: f64 = 150.0;

/// A wall along the road.
#[derive(Clone, Debug)]
pub struct Wall {
    /// Lateral position, to the left of the centre line, m.
    pub left_m: f64,
    /// Height above the adjacent road, m.
    pub height_m: f64,
    /// Gaps: start and end along the centre line, m.
    pub gaps_m: Vec<(f64, f64)>,
}

/// Motion of a car: `s + v t` along the centre line with a slow change of speed; `left` beside it with a slow
/// oscillation.
#[derive(Clone, Debug)]
pub struct Driver {
    /// Index of its shape.
    pub shape: usize,
    /// Reflectivity of its paint.
    pub paint: f64,
    start_m: f64,
    speed_m_s: f64,
    left_m: f64,
    swing: [f64; 3],
    surge: [f64; 3],
}

impl Driver {
    /// Position along the centre line and lateral offset at time `t`, s.
    pub fn place(&self, t: f64) -> (f64, f64) {
        let wave = |[size, rate, phase]: [f64; 3]| size * (rate * t + phase).sin();
        (self.start_m + self.speed_m_s * t + wave(self.surge), self.left_m + wave(self.swing))
    }

    /// Speed along the centre line, m/s.
    pub fn speed_m_s(&self, t: f64) -> f64 {
        (self.place(t + 1e-3).0 - self.place(t - 1e-3).0) / 2e-3
    }
}

/// The scene, independent of the sensor.
#[derive(Clone, Debug)]
pub struct World {
    /// The road.
    pub track: Track,
    /// Walls.
    pub walls: Vec<Wall>,
    /// Roadside objects in the world frame.
    pub things: Vec<Solid>,
    /// Car shapes.
    pub shapes: Vec<CarShape>,
    /// All cars; the ego vehicle is first.
    pub drivers: Vec<Driver>,
    /// Height of the ego vehicle's origin above the road, m.
    pub ego_above_m: f64,
    /// Reflectivity of asphalt and concrete.
    pub reflectivity: [f64; 2],
}

/// The scene at one moment, ready for ray casting; in the ego frame at that moment.
pub struct Moment<'a> {
    world: &'a World,
    world_from_ego: Isometry3<f64>,
    things: Vec<(Solid, Point3<f64>, f64)>,
    cars: Vec<(usize, Vec<Solid>, Point3<f64>, f64)>,
}

/// Draws a world with a race.
pub fn draw_world(rng: &mut Stream, ego_above_m: f64) -> World {
    let track = Track {
        straight_m: rng.random_range(120.0..420.0),
        radius_m: rng.random_range(70.0..220.0),
        slope: [rng.random_range(0.0..0.12f64).tan(), rng.random_range(0.1..0.33f64).tan()],
        half_width_m: rng.random_range(5.5..8.0),
        waves_m: rng.random_range(0.0..0.02),
    };
    let outer = -(track.half_width_m + rng.random_range(0.4..1.0));
    let mut walls = vec![Wall { left_m: outer, height_m: rng.random_range(0.9..1.3), gaps_m: vec![] }];
    let inner = track.half_width_m + rng.random_range(2.0..6.0);
    let lap = track.lap_m();
    let gap = rng.random_range(0.0..lap * 0.7);
    walls.push(Wall { left_m: inner, height_m: rng.random_range(0.6..1.1), gaps_m: vec![(gap, gap + 0.2 * lap)] });
    let things = draw_things(rng, &track, outer, inner);
    let shapes: Vec<CarShape> = (0..2).map(|_| draw_shape(rng)).collect();
    let start = rng.random_range(0.0..lap);
    let speed = rng.random_range(25.0..55.0);
    let driver = |rng: &mut Stream, ahead: f64, left: f64| Driver {
        shape: rng.random_range(0..2),
        paint: rng.random_range(0.12..0.8),
        start_m: start + ahead,
        speed_m_s: speed,
        left_m: left,
        swing: [rng.random_range(0.2..0.9), rng.random_range(0.2..0.9), rng.random_range(0.0..6.0)],
        surge: [rng.random_range(2.0..9.0), rng.random_range(0.25..0.8), rng.random_range(0.0..6.0)],
    };
    let mut drivers = vec![driver(rng, 0.0, 0.0)];
    let n = rng.random_range(4..7);
    for k in 0..n {
        let side = if k % 2 == 0 { 1.0 } else { -1.0 };
        let ahead = side * (12.0 + 17.0 * (k / 2) as f64 + rng.random_range(0.0..8.0));
        let left = rng.random_range(1.2..3.2) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        drivers.push(driver(rng, ahead, left));
    }
    let reflectivity = [rng.random_range(0.1..0.25), rng.random_range(0.3..0.6)];
    World { track, walls, things, shapes, drivers, ego_above_m, reflectivity }
}

fn draw_things(rng: &mut Stream, track: &Track, outer: f64, inner: f64) -> Vec<Solid> {
    let mut things = Vec::new();
    let mut stand = |rng: &mut Stream, s: f64, left: f64, size: [f64; 3], lift: f64, material: Material| {
        let ([x, y], heading) = track.at(s, left);
        let z = track.height_m(x, y) + lift + size[2] / 2.0;
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), heading + rng.random_range(-0.05..0.05));
        let pose = Isometry3::from_parts(Translation3::new(x, y, z), turn);
        things.push(Solid { pose, form: Form::Cuboid(Vector3::from(size) / 2.0), material });
    };
    let lap = track.lap_m();
    let every = rng.random_range(12.0..20.0);
    let mut s = 0.0;
    while s < lap {
        stand(rng, s, outer - 0.4, [0.25, 0.25, 4.5], -0.3, Material::Metal);
        if rng.random_bool(0.3) {
            let size = [rng.random_range(4.0..18.0), rng.random_range(2.0..6.0), rng.random_range(3.0..8.0)];
            stand(rng, s, outer - 8.0, size, -1.0, Material::Concrete);
        }
        if rng.random_bool(0.25) {
            let size = [rng.random_range(1.0..6.0), rng.random_range(0.4..3.0), rng.random_range(1.6..3.5)];
            stand(rng, s, inner + 4.0, size, -0.3, Material::Concrete);
        }
        s += every;
    }
    things
}

impl World {
    /// Pose of a car at a time: the ego vehicle's origin, or the box centre of another car.
    pub fn pose(&self, driver: usize, t: f64) -> Isometry3<f64> {
        let (s, left) = self.drivers[driver].place(t);
        let above = if driver == 0 { self.ego_above_m } else { self.shape(driver).size_m[2] / 2.0 };
        self.track.pose(s, left, above)
    }

    /// Shape of a car.
    pub fn shape(&self, driver: usize) -> &CarShape {
        &self.shapes[self.drivers[driver].shape]
    }

    /// Reflectivity at a hit.
    pub fn reflectivity(&self, hit: &Hit) -> f64 {
        match hit.material {
            Material::Asphalt => self.reflectivity[0],
            Material::Concrete => self.reflectivity[1],
            Material::Metal | Material::Container => 0.5,
            Material::Paint => hit.car.map_or(0.4, |car| self.drivers[car].paint),
            Material::Carbon => 0.07,
            Material::Rubber => 0.04,
        }
    }

    /// The scene at time `t` (s) in the ego frame given by `world_from_ego`.
    pub fn moment(&self, t: f64, world_from_ego: Isometry3<f64>) -> Moment<'_> {
        let ego_from_world = world_from_ego.inverse();
        let near = |p: &Point3<f64>, reach: f64| p.coords.norm() < REACH_M + reach;
        let things = self.things.iter().map(|s| Solid { pose: ego_from_world * s.pose, ..*s });
        let things = things.map(|s| (s, Point3::from(s.pose.translation.vector), s.reach_m()));
        let things = things.filter(|(_, p, reach)| near(p, *reach)).collect();
        let mut cars = Vec::new();
        for driver in 1..self.drivers.len() {
            let pose = ego_from_world * self.pose(driver, t);
            let center = Point3::from(pose.translation.vector);
            let reach = Vector3::from(self.shape(driver).size_m).norm() / 2.0 + 0.1;
            if near(&center, reach) {
                let parts = self.shape(driver).parts.iter().map(|p| Solid { pose: pose * p.pose, ..*p }).collect();
                cars.push((driver, parts, center, reach));
            }
        }
        Moment { world: self, world_from_ego, things, cars }
    }
}

impl Moment<'_> {
    /// First hit of a ray in the ego frame.
    pub fn cast(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<Hit> {
        let mut best = Hit { range_m: REACH_M, normal: Vector3::z(), material: Material::Asphalt, car: None };
        let mut found = false;
        let passes = |center: &Point3<f64>, reach: f64| {
            let to = center - origin;
            let along = to.dot(direction);
            along > -reach && to.norm_squared() - along * along < reach * reach
        };
        let mut try_solid = |solid: &Solid, car: Option<usize>| {
            if let Some((t, normal)) = solid.cast(origin, direction)
                && t < best.range_m
            {
                (best, found) = (Hit { range_m: t, normal, material: solid.material, car }, true);
            }
        };
        for (solid, center, reach) in &self.things {
            if passes(center, *reach) {
                try_solid(solid, None);
            }
        }
        for (car, parts, center, reach) in &self.cars {
            if passes(center, *reach) {
                parts.iter().for_each(|p| try_solid(p, Some(*car)));
            }
        }
        let o = self.world_from_ego * origin;
        let d = self.world_from_ego.rotation * direction;
        let mut meet = |t: f64, normal_world: Vector3<f64>, material: Material| {
            if t < best.range_m {
                let normal = self.world_from_ego.rotation.inverse_transform_vector(&normal_world);
                (best, found) = (Hit { range_m: t, normal, material, car: None }, true);
            }
        };
        for wall in &self.world.walls {
            if let Some((t, normal)) = self.world.cast_wall(wall, &o, &d) {
                meet(t, normal, Material::Concrete);
            }
        }
        if let Some((t, normal)) = self.world.cast_road(&o, &d, best.range_m) {
            let normal = self.world_from_ego.rotation.inverse_transform_vector(&normal);
            (best, found) = (Hit { range_m: t, normal, material: Material::Asphalt, car: None }, true);
        }
        found.then_some(best)
    }
}

impl World {
    fn cast_wall(&self, wall: &Wall, o: &Point3<f64>, d: &Vector3<f64>) -> Option<(f64, Vector3<f64>)> {
        let track = &self.track;
        let half = track.straight_m / 2.0;
        let mut candidates = [(f64::INFINITY, Vector3::zeros()); 6];
        let mut n = 0;
        let mut push = |t: f64, normal: Vector3<f64>| {
            if t > 1e-6 && t < REACH_M && n < 6 {
                candidates[n] = (t, normal);
                n += 1;
            }
        };
        for (y, sign) in [(-track.radius_m + wall.left_m, 1.0), (track.radius_m - wall.left_m, -1.0)] {
            let t = (y - o.y) / d.y;
            if (o.x + t * d.x).abs() <= half {
                push(t, Vector3::y() * sign);
            }
        }
        let radius = track.radius_m - wall.left_m;
        for side in [1.0, -1.0] {
            let (px, py) = (o.x - side * half, o.y);
            let (a, b, c) = (d.x * d.x + d.y * d.y, px * d.x + py * d.y, px * px + py * py - radius * radius);
            let disc = b * b - a * c;
            if disc > 0.0 {
                for root in [-1.0, 1.0] {
                    let t = (-b + root * disc.sqrt()) / a;
                    let (x, y) = (px + t * d.x, py + t * d.y);
                    if x * side > 0.0 {
                        push(t, Vector3::new(-x / radius, -y / radius, 0.0));
                    }
                }
            }
        }
        candidates[..n].sort_by(|a, b| a.0.total_cmp(&b.0));
        candidates[..n].iter().copied().find_map(|(t, normal)| {
            let p = o + d * t;
            let foot = track.height_m(p.x, p.y);
            let s = track.curve_coordinates(p.x, p.y).0;
            let lap = track.lap_m();
            let open = wall.gaps_m.iter().any(|(a, b)| (s - a).rem_euclid(lap) < b - a);
            let stands = !open && p.z > foot - 0.3 && p.z < foot + wall.height_m;
            stands.then(|| (t, if normal.dot(d) > 0.0 { -normal } else { normal }))
        })
    }

    /// Marches with steps that cannot cross the surface, then refines the intersection by chords.
    fn cast_road(&self, o: &Point3<f64>, d: &Vector3<f64>, before_m: f64) -> Option<(f64, Vector3<f64>)> {
        let track = &self.track;
        let gap = |t: f64| {
            let p = o + d * t;
            p.z - track.height_m(p.x, p.y)
        };
        let steepest = track.slope[1].max(track.slope[0]) + 0.02;
        let fall = (steepest * d.xy().norm() - d.z).max(1e-3);
        // Above the highest wave crest its phase is irrelevant.
        let (mut t, mut above) = (0.0, f64::INFINITY);
        while above > 0.15 {
            let p = o + d * t;
            above = p.z - track.at_most_m(p.x, p.y);
            if t > before_m || t > REACH_M {
                return None;
            }
            t += (above / fall).max(0.0);
        }
        let mut g = gap(t);
        if g <= 0.0 {
            (t, g) = (0.0, gap(0.0));
        }
        while g > 0.0 {
            let next = t + (g / fall).max(0.25);
            if t > before_m || next > REACH_M {
                return None;
            }
            let after = gap(next);
            if after <= 0.0 {
                let high = crossing((t, g), (next, after), gap);
                if high >= before_m {
                    return None;
                }
                let p = o + d * high;
                let h = 0.05;
                let slope = |dx: f64, dy: f64| {
                    (track.height_m(p.x + dx, p.y + dy) - track.height_m(p.x - dx, p.y - dy)) / (2.0 * h)
                };
                return Some((high, Vector3::new(-slope(h, 0.0), -slope(0.0, h), 1.0).normalize()));
            }
            (t, g) = (next, after);
        }
        None
    }
}

/// Zero crossing of a falling function between two positions, by the Illinois variant of regula falsi.
fn crossing(mut above: (f64, f64), mut below: (f64, f64), gap: impl Fn(f64) -> f64) -> f64 {
    for _ in 0..40 {
        let t = (above.0 * below.1 - below.0 * above.1) / (below.1 - above.1);
        let g = gap(t);
        if g.abs() < 1e-9 || below.0 - above.0 < 1e-9 {
            return t;
        }
        if g > 0.0 {
            above = (t, g);
            below.1 *= 0.5;
        } else {
            below = (t, g);
            above.1 *= 0.5;
        }
    }
    below.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rays_from_the_ego_car_meet_road_wall_and_cars() {
        let world = draw_world(&mut data::stream(3, "world", 0, 0), 0.3);
        let pose = world.pose(0, 1.0);
        let moment = world.moment(1.0, pose);
        let mount = Point3::new(0.0, 0.0, 1.5);
        let down = moment.cast(&mount, &Vector3::new(0.3, 0.0, -1.0).normalize()).unwrap();
        assert_eq!(down.material, Material::Asphalt);
        assert!((down.range_m - 1.8 * 1.09f64.sqrt()).abs() < 0.05, "{}", down.range_m);
        assert!((down.normal.z - 1.0).abs() < 0.01);
        let right = moment.cast(&mount, &Vector3::new(0.0, -1.0, -0.12).normalize()).unwrap();
        assert!(right.range_m < 12.0 && right.normal.y > 0.9 || right.material == Material::Asphalt, "{right:?}");
        let mut cars = 0;
        for driver in 1..world.drivers.len() {
            let center = Point3::from((pose.inverse() * world.pose(driver, 1.0)).translation.vector);
            let hit = moment.cast(&mount, &(center - mount).normalize());
            cars += usize::from(hit.is_some_and(|h| h.car == Some(driver)));
        }
        assert!(cars >= 1);
    }
}
