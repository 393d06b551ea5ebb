//! Neighbours of a shot in the pattern of its sensor.

use crate::scan::{Echo, Scan};
use std::collections::BTreeMap;

/// Index of the first return of each sensor, row and column.
pub(super) struct ShotGrid {
    sensors: BTreeMap<u8, (usize, Vec<u32>)>,
}

impl ShotGrid {
    pub(super) fn new(scan: &Scan) -> ShotGrid {
        let known = |e: &Echo| e.number == 0 && e.row != Echo::UNKNOWN && e.column != Echo::UNKNOWN;
        let mut sizes: BTreeMap<u8, (usize, usize)> = BTreeMap::new();
        for echo in scan.echoes.iter().filter(|e| known(e)) {
            let size = sizes.entry(echo.sensor).or_default();
            *size = (size.0.max(usize::from(echo.row) + 1), size.1.max(usize::from(echo.column) + 1));
        }
        let mut sensors: BTreeMap<u8, (usize, Vec<u32>)> =
            sizes.into_iter().map(|(s, (rows, columns))| (s, (columns, vec![u32::MAX; rows * columns]))).collect();
        for (i, echo) in scan.echoes.iter().enumerate().filter(|(_, e)| known(e)) {
            if let Some((columns, places)) = sensors.get_mut(&echo.sensor) {
                places[usize::from(echo.row) * *columns + usize::from(echo.column)] = i as u32;
            }
        }
        ShotGrid { sensors }
    }

    /// Indices of the shots within `rows` rows and `columns` columns of a shot, itself included.
    pub(super) fn around(&self, echo: &Echo, rows: usize, columns: usize) -> impl Iterator<Item = usize> {
        let found = self.sensors.get(&echo.sensor);
        let (width, places) = found.map_or((1, &[][..]), |(width, places)| (*width, places.as_slice()));
        let (row, column) = (usize::from(echo.row), usize::from(echo.column));
        let last_row = (row + rows).min((places.len() / width).saturating_sub(1));
        let last_column = (column + columns).min(width - 1);
        let cells = (row.saturating_sub(rows)..=last_row)
            .flat_map(move |r| (column.saturating_sub(columns)..=last_column).map(move |c| r * width + c));
        cells.filter_map(|cell| places.get(cell)).filter(|i| **i != u32::MAX).map(|i| *i as usize)
    }
}

/// Numbers of rows and columns that cover an angle, from the angular steps of the grid around a shot; at most `most`.
pub(super) fn reach(scan: &Scan, grid: &ShotGrid, echo: &Echo, angle_rad: f32, most: usize) -> (usize, usize) {
    let step = |rows: usize, columns: usize| {
        let other = grid.around(echo, rows, columns).map(|i| &scan.echoes[i]);
        let angle = |e: &Echo| crate::scan::dot(e.direction, echo.direction).clamp(-1.0, 1.0).acos();
        let neighbour = other.filter(|e| (e.row, e.column) != (echo.row, echo.column)).map(angle);
        neighbour.fold(f32::INFINITY, f32::min).max(1e-4)
    };
    let cells = |step: f32| ((angle_rad / step).ceil() as usize).min(most);
    (cells(step(1, 0)), cells(step(0, 1)))
}
