//! The way of the ego vehicle through the streets: straights joined by arcs.

use std::f64::consts::FRAC_PI_2;

/// A piece of a route.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Piece {
    /// Begin (m), heading (rad), length (m).
    Straight([f64; 2], f64, f64),
    /// Centre (m), radius (m), heading at the begin (rad), and 1 for a turn to the left, -1 to the right. A quarter
    /// circle.
    Arc([f64; 2], f64, f64, f64),
}

/// A route by its length from the begin, m. World frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Route {
    pieces: Vec<(f64, Piece)>,
    length_m: f64,
}

/// Half of the distance over which the heading is averaged, m.
const AXLES_M: f64 = 1.3;

impl Route {
    /// A route through corners at right angles, of which each has the radius of its arc, m. The first and last corners
    /// are the ends.
    pub fn through(corners: &[([f64; 2], f64)]) -> Route {
        let mut route = Route { pieces: Vec::new(), length_m: 0.0 };
        let heading = |a: [f64; 2], b: [f64; 2]| (b[1] - a[1]).atan2(b[0] - a[0]);
        let mut begin = corners[0].0;
        for i in 1..corners.len() {
            let (corner, radius) = corners[i];
            let ahead = heading(corners[i - 1].0, corner);
            let (sin, cos) = ahead.sin_cos();
            let last = i + 1 == corners.len();
            let cut = if last { 0.0 } else { radius };
            let end = [corner[0] - cut * cos, corner[1] - cut * sin];
            route.push(Piece::Straight(begin, ahead, (end[0] - begin[0]) * cos + (end[1] - begin[1]) * sin));
            if last {
                break;
            }
            let after = heading(corner, corners[i + 1].0);
            let side = (after - ahead).sin().signum();
            route.push(Piece::Arc([end[0] - side * radius * sin, end[1] + side * radius * cos], radius, ahead, side));
            begin = [corner[0] + radius * after.cos(), corner[1] + radius * after.sin()];
        }
        route
    }

    fn push(&mut self, piece: Piece) {
        self.pieces.push((self.length_m, piece));
        self.length_m += match piece {
            Piece::Straight(_, _, length) => length,
            Piece::Arc(_, radius, ..) => FRAC_PI_2 * radius,
        };
    }

    /// Length, m.
    pub fn length_m(&self) -> f64 {
        self.length_m
    }

    /// Radius of the curve at a place, m; infinite on a straight.
    pub fn radius_m(&self, s: f64) -> f64 {
        match self.piece(s).1 {
            Piece::Straight(..) => f64::INFINITY,
            Piece::Arc(_, radius, ..) => radius,
        }
    }

    fn piece(&self, s: f64) -> (f64, Piece) {
        let i = self.pieces.partition_point(|(begin, _)| *begin <= s).saturating_sub(1);
        (s - self.pieces[i].0, self.pieces[i].1)
    }

    /// Place and heading of the line itself.
    fn on_line(&self, s: f64) -> ([f64; 2], f64) {
        match self.piece(s) {
            (along, Piece::Straight(begin, heading, _)) => {
                let (sin, cos) = heading.sin_cos();
                ([begin[0] + along * cos, begin[1] + along * sin], heading)
            }
            (along, Piece::Arc(center, radius, heading, side)) => {
                let now = heading + side * along / radius;
                ([center[0] + side * radius * now.sin(), center[1] - side * radius * now.cos()], now)
            }
        }
    }

    /// Place (m) and heading (rad) at a length `s` from the begin, `left` of the route, m. The heading is that of a
    /// vehicle, whose axles are some metres apart.
    pub fn at(&self, s: f64, left: f64) -> ([f64; 2], f64) {
        let beside = |s: f64| {
            let ([x, y], heading) = self.on_line(s);
            [x - left * heading.sin(), y + left * heading.cos()]
        };
        let [back, front] = [beside(s - AXLES_M), beside(s + AXLES_M)];
        (beside(s), (front[1] - back[1]).atan2(front[0] - back[0]))
    }
}

/// Distance driven as a function of time.
#[derive(Clone, Debug, PartialEq)]
pub struct Drive {
    /// Time of the first entry, s.
    begin_s: f64,
    /// Distance (m) and speed (m/s) at equal steps of time.
    table: Vec<[f64; 2]>,
}

