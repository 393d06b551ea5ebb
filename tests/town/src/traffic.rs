//! How vehicles move.

use crate::route::{Drive, Route};
use crate::street::Streets;
use crate::vehicle::Place;
use nalgebra::Vector3;
use std::f64::consts::PI;
use std::sync::Arc;

/// Motion of a vehicle.
#[derive(Clone, Debug)]
pub enum Motion {
    /// It stands.
    Parked(Place),
    /// Along a line.
    Line {
        /// Place at time 0, m.
        start: [f64; 2],
        /// Heading, rad.
        heading_rad: f64,
        /// Speed, m/s.
        speed_m_s: f64,
        /// Oscillation along the line: amplitude (m), rate (rad/s), phase (rad).
        surge: [f64; 3],
    },
    /// Along the route of the ego vehicle.
    Route {
        /// The route.
        route: Arc<Route>,
        /// The drive of the ego vehicle.
        drive: Arc<Drive>,
        /// With the ego vehicle: how far ahead of it; against it: place on the route at time 0, m.
        at_m: f64,
        /// Speed against the direction of the route, m/s; `None` with the ego vehicle.
        against_m_s: Option<f64>,
        /// Beside the route, to its left, m.
        left_m: f64,
        /// Oscillation along the route: amplitude (m), rate (rad/s), phase (rad).
        surge: [f64; 3],
    },
}

fn wave([size, rate, phase]: [f64; 3], t: f64) -> f64 {
    size * (rate * t + phase).sin()
}

impl Motion {
    /// Where a vehicle of some height (m) is at a time, s.
    pub fn place(&self, t: f64, height_m: f64, streets: &Streets) -> Place {
        let ([x, y], heading_rad) = match self {
            Motion::Parked(place) => return *place,
            Motion::Line { start, heading_rad, speed_m_s, surge } => {
                let along = speed_m_s * t + wave(*surge, t);
                let (sin, cos) = heading_rad.sin_cos();
                ([start[0] + along * cos, start[1] + along * sin], *heading_rad)
            }
            Motion::Route { route, drive, at_m, against_m_s, left_m, surge } => match against_m_s {
                None => route.at(drive.distance_m(t) + at_m + wave(*surge, t), *left_m),
                Some(speed) => {
                    let (place, heading) = route.at(at_m - speed * t + wave(*surge, t), *left_m);
                    (place, heading + PI)
                }
            },
        };
        Place { center: [x, y, streets.height_m(x, y) + height_m / 2.0], heading_rad }
    }

    /// Velocity at a time, m/s, world frame.
    pub fn velocity_m_s(&self, t: f64, streets: &Streets) -> Vector3<f64> {
        let h = 0.01;
        let [before, after] = [t - h, t + h].map(|t| Vector3::from(self.place(t, 0.0, streets).center));
        let mut velocity = (after - before) / (2.0 * h);
        // Kerbs and crowns are no velocity.
        velocity.z = 0.0;
        velocity
    }
}
