//! C3: constant direction errors of each beam (row).

use super::reshoot::reaim;
use super::row_table::{RowTable, Rows, check_rows};
use super::{Draws, FrameContext, Need, SensorEffect};
use crate::beams::{Beams, turned};
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::within;
use geometry::Pose;
use nalgebra::Vector3;
use rand_distr::{Distribution, StandardNormal};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The true directions of all shots of a row differ from the nominal ones by
/// `elevation_deg + elevation_std_deg * N(0, 1)` upwards and `azimuth_std_deg * N(0, 1)` to the left. The random values
/// are drawn once for each row of each sensor. Points are reported in the nominal directions.
///
/// Typical: 0.2 degrees for all rows of KITTI's HDL-64E (corrected by KISS-ICP, CT-ICP and others); 0.01 to 0.05
/// between rows.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BeamAngleError {
    /// Elevation error common to all rows, degrees; positive upwards.
    pub elevation_deg: f64,
    /// Standard deviation of the elevation error between rows, degrees.
    pub elevation_std_deg: f64,
    /// Standard deviation of the azimuth error between rows, degrees.
    pub azimuth_std_deg: f64,
    /// Name of the sensor whose rows `rows_deg` gives; the effect is then of that sensor alone.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub sensor: String,
    /// Elevations of that sensor's rows, ascending, degrees.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub rows_deg: Vec<f64>,
    /// Height of the origin of each row's rays over that of the sensor, m; empty where all rays start there.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub heights_m: Vec<f64>,
    /// Elevation error of each of them, degrees; it is added to `elevation_deg` in place of a random value.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub elevations_deg: Vec<f64>,
}

impl BeamAngleError {
    /// Azimuth error (to the left) and elevation error (upwards) of a row, rad.
    fn of_row(&self, sensor: usize, row: u16, draws: &Draws) -> [f32; 2] {
        let mut random = draws.of_set((sensor as u64) << 16 | u64::from(row));
        let [left, up]: [f64; 2] = [StandardNormal.sample(&mut random), StandardNormal.sample(&mut random)];
        [self.azimuth_std_deg * left, self.elevation_deg + self.elevation_std_deg * up].map(|v| v.to_radians() as f32)
    }
}

impl BeamAngleError {
    fn table(&self) -> RowTable<'_> {
        RowTable {
            sensor: &self.sensor,
            rows_deg: &self.rows_deg,
            heights_m: &self.heights_m,
            name: "elevations_deg",
            most: 5.0,
            values: &self.elevations_deg,
        }
    }

    /// Elevation error of a row of the table, upwards, rad.
    fn up_rad(&self, row: Option<usize>) -> f32 {
        let own = row.and_then(|row| self.elevations_deg.get(row)).copied().unwrap_or(0.0);
        (self.elevation_deg + own).to_radians() as f32
    }
}

impl SensorEffect for BeamAngleError {
    fn check(&self) -> Result<(), KeyError> {
        within("elevation_deg", self.elevation_deg, -5.0, 5.0)?;
        within("elevation_std_deg", self.elevation_std_deg, 0.0, 5.0)?;
        check_rows(&self.table())?;
        within("azimuth_std_deg", self.azimuth_std_deg, 0.0, 5.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.rows_deg.is_empty() { &[Need::Incidence, Need::Row] } else { &[Need::Incidence] })
    }

    fn sensor(&self) -> &str {
        if self.rows_deg.is_empty() { "" } else { &self.sensor }
    }

    fn on_beams(&self, beams: &mut Beams, frame: &FrameContext, draws: &Draws) {
        if *self == BeamAngleError::default() {
            return;
        }
        if !self.rows_deg.is_empty() {
            let number = frame.rig.find(&self.sensor);
            let Some(sensor) = number.and_then(|number| beams.sensors.get_mut(number)) else { return };
            let rows = Rows::new(0, Pose::identity(), &self.table());
            let nominal = sensor.nominal_directions.clone();
            for (direction, nominal) in sensor.true_directions_mut().iter_mut().zip(nominal.iter()) {
                let row = rows.of_direction(Vector3::from(nominal.map(f64::from)), f32::INFINITY);
                *direction = turned(*direction, 0.0, self.up_rad(row));
            }
            return;
        }
        for (number, sensor) in beams.sensors.iter_mut().enumerate() {
            let shots = sensor.shots.clone();
            let mut known = (u16::MAX, [0.0; 2]);
            for (direction, shot) in sensor.true_directions_mut().iter_mut().zip(shots.iter()) {
                if known.0 != shot.row || shot.row == u16::MAX {
                    known = (shot.row, self.of_row(number, shot.row, draws));
                }
                *direction = turned(*direction, known.1[0], known.1[1]);
            }
        }
    }

    fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        if *self == BeamAngleError::default() {
            return;
        }
        if !self.rows_deg.is_empty() {
            let Some(rows) = Rows::of(&self.table(), frame) else { return };
            let up = |row, direction| turned(direction, 0.0, self.up_rad(Some(row)));
            let direction = |echo: &Echo| rows.row(echo).map_or(echo.direction, |row| up(row, echo.direction));
            return reaim(scan, frame, draws, direction);
        }
        let mut known = (u8::MAX, u16::MAX, [0.0; 2]);
        reaim(scan, frame, draws, |echo| {
            if (known.0, known.1) != (echo.sensor, echo.row) {
                known = (echo.sensor, echo.row, self.of_row(echo.sensor.into(), echo.row, draws));
            }
            turned(echo.direction, known.2[0], known.2[1])
        });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;

    #[test]
    fn all_shots_of_a_row_have_the_same_error() {
        let effect = BeamAngleError { elevation_deg: 0.2, elevation_std_deg: 0.05, ..BeamAngleError::default() };
        let turned_in = |frame: u64| {
            let mut beams = Beams::of(&rig());
            with_frame(frame, |frame, draws| effect.on_beams(&mut beams, frame, draws));
            beams
        };
        let beams = turned_in(0);
        assert_eq!(beams.sensors[0].true_directions, turned_in(5).sensors[0].true_directions);
        let sensor = &beams.sensors[0];
        let up = |i: usize| {
            f64::from(sensor.true_directions[i][2].asin() - sensor.nominal_directions[i][2].asin()).to_degrees()
        };
        let rows: Vec<f64> = (0..GRID.0).map(|r| up(r * GRID.1 + 100)).collect();
        for r in 0..GRID.0 {
            assert!((up(r * GRID.1 + 300) - rows[r]).abs() < 1e-3);
        }
        let (mean, std) = moments(&rows);
        assert!((mean - 0.2).abs() < 0.03 && (0.03..0.08).contains(&std), "{mean} {std}");
    }

    #[test]
    fn an_upward_error_lengthens_ranges_to_the_ground() {
        let effect = BeamAngleError { elevation_deg: 0.2, elevation_std_deg: 0.0, ..BeamAngleError::default() };
        let before = scene();
        let mut after = before.clone();
        with_frame(0, |frame, draws| effect.on_cloud(&mut after, frame, draws));
        for (a, b) in before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return() && a.object == 1) {
            let elevation = a.direction[2].asin() + 0.2_f32.to_radians();
            let want = -2.0 / elevation.sin();
            assert!((b.range_m / want - 1.0).abs() < 1e-3, "{} {want}", b.range_m);
        }
    }
}