/// Step of the table, s.
const STEP_S: f64 = 0.02;

/// Largest acceleration along and across, m/s2.
const ACCELERATION_M_S2: f64 = 2.0;
const ACROSS_M_S2: f64 = 3.0;

impl Drive {
    /// From `from_s` to `to_s`, beginning at `start_m` of the route, at the speed that `wanted` gives for a time. It
    /// slows down before curves.
    pub fn along(route: &Route, start_m: f64, [from_s, to_s]: [f64; 2], wanted: impl Fn(f64) -> f64) -> Drive {
        let steps = ((to_s - from_s) / STEP_S).ceil() as usize + 2;
        let allowed = |s: f64, t: f64| {
            // The speed from which the vehicle can still slow down to that of each curve ahead.
            let curves = (0..30).map(|i| {
                let ahead = f64::from(i);
                let curve = (ACROSS_M_S2 * route.radius_m(s + ahead)).sqrt();
                (curve * curve + 2.0 * ACCELERATION_M_S2 * ahead).sqrt()
            });
            curves.fold(wanted(t), f64::min)
        };
        let (mut s, mut speed) = (start_m, allowed(start_m, from_s));
        let mut table = Vec::with_capacity(steps);
        for i in 0..steps {
            table.push([s, speed]);
            let t = from_s + i as f64 * STEP_S;
            let change = (allowed(s, t) - speed).clamp(-1.5 * ACCELERATION_M_S2 * STEP_S, ACCELERATION_M_S2 * STEP_S);
            s += (speed + 0.5 * change) * STEP_S;
            speed += change;
        }
        Drive { begin_s: from_s, table }
    }

    fn entry(&self, t: f64) -> (f64, [f64; 2], [f64; 2]) {
        let at = ((t - self.begin_s) / STEP_S).clamp(0.0, self.table.len() as f64 - 1.001);
        let i = at as usize;
        (at - i as f64, self.table[i], self.table[i + 1])
    }

    /// Distance from the begin of the route at a time, m.
    pub fn distance_m(&self, t: f64) -> f64 {
        let (u, [s, v], [_, next]) = self.entry(t);
        s + STEP_S * (v * u + 0.5 * (next - v) * u * u)
    }

    /// Speed at a time, m/s.
    pub fn speed_m_s(&self, t: f64) -> f64 {
        let (u, [_, v], [_, next]) = self.entry(t);
        v + u * (next - v)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn route() -> Route {
        Route::through(&[([0.0, 0.0], 0.0), ([50.0, 0.0], 8.0), ([50.0, 60.0], 10.0), ([120.0, 60.0], 0.0)])
    }

    #[test]
    fn pieces_join_without_a_gap() {
        let route = route();
        assert!((route.length_m() - (42.0 + 42.0 + 60.0 + FRAC_PI_2 * 18.0)).abs() < 1e-9);
        let mut last = route.on_line(0.0).0;
        let mut s = 0.0;
        while s < route.length_m() - 0.1 {
            s += 0.1;
            let p = route.on_line(s).0;
            assert!(((p[0] - last[0]).hypot(p[1] - last[1]) - 0.1).abs() < 2e-3, "{s}");
            last = p;
        }
        assert_eq!(route.at(20.0, 1.0), ([20.0, 1.0], 0.0));
        assert!((route.at(80.0, 0.0).1 - FRAC_PI_2).abs() < 1e-9);
    }

    #[test]
    fn a_drive_slows_down_in_curves_and_its_distance_is_the_integral_of_its_speed() {
        let route = route();
        let drive = Drive::along(&route, 5.0, [-1.0, 12.0], |_| 11.0);
        let mut slowest: f64 = 99.0;
        for i in 0..1_000 {
            let t = -0.9 + 0.012 * f64::from(i);
            let h = 1e-4;
            let rate = (drive.distance_m(t + h) - drive.distance_m(t - h)) / (2.0 * h);
            assert!((rate - drive.speed_m_s(t)).abs() < 1e-2, "{t}: {rate}");
            slowest = slowest.min(drive.speed_m_s(t));
        }
        assert!((4.0..6.5).contains(&slowest), "{slowest}");
    }
}
