//! What a slightly turned ray would have met, where no ray can be cast any more: the plane through the point that was hit.

use crate::scan::{Echo, dot};

/// Measures along `true_direction` instead of the echo's own, and reports the range along its own.
pub(super) fn measure_along(echo: &mut Echo, true_direction: [f32; 3]) {
    let (before, after) = (dot(echo.normal, echo.direction), dot(echo.normal, true_direction));
    // Without a normal, and where the turned ray would graze the plane, the range stays.
    if before < -1e-3 && after < 0.2 * before {
        echo.range_m *= before / after;
    }
}
