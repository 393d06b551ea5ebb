//! Where the ground is around a place, from the lowest points near it, and which points stand above it.

use crate::Cloud;
use std::collections::HashMap;

/// Side of a cell, m.
const CELL_M: f64 = 2.0;
/// Points lower than this above the ground are taken for ground, m.
const ABOVE_M: f64 = 0.3;

type Cell = (i32, i32);

/// Ground and standing points of a frame, by cells seen from above.
pub(super) struct Ground {
    /// The lowest z that three points of the cell confirm; single points far below the ground are echoes of echoes.
    low: HashMap<Cell, f64>,
    /// Points above the ground.
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
            if height.is_some_and(|ground| p[2] > ground + ABOVE_M) {
                ground.standing.entry(at).or_default().push(p);
            }
        }
        ground
    }

    /// Height of the ground around a place, m; `None` where nothing near says so.
    pub(super) fn at(&self, x: f64, y: f64) -> Option<f64> {
        self.at_cell(cell(x, y))
    }

    /// The lower quartile of the cells around: many of them show only what stands on them.
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

    /// Points above the ground in the cells that a circle touches.
    pub(super) fn standing_near(&self, x: f64, y: f64, radius: f64) -> impl Iterator<Item = &[f64; 3]> {
        let ((x0, y0), (x1, y1)) = (cell(x - radius, y - radius), cell(x + radius, y + radius));
        let cells = (x0..=x1).flat_map(move |cx| (y0..=y1).map(move |cy| (cx, cy)));
        cells.filter_map(|cell| self.standing.get(&cell)).flatten()
    }

    /// All points above the ground, cell by cell in no order.
    pub(super) fn standing(&self) -> impl Iterator<Item = &[f64; 3]> {
        self.standing.values().flatten()
    }
}

fn cell(x: f64, y: f64) -> Cell {
    ((x / CELL_M).floor() as i32, (y / CELL_M).floor() as i32)
}
