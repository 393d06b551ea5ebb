//! Changes of the whole scene: flip, rotation, scaling, translation.

use crate::{Frame, Stream};
use rand::RngExt;
use std::f64::consts::PI;

/// Flips along x (y becomes -y, yaw becomes -yaw) and along y (x becomes -x, yaw becomes -(yaw + pi)), each with its
/// probability.
pub fn flip(mut frame: Frame, along_x_probability: f64, along_y_probability: f64, stream: &mut Stream) -> Frame {
    if stream.random::<f64>() < along_x_probability {
        frame.cloud.points_mut().for_each(|p| p[1] = -p[1]);
        for object in &mut frame.objects {
            object.bbox.center[1] *= -1.0;
            object.bbox.yaw_rad *= -1.0;
        }
    }
    if stream.random::<f64>() < along_y_probability {
        frame.cloud.points_mut().for_each(|p| p[0] = -p[0]);
        for object in &mut frame.objects {
            object.bbox.center[0] *= -1.0;
            object.bbox.yaw_rad = -(object.bbox.yaw_rad + PI);
        }
    }
    frame
}

/// Rotates the scene about z by a random angle from `[smallest, largest]`, rad.
pub fn rotate(mut frame: Frame, rotation_rad: [f64; 2], stream: &mut Stream) -> Frame {
    let angle = uniform(rotation_rad, stream);
    if angle == 0.0 {
        return frame;
    }
    let (s, c) = angle.sin_cos();
    let turned = |x: f64, y: f64| (x * c - y * s, x * s + y * c);
    for p in frame.cloud.points_mut() {
        let (x, y) = turned(p[0].into(), p[1].into());
        (p[0], p[1]) = (x as f32, y as f32);
    }
    for object in &mut frame.objects {
        let [x, y, _] = &mut object.bbox.center;
        (*x, *y) = turned(*x, *y);
        object.bbox.yaw_rad += angle;
    }
    frame
}

/// Scales the scene about the origin by a random factor from `[smallest, largest]`.
pub fn scale(mut frame: Frame, scaling: [f64; 2], stream: &mut Stream) -> Frame {
    let factor = uniform(scaling, stream);
    frame.cloud.points_mut().flat_map(|p| &mut p[..3]).for_each(|v| *v = (f64::from(*v) * factor) as f32);
    for object in &mut frame.objects {
        object.bbox.center.iter_mut().chain(&mut object.bbox.size).for_each(|v| *v *= factor);
    }
    frame
}

/// Translates the scene by a normally distributed vector with these standard deviations along x, y and z, m.
pub fn translate(mut frame: Frame, std_m: [f64; 3], stream: &mut Stream) -> Frame {
    let by = std_m.map(|std| std * normal(stream));
    frame.cloud.points_mut().for_each(|p| (0..3).for_each(|i| p[i] = (f64::from(p[i]) + by[i]) as f32));
    for object in &mut frame.objects {
        (0..3).for_each(|i| object.bbox.center[i] += by[i]);
    }
    frame
}

/// A uniform random number from `[smallest, largest)`; `smallest` if both are equal.
pub(super) fn uniform([smallest, largest]: [f64; 2], stream: &mut Stream) -> f64 {
    smallest + (largest - smallest) * stream.random::<f64>()
}

/// A standard normal random number (Box-Muller transform).
pub(super) fn normal(stream: &mut Stream) -> f64 {
    let (u, v): (f64, f64) = (stream.random(), stream.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (2.0 * PI * v).cos()
}
