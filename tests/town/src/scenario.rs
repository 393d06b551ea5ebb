//! A scenario: a world, the way of the ego vehicle through it, and the traffic.

use crate::route::{Drive, Route};
use crate::setting::{Scene, Setting};
use crate::street::Streets;
use crate::town::{CAR_MODELS, STREETS, draw_corridor, draw_town};
use crate::traffic::Motion;
use crate::vehicle::Model;
use crate::world::{Vehicle, World};
use data::Stream;
use nalgebra::{Isometry3, Translation3, UnitQuaternion};
use rand::RngExt;
use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

/// A scenario as the log and the simulation have it.
#[derive(Clone, Debug)]
pub struct Scenario {
    /// The world.
    pub world: World,
    /// The way of the ego vehicle.
    pub route: Arc<Route>,
    /// Where the ego vehicle is on it.
    pub drive: Arc<Drive>,
    /// Height of the vehicle frame above the ground, m.
    pub above_m: f64,
}

/// Distance of a lane from the middle of its street, m.
const LANE_M: f64 = 1.7;

/// Length of the route before the ego vehicle begins, and after it ends, m.
const SPARE_M: f64 = 90.0;

/// Time that is driven before the first and after the last frame, s.
const SPARE_S: f64 = 1.0;

/// Half of the distances at which the ground under the wheels is taken, along and across, m.
const WHEELS_M: [f64; 2] = [1.35, 0.8];

impl Scenario {
    /// Draws a scenario of some duration, s. `above_m` is the height of the vehicle frame above the ground, m.
    pub fn draw(rng: &mut Stream, setting: &Setting, duration_s: f64, above_m: f64) -> Scenario {
        let usual = match setting.scene {
            Scene::Town => rng.random_range(6.5..12.0),
            Scene::Crawl => rng.random_range(4.2..5.2),
            Scene::Parallel => rng.random_range(9.0..22.0),
        };
        let length = 1.3 * usual * (duration_s + 2.0 * SPARE_S) + 2.0 * SPARE_M;
        let (mut world, route) = match setting.scene {
            Scene::Parallel => {
                let ends = [([-SPARE_M, -LANE_M], 0.0), ([length, -LANE_M], 0.0)];
                (draw_corridor(rng, length), Route::through(&ends))
            }
            Scene::Town | Scene::Crawl => {
                let world = draw_town(rng);
                let route = draw_route(rng, &world.streets, length);
                (world, route)
            }
        };
        let (swing, rate) = (rng.random_range(0.1..0.3), rng.random_range(0.25..0.6));
        let phase = rng.random_range(0.0..TAU);
        let wanted = |t: f64| usual * (1.0 + swing * (rate * t + phase).sin());
        let drive = Drive::along(&route, SPARE_M, [-SPARE_S, duration_s + SPARE_S], wanted);
        for vehicle in &mut world.vehicles {
            vehicle.labelled = setting.parked_labels;
        }
        let mut scenario = Scenario { world, route: Arc::new(route), drive: Arc::new(drive), above_m };
        scenario.draw_cars(rng, setting.cars, duration_s);
        if setting.scene != Scene::Parallel {
            scenario.draw_pedestrians(rng, duration_s);
        }
        scenario
    }

    /// Pose of the ego vehicle (`world_from_vehicle`) at a time, s.
    pub fn ego(&self, t: f64) -> Isometry3<f64> {
        let ([x, y], heading) = self.route.at(self.drive.distance_m(t), 0.0);
        let (sin, cos) = heading.sin_cos();
        let ground = |ahead: f64, left: f64| {
            self.world.streets.height_m(x + ahead * cos - left * sin, y + ahead * sin + left * cos)
        };
        let [a, b] = WHEELS_M;
        let corners = [ground(a, b), ground(a, -b), ground(-a, b), ground(-a, -b)];
        let pitch = (corners[2] + corners[3] - corners[0] - corners[1]) / (4.0 * a);
        let roll = (corners[0] + corners[2] - corners[1] - corners[3]) / (4.0 * b);
        let z = corners.iter().sum::<f64>() / 4.0 + self.above_m;
        Isometry3::from_parts(Translation3::new(x, y, z), UnitQuaternion::from_euler_angles(roll, pitch, heading))
    }

