//! A grid of cells seen from above, which lists the bodies in each cell and is walked along a ray.

use nalgebra::{Point3, Vector3};

/// Side of a cell, m.
const CELL_M: f64 = 4.0;

/// Contents of a cell.
#[derive(Clone, Debug, Default)]
pub struct Cell {
    /// Numbers of the bodies in it.
    pub bodies: Vec<u32>,
    /// Height below which bodies are, m.
    pub top_m: f64,
    /// Height below which its ground is, m.
    pub ground_m: f64,
}

/// The grid. World frame.
#[derive(Clone, Debug)]
pub struct Grid {
    low: [f64; 2],
    columns: usize,
    rows: usize,
    cells: Vec<Cell>,
}

impl Grid {
    /// An empty grid over a rectangle. `ground_m` gives the height of the ground at a place, which it exceeds nowhere
    /// in a cell by more than `margin_m` over the values at nine places of the cell.
    pub fn over(low: [f64; 2], high: [f64; 2], ground_m: impl Fn(f64, f64) -> f64, margin_m: f64) -> Grid {
        let [columns, rows] = [0, 1].map(|k| ((high[k] - low[k]) / CELL_M).ceil() as usize);
        let cell = |i: usize| {
            let corner = [low[0] + CELL_M * (i % columns) as f64, low[1] + CELL_M * (i / columns) as f64];
            let at = |k: usize| {
                ground_m(corner[0] + CELL_M * (k % 3) as f64 / 2.0, corner[1] + CELL_M * (k / 3) as f64 / 2.0)
            };
            let ground = (0..9).map(at).fold(f64::NEG_INFINITY, f64::max) + margin_m;
            Cell { bodies: Vec::new(), top_m: f64::NEG_INFINITY, ground_m: ground }
        };
        Grid { low, columns, rows, cells: (0..columns * rows).map(cell).collect() }
    }

    /// Adds a body to the cells that its bounds touch.
    pub fn add(&mut self, body: u32, [low, high]: [[f64; 3]; 2]) {
        let index = |v: f64, k: usize, n: usize| (((v - self.low[k]) / CELL_M).floor().max(0.0) as usize).min(n - 1);
        let [x0, x1] = [low, high].map(|p| index(p[0], 0, self.columns));
        let [y0, y1] = [low, high].map(|p| index(p[1], 1, self.rows));
        for y in y0..=y1 {
            for x in x0..=x1 {
                let cell = &mut self.cells[y * self.columns + x];
                cell.bodies.push(body);
                cell.top_m = cell.top_m.max(high[2]);
            }
        }
    }

    /// Calls `visit` with the cells along a ray and the part of the ray in each, from the nearest, until it returns
    /// `true` or the ray ends after `reach` or leaves the grid.
    pub fn walk(
        &self,
        origin: &Point3<f64>,
        direction: &Vector3<f64>,
        reach: f64,
        mut visit: impl FnMut(&Cell, f64, f64) -> bool,
    ) {
        let (mut at, mut step, mut next, mut every) = ([0i64; 2], [0i64; 2], [0.0; 2], [0.0; 2]);
        for k in 0..2 {
            let place = (origin[k] - self.low[k]) / CELL_M;
            at[k] = place.floor() as i64;
            let d = direction[k];
            step[k] = if d > 0.0 { 1 } else { -1 };
            every[k] = if d.abs() > 1e-12 { CELL_M / d.abs() } else { f64::INFINITY };
            let to_border = if d > 0.0 { at[k] as f64 + 1.0 - place } else { place - at[k] as f64 };
            next[k] = if every[k].is_finite() { to_border * every[k] } else { f64::INFINITY };
        }
        let (columns, rows) = (self.columns as i64, self.rows as i64);
        let mut from = 0.0;
        while from < reach && (0..columns).contains(&at[0]) && (0..rows).contains(&at[1]) {
            let k = usize::from(next[1] < next[0]);
            let to = next[k].min(reach);
            if visit(&self.cells[(at[1] * columns + at[0]) as usize], from, to) {
                return;
            }
            from = to;
            at[k] += step[k];
            next[k] += every[k];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_walk_visits_every_cell_on_the_way_once() {
        let mut grid = Grid::over([0.0, 0.0], [40.0, 40.0], |_, _| 0.0, 0.0);
        for i in 0..100u32 {
            let low = [4.0 * f64::from(i % 10) + 1.0, 4.0 * f64::from(i / 10) + 1.0, 0.0];
            grid.add(i, [low, [low[0] + 1.0, low[1] + 1.0, 2.0]]);
        }
        let (mut seen, mut end): (Vec<u32>, f64) = (Vec::new(), 0.0);
        let direction = Vector3::new(0.8, 0.6, 0.0);
        grid.walk(&Point3::new(1.0, 1.0, 1.0), &direction, 30.0, |cell, from, to| {
            assert!((from - end).abs() < 1e-12 && to > from);
            end = to;
            seen.extend(&cell.bodies);
            false
        });
        assert_eq!(end, 30.0);
        let mut wanted: Vec<u32> = Vec::new();
        for i in 0..30_000 {
            let p = Point3::new(1.0, 1.0, 1.0) + direction * (0.001 * f64::from(i));
            let cell = (p.y / 4.0).floor() as u32 * 10 + (p.x / 4.0).floor() as u32;
            if wanted.last() != Some(&cell) {
                wanted.push(cell);
            }
        }
        assert_eq!(seen, wanted);
    }
}
