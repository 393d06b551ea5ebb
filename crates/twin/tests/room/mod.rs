//! A made-up recording with exact ranges: a room of 30 x 20 x 5 m with a box in it.

use sensor::rig::direction;
use std::fmt::Write;
use std::path::Path;

/// Low and high corner of the room, and of a box of 4 x 2 x 1.5 m on its floor, m.
const ROOM: [[f64; 3]; 2] = [[-10.0, -8.0, 0.0], [20.0, 12.0, 5.0]];
const BOX: [[f64; 3]; 2] = [[8.0, 3.0, 0.0], [12.0, 5.0, 1.5]];

/// Range from a place in the room along a direction; `None` through the window, which is a part of one wall.
fn range(at: [f64; 3], along: [f64; 3]) -> Option<f64> {
    let wall = |k: usize| (ROOM[usize::from(along[k] > 0.0)][k] - at[k]) / along[k];
    let room = (0..3).map(wall).fold(f64::INFINITY, f64::min);
    let hit: Vec<f64> = (0..3).map(|k| at[k] + room * along[k]).collect();
    if hit[0] > 19.99 && (2.0..6.0).contains(&hit[1]) {
        return None;
    }
    let (mut near, mut far) = (0.0f64, f64::INFINITY);
    for k in 0..3 {
        let [a, b] = [0, 1].map(|side: usize| (BOX[side][k] - at[k]) / along[k]);
        (near, far) = (near.max(a.min(b)), far.min(a.max(b)));
    }
    Some(if near < far { room.min(near) } else { room })
}

/// Where the sensor is in a frame: x, y, z (m) and yaw (rad), on a bend to the left.
pub fn place(frame: usize, step_m: f64, turn_rad: f64) -> ([f64; 3], f64) {
    let (mut at, mut yaw) = ([0.0, 0.0, 1.7], 0.0f64);
    for _ in 0..frame {
        at[0] += step_m * yaw.cos();
        at[1] += step_m * yaw.sin();
        yaw += turn_rad;
    }
    (at, yaw)
}

/// Writes a recording of the room by 24 rows of 400 shots: `velodyne`, `poses.txt` and `labels.csv` with the box. The
/// sensor drives `step_m` a frame and turns by `turn_rad`.
pub fn write_recording(root: &Path, frames: usize, step_m: f64, turn_rad: f64) {
    std::fs::create_dir_all(root.join("velodyne")).unwrap();
    let (mut poses, mut labels) = (String::new(), String::from("frame,track,class,cx,cy,cz,l,w,h,yaw\n"));
    for frame in 0..frames {
        let (at, yaw) = place(frame, step_m, turn_rad);
        let (sin, cos) = yaw.sin_cos();
        let mut bytes = Vec::new();
        for row in 0..24 {
            for column in 0..400 {
                let (azimuth, elevation) =
                    ((f64::from(column) + 0.5) * 0.9_f64.to_radians(), (8.3 - f64::from(row)).to_radians());
                let local = direction(azimuth, elevation);
                let along = [cos * local[0] - sin * local[1], sin * local[0] + cos * local[1], local[2]];
                let Some(range) = range(at, along) else { continue };
                for v in [local[0] * range, local[1] * range, local[2] * range, 0.5] {
                    bytes.extend((v as f32).to_le_bytes());
                }
            }
        }
        std::fs::write(root.join(format!("velodyne/{frame:06}.bin")), bytes).unwrap();
        let [x, y, z] = at;
        writeln!(poses, "{cos} {} 0 {x} {sin} {cos} 0 {y} 0 0 1 {z}", -sin).unwrap();
        let (dx, dy) = (10.0 - x, 4.0 - y);
        let (cx, cy) = (cos * dx + sin * dy, cos * dy - sin * dx);
        writeln!(labels, "{frame},7,Car,{cx},{cy},{},4.0,2.0,1.5,{}", 0.75 - z, -yaw).unwrap();
    }
    std::fs::write(root.join("poses.txt"), poses).unwrap();
    std::fs::write(root.join("labels.csv"), labels).unwrap();
}