    /// Distance of a place from the ego vehicle at a time, m.
    fn ego_distance_m(&self, t: f64, [x, y]: [f64; 2]) -> f64 {
        let ([ex, ey], _) = self.route.at(self.drive.distance_m(t), 0.0);
        (x - ex).hypot(y - ey)
    }

    fn draw_cars(&mut self, rng: &mut Stream, number: usize, duration_s: f64) {
        let times = quarter_seconds(duration_s);
        let mut places: Vec<Vec<[f64; 2]>> = Vec::new();
        for _ in 0..400 * number {
            if places.len() == number {
                break;
            }
            let motion = match rng.random_range(0..10u32) {
                0..4 => self.draw_with_ego(rng),
                4..7 => self.draw_against_ego(rng, duration_s),
                _ => self.draw_on_street(rng, duration_s),
            };
            let Some(motion) = motion else { continue };
            let path: Vec<[f64; 2]> = times
                .iter()
                .map(|t| {
                    let [x, y, _] = motion.place(*t, 0.0, &self.world.streets).center;
                    [x, y]
                })
                .collect();
            let free = |i: usize, others: &[f64; 2]| (path[i][0] - others[0]).hypot(path[i][1] - others[1]) > 6.5;
            let alone = places.iter().all(|other| other.iter().enumerate().all(|(i, p)| free(i, p)));
            let clear = times.iter().zip(&path).all(|(t, p)| self.ego_distance_m(*t, *p) > 7.0);
            let within =
                |p: &[f64; 2]| (0..2).all(|k| p[k] > self.world.corners[0][k] && p[k] < self.world.corners[1][k]);
            if !alone || !clear || !path.iter().all(within) {
                continue;
            }
            places.push(path);
            self.world.vehicles.push(Vehicle {
                model: rng.random_range(0..CAR_MODELS),
                reflectivity: rng.random_range(0.06..0.7),
                motion,
                labelled: true,
            });
        }
    }

    fn surge(rng: &mut Stream) -> [f64; 3] {
        [rng.random_range(0.5..3.0), rng.random_range(0.3..0.8), rng.random_range(0.0..TAU)]
    }

    fn draw_with_ego(&self, rng: &mut Stream) -> Option<Motion> {
        let at_m = rng.random_range(10.0..75.0) * if rng.random_bool(0.6) { 1.0 } else { -1.0 };
        Some(Motion::Route {
            route: self.route.clone(),
            drive: self.drive.clone(),
            at_m,
            against_m_s: None,
            left_m: rng.random_range(-0.3..0.3),
            surge: Self::surge(rng),
        })
    }

    fn draw_against_ego(&self, rng: &mut Stream, duration_s: f64) -> Option<Motion> {
        let meets_s = rng.random_range(0.0..duration_s + 3.0);
        let speed = rng.random_range(4.0..11.0);
        let at_m = self.drive.distance_m(meets_s) + speed * meets_s;
        let inside = at_m < self.route.length_m() - 5.0 && at_m - speed * duration_s > 5.0;
        inside.then(|| Motion::Route {
            route: self.route.clone(),
            drive: self.drive.clone(),
            at_m,
            against_m_s: Some(speed),
            left_m: 2.0 * LANE_M + rng.random_range(-0.2..0.2),
            surge: Self::surge(rng),
        })
    }

