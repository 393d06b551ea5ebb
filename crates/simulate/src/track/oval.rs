//! The default track: an oval modelled on the Las Vegas Motor Speedway from published figures.
//!
//! - A lap of 2,454 m, 12.5 to 15.5 m wide, banking of 6 to 20 degrees: figures of the Indy Autonomous Challenge.
//! - D-shaped, left turns of 20 degrees, a front stretch of 9 degrees with a bend in its middle: descriptions of
//!   iRacing and the circuit.
//! - Front stretch 2,275 ft (693 m), back stretch 1,572 ft (479 m): the circuit's fact sheets. Their lap is 1.5 miles
//!   (2,414 m) along the lower line; here all lengths are scaled to the lap above.
//!
//! The positions of the transitions and the change of width are not published and are plausible guesses.

use super::centre_line::{CentreLine, CentrePoint};
use std::f64::consts::PI;

/// Length of a lap along the centre line, m.
const LAP_M: f64 = 2454.0;
/// Minimum and maximum width, m.
const WIDTH_M: [f64; 2] = [12.5, 15.5];
const BACK_BANK_DEG: f64 = 6.0;
const FRONT_BANK_DEG: f64 = 9.0;
const TURN_BANK_DEG: f64 = 20.0;
/// Before scaling to the lap length, m.
const BACK_STRETCH_M: f64 = 479.0;
const TURN_RADIUS_M: f64 = 190.0;
const BEND_RADIUS_M: f64 = 500.0;
/// Half the angle of the bend in the front stretch, rad.
const HALF_BEND_RAD: f64 = 0.22;
/// Length over which curvature and banking change between straight and turn, m.
const TRANSITION_M: f64 = 90.0;
/// Spacing of the table, m.
const STEP_M: f64 = 4.0;

/// A part of the half lap: length, and curvature (1/m) and banking (degrees) at both ends, with linear interpolation
/// between.
#[derive(Clone, Copy)]
struct Part {
    length_m: f64,
    curvature: [f64; 2],
    bank_deg: [f64; 2],
}

/// From the middle of the front stretch to the middle of the back stretch; `straight_m` is the length of the straight
/// half of the front stretch.
fn half_lap(straight_m: f64) -> [Part; 6] {
    let (turn, bend) = (1.0 / TURN_RADIUS_M, 1.0 / BEND_RADIUS_M);
    // A transition turns by half as much as an arc of its length.
    let arc_m = (PI - HALF_BEND_RAD) * TURN_RADIUS_M - TRANSITION_M;
    let part = |length_m, curvature, bank_deg| Part { length_m, curvature, bank_deg };
    [
        part(HALF_BEND_RAD / bend - 20.0, [bend; 2], [FRONT_BANK_DEG + 1.0; 2]),
        part(40.0, [bend, 0.0], [FRONT_BANK_DEG + 1.0, FRONT_BANK_DEG]),
        part(straight_m, [0.0; 2], [FRONT_BANK_DEG; 2]),
        part(TRANSITION_M, [0.0, turn], [FRONT_BANK_DEG, TURN_BANK_DEG]),
        part(arc_m, [turn; 2], [TURN_BANK_DEG; 2]),
        part(TRANSITION_M, [turn, 0.0], [TURN_BANK_DEG, BACK_BANK_DEG]),
    ]
}

/// Position, heading and banking after `way_m` of the half lap; straight beyond its end.
fn trace(parts: &[Part], way_m: f64) -> ([f64; 2], f64) {
    let (mut left, mut position, mut heading) = (way_m, [0.0; 2], 0.0_f64);
    let mut go = |length_m: f64, curvature: [f64; 2], whole_m: f64| {
        let steps = (length_m / 0.25).ceil().max(1.0);
        let h = length_m / steps;
        for i in 0..steps as usize {
            let middle = (i as f64 + 0.5) * h / whole_m;
            let k = curvature[0] + middle * (curvature[1] - curvature[0]);
            let mid_heading = heading + k * h / 2.0;
            position[0] += h * mid_heading.cos();
            position[1] += h * mid_heading.sin();
            heading += k * h;
        }
    };
    for part in parts {
        let length = part.length_m.min(left);
        if length > 0.0 {
            go(length, part.curvature, part.length_m);
        }
        left -= length;
    }
    if left > 0.0 {
        go(left, [0.0; 2], left);
    }
    (position, heading)
}

