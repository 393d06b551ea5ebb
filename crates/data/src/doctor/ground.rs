//! Local ground height, from the lowest points near a position, and the points above the ground.

use crate::Cloud;
use std::collections::HashMap;

/// Side of a grid cell, m.
const CELL_M: f64 = 2.0;
/// Points up to this height above the ground count as ground, m.
const GROUND_THICKNESS_M: f64 = 0.3;

type Cell = (i32, i32);

/// Ground height and points above the ground of a frame, on a grid in x and y.
pub(super) struct Ground {
    /// Third-lowest z of the points in a cell, m. One or two points below the ground are multipath returns.
    low: HashMap<Cell, f64>,
    /// Points above the ground, m.
    standing: HashMap<Cell, Vec<[f64; 3]>>,
}

impl Ground {
    pub(super) fn new(cloud: &Cloud) -> Self {
        let mut lowest: HashMap<Cell, [f64; 3]> = HashMap::new();
        for p in cloud.points() {
            let three = lowest.entry(cell(p[0].into(), p[1].into())).or_insert([f64::INFINITY; 3]);
            let mut z = f64::from(p[2]);
            for slot in three {
                if z < *slot {
                    std::mem::swap(&mut z, slot);
                }
            }
        }
        let low = lowest.into_iter().map(|(cell, three)| (cell, three[2])).filter(|(_, z)| z.is_finite()).collect();
        let mut ground = Ground { low, standing: HashMap::new() };
        let mut heights: HashMap<Cell, Option<f64>> = HashMap::new();
        for p in cloud.points() {
            let p = [p[0].into(), p[1].into(), p[2].into()];
            let at = cell(p[0], p[1]);
            let height = *heights.entry(at).or_insert_with(|| ground.at_cell(at));
            if height.is_some_and(|ground| p[2] > ground + GROUND_THICKNESS_M) {
                ground.standing.entry(at).or_default().push(p);
            }
        }
        ground
    }

    /// z of the ground around a position, m; `None` if there are too few points near it.
    pub(super) fn at(&self, x: f64, y: f64) -> Option<f64> {
        self.at_cell(cell(x, y))
    }

    /// Lower quartile over the surrounding cells. Many cells have points on objects only, not on the ground.
    fn at_cell(&self, (cx, cy): Cell) -> Option<f64> {
        for reach in [1, 2, 4] {
            let around = (-reach..=reach).flat_map(|dx| (-reach..=reach).map(move |dy| (cx + dx, cy + dy)));
            let mut heights: Vec<f64> = around.filter_map(|cell| self.low.get(&cell).copied()).collect();
            if heights.len() >= 5 {
                heights.sort_by(f64::total_cmp);
                return Some(heights[heights.len() / 4]);
            }
        }
        None
    }

    /// Points above the ground in all cells that the bounding square of a circle touches.
    pub(super) fn standing_near(&self, x: f64, y: f64, radius: f64) -> impl Iterator<Item = &[f64; 3]> {
        let ((x0, y0), (x1, y1)) = (cell(x - radius, y - radius), cell(x + radius, y + radius));
        let cells = (x0..=x1).flat_map(move |cx| (y0..=y1).map(move |cy| (cx, cy)));
        cells.filter_map(|cell| self.standing.get(&cell)).flatten()
    }

    /// All points above the ground, in no defined order.
    pub(super) fn standing(&self) -> impl Iterator<Item = &[f64; 3]> {
        self.standing.values().flatten()
    }
}

fn cell(x: f64, y: f64) -> Cell {
    ((x / CELL_M).floor() as i32, (y / CELL_M).floor() as i32)
}
