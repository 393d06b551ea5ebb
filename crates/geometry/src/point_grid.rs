//! Points sorted into the cells of a BEV grid, for neighbour searches whose result equals brute force.

/// Largest number of cells along one side.
const MAX_SIDE: usize = 2048;

/// Points sorted by cell; inside a cell by index.
pub(crate) struct PointGrid {
    low: [f64; 2],
    cell_m: f64,
    /// Cells along x and y.
    pub(crate) size: [usize; 2],
    /// Cell (x, y) has the points `starts[x * size[1] + y]..starts[x * size[1] + y + 1]`: the cells of a column are
    /// contiguous.
    starts: Vec<u32>,
    /// Index of each point in the cloud.
    pub(crate) index: Vec<u32>,
    /// Their coordinates, m.
    pub(crate) xyz: [Vec<f32>; 3],
}

impl PointGrid {
    /// A grid with cells of `cell_m`, or larger ones if they would hold fewer than `in_cell` points on average. Points
    /// that are not finite are left out.
    pub(crate) fn new(points: &[[f32; 3]], cell_m: f64, in_cell: f64) -> Self {
        let finite = |p: &[f32; 3]| p.iter().all(|v| v.is_finite());
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        for p in points.iter().filter(|p| finite(p)) {
            for axis in 0..2 {
                low[axis] = low[axis].min(f64::from(p[axis]));
                high[axis] = high[axis].max(f64::from(p[axis]));
            }
        }
        if !(low[0] <= high[0]) {
            (low, high) = ([0.0; 2], [0.0; 2]);
        }
        let extent = [high[0] - low[0], high[1] - low[1]];
        let cells = (points.len() as f64 / in_cell).max(1.0);
        let longest = extent[0].max(extent[1]);
        let roomy = (extent[0] * extent[1] / cells).sqrt().max(longest / cells.min((MAX_SIDE - 1) as f64));
        let cell_m = cell_m.max(roomy).max(1e-9);
        let size = extent.map(|e| (e / cell_m) as usize + 1);
        let mut grid = PointGrid {
            low,
            cell_m,
            size,
            starts: vec![0; size[0] * size[1] + 1],
            index: vec![],
            xyz: Default::default(),
        };

        let cell_of = |p: &[f32; 3]| grid.cell(0, f64::from(p[0])) * size[1] + grid.cell(1, f64::from(p[1]));
        let cells: Vec<u32> = points.iter().map(|p| if finite(p) { cell_of(p) as u32 } else { u32::MAX }).collect();
        let mut starts = vec![0u32; size[0] * size[1] + 1];
        let kept = cells.iter().filter(|c| **c != u32::MAX);
        kept.clone().for_each(|&cell| starts[cell as usize + 1] += 1);
        for cell in 1..starts.len() {
            starts[cell] += starts[cell - 1];
        }
        let mut next = starts.clone();
        let mut index = vec![0; kept.count()];
        for (i, &cell) in cells.iter().enumerate().filter(|(_, cell)| **cell != u32::MAX) {
            index[next[cell as usize] as usize] = i as u32;
            next[cell as usize] += 1;
        }
        grid.xyz = [0, 1, 2].map(|axis| index.iter().map(|&i| points[i as usize][axis]).collect());
        (grid.starts, grid.index) = (starts, index);
        grid
    }

    /// Cell of a coordinate, clamped to the grid; monotone in `v`.
    pub(crate) fn cell(&self, axis: usize, v: f64) -> usize {
        let cell = (v - self.low[axis]) / self.cell_m;
        (cell.max(0.0) as usize).min(self.size[axis] - 1)
    }

    /// Lower border of cell `cell` along an axis, m; minus infinity for the first cell, infinity after the last.
    pub(crate) fn border_m(&self, axis: usize, cell: usize) -> f64 {
        match cell {
            0 => f64::NEG_INFINITY,
            _ if cell >= self.size[axis] => f64::INFINITY,
            _ => self.low[axis] + cell as f64 * self.cell_m,
        }
    }

    /// Positions of the points in cells `y_from..=y_to` of the column `x`.
    pub(crate) fn run(&self, x: usize, y_from: usize, y_to: usize) -> std::ops::Range<usize> {
        self.starts[x * self.size[1] + y_from] as usize..self.starts[x * self.size[1] + y_to + 1] as usize
    }
}