    /// A car on a street that the ego vehicle is near to at some time.
    fn draw_on_street(&self, rng: &mut Stream, duration_s: f64) -> Option<Motion> {
        let near_s = rng.random_range(0.0..duration_s.max(0.1));
        let ([x, y], _) = self.route.at(self.drive.distance_m(near_s), 0.0);
        let streets = &self.world.streets;
        let lines = if rng.random_bool(0.5) { (&streets.at_x, 0) } else { (&streets.at_y, 1) };
        let here = [x, y];
        let close: Vec<f64> = lines.0.iter().copied().filter(|l| (l - here[lines.1]).abs() < 85.0).collect();
        if close.is_empty() {
            return None;
        }
        let line = close[rng.random_range(0..close.len())];
        let onward = if rng.random_bool(0.5) { 1.0 } else { -1.0 };
        let speed_m_s = rng.random_range(3.0..11.0);
        let along = here[1 - lines.1] + rng.random_range(-70.0..70.0) - onward * speed_m_s * near_s;
        // Traffic keeps to the right: east of the middle when driving north, south of it when driving east.
        let (start, heading_rad) = if lines.1 == 0 {
            ([line + onward * LANE_M, along], onward * FRAC_PI_2)
        } else {
            ([along, line - onward * LANE_M], if onward > 0.0 { 0.0 } else { 2.0 * FRAC_PI_2 })
        };
        Some(Motion::Line { start, heading_rad, speed_m_s, surge: Self::surge(rng) })
    }

    fn draw_pedestrians(&mut self, rng: &mut Stream, duration_s: f64) {
        let models = self.world.models.len();
        self.world.models.extend((0..3).map(|_| Model::pedestrian(rng)));
        let half = self.world.streets.half_road_m;
        for _ in 0..rng.random_range(4..12) {
            let near_s = rng.random_range(0.0..duration_s.max(0.1));
            let s = self.drive.distance_m(near_s) + rng.random_range(-20.0..40.0);
            let beside = rng.random_range(0.9..1.6);
            let left = if rng.random_bool(0.5) { half + LANE_M + beside } else { LANE_M - half - beside };
            let (place, heading) = self.route.at(s.clamp(3.0, self.route.length_m() - 3.0), left);
            let heading_rad = heading + if rng.random_bool(0.5) { 0.0 } else { 2.0 * FRAC_PI_2 };
            let speed_m_s = rng.random_range(0.6..1.7);
            let (sin, cos) = heading_rad.sin_cos();
            let start = [place[0] - cos * speed_m_s * near_s, place[1] - sin * speed_m_s * near_s];
            let motion = Motion::Line { start, heading_rad, speed_m_s, surge: [0.0; 3] };
            let (model, reflectivity) = (models + rng.random_range(0..3usize), rng.random_range(0.08..0.6));
            let apart = |t: &f64| {
                let [x, y, _] = motion.place(*t, 0.0, &self.world.streets).center;
                self.ego_distance_m(*t, [x, y]) > 3.0
            };
            if quarter_seconds(duration_s).iter().all(apart) {
                self.world.vehicles.push(Vehicle { model, reflectivity, motion, labelled: true });
            }
        }
    }
}

/// Times at which places are compared, s.
fn quarter_seconds(duration_s: f64) -> Vec<f64> {
    (0..=(duration_s / 0.25) as usize).map(|i| 0.25 * i as f64).collect()
}

