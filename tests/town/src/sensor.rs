//! Sensors: mounts, scan patterns, shots, and the rig file.

use data::Stream;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use rand::RngExt;
use std::f64::consts::TAU;
use std::fmt::Write;

/// Scan pattern of a sensor.
#[derive(Clone, Debug, PartialEq)]
pub enum Pattern {
    /// Rows that turn clockwise.
    Rows {
        /// Elevations from the top, rad.
        rows_rad: Vec<f64>,
        /// Offset of each row along the azimuth, in steps between columns.
        stagger: Vec<f64>,
        /// Shots per row.
        columns: usize,
    },
    /// A rosette of two turning prisms that never repeats.
    Rosette {
        /// Deflection of each prism, rad.
        prisms_rad: [f64; 2],
        /// Turns of each prism in a scan.
        turns: [f64; 2],
        /// Shots per scan.
        shots: usize,
    },
}

/// A sensor.
#[derive(Clone, Debug, PartialEq)]
pub struct Mount {
    /// Name in the rig file.
    pub name: &'static str,
    /// Position in the vehicle frame, m.
    pub position_m: [f64; 3],
    /// Heading of its x axis in the vehicle frame, rad.
    pub yaw_rad: f64,
    /// Horizontal field of view, rad.
    pub fov_rad: f64,
    /// Scan pattern.
    pub pattern: Pattern,
}

/// A shot of a scan, in the sensor's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Number of the sensor.
    pub sensor: usize,
    /// Row from the top; 0 for a rosette.
    pub row: usize,
    /// Column from the left, or the number of the shot.
    pub column: usize,
    /// Counter-clockwise from the sensor's x axis, rad.
    pub azimuth_rad: f64,
    /// Up from the sensor's horizontal plane, rad.
    pub elevation_rad: f64,
    /// Time in the scan as a fraction: -1/2 at its begin, 1/2 at its end.
    pub phase: f64,
}

/// Known unsteadiness of the shots of a side: share of the steps between columns and rows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Dither {
    /// Random, along columns and rows.
    pub random: [f64; 2],
    /// Amplitude of a wobble of the azimuth.
    pub wobble: f64,
}

/// Unit vector of an azimuth and an elevation.
pub fn direction(azimuth_rad: f64, elevation_rad: f64) -> Vector3<f64> {
    let ((sa, ca), (se, ce)) = (azimuth_rad.sin_cos(), elevation_rad.sin_cos());
    Vector3::new(ca * ce, sa * ce, se)
}

impl Mount {
    /// `vehicle_from_sensor`.
    pub fn pose(&self) -> Isometry3<f64> {
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), self.yaw_rad);
        Isometry3::from_parts(Translation3::from(self.position_m), turn)
    }

    /// Number of rows; 1 for a rosette.
    pub fn rows(&self) -> usize {
        match &self.pattern {
            Pattern::Rows { rows_rad, .. } => rows_rad.len(),
            Pattern::Rosette { .. } => 1,
        }
    }

    /// Number of columns, or of shots of a rosette.
    pub fn columns(&self) -> usize {
        match &self.pattern {
            Pattern::Rows { columns, .. } => *columns,
            Pattern::Rosette { shots, .. } => *shots,
        }
    }

    /// Lowest and highest elevation, rad.
    pub fn elevations_rad(&self) -> [f64; 2] {
        match &self.pattern {
            Pattern::Rows { rows_rad, .. } => [rows_rad[rows_rad.len() - 1], rows_rad[0]],
            Pattern::Rosette { prisms_rad: [a, b], .. } => [-(a + b), a + b],
        }
    }

    /// The shots of a frame. Their order and phase differ from frame to frame.
    pub fn shots(&self, sensor: usize, dither: &Dither, rng: &mut Stream) -> Vec<Shot> {
        let begin: [f64; 3] = [rng.random(), rng.random(), rng.random()];
        match &self.pattern {
            Pattern::Rows { rows_rad, stagger, columns } => {
                let step = self.fov_rad / *columns as f64;
                let full = self.fov_rad > 0.98 * TAU;
                let mut shots = Vec::with_capacity(rows_rad.len() * columns);
                for column in 0..*columns {
                    let wobble = dither.wobble * (TAU * (column as f64 / 37.0 + begin[1])).sin();
                    for (row, elevation) in rows_rad.iter().enumerate() {
                        let low = row.saturating_sub(1);
                        let high = (row + 1).min(rows_rad.len() - 1);
                        let row_step = (rows_rad[low] - rows_rad[high]) / (high - low) as f64;
                        let noise = [(); 2].map(|()| rng.random_range(-1.0..1.0));
                        let mut at = column as f64 + begin[0] + stagger[row] + wobble + dither.random[0] * noise[0];
                        if full {
                            at = at.rem_euclid(*columns as f64);
                        }
                        let azimuth_rad = self.fov_rad / 2.0 - at * step;
                        shots.push(Shot {
                            sensor,
                            row,
                            column,
                            azimuth_rad,
                            elevation_rad: elevation + dither.random[1] * noise[1] * row_step,
                            phase: -azimuth_rad / self.fov_rad,
                        });
                    }
                }
                shots
            }
            Pattern::Rosette { prisms_rad, turns, shots } => (0..*shots)
                .map(|column| {
                    let u = (column as f64 + begin[2]) / *shots as f64;
                    let [a, b] = [0, 1].map(|k| TAU * (turns[k] * u + begin[k]));
                    Shot {
                        sensor,
                        row: 0,
                        column,
                        azimuth_rad: prisms_rad[0] * a.cos() + prisms_rad[1] * b.cos(),
                        elevation_rad: prisms_rad[0] * a.sin() + prisms_rad[1] * b.sin(),
                        phase: u - 0.5,
                    }
                })
                .collect(),
        }
    }
}

