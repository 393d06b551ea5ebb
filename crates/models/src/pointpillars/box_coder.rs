//! Encoding of boxes as residuals of anchors, and of headings as residual and direction bin (OpenPCDet:
//! `ResidualCoder`).
//!
//! All in f32, in the reference's order of operations. Boxes are `[x, y, z, dx, dy, dz, yaw]`, m and rad.

use std::f32::consts::TAU;

/// Sizes are clamped to at least this, m.
const SMALLEST_SIZE_M: f32 = 1e-5;

/// Start of the first direction bin of the reference, rad: pi / 4, rounded as in its configuration.
#[expect(clippy::approx_constant, reason = "rounded as in the reference")]
pub const DIRECTION_OFFSET_RAD: f32 = 0.78539;

/// Number of direction bins of the targets.
pub const DIRECTION_BINS: usize = 2;

/// `value` shifted by whole periods into `[-offset * period, (1 - offset) * period)`, up to rounding.
pub fn limit_period(value: f32, offset: f32, period: f32) -> f32 {
    value - (value / period + offset).floor() * period
}

/// The residuals of `bbox` at `anchor`: centre offsets divided by the anchor's base diagonal and height, logarithms of
/// the size ratios, difference of the headings.
pub fn encode(bbox: [f32; 7], anchor: [f32; 7]) -> [f32; 7] {
    let [x, y, z, dx, dy, dz, yaw] = with_least_size(bbox);
    let [xa, ya, za, dxa, dya, dza, yaw_a] = with_least_size(anchor);
    let diagonal = (dxa * dxa + dya * dya).sqrt();
    [
        (x - xa) / diagonal,
        (y - ya) / diagonal,
        (z - za) / dza,
        (dx / dxa).ln(),
        (dy / dya).ln(),
        (dz / dza).ln(),
        yaw - yaw_a,
    ]
}

/// The box of a residual at `anchor`; the inverse of [`encode`].
pub fn decode(residual: [f32; 7], anchor: [f32; 7]) -> [f32; 7] {
    let [xt, yt, zt, dxt, dyt, dzt, yaw_t] = residual;
    let [xa, ya, za, dxa, dya, dza, yaw_a] = anchor;
    let diagonal = (dxa * dxa + dya * dya).sqrt();
    [
        xt * diagonal + xa,
        yt * diagonal + ya,
        zt * dza + za,
        dxt.exp() * dxa,
        dyt.exp() * dya,
        dzt.exp() * dza,
        yaw_t + yaw_a,
    ]
}

/// The direction bin of a heading. Bins have equal width, and the first begins at `offset_rad`.
pub fn direction_target(yaw_rad: f32, offset_rad: f32, bins: usize) -> usize {
    let turned = limit_period(yaw_rad - offset_rad, 0.0, TAU);
    let bin = (turned / (TAU / bins as f32)).floor();
    (bin.max(0.0) as usize).min(bins - 1)
}

/// The heading from `yaw_rad`, which defines the position within a bin, and the bin `bin`.
pub fn direction_decode(yaw_rad: f32, bin: usize, offset_rad: f32, limit_offset: f32, bins: usize) -> f32 {
    let period = TAU / bins as f32;
    limit_period(yaw_rad - offset_rad, limit_offset, period) + offset_rad + period * bin as f32
}

fn with_least_size(mut bbox: [f32; 7]) -> [f32; 7] {
    bbox[3..6].iter_mut().for_each(|size| *size = size.max(SMALLEST_SIZE_M));
    bbox
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn decode_inverts_encode(
            center in prop::array::uniform3(-50.0f32..50.0),
            size in prop::array::uniform3(0.3f32..6.0),
            yaw in -3.1f32..3.1,
            anchor_center in prop::array::uniform3(-50.0f32..50.0),
        ) {
            let bbox = [center[0], center[1], center[2], size[0], size[1], size[2], yaw];
            let anchor = [anchor_center[0], anchor_center[1], anchor_center[2], 3.9, 1.6, 1.56, 1.57];
            let back = decode(encode(bbox, anchor), anchor);
            prop_assert!((0..7).all(|i| (back[i] - bbox[i]).abs() < 1e-4), "{:?} {:?}", back, bbox);
        }

        /// The heading modulo 2 pi follows from the heading modulo pi and the bin.
        #[test]
        fn a_heading_survives_its_bin(yaw in -3.1f32..3.1, half_turns in -2i32..3) {
            let bin = direction_target(yaw, DIRECTION_OFFSET_RAD, DIRECTION_BINS);
            let folded = yaw + half_turns as f32 * std::f32::consts::PI;
            let back = direction_decode(folded, bin, DIRECTION_OFFSET_RAD, 0.0, DIRECTION_BINS);
            let difference = limit_period(back - yaw, 0.5, TAU).abs();
            // At a bin border, rounding may add pi.
            let border = limit_period(yaw - DIRECTION_OFFSET_RAD, 0.5, std::f32::consts::PI).abs();
            prop_assert!(difference < 1e-4 || border < 1e-4, "{} {}", back, yaw);
        }
    }

    #[test]
    fn bins_of_the_reference() {
        let bins: Vec<usize> =
            [0.0, 0.8, 3.0, 3.93, -3.0, -1.0].iter().map(|&y| direction_target(y, DIRECTION_OFFSET_RAD, 2)).collect();
        assert_eq!(bins, [1, 0, 0, 1, 0, 1]);
    }

    #[test]
    fn no_size_is_zero() {
        let anchor = [0.0, 0.0, 0.0, 3.9, 1.6, 1.56, 0.0];
        assert!(encode([0.0; 7], anchor).iter().all(|v| v.is_finite()));
    }
}
