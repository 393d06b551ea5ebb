//! Directions and times of a sensor's shots.

use data::limits::{MOST_TEXT_BYTES, read_file};
use data::toml_text::{within, wrong};
use data::{DataError, KeyError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Shots per scan of the grids of all sensors of a rig.
pub(super) const MOST_SHOTS: f64 = 16e6;

/// Scan pattern: a grid of rows and columns, or a CSV file of single shots.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Pattern {
    /// Blocks of rows at equal angular steps, from the top.
    #[serde(default)]
    pub blocks: Vec<RowBlock>,
    /// Shots per row, at equal angular steps over the horizontal field of view, from left to right.
    #[serde(default)]
    pub columns: u32,
    /// Order in which the grid is scanned.
    #[serde(default)]
    pub sweep: Sweep,
    /// CSV file with one line per shot, relative to this file. It replaces `blocks` and `columns`. Columns:
    /// `azimuth_deg` (counter-clockwise from the sensor's x axis), `elevation_deg` (upwards from the sensor's
    /// horizontal plane), `time_s` (relative to the middle of the scan), and optionally `row` and `column`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<PathBuf>,
    #[serde(skip)]
    shots: Vec<Shot>,
    #[serde(skip)]
    grid_columns: usize,
}

/// Rows at equal angular steps.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RowBlock {
    /// Number of rows.
    pub rows: u32,
    /// Elevation of the first row in the sensor's frame, degrees.
    pub top_deg: f64,
    /// Elevation of the last row in the sensor's frame, degrees.
    pub bottom_deg: f64,
}

/// Order in which a grid is scanned.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Sweep {
    /// Row by row from the top, each from left to right: raster scan.
    #[default]
    Rows,
    /// Column by column from the left, all rows of a column at the same time: spinning sensor.
    Columns,
}

/// One shot of a scan, in the sensor's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Shot {
    /// Row, counted from the top.
    pub row: u16,
    /// Column, counted from the left.
    pub column: u16,
    /// Azimuth, counter-clockwise from the sensor's x axis, rad.
    pub azimuth_rad: f64,
    /// Elevation, upwards from the sensor's horizontal plane, rad.
    pub elevation_rad: f64,
    /// Time relative to the middle of the scan, s.
    pub time_s: f64,
}

impl Shot {
    /// Unit vector of the shot in the sensor's frame.
    pub fn direction(&self) -> [f64; 3] {
        direction(self.azimuth_rad, self.elevation_rad)
    }
}

/// Unit vector of an azimuth and an elevation, rad.
pub fn direction(azimuth_rad: f64, elevation_rad: f64) -> [f64; 3] {
    let ((sa, ca), (se, ce)) = (azimuth_rad.sin_cos(), elevation_rad.sin_cos());
    [ca * ce, sa * ce, se]
}

impl Pattern {
    /// The shots of a CSV file beside the rig, which are not read here.
    pub fn of_file(file: PathBuf) -> Pattern {
        Pattern {
            blocks: Vec::new(),
            columns: 0,
            sweep: Sweep::Rows,
            file: Some(file),
            shots: Vec::new(),
            grid_columns: 0,
        }
    }

    /// A grid of one block of rows, with its shots.
    pub fn grid(block: RowBlock, columns: u32, horizontal_fov_deg: f64, rate_hz: f64) -> Pattern {
        let mut pattern = Pattern {
            blocks: vec![block],
            columns,
            sweep: Sweep::Rows,
            file: None,
            shots: Vec::new(),
            grid_columns: 0,
        };
        pattern.make_grid(horizontal_fov_deg, rate_hz);
        pattern
    }

    /// All shots of a scan; those of a grid row by row.
    pub fn shots(&self) -> &[Shot] {
        &self.shots
    }

    /// Number of columns of [`Pattern::shots`] as a grid; all shots for a CSV pattern.
    pub fn grid_columns(&self) -> usize {
        self.grid_columns
    }

