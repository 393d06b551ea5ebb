//! Dimensions of the racing car, the Dallara AV-21.
//!
//! Coordinates are in the car frame, which is also the frame of its clouds: origin at the centre of the rear axle,
//! 0.198 m above the ground (the frame of the published sensor mounts), x forward, y left, z up, m.

use geometry::Box3;

/// Length, width, height, m (Huch et al. 2023, section III-C).
pub const CAR_SIZE_M: [f64; 3] = [4.88, 1.90, 1.18];
/// Height of the car frame's origin above the ground, m (the car's description in RACECAR, `av21.urdf`).
pub const ORIGIN_ABOVE_GROUND_M: f64 = 0.198;
/// Minimum x of the car, at the rear wing, m.
pub const REAR_M: f64 = -0.84;

/// Box of the car in its own frame, yaw 0.
pub fn car_box() -> Box3 {
    let [length, _, height] = CAR_SIZE_M;
    Box3 { center: [REAR_M + length / 2.0, 0.0, height / 2.0 - ORIGIN_ABOVE_GROUND_M], size: CAR_SIZE_M, yaw_rad: 0.0 }
}
