//! Distance to the surface of a shape, sampled on a grid.

use crate::mesh::Mesh;

/// Side of a cell, m.
const CELL_M: f64 = 0.05;
/// Largest distance that is distinguished from larger ones, m.
pub const REACH_M: f64 = 0.2;
/// Largest distance of neighbouring samples of the surface, m.
const SPACING_M: f64 = 0.03;

/// Distances to the surface of a mesh, up to [`REACH_M`].
#[derive(Clone, Debug)]
pub struct ShapeField {
    low: [f64; 3],
    cells: [usize; 3],
    distance_m: Vec<f32>,
}

impl ShapeField {
    /// Of a mesh; `center` becomes the origin.
    pub fn new(mesh: &Mesh, center: [f64; 3]) -> ShapeField {
        let [low, high] = mesh.bounds().unwrap_or_default();
        let low: [f64; 3] = std::array::from_fn(|k| low[k] - center[k] - REACH_M - CELL_M);
        let high: [f64; 3] = std::array::from_fn(|k| high[k] - center[k] + REACH_M + CELL_M);
        let cells = std::array::from_fn(|k| ((high[k] - low[k]) / CELL_M).ceil() as usize + 1);
        let n = cells.iter().product();
        let mut field = ShapeField { low, cells, distance_m: vec![REACH_M as f32; n] };
        for face in &mesh.faces {
            let corners = face.corners.map(|i| {
                let vertex = mesh.vertices[i as usize];
                std::array::from_fn(|k| vertex[k] - center[k])
            });
            field.add(corners);
        }
        field
    }

    /// Adds the points of a triangle.
    fn add(&mut self, [a, b, c]: [[f64; 3]; 3]) {
        let length = |p: [f64; 3], q: [f64; 3]| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>().sqrt();
        let steps = (length(a, b).max(length(a, c)).max(length(b, c)) / SPACING_M).ceil().max(1.0) as usize;
        for i in 0..=steps {
            for j in 0..=steps - i {
                let (u, v) = (i as f64 / steps as f64, j as f64 / steps as f64);
                self.add_point(std::array::from_fn(|k| a[k] + u * (b[k] - a[k]) + v * (c[k] - a[k])));
            }
        }
    }

    fn add_point(&mut self, point: [f64; 3]) {
        let span = |k: usize| {
            let at = (point[k] - self.low[k]) / CELL_M;
            let reach = REACH_M / CELL_M;
            ((at - reach).ceil().max(0.0) as usize)..=((at + reach).floor() as usize).min(self.cells[k] - 1)
        };
        for x in span(0) {
            for y in span(1) {
                for z in span(2) {
                    let at = [x, y, z];
                    let squared = (0..3).map(|k| (self.low[k] + at[k] as f64 * CELL_M - point[k]).powi(2));
                    let distance = squared.sum::<f64>().sqrt() as f32;
                    let cell = (x * self.cells[1] + y) * self.cells[2] + z;
                    self.distance_m[cell] = self.distance_m[cell].min(distance);
                }
            }
        }
    }

    /// Distance of a point to the surface, m, at most [`REACH_M`]; exact to half a cell.
    pub fn at(&self, point: [f64; 3]) -> f64 {
        let mut cell = 0;
        for k in 0..3 {
            let i = ((point[k] - self.low[k]) / CELL_M).round();
            if !(0.0..self.cells[k] as f64).contains(&i) {
                return REACH_M;
            }
            cell = cell * self.cells[k] + i as usize;
        }
        f64::from(self.distance_m[cell])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::mesh::cuboid;
    use sensor::material::MaterialTable;

    #[test]
    fn distances_to_a_cuboid() {
        let mesh = cuboid([1.0, -1.0, 0.0], [3.0, 1.0, 1.0], MaterialTable::built_in("asphalt"));
        let field = ShapeField::new(&mesh, [2.0, 0.0, 0.5]);
        for (point, want) in [
            ([1.0, 0.0, 0.0], 0.0),
            ([1.1, 0.0, 0.0], 0.1),
            ([0.9, 0.3, 0.2], 0.1),
            ([0.0, 0.0, 0.0], REACH_M),
            ([9.0, 0.0, 0.0], REACH_M),
        ] {
            assert!((field.at(point) - want).abs() < 0.045, "{point:?}: {} instead of {want}", field.at(point));
        }
    }
}