/// A route along the right lanes of the streets, of at least some length, m. It stays away from the outermost streets.
fn draw_route(rng: &mut Stream, streets: &Streets, length_m: f64) -> Route {
    // Steps to the east, north, west, south.
    const STEPS: [[i64; 2]; 4] = [[1, 0], [0, 1], [-1, 0], [0, -1]];
    let inner = 1..STREETS as i64 - 1;
    let mut node = [(); 2].map(|()| rng.random_range(2..STREETS as i64 - 2));
    let mut way = rng.random_range(0..4usize);
    // The line of the right lane of the street along `way` through a node: the coordinate across it.
    let lane = |node: [i64; 2], way: usize| match way {
        0 => streets.at_y[node[1] as usize] - LANE_M,
        1 => streets.at_x[node[0] as usize] + LANE_M,
        2 => streets.at_y[node[1] as usize] + LANE_M,
        _ => streets.at_x[node[0] as usize] - LANE_M,
    };
    let middle = |node: [i64; 2]| [streets.at_x[node[0] as usize], streets.at_y[node[1] as usize]];
    let start = middle(node);
    let begin = if way % 2 == 0 { [start[0], lane(node, way)] } else { [lane(node, way), start[1]] };
    let mut corners = vec![(begin, 0.0)];
    let mut driven = 0.0;
    loop {
        let next = [0, 1].map(|k| node[k] + STEPS[way][k]);
        let turns: Vec<usize> = [0usize, 1, 3]
            .into_iter()
            .map(|turn| (way + turn) % 4)
            .filter(|&w| (0..2).all(|k| inner.contains(&(next[k] + STEPS[w][k]))))
            .collect();
        driven += (0..2).map(|k| (middle(next)[k] - middle(node)[k]).abs()).sum::<f64>();
        node = next;
        let after = turns[rng.random_range(0..turns.len())];
        if driven > length_m + 60.0 {
            let end = middle(node);
            corners.push((if way % 2 == 0 { [end[0], lane(node, way)] } else { [lane(node, way), end[1]] }, 0.0));
            return Route::through(&corners);
        }
        if after != way {
            let right = after == (way + 3) % 4;
            let radius = if right { rng.random_range(5.5..7.0) } else { rng.random_range(8.0..10.0) };
            let [across, along] = [lane(node, way), lane(node, after)];
            corners.push((if way % 2 == 0 { [along, across] } else { [across, along] }, radius));
            way = after;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensor::Layout;
    use crate::setting::Intensity;

    fn setting(scene: Scene, cars: usize) -> Setting {
        Setting {
            scene,
            layout: Layout::Roof(32),
            pattern_known: false,
            intensity: Intensity::None,
            rate_hz: 10.0,
            every: 4,
            cars,
            labels: true,
            parked_labels: true,
        }
    }

    #[test]
    fn the_ego_vehicle_stays_on_the_road_and_nobody_comes_near_it() {
        for seed in 0..8 {
            let mut rng = data::stream(seed, "scenario", 0, 0);
            let scenario = Scenario::draw(&mut rng, &setting(Scene::Town, 10), 16.0, 0.2);
            let moving = scenario.world.vehicles.iter().filter(|v| !matches!(v.motion, Motion::Parked(_))).count();
            assert!(moving > 8, "{moving}");
            for i in 0..64 {
                let t = 0.25 * f64::from(i);
                let p = scenario.ego(t).translation.vector;
                assert!(scenario.world.streets.is_road(p.x, p.y), "{seed} {t}: {p}");
                for v in 0..scenario.world.vehicles.len() {
                    let [x, y, _] = scenario.world.place(v, t).center;
                    assert!((x - p.x).hypot(y - p.y) > 2.2, "{seed} {t} vehicle {v}: {:.1}", (x - p.x).hypot(y - p.y));
                }
            }
        }
    }

    #[test]
    fn thirty_cars_find_their_place() {
        for seed in 0..6 {
            let mut rng = data::stream(seed, "scenario", 0, 0);
            let scenario = Scenario::draw(&mut rng, &setting(Scene::Town, 30), 12.0, 0.2);
            let is_moving_car = |v: &&Vehicle| v.model < CAR_MODELS && !matches!(v.motion, Motion::Parked(_));
            assert_eq!(scenario.world.vehicles.iter().filter(is_moving_car).count(), 30, "{seed}");
        }
    }

    #[test]
    fn it_turns_at_varied_speed() {
        let mut rng = data::stream(3, "scenario", 0, 0);
        let scenario = Scenario::draw(&mut rng, &setting(Scene::Town, 5), 40.0, 0.2);
        let speeds: Vec<f64> = (0..160).map(|i| scenario.drive.speed_m_s(0.25 * f64::from(i))).collect();
        let (low, high) = speeds.iter().fold((f64::MAX, 0.0f64), |(l, h), v| (l.min(*v), h.max(*v)));
        assert!(low > 2.0 && high < 16.0 && high > 1.4 * low, "{low} {high}");
        let yaw = |t: f64| scenario.ego(t).rotation.euler_angles().2;
        assert!((0..40).any(|i| geometry::limit_period(yaw(f64::from(i)) - yaw(0.0), 0.5, TAU).abs() > 1.0));
    }
}