    /// Elevation of each row, from the top, rad; empty for a CSV pattern.
    pub fn row_elevations_rad(&self) -> Vec<f64> {
        let of_block = |b: &RowBlock| {
            let (top, step) = (b.top_deg, (b.top_deg - b.bottom_deg) / f64::from((b.rows - 1).max(1)));
            (0..b.rows).map(move |i| (top - step * f64::from(i)).to_radians())
        };
        self.blocks.iter().flat_map(of_block).collect()
    }

    pub(super) fn check(&self) -> Result<(), KeyError> {
        if self.file.is_some() {
            if self.blocks.is_empty() && self.columns == 0 {
                return Ok(());
            }
            return Err(wrong("file", "cannot be combined with blocks and columns: remove those"));
        }
        if self.blocks.is_empty() {
            return Err(wrong(
                "blocks",
                "is empty; for example blocks = [{ rows = 64, top_deg = 5, bottom_deg = -20 }]",
            ));
        }
        for (i, block) in self.blocks.iter().enumerate() {
            let here = |key: &str| format!("blocks[{i}].{key}");
            within(&here("rows"), block.rows.into(), 1.0, 4096.0)?;
            within(&here("top_deg"), block.top_deg, -89.0, 89.0)?;
            within(&here("bottom_deg"), block.bottom_deg, -89.0, block.top_deg)?;
        }
        within("columns", self.columns.into(), 1.0, 65_535.0)?;
        let shots = self.shots_of_grid();
        within("columns", shots, 1.0, MOST_SHOTS)
            .map_err(|_| wrong("columns", format!("{shots} shots per scan, more than 16 million")))
    }

    /// Number of shots of the grid; 0 for a CSV pattern.
    pub(super) fn shots_of_grid(&self) -> f64 {
        f64::from(self.columns) * self.blocks.iter().map(|b| f64::from(b.rows)).sum::<f64>()
    }

    pub(super) fn load_shots(&mut self, folder: &Path, fov_deg: f64, rate_hz: f64) -> Result<(), DataError> {
        if let Some(file) = &self.file {
            let path = folder.join(file);
            self.shots = read_shots(&path)?;
            self.grid_columns = self.shots.len();
        } else {
            self.make_grid(fov_deg, rate_hz);
        }
        Ok(())
    }

    fn make_grid(&mut self, fov_deg: f64, rate_hz: f64) {
        let (elevations, columns) = (self.row_elevations_rad(), f64::from(self.columns));
        let step = (fov_deg / columns).to_radians();
        let left = step * (columns - 1.0) / 2.0;
        let rows = elevations.len() as f64;
        let shot = |row: usize, column: u32| {
            let (r, c) = (row as f64, f64::from(column));
            let done = match self.sweep {
                Sweep::Rows => (r + (c + 0.5) / columns) / rows,
                Sweep::Columns => (c + 0.5) / columns,
            };
            Shot {
                row: row as u16,
                column: column as u16,
                azimuth_rad: left - step * c,
                elevation_rad: elevations[row],
                time_s: (done - 0.5) / rate_hz,
            }
        };
        self.shots = (0..elevations.len())
            .flat_map(|row| (0..self.columns).map(move |c| (row, c)))
            .map(|(r, c)| shot(r, c))
            .collect();
        self.grid_columns = self.columns as usize;
    }

    /// Multiplies the numbers of rows and columns by `factor`, over the same field of view and time.
    pub(super) fn scale(&mut self, factor: f64, fov_deg: f64, rate_hz: f64) {
        if self.file.is_none() {
            let scaled = |n: u32| ((f64::from(n) * factor).round() as u32).max(1);
            self.blocks.iter_mut().for_each(|block| block.rows = scaled(block.rows));
            self.columns = scaled(self.columns);
            self.make_grid(fov_deg, rate_hz);
        }
    }
}

/// A line of a CSV pattern.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ShotLine {
    azimuth_deg: f64,
    elevation_deg: f64,
    time_s: f64,
    row: Option<u16>,
    column: Option<u16>,
}

