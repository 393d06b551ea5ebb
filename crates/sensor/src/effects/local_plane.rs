//! Range in a slightly different direction for clouds without a scene: intersection with the local plane through the
//! point.

use crate::scan::{Echo, dot};

/// Sets the range of the echo to that of its local plane in `true_direction`. The direction of the echo stays the same.
pub(super) fn measure_along(echo: &mut Echo, true_direction: [f32; 3]) {
    let (before, after) = (dot(echo.normal, echo.direction), dot(echo.normal, true_direction));
    // The range stays if there is no normal or if the ray in the true direction is almost parallel to the plane.
    if before < -1e-3 && after < 0.2 * before {
        echo.range_m *= before / after;
    }
}
