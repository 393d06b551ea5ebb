//! The grandstand along the front stretch.

use super::Track;
use super::surface::across_at;
use crate::mesh::{Mesh, grid};
use sensor::material::MaterialTable;

/// Distance from the outer edge of the surface to the first row, m.
const DISTANCE_M: f64 = 16.0;
const ROWS: u32 = 40;
/// Depth and rise of a row, m.
const STEP_M: [f64; 2] = [0.85, 0.48];
/// Height of the first row above the edge of the track, m.
const FIRST_M: f64 = 1.8;
/// Half length along the track, m.
const HALF_LENGTH_M: f64 = 290.0;

/// Rows of seats facing the track, and a wall behind.
pub(super) fn grandstand(track: &Track) -> Mesh {
    let sections = 72;
    let rows: Vec<Vec<[f64; 3]>> = (0..=sections)
        .map(|i| {
            let way = HALF_LENGTH_M * (2.0 * f64::from(i) / f64::from(sections) - 1.0);
            across_at(track, way, |station| {
                let edge = station.position[2] + station.width_right_m * station.bank_rad.tan();
                let front = -station.width_right_m - DISTANCE_M;
                let mut profile = vec![(front, -1.0)];
                for row in 0..ROWS {
                    let (left, z) = (front - f64::from(row) * STEP_M[0], edge + FIRST_M + f64::from(row) * STEP_M[1]);
                    profile.extend([(left, z), (left - STEP_M[0], z)]);
                }
                let top = edge + FIRST_M + f64::from(ROWS) * STEP_M[1];
                let back = front - f64::from(ROWS) * STEP_M[0];
                profile.extend([(back, top + 3.0), (back - 0.5, top + 3.0), (back - 0.5, -1.0)]);
                profile
            })
        })
        .collect();
    grid(&rows, MaterialTable::built_in("seats"))
}
