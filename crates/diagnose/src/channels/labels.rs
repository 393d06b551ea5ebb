//! Shifts of labelled objects in the object's own frame (forward, left, up): of the measured label against the
//! simulated one, and of the measured returns against the simulated ones.

use crate::pairing::FramePair;
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
    /// Measured returns against simulated returns, m, with standard errors; `None` where there are too few.
    pub cloud_m: Option<([f64; 3], [f64; 3])>,
    /// Velocity of the simulated label relative to the ego vehicle, along the object's own axes, m/s. `None` where
    /// neighbouring frames do not show the object.
    pub seen_velocity_m_s: Option<[f64; 3]>,
    /// Distance, m.
    pub distance_m: f64,
    /// Azimuth in the cloud's frame, rad.
    pub azimuth_rad: f64,
    /// Measured returns in the box.
    pub points: usize,
}

/// Times of the frames from their ids: numbers of scans, or nanoseconds where neighbours differ by 1e6 or more.
/// `None` unless ids are rising numbers.
pub fn times_s(ids: &[String], rate_hz: f64) -> Option<Vec<f64>> {
    let numbers: Vec<f64> = ids.iter().map(|id| id.parse::<f64>().ok()).collect::<Option<_>>()?;
    if numbers.windows(2).any(|w| w[1] <= w[0]) {
        return None;
    }
    let gaps: Vec<f64> = numbers.windows(2).map(|w| w[1] - w[0]).collect();
    let usual = statistics::median_upper(gaps)?;
    let unit = if usual >= 1e6 { 1e-9 } else { 1.0 / rate_hz };
    Some(numbers.iter().map(|n| (n - numbers[0]) * unit).collect())
}

/// Longest time between frames from which a velocity is estimated, s.
const LONGEST_S: f64 = 0.6;

/// Largest relative speed of an object, m/s.
const FASTEST_M_S: f64 = 60.0;

/// Shifts of all objects.
pub fn object_shifts(frames: &[FramePair], times: Option<&[f64]>) -> Vec<ObjectShift> {
    let mut shifts = Vec::new();
    for (f, frame) in frames.iter().enumerate() {
        for (k, object) in frame.objects.iter().enumerate() {
            let (Some(simulated), Some(measured)) = (object.simulated, object.measured) else { continue };
            let center = Vector3::from(simulated.center);
            let (sin, cos) = simulated.yaw_rad.sin_cos();
            let along = |v: Vector3<f64>| [v.x * cos + v.y * sin, -v.x * sin + v.y * cos, v.z];
            shifts.push(ObjectShift {
                frame: f,
                object: k,
                label_m: simulated.to_local(measured.center),
                label_yaw_rad: limit_period(measured.yaw_rad - simulated.yaw_rad, 0.5, PI),
                cloud_m: object.shift.map(|s| (s.shift_m, s.error_m)),
                seen_velocity_m_s: times.and_then(|t| seen_velocity(frames, t, f, &simulated)).map(along),
                distance_m: center.xy().norm(),
                azimuth_rad: center.y.atan2(center.x),
                points: object.points[0],
            });
        }
    }
    shifts
}

/// Velocity of a simulated box of frame `f` relative to the ego vehicle, from the nearest boxes of the frames before
/// and after, m/s, cloud's frame.
pub fn seen_velocity(frames: &[FramePair], times: &[f64], f: usize, bbox: &Box3) -> Option<Vector3<f64>> {
    let neighbour = |g: usize| -> Option<(f64, Vector3<f64>)> {
        let dt = times[g] - times[f];
        if dt.abs() > LONGEST_S {
            return None;
        }
        let here = Vector3::from(bbox.center);
        let boxes = frames[g].objects.iter().filter_map(|o| o.simulated);
        let same_size = |b: &Box3| (0..3).all(|k| (b.size[k] - bbox.size[k]).abs() < 0.35 * bbox.size[k]);
        let nearest = boxes
            .filter(same_size)
            .map(|b| Vector3::from(b.center) - here)
            .min_by(|a, b| a.norm().total_cmp(&b.norm()))?;
        (nearest.norm() < (FASTEST_M_S * dt.abs()).min(5.0)).then_some((dt, nearest))
    };
    let before = f.checked_sub(1).and_then(neighbour);
    let after = if f + 1 < frames.len() { neighbour(f + 1) } else { None };
    let v = match (before, after) {
        (Some((t0, d0)), Some((t1, d1))) => (d1 - d0) / (t1 - t0),
        (Some((t, d)), None) | (None, Some((t, d))) => d / t,
        (None, None) => return None,
    };
    Some(v)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_scans_or_nanoseconds() {
        let ids = |v: &[&str]| v.iter().map(|s| s.to_string()).collect::<Vec<_>>();
        assert_eq!(times_s(&ids(&["000005", "000010"]), 20.0), Some(vec![0.0, 0.25]));
        let stamps = times_s(&ids(&["1650000000000000000", "1650000000050000000"]), 20.0).unwrap();
        assert!((stamps[1] - 0.05).abs() < 1e-4);
        assert_eq!(times_s(&ids(&["a", "b"]), 20.0), None);
        assert_eq!(times_s(&ids(&["3", "3"]), 20.0), None);
    }
}
