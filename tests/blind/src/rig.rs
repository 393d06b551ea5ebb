//! Rigs: one to four sensors with rows and columns.

use data::Stream;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use std::fmt::Write;

/// One sensor of a rig.
#[derive(Clone, Debug)]
pub struct Mount {
    /// Position in the vehicle frame, m.
    pub position_m: [f64; 3],
    /// Direction of the centre of the field of view, rad.
    pub yaw_rad: f64,
    /// Horizontal field of view, rad.
    pub fov_rad: f64,
    /// Elevations of the rows, from the top, rad.
    pub rows_rad: Vec<f64>,
    /// Shots per row.
    pub columns: usize,
}

impl Mount {
    /// `car_from_sensor`.
    pub fn pose(&self) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw_rad);
        Isometry3::from_parts(Translation3::from(self.position_m), turn)
    }

    /// Azimuth step between columns, rad.
    pub fn column_step_rad(&self) -> f64 {
        self.fov_rad / self.columns as f64
    }

    /// Mean elevation step between rows, rad.
    pub fn row_step_rad(&self) -> f64 {
        (self.rows_rad[0] - self.rows_rad[self.rows_rad.len() - 1]) / (self.rows_rad.len() - 1) as f64
    }
}

/// Draws a rig with about `shots` shots per scan, and the height of the vehicle origin above the road, m. `sensors`
/// fixes their number (1 to 4).
pub fn draw_rig(rng: &mut Stream, shots: usize, sensors: Option<usize>) -> (Vec<Mount>, f64) {
    let drawn = rng.random_range(0..4);
    let kind = match sensors {
        None => drawn,
        Some(1) => 1,
        Some(2) => 3,
        Some(3) => 0,
        Some(_) => 2,
    };
    let rows = if shots > 12_000 { rng.random_range(28..44) } else { rng.random_range(20..26) };
    let (top, bottom) = (rng.random_range(3.0..7.0f64).to_radians(), rng.random_range(-20.0..-14.0f64).to_radians());
    let uneven = rng.random_bool(0.3);
    let rows_of = |rows: usize| -> Vec<f64> {
        let at = |i: usize| {
            let u = i as f64 / (rows - 1) as f64;
            top + (bottom - top) * if uneven { 0.5 * u + 0.5 * u * u } else { u }
        };
        (0..rows).map(at).collect()
    };
    let mount = |position_m: [f64; 3], yaw: f64, fov: f64, share: f64| {
        let columns = (shots as f64 * share / rows as f64).round() as usize;
        Mount { position_m, yaw_rad: yaw.to_radians(), fov_rad: fov.to_radians(), rows_rad: rows_of(rows), columns }
    };
    match kind {
        0 => {
            let (x, z) = (rng.random_range(2.1..2.6), rng.random_range(0.35..0.55));
            let side = |yaw: f64, y: f64| mount([x - 0.8, y, z + 0.1], yaw, 120.0, 1.0 / 3.0);
            (vec![mount([x, 0.0, z], 0.0, 120.0, 1.0 / 3.0), side(120.0, 0.27), side(-120.0, -0.27)], 0.2)
        }
        1 => {
            let z = rng.random_range(1.4..1.9);
            (vec![mount([0.6, 0.0, z], 0.0, 360.0, 1.0)], 0.3)
        }
        2 => {
            let side = |yaw: f64, p: [f64; 3]| mount(p, yaw, 90.0, 0.25);
            let z = rng.random_range(0.5..1.2);
            (
                vec![
                    side(0.0, [2.0, 0.0, z]),
                    side(90.0, [0.8, 0.7, z]),
                    side(180.0, [-1.6, 0.0, z]),
                    side(-90.0, [0.8, -0.7, z]),
                ],
                0.25,
            )
        }
        _ => {
            let z = rng.random_range(0.8..1.5);
            (vec![mount([1.2, 0.3, z], 90.0, 180.0, 0.5), mount([1.2, -0.3, z], -90.0, 180.0, 0.5)], 0.25)
        }
    }
}

/// The rig file a user would write: names, positions, fields of view, and the scan patterns if `with_pattern`.
pub fn rig_toml(mounts: &[Mount], with_pattern: bool) -> String {
    let mut text = String::new();
    for (i, m) in mounts.iter().enumerate() {
        let _ = writeln!(
            text,
            "[[sensor]]\nname = \"s{i}\"\nposition = {:?}\nyaw_deg = {:?}\nhorizontal_fov_deg = {:?}\n",
            m.position_m.map(|v| (v * 1e4).round() / 1e4),
            micro_deg(m.yaw_rad),
            micro_deg(m.fov_rad),
        );
        if with_pattern {
            // A block for each row, because rows may be uneven.
            let block = |row: &f64| format!("{{ rows = 1, top_deg = {0:?}, bottom_deg = {0:?} }}", micro_deg(*row));
            let blocks: Vec<String> = m.rows_rad.iter().map(block).collect();
            let _ = writeln!(
                text,
                "[sensor.pattern]\nblocks = [{}]\ncolumns = {}\nsweep = \"columns\"\n",
                blocks.join(", "),
                m.columns
            );
        }
    }
    text
}

/// Degrees, rounded to a millionth.
fn micro_deg(rad: f64) -> f64 {
    (rad.to_degrees() * 1e6).round() / 1e6
}
