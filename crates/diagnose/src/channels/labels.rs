//! Shifts of labelled objects in the object's own frame (forward, left, up): of the measured label against the
//! simulated one, and of the measured returns against the simulated ones.

use super::motion::{OwnMotion, SeenVelocity};
use crate::pairing::{BoxShift, FramePair};
use geometry::{Box3, limit_period};
use nalgebra::Vector3;
use std::f64::consts::PI;

/// One object of one frame that both sides have.
#[derive(Clone, Copy, Debug)]
pub struct ObjectShift {
    /// Number of the frame.
    pub frame: usize,
    /// Number of the object in the frame.
    pub object: usize,
    /// Measured label minus simulated label, m.
    pub label_m: [f64; 3],
    /// Difference of the headings, rad.
    pub label_yaw_rad: f64,
    /// Measured returns against simulated returns; `None` where there are too few.
    pub cloud: Option<BoxShift>,
    /// Velocity of the simulated label relative to the ego vehicle, along the object's own axes, m/s. `None` where
    /// neighbouring frames do not show the object.
    pub seen_velocity_m_s: Option<[f64; 3]>,
    /// Its velocity over the ground, forward, m/s, where the motion of the ego vehicle is known as well.
    pub speed_m_s: Option<f64>,
    /// Distance, m.
    pub distance_m: f64,
    /// Azimuth in the cloud's frame, rad.
    pub azimuth_rad: f64,
    /// Measured returns in the box.
    pub points: usize,
}

/// Shifts of all objects, from the times of the frames, s, where they are known, and the motion of the ego vehicle from
/// each frame to the next.
pub fn object_shifts(frames: &[FramePair], times: Option<&[f64]>, to_next: &[Option<OwnMotion>]) -> Vec<ObjectShift> {
    let mut shifts = Vec::new();
    for (f, frame) in frames.iter().enumerate() {
        for (k, object) in frame.objects.iter().enumerate() {
            let (Some(simulated), Some(measured)) = (object.simulated, object.measured) else { continue };
            let center = Vector3::from(simulated.center);
            let (sin, cos) = simulated.yaw_rad.sin_cos();
            let along = |v: Vector3<f64>| [v.x * cos + v.y * sin, -v.x * sin + v.y * cos, v.z];
            let seen = times.and_then(|t| seen_velocity(frames, t, f, &simulated, to_next));
            shifts.push(ObjectShift {
                frame: f,
                object: k,
                label_m: simulated.to_local(measured.center),
                label_yaw_rad: limit_period(measured.yaw_rad - simulated.yaw_rad, 0.5, PI),
                cloud: object.shift,
                seen_velocity_m_s: seen.map(|seen| along(seen.relative_m_s)),
                speed_m_s: seen.and_then(|seen| seen.speed_m_s),
                distance_m: center.xy().norm(),
                azimuth_rad: center.y.atan2(center.x),
                points: object.points[0],
            });
        }
    }
    shifts
}

/// Velocity of a simulated box of frame `f`; see [`sensor::motion::seen_velocity`].
pub fn seen_velocity(
    frames: &[FramePair],
    times: &[f64],
    f: usize,
    bbox: &Box3,
    to_next: &[Option<OwnMotion>],
) -> Option<SeenVelocity> {
    let boxes = |g: usize| frames[g].objects.iter().filter_map(|o| o.simulated).collect();
    sensor::motion::seen_velocity(&boxes, times, f, bbox, to_next)
}