fn read_shots(path: &Path) -> Result<Vec<Shot>, DataError> {
    let bytes = read_file(path, MOST_TEXT_BYTES)?;
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(bytes.as_slice());
    let mut shots = Vec::new();
    for line in reader.deserialize() {
        let number = |e: &csv::Error| e.position().map_or(1, |p| p.line() as usize);
        let line: ShotLine = line.map_err(|e| DataError::line(path, number(&e), e.to_string()))?;
        let here = shots.len();
        let bad =
            |what: &str, v: f64| DataError::file(path, format!("shot {here} (from 0): {what} = {v} is out of range"));
        if !(-360.0..=360.0).contains(&line.azimuth_deg) {
            return Err(bad("azimuth_deg", line.azimuth_deg));
        }
        if !(-90.0..=90.0).contains(&line.elevation_deg) {
            return Err(bad("elevation_deg", line.elevation_deg));
        }
        if line.time_s.abs().partial_cmp(&10.0) != Some(std::cmp::Ordering::Less) {
            return Err(bad("time_s", line.time_s));
        }
        shots.push(Shot {
            row: line.row.unwrap_or(0),
            column: line.column.unwrap_or(here.min(65_535) as u16),
            azimuth_rad: line.azimuth_deg.to_radians(),
            elevation_rad: line.elevation_deg.to_radians(),
            time_s: line.time_s,
        });
    }
    if shots.is_empty() {
        return Err(DataError::file(path, "contains no shots"));
    }
    Ok(shots)
}

#[cfg(test)]
mod tests {
    use super::*;

    const BLOCK: RowBlock = RowBlock { rows: 4, top_deg: 3.0, bottom_deg: -3.0 };

    #[test]
    fn a_grid_covers_the_field_of_view_and_the_scan_time() {
        let pattern = Pattern::grid(BLOCK, 6, 120.0, 20.0);
        let shots = pattern.shots();
        assert_eq!((shots.len(), pattern.grid_columns()), (24, 6));
        assert!(
            (shots[0].azimuth_rad.to_degrees() - 50.0).abs() < 1e-9
                && (shots[5].azimuth_rad.to_degrees() + 50.0).abs() < 1e-9
        );
        assert!((shots[23].elevation_rad.to_degrees() + 3.0).abs() < 1e-9);
        assert!((shots[0].time_s + shots[23].time_s).abs() < 1e-12 && shots[23].time_s < 0.025);
        assert!(shots.windows(2).all(|w| w[0].time_s < w[1].time_s));
        let mut spinning = pattern.clone();
        spinning.sweep = Sweep::Columns;
        spinning.make_grid(120.0, 20.0);
        assert_eq!(spinning.shots()[0].time_s, spinning.shots()[6].time_s, "all rows of a column have the same time");
    }

    #[test]
    fn shots_from_csv() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.csv");
        std::fs::write(&path, "azimuth_deg, elevation_deg, time_s\n# a comment\n10, -2, 0.001\n-10, 2, 0.002\n")
            .unwrap();
        let shots = read_shots(&path).unwrap();
        assert_eq!((shots.len(), shots[1].column), (2, 1));
        assert!((shots[0].direction()[1] - 10_f64.to_radians().sin() * 2_f64.to_radians().cos()).abs() < 1e-12);
        for (text, want) in [
            ("azimuth_deg,elevation_deg\n1,2\n", "p.csv:2"),
            ("azimuth_deg,elevation_deg,time_s\n1,2,x\n", "p.csv:2"),
            ("azimuth_deg,elevation_deg,time_s\n1,2,0\n1,200,0\n", "shot 1 (from 0): elevation_deg = 200"),
            ("azimuth_deg,elevation_deg,time_s\n1,2,nan\n", "time_s = NaN"),
            ("azimuth_deg,elevation_deg,time_s\n", "contains no shots"),
        ] {
            std::fs::write(&path, text).unwrap();
            let error = read_shots(&path).unwrap_err().to_string();
            assert!(error.contains(want), "{text}: {error}");
        }
    }
}
