//! Size and place of the racing car, the Dallara AV-21, in its own frame.
//!
//! The car's frame is also that of its clouds: origin at the middle of the rear axle, 0.198 m above the ground (the
//! frame of the published sensor mounts), x forward, y left, z up, m.

use geometry::Box3;

/// Length, width, height, m (Huch et al. 2023, section III-C).
pub const CAR_SIZE_M: [f64; 3] = [4.88, 1.90, 1.18];
/// Height of the car's frame above the ground, m (RACECAR's description of the car, `av21.urdf`).
pub const ORIGIN_ABOVE_GROUND_M: f64 = 0.198;
/// The rearmost point, at the rear wing, m.
pub const REAR_M: f64 = -0.84;

/// The car's box in its own frame, upright.
pub fn car_box() -> Box3 {
    let [length, _, height] = CAR_SIZE_M;
    Box3 { center: [REAR_M + length / 2.0, 0.0, height / 2.0 - ORIGIN_ABOVE_GROUND_M], size: CAR_SIZE_M, yaw_rad: 0.0 }
}
