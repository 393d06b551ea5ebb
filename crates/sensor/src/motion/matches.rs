//! How many edges of a frame lie where other frames have edges, after a motion of the vehicle.

use nalgebra::Vector2;

/// Side of a cell in bird's-eye view, m.
pub const CELL_M: f64 = 0.35;

/// Cells along a side of the square about the ego vehicle: 151 m. Edges lie within 70 m.
const SIDE: usize = 432;

/// The cell of a place, both in cells from a corner of the square; `None` beyond it.
fn cell([x, y]: [f64; 2]) -> Option<usize> {
    let inside = 0.0..SIDE as f64;
    (inside.contains(&x) && inside.contains(&y)).then(|| x as usize * SIDE + y as usize)
}

/// A coordinate relative to the ego vehicle, m, in cells from a corner of the square.
fn in_cells(m: f64) -> f64 {
    m / CELL_M + (SIDE / 2) as f64
}

/// Cells of a square about the ego vehicle, in bird's-eye view.
pub struct Cells {
    /// A bit for each.
    taken: Vec<u64>,
}

impl Cells {
    /// The cells that hold a point.
    pub fn new<'a>(points: impl IntoIterator<Item = &'a Vector2<f64>>) -> Self {
        let mut taken = vec![0; (SIDE * SIDE).div_ceil(64)];
        points.into_iter().filter_map(Self::place).for_each(|i| taken[i / 64] |= 1 << (i % 64));
        Cells { taken }
    }

    fn place(p: &Vector2<f64>) -> Option<usize> {
        cell([p.x, p.y].map(in_cells))
    }

    /// Whether a point lies in a cell that holds one.
    pub fn contains(&self, p: &Vector2<f64>) -> bool {
        Self::place(p).is_some_and(|i| self.taken[i / 64] >> (i % 64) & 1 == 1)
    }

    /// Number of cells that hold points of both.
    pub(super) fn in_common(&self, other: &Cells) -> u32 {
        self.taken.iter().zip(&other.taken).map(|(a, b)| (a & b).count_ones()).sum()
    }
}

/// The cells that each of three frames occupies.
pub(super) struct OfThree {
    /// A bit for each frame.
    by: Vec<u8>,
}

impl OfThree {
    pub(super) fn new(edges: [&[Vector2<f64>]; 3]) -> Self {
        let mut by = vec![0; SIDE * SIDE];
        for (frame, edges) in edges.into_iter().enumerate() {
            edges.iter().filter_map(Cells::place).for_each(|i| by[i] |= 1 << frame);
        }
        OfThree { by }
    }
}

/// Edges as the vehicle sees them after a turn.
pub(super) struct Turned {
    /// In cells from a corner of the square.
    places: Vec<[f64; 2]>,
    /// By how many cells they move where the vehicle goes a metre along its mean heading.
    by_way: [f64; 2],
}

impl Turned {
    /// By an angle, rad.
    pub(super) fn new(edges: &[Vector2<f64>], yaw: f64) -> Self {
        let (sin, cos) = yaw.sin_cos();
        let (half_sin, half_cos) = (0.5 * yaw).sin_cos();
        let turned = |x: f64, y: f64| [cos * x + sin * y, cos * y - sin * x];
        Turned {
            places: edges.iter().map(|p| turned(p.x, p.y).map(in_cells)).collect(),
            by_way: turned(half_cos, half_sin).map(|v| -v / CELL_M),
        }
    }

    /// Number of edges that lie in cells of each of three frames if the vehicle goes ahead by a way, m.
    pub(super) fn on(&self, frames: &OfThree, way_m: f64) -> [f64; 3] {
        let by = self.by_way.map(|v| v * way_m);
        let mut counts = [0u32; 3];
        for place in &self.places {
            if let Some(i) = cell([place[0] + by[0], place[1] + by[1]]) {
                let taken = frames.by[i];
                (0..3).for_each(|k| counts[k] += u32::from(taken >> k & 1));
            }
        }
        counts.map(f64::from)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn edges_lie_on_those_of_a_frame_after_the_motion_to_it() {
        let edges: Vec<Vector2<f64>> =
            (0..50).map(|i| Vector2::new(f64::from(i * 37 % 90) - 45.0, 0.3 * f64::from(i))).collect();
        let (way_m, yaw) = (1.7, 0.05f64);
        let moved: Vec<Vector2<f64>> = edges
            .iter()
            .map(|p| {
                let q = p - way_m * Vector2::new((0.5 * yaw).cos(), (0.5 * yaw).sin());
                nalgebra::Rotation2::new(-yaw) * q
            })
            .collect();
        let far = [Vector2::new(60.0, 60.0), Vector2::new(900.0, 0.0)];
        let three = OfThree::new([&moved, &edges, &far]);
        let [on, stood, none] = Turned::new(&edges, yaw).on(&three, way_m);
        assert!(on > 48.0 && stood < 10.0 && none == 0.0, "{on} {stood} {none}");
        assert_eq!(Turned::new(&edges, 0.0).on(&three, 0.0)[1], 50.0);
        let [a, b] = [&edges, &moved].map(Cells::new);
        let counted = edges.iter().filter(|p| b.contains(p)).count();
        assert!(a.in_common(&b) as usize <= counted && a.in_common(&a) > 45 && !a.contains(&far[1]));
    }
}