fn bank_deg(parts: &[Part], way_m: f64) -> f64 {
    let mut left = way_m;
    for part in parts {
        if left <= part.length_m {
            let t = left / part.length_m;
            let smooth = t * t * (3.0 - 2.0 * t);
            return part.bank_deg[0] + smooth * (part.bank_deg[1] - part.bank_deg[0]);
        }
        left -= part.length_m;
    }
    BACK_BANK_DEG
}

/// The track, driven counter-clockwise from the middle of its front stretch, which is in the south and runs east.
pub fn las_vegas() -> CentreLine {
    // With the correct straight length the half lap ends exactly above its start; the overshoot is linear in that
    // length.
    let end = |straight_m: f64| {
        let parts = half_lap(straight_m);
        let way = parts.iter().map(|p| p.length_m).sum::<f64>() + BACK_STRETCH_M / 2.0;
        trace(&parts, way).0[0]
    };
    let (at0, at100) = (end(0.0), end(100.0));
    let straight_m = -at0 / (at100 - at0) * 100.0;
    let parts = half_lap(straight_m);
    let half_m = parts.iter().map(|p| p.length_m).sum::<f64>() + BACK_STRETCH_M / 2.0;
    let scale = LAP_M / (2.0 * half_m);
    let height_m = trace(&parts, half_m).0[1];

    let n = (LAP_M / STEP_M).round() as usize / 2 * 2;
    let point = |i: usize| {
        let way = 2.0 * half_m * i as f64 / n as f64;
        let (way, mirrored) = if way <= half_m { (way, false) } else { (2.0 * half_m - way, true) };
        let ([x, y], _) = trace(&parts, way);
        let bank_deg = bank_deg(&parts, way);
        let steep = (bank_deg - BACK_BANK_DEG) / (TURN_BANK_DEG - BACK_BANK_DEG);
        let half_width_m = (WIDTH_M[0] + (WIDTH_M[1] - WIDTH_M[0]) * steep) / 2.0;
        let x = if mirrored { -x } else { x };
        CentrePoint {
            x_m: x * scale,
            y_m: (y - height_m / 2.0) * scale,
            z_m: half_width_m * bank_deg.to_radians().tan(),
            bank_deg,
            width_left_m: half_width_m,
            width_right_m: half_width_m,
        }
    };
    CentreLine::from_points((0..n).map(point).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_is_as_published() {
        let line = las_vegas();
        assert!((line.length_m() - LAP_M).abs() < 2.0, "{}", line.length_m());
        assert!(line.turns_left());
        let of = |f: fn(&CentrePoint) -> f64| {
            line.points().iter().map(f).fold([f64::MAX, f64::MIN], |[l, h], v| [l.min(v), h.max(v)])
        };
        let bank = of(|p| p.bank_deg);
        assert!((bank[0] - 6.0).abs() < 1e-9 && (bank[1] - 20.0).abs() < 1e-9, "{bank:?}");
        let width = of(|p| p.width_left_m + p.width_right_m);
        assert!((width[0] - 12.5).abs() < 1e-9 && (width[1] - 15.5).abs() < 1e-9);
    }

    #[test]
    fn it_closes_smoothly() {
        let line = las_vegas();
        let n = 2000;
        let headings: Vec<f64> =
            (0..=n).map(|i| line.at(line.length_m() * f64::from(i) / f64::from(n)).heading_rad).collect();
        let step = line.length_m() / f64::from(n);
        for pair in headings.windows(2) {
            let turned = geometry::limit_period(pair[1] - pair[0], 0.5, 2.0 * PI);
            assert!((-1e-4..1.3 * step / 190.0).contains(&turned), "{turned}");
        }
        let station = line.at(0.0);
        assert!(station.heading_rad.abs() < 1e-3 && station.position[1] < -150.0, "{station:?}");
    }

    #[test]
    fn its_table_is_up_to_date() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/tracks/las_vegas.csv");
        let text = std::fs::read_to_string(path).unwrap();
        assert!(text == las_vegas().to_csv(), "{path} is stale: write `las_vegas().to_csv()` into it");
    }
}