/// Arrangement of the sensors of a vehicle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Layout {
    /// One sensor on the roof with this number of rows.
    Roof(usize),
    /// One rosette behind the windscreen.
    Rosette,
    /// Two sensors on the roof for the back and the sides, one in the grille for the front.
    RoofAndGrille,
}

impl Layout {
    /// Name in tables.
    pub fn name(self) -> String {
        match self {
            Layout::Roof(rows) => format!("roof {rows} rows"),
            Layout::Rosette => "rosette".into(),
            Layout::RoofAndGrille => "roof and grille".into(),
        }
    }
}

/// Elevations of rows from the top, rad: even, or denser towards the horizon.
fn rows_rad(rng: &mut Stream, rows: usize, top_deg: f64, bottom_deg: f64) -> Vec<f64> {
    let dense = rng.random_bool(0.5);
    let at = |i: usize| {
        let u = i as f64 / (rows - 1) as f64;
        if !dense {
            return top_deg + (bottom_deg - top_deg) * u;
        }
        // A cubic whose slope is a third at the horizon.
        let horizon = (top_deg - 1.0) / (top_deg - bottom_deg);
        let cubic = |u: f64| (u - horizon) / 3.0 + (u - horizon).powi(3) * 2.0;
        top_deg + (bottom_deg - top_deg) * (cubic(u) - cubic(0.0)) / (cubic(1.0) - cubic(0.0))
    };
    (0..rows).map(|i| at(i).to_radians()).collect()
}

/// Draws the sensors of a layout with about `shots` shots per scan, twice as many for 128 rows. `pattern_known` says
/// that the rig file will state the pattern: rows are not staggered then. Also draws the height of the vehicle frame
/// above the ground, m.
pub fn draw_mounts(rng: &mut Stream, layout: Layout, shots: usize, pattern_known: bool) -> (Vec<Mount>, f64) {
    // The clouds of a single sensor are in its own frame, as KITTI's are, or in that of the vehicle.
    let own_frame = rng.random_bool(0.5);
    let mut mount = |name, position_m, yaw_deg: f64, fov_deg: f64, rows: usize, span: [f64; 2], share: f64| {
        let columns = (shots as f64 * share / rows as f64).round() as usize;
        let staggered = !pattern_known && rng.random_bool(0.4);
        let stagger = (0..rows).map(|_| if staggered { rng.random_range(-0.5..0.5) } else { 0.0 }).collect();
        let pattern = Pattern::Rows { rows_rad: rows_rad(rng, rows, span[0], span[1]), stagger, columns };
        Mount { name, position_m, yaw_rad: yaw_deg.to_radians(), fov_rad: fov_deg.to_radians(), pattern }
    };
    match layout {
        Layout::Roof(rows) => {
            let span = if rows == 16 { [15.0, -15.0] } else { [12.0, -23.0] };
            let share = if rows >= 128 { 2.0 } else { 1.0 };
            let position = if own_frame { [0.0; 3] } else { [0.9, 0.0, 1.85] };
            let mount = mount("roof", position, 0.0, 360.0, rows, span, share);
            (vec![mount], if own_frame { 1.85 } else { 0.0 })
        }
        Layout::Rosette => {
            let prisms_rad = [18.6f64, 16.4].map(f64::to_radians);
            let position_m = [1.4, 0.0, 1.35];
            let turns = [61.3 + rng.random_range(0.0..0.5), -38.7 - rng.random_range(0.0..0.5)];
            let pattern = Pattern::Rosette { prisms_rad, turns, shots };
            (vec![Mount { name: "screen", position_m, yaw_rad: 0.0, fov_rad: 70f64.to_radians(), pattern }], 0.2)
        }
        Layout::RoofAndGrille => {
            let low = mount("grille", [3.6, 0.0, 0.35], 0.0, 120.0, 24, [8.0, -10.0], 0.34);
            let left = mount("roof_left", [1.1, 0.55, 1.6], 120.0, 120.0, 24, [8.0, -22.0], 0.33);
            let right = mount("roof_right", [1.1, -0.55, 1.6], -120.0, 120.0, 24, [8.0, -22.0], 0.33);
            (vec![low, left, right], 0.25)
        }
    }
}

