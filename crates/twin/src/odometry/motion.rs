//! Motions as twists: velocity and angular velocity held for a unit of time.

use geometry::Pose;
use nalgebra::{Matrix3, Translation3, UnitQuaternion, Vector3, Vector6};

/// Angle below which series replace the closed forms, rad.
const SMALL_RAD: f64 = 1e-6;

/// The motion that a constant twist makes in a unit of time. The twist has the velocity first (m), then the angular
/// velocity (rad), in the frame of the body.
pub fn exp(twist: &Vector6<f64>) -> Pose {
    let (velocity, omega) = (twist.fixed_rows::<3>(0).into_owned(), twist.fixed_rows::<3>(3).into_owned());
    let rotation = UnitQuaternion::from_scaled_axis(omega);
    Pose::from_parts(Translation3::from(left_jacobian(&omega) * velocity), rotation)
}

/// The twist of a motion of less than half a turn: the inverse of [`exp`].
pub fn log(motion: &Pose) -> Vector6<f64> {
    let omega = motion.rotation.scaled_axis();
    let inverse = left_jacobian(&omega).try_inverse().expect("it is regular below a whole turn");
    let velocity = inverse * motion.translation.vector;
    Vector6::new(velocity.x, velocity.y, velocity.z, omega.x, omega.y, omega.z)
}

fn left_jacobian(omega: &Vector3<f64>) -> Matrix3<f64> {
    let angle = omega.norm();
    let cross = omega.cross_matrix();
    let (first, second) = if angle < SMALL_RAD {
        (0.5, 1.0 / 6.0)
    } else {
        ((1.0 - angle.cos()) / (angle * angle), (angle - angle.sin()) / angle.powi(3))
    };
    Matrix3::identity() + first * cross + second * cross * cross
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn log_is_the_inverse_of_exp(v in prop::array::uniform3(-50.0..50.0), w in prop::array::uniform3(-1.7..1.7)) {
            let twist = Vector6::new(v[0], v[1], v[2], w[0], w[1], w[2]);
            prop_assert!((log(&exp(&twist)) - twist).norm() < 1e-9);
            // Two halves of a motion are the motion.
            let half = exp(&(twist * 0.5));
            let (twice, whole) = (half * half, exp(&twist));
            prop_assert!((twice.translation.vector - whole.translation.vector).norm() < 1e-9);
            prop_assert!(twice.rotation.angle_to(&whole.rotation) < 1e-7);
            let tiny = twist * 1e-8;
            prop_assert!((log(&exp(&tiny)) - tiny).norm() < 1e-14);
        }
    }
}
