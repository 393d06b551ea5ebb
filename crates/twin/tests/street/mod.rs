//! A made-up drive through a street of cuboids with exact ranges, and what a faulty sensor makes of them.

use sensor::rig::direction;
use std::fmt::Write;
use std::path::Path;

/// Rows and columns of a scan.
const ROWS: usize = 32;
const COLUMNS: usize = 720;

/// Farthest return, m.
const FARTHEST_M: f64 = 70.0;

/// A shot that met a surface.
#[derive(Clone, Copy, Debug)]
pub struct Hit {
    /// Row, from the top.
    pub row: usize,
    /// True range, m.
    pub range_m: f64,
    /// A number that no other shot has.
    number: u64,
}

impl Hit {
    /// A number from 0 to 1 of this shot; `purpose` tells several apart.
    pub fn uniform(&self, purpose: u64) -> f64 {
        let mut x = self.number.wrapping_add(purpose.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        for _ in 0..2 {
            x = (x ^ (x >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            x = (x ^ (x >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            x ^= x >> 31;
        }
        (x >> 11) as f64 / (1u64 << 53) as f64
    }

    /// A normal number with mean 0 and deviation 1.
    pub fn normal(&self, purpose: u64) -> f64 {
        let [a, b] = [2 * purpose, 2 * purpose + 1].map(|p| self.uniform(1000 + p));
        (-2.0 * (1.0 - a).ln()).sqrt() * (std::f64::consts::TAU * b).cos()
    }
}

/// Low and high corner of a cuboid, m.
type Cuboid = [[f64; 3]; 2];

/// Houses with gaps, parked cars, walls and posts on both sides of a road along x.
fn cuboids() -> Vec<Cuboid> {
    let mut all = Vec::new();
    for i in 0..14 {
        let x = -60.0 + 14.0 * f64::from(i);
        for (side, set_back) in [(1.0, 8.0 + f64::from(i * 7 % 5)), (-1.0, 9.0 + f64::from(i * 3 % 4))] {
            let (width, height) = (9.0 + f64::from(i * 5 % 4), 5.0 + f64::from(i * 11 % 6));
            let y = [side * set_back, side * (set_back + 8.0)];
            all.push([[x, y[0].min(y[1]), 0.0], [x + width, y[0].max(y[1]), height]]);
            let car = x + f64::from(i * 13 % 6);
            let y = [side * 4.0, side * 5.8];
            all.push([[car, y[0].min(y[1]), 0.25], [car + 4.3, y[0].max(y[1]), 1.5]]);
            let post = x + 11.0;
            all.push([[post, side * 6.5 - 0.15, 0.0], [post + 0.3, side * 6.5 + 0.15, 4.0]]);
        }
    }
    all.push([[125.0, -30.0, 0.0], [130.0, 30.0, 9.0]]);
    all
}

/// Range of a ray.
fn cast(all: &[Cuboid], from: [f64; 3], along: [f64; 3]) -> Option<f64> {
    let mut best = if along[2] < 0.0 { -from[2] / along[2] } else { f64::INFINITY };
    for [low, high] in all {
        let (mut near, mut far) = (0.0f64, f64::INFINITY);
        for k in 0..3 {
            let (a, b) = ((low[k] - from[k]) / along[k], (high[k] - from[k]) / along[k]);
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        if near > 0.0 && near < far && near < best {
            best = near;
        }
    }
    (best < FARTHEST_M).then_some(best)
}

/// Writes a drive of 1 m a frame. `measured` gives the range of a shot that met something; `None` is a loss.
pub fn write_street(root: &Path, frames: usize, measured: &dyn Fn(&Hit) -> Option<f64>) {
    std::fs::create_dir_all(root.join("velodyne")).unwrap();
    let (all, mut poses, mut number) = (cuboids(), String::new(), 0);
    for frame in 0..frames {
        let yaw = 0.04 * (0.3 * frame as f64).sin();
        let (sin, cos_yaw) = yaw.sin_cos();
        let at = [frame as f64, 0.3 * (0.2 * frame as f64).sin(), 1.73];
        let mut bytes = Vec::new();
        for row in 0..ROWS {
            // The phase of a row differs from frame to frame.
            let phase = (0.37 * frame as f64 + 0.61 * row as f64).fract();
            for column in 0..COLUMNS {
                let azimuth = ((column as f64 + phase) * 360.0 / COLUMNS as f64).to_radians();
                let local = direction(azimuth, (6.0 - 0.8 * row as f64).to_radians());
                let along = [cos_yaw * local[0] - sin * local[1], sin * local[0] + cos_yaw * local[1], local[2]];
                number += 1;
                let Some(range_m) = cast(&all, at, along) else { continue };
                let Some(range) = measured(&Hit { row, range_m, number }) else { continue };
                for v in [local[0] * range, local[1] * range, local[2] * range, 0.4] {
                    bytes.extend((v as f32).to_le_bytes());
                }
            }
        }
        std::fs::write(root.join(format!("velodyne/{frame:06}.bin")), bytes).unwrap();
        let [x, y, z] = at;
        writeln!(poses, "{cos_yaw} {} 0 {x} {sin} {cos_yaw} 0 {y} 0 0 1 {z}", -sin).unwrap();
    }
    std::fs::write(root.join("poses.txt"), poses).unwrap();
}