/// The rig file a user would write.
pub fn rig_toml(mounts: &[Mount], rate_hz: f64, with_pattern: bool) -> String {
    let mut text = String::new();
    for m in mounts {
        let _ = writeln!(
            text,
            "[[sensor]]\nname = \"{}\"\nposition = {:?}\nyaw_deg = {:?}\nhorizontal_fov_deg = {:?}\nrate_hz = {rate_hz:?}\n",
            m.name,
            m.position_m,
            micro_deg(m.yaw_rad),
            micro_deg(m.fov_rad),
        );
        if let (Pattern::Rows { rows_rad, columns, .. }, true) = (&m.pattern, with_pattern) {
            let block = |row: &f64| format!("{{ rows = 1, top_deg = {0:?}, bottom_deg = {0:?} }}", micro_deg(*row));
            let blocks: Vec<String> = rows_rad.iter().map(block).collect();
            let _ = writeln!(
                text,
                "[sensor.pattern]\nblocks = [{}]\ncolumns = {columns}\nsweep = \"columns\"\n",
                blocks.join(", ")
            );
        }
    }
    text
}

/// Degrees, rounded to a millionth.
fn micro_deg(rad: f64) -> f64 {
    (rad.to_degrees() * 1e6).round() / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    const CALM: Dither = Dither { random: [0.0; 2], wobble: 0.0 };

    #[test]
    fn patterns_have_their_shots_inside_of_the_field_of_view() {
        for (layout, sensors) in [
            (Layout::Roof(16), 1),
            (Layout::Roof(32), 1),
            (Layout::Roof(64), 1),
            (Layout::Roof(128), 1),
            (Layout::Rosette, 1),
            (Layout::RoofAndGrille, 3),
        ] {
            let mut rng = data::stream(4, "mounts", 0, 0);
            let (mounts, _) = draw_mounts(&mut rng, layout, 24_000, false);
            assert_eq!(mounts.len(), sensors);
            let mut all = 0;
            for (k, mount) in mounts.iter().enumerate() {
                let shots = mount.shots(k, &CALM, &mut rng);
                all += shots.len();
                let [low, high] = mount.elevations_rad();
                for shot in &shots {
                    assert!(shot.azimuth_rad.abs() < mount.fov_rad / 2.0 * 1.06 && shot.phase.abs() < 0.53);
                    assert!(shot.elevation_rad > low - 1e-9 && shot.elevation_rad < high + 1e-9);
                }
            }
            let factor = if layout == Layout::Roof(128) { 2.0 } else { 1.0 };
            assert!((all as f64 / (24_000.0 * factor) - 1.0).abs() < 0.04, "{}: {all}", layout.name());
        }
    }

    #[test]
    fn rows_turn_clockwise_and_a_rosette_does_not_repeat() {
        let mut rng = data::stream(5, "mounts", 0, 0);
        let (rows, _) = draw_mounts(&mut rng, Layout::Roof(32), 20_000, true);
        let shots = rows[0].shots(0, &CALM, &mut rng);
        let early: Vec<&Shot> = shots.iter().filter(|s| s.phase < -0.4).collect();
        assert!(early.iter().all(|s| s.azimuth_rad > 2.4));
        let (rosette, _) = draw_mounts(&mut rng, Layout::Rosette, 20_000, false);
        let [a, b] = [(); 2].map(|()| rosette[0].shots(0, &CALM, &mut rng));
        assert!(a.iter().zip(&b).all(|(a, b)| a.azimuth_rad != b.azimuth_rad));
    }

    #[test]
    fn rig_files_can_be_read() {
        let mut rng = data::stream(6, "mounts", 0, 0);
        for layout in [Layout::Roof(64), Layout::Rosette, Layout::RoofAndGrille] {
            for known in [true, false] {
                let (mounts, _) = draw_mounts(&mut rng, layout, 20_000, known);
                let text = rig_toml(&mounts, 10.0, known);
                let rig = sensor::Rig::parse(&text, std::path::Path::new("sensor.toml")).unwrap();
                assert_eq!((rig.sensors.len(), rig.sensors[0].rate_hz), (mounts.len(), 10.0));
                let rows = matches!(mounts[0].pattern, Pattern::Rows { .. });
                assert_eq!(rig.sensors[0].pattern.is_some(), known && rows);
            }
        }
    }
}
