//! Height of the ground below every place of a cloud, and clouds whose heights count from it.
//!
//! On banked or hilly ground the cars of a frame stand at heights that differ by metres. Above the ground they stand at
//! the same height.

use crate::{Cloud, Frame};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Distance between the places at which the height is estimated, m. Between them it is interpolated bilinearly.
const STEP_M: f64 = 8.0;
/// Places at most this far from the sensor along x and y, m. Beyond them the height of the nearest place counts.
const FARTHEST_M: f64 = 120.0;
/// Deviations from the plane that quarter the weight of a candidate, in the rounds of the robust fit to the candidates
/// of large cells, m. Large cells have a point of the ground where small ones have only walls and cars.
const COARSE_TOLERANCES_M: [f64; 4] = [3.0, 1.5, 0.6, 0.3];
/// The same for the small cells, from the plane of the large ones on, m.
const FINE_TOLERANCES_M: [f64; 2] = [0.5, 0.25];
/// Side and reach of the large cells, in those of the small ones.
const COARSE: f64 = 2.0;
/// Slopes are drawn to zero as if the candidates of a place spread by this much less, m. It matters only where they lie
/// on a line or in a point.
const RIDGE_M: f64 = 2.0;
/// Candidates that a plane needs at least.
const FEWEST: usize = 4;

/// How the height of the ground is estimated from a cloud.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct GroundConfig {
    /// Side of the square cells of which the third-lowest point is a candidate for the ground, m. One or two points
    /// below the ground are multipath returns.
    pub cell_m: f64,
    /// Candidates up to this horizontal distance decide about the ground at a place, m.
    pub reach_m: f64,
}

impl Default for GroundConfig {
    fn default() -> Self {
        GroundConfig { cell_m: 4.0, reach_m: 12.0 }
    }
}

impl GroundConfig {
    /// Whether the values are possible; the message names the key.
    pub fn check(&self) -> Result<(), String> {
        if !(self.cell_m >= 0.5 && self.cell_m.is_finite()) {
            return Err(format!("ground.cell_m = {} is below 0.5", self.cell_m));
        }
        if !(self.reach_m >= self.cell_m && self.reach_m <= FARTHEST_M) {
            return Err(format!("ground.reach_m = {} is not between cell_m and {FARTHEST_M}", self.reach_m));
        }
        Ok(())
    }
}

/// z of the ground in the LiDAR frame, as a function of x and y.
#[derive(Clone, Debug, PartialEq)]
pub struct GroundHeight {
    /// x and y of the first place, m.
    first_m: [f64; 2],
    /// Places along x and y.
    places: [usize; 2],
    /// z at each place, m, row by row of equal y.
    heights_m: Vec<f64>,
}

impl GroundHeight {
    /// Fits a plane to the candidates around each place. Points of objects and walls get little weight. A place without
    /// candidates gets the mean of its neighbours; without any candidate the ground is at z = 0.
    pub fn of(cloud: &Cloud, config: &GroundConfig) -> Self {
        let GroundConfig { cell_m, reach_m } = *config;
        let [fine, coarse] = [1.0, COARSE].map(|scale| Candidates::of(cloud, scale * cell_m));
        let places = fine.extent_m.map(|[low, high]| ((high - low) / STEP_M).ceil().max(0.0) as usize + 1);
        let first_m = fine.extent_m.map(|[low, _]| low);
        let height = |k: usize| {
            let at = [0, 1].map(|axis| first_m[axis] + STEP_M * [k % places[0], k / places[0]][axis] as f64);
            let level = [coarse.median_near(at, COARSE * reach_m)?, 0.0, 0.0];
            let plane = coarse.plane_at(at, COARSE * reach_m, level, &COARSE_TOLERANCES_M)?;
            Some(fine.plane_at(at, reach_m, plane, &FINE_TOLERANCES_M).unwrap_or(plane)[0])
        };
        let mut heights: Vec<Option<f64>> = (0..places[0] * places[1]).map(height).collect();
        fill(&mut heights, places);
        GroundHeight { first_m, places, heights_m: heights.into_iter().map(|z| z.unwrap_or(0.0)).collect() }
    }

    /// z of the ground at a place, m, LiDAR frame.
    pub fn at(&self, x: f64, y: f64) -> f64 {
        let cell = |axis: usize, v: f64| {
            let last = (self.places[axis] - 1) as f64;
            let at = ((v - self.first_m[axis]) / STEP_M).clamp(0.0, last);
            let low = at.floor().min((last - 1.0).max(0.0));
            (low as usize, at - low)
        };
        let ((i, u), (j, v)) = (cell(0, x), cell(1, y));
        let z =
            |i: usize, j: usize| self.heights_m[j.min(self.places[1] - 1) * self.places[0] + i.min(self.places[0] - 1)];
        let row = |j: usize| z(i, j) * (1.0 - u) + z(i + 1, j) * u;
        row(j) * (1.0 - v) + row(j + 1) * v
    }

    /// The frame with z counted from the ground: of points below them, of boxes below their centres.
    pub fn level(&self, frame: &Frame) -> Frame {
        let mut frame = frame.clone();
        for p in frame.cloud.points_mut() {
            p[2] = (f64::from(p[2]) - self.at(p[0].into(), p[1].into())) as f32;
        }
        for object in &mut frame.objects {
            let [x, y, z] = &mut object.bbox.center;
            *z -= self.at(*x, *y);
        }
        frame
    }
}

/// The third-lowest point of each cell.
struct Candidates {
    /// Smallest and largest x, then y, of the candidates, m.
    extent_m: [[f64; 2]; 2],
    cell_m: f64,
    /// Cells along x and y.
    cells: [usize; 2],
    /// x, y, z, m, of each cell, row by row of equal y.
    points: Vec<Option<[f64; 3]>>,
}

impl Candidates {
    fn of(cloud: &Cloud, cell_m: f64) -> Self {
        let n = (2.0 * FARTHEST_M / cell_m).ceil() as usize;
        let mut lowest = vec![[[f32::INFINITY; 3]; 3]; n * n];
        for p in cloud.points() {
            let cell = [p[0], p[1]].map(|v| (f64::from(v) + FARTHEST_M) / cell_m);
            // Not a number is no cell.
            if !cell.iter().all(|v| *v >= 0.0 && *v < n as f64) {
                continue;
            }
            let mut point = [p[0], p[1], p[2]];
            for slot in &mut lowest[cell[1] as usize * n + cell[0] as usize] {
                if point[2] < slot[2] {
                    std::mem::swap(&mut point, slot);
                }
            }
        }
        let third = |three: [[f32; 3]; 3]| three[2][2].is_finite().then(|| three[2].map(f64::from));
        let points: Vec<Option<[f64; 3]>> = lowest.into_iter().map(third).collect();
        let extent = |axis: usize| {
            let values = points.iter().flatten().map(|p| p[axis]);
            let [low, high] =
                values.fold([f64::INFINITY, f64::NEG_INFINITY], |[low, high], v| [low.min(v), high.max(v)]);
            if low <= high { [low, high] } else { [0.0, 0.0] }
        };
        Candidates { extent_m: [extent(0), extent(1)], cell_m, cells: [n, n], points }
    }

    /// Median z of the candidates around a place, m; `None` with too few of them.
    fn median_near(&self, place: [f64; 2], reach_m: f64) -> Option<f64> {
        let near = self.near(place, reach_m)?;
        statistics::median_upper(near.iter().map(|p| p[2]).collect())
    }

    /// The plane through the candidates around a place: weighted least squares from `plane` on, the weights repeated
    /// with tighter tolerances. `None` with too few candidates.
    fn plane_at(&self, place: [f64; 2], reach_m: f64, plane: [f64; 3], tolerances_m: &[f64]) -> Option<[f64; 3]> {
        let near = self.near(place, reach_m)?;
        Some(tolerances_m.iter().fold(plane, |plane, &tolerance_m| fit(&near, plane, tolerance_m)))
    }

    /// Offsets along x and y from a place, z, and a weight by distance of the candidates around it; `None` with too few
    /// of them.
    fn near(&self, [x, y]: [f64; 2], reach_m: f64) -> Option<Vec<[f64; 4]>> {
        let span = |v: f64, n: usize| {
            let cell = |v: f64| ((v + FARTHEST_M) / self.cell_m).floor().clamp(0.0, n as f64 - 1.0) as usize;
            cell(v - reach_m)..cell(v + reach_m) + 1
        };
        let mut near = Vec::new();
        for row in span(y, self.cells[1]) {
            for point in self.points[row * self.cells[0]..][span(x, self.cells[0])].iter().flatten() {
                let [dx, dy] = [point[0] - x, point[1] - y];
                let inside = 1.0 - (dx * dx + dy * dy) / (reach_m * reach_m);
                if inside > 0.0 {
                    near.push([dx, dy, point[2], inside * inside]);
                }
            }
        }
        (near.len() >= FEWEST).then_some(near)
    }
}

/// The plane `z = a + b dx + c dy` with weights from the deviations of the one before.
fn fit(near: &[[f64; 4]], [a, b, c]: [f64; 3], tolerance_m: f64) -> [f64; 3] {
    let (mut all, mut sx, mut sy, mut sz) = (0.0, 0.0, 0.0, 0.0);
    let (mut xx, mut xy, mut yy, mut xz, mut yz) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for &[dx, dy, z, weight] in near {
        let off = (z - a - b * dx - c * dy) / tolerance_m;
        let w = weight / (1.0 + off * off).powi(2);
        all += w;
        sx += w * dx;
        sy += w * dy;
        sz += w * z;
        xx += w * dx * dx;
        xy += w * dx * dy;
        yy += w * dy * dy;
        xz += w * dx * z;
        yz += w * dy * z;
    }
    // Centred normal equations of the slopes, with a ridge.
    let ridge = RIDGE_M * RIDGE_M * all;
    let (xx, xy, yy) = (xx - sx * sx / all + ridge, xy - sx * sy / all, yy - sy * sy / all + ridge);
    let (xz, yz) = (xz - sx * sz / all, yz - sy * sz / all);
    let determinant = xx * yy - xy * xy;
    let (b, c) = ((xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant);
    [(sz - b * sx - c * sy) / all, b, c]
}

/// Gives places without a height the mean of their neighbours, ring by ring.
fn fill(heights: &mut [Option<f64>], [nx, ny]: [usize; 2]) {
    while heights.iter().any(Option::is_none) && heights.iter().any(Option::is_some) {
        let before = heights.to_vec();
        for (k, height) in heights.iter_mut().enumerate().filter(|(_, height)| height.is_none()) {
            let (i, j) = (k % nx, k / nx);
            let rows = j.saturating_sub(1)..(j + 2).min(ny);
            let around = rows.flat_map(|j| (i.saturating_sub(1)..(i + 2).min(nx)).map(move |i| j * nx + i));
            let known: Vec<f64> = around.filter_map(|k| before[k]).collect();
            *height = (!known.is_empty()).then(|| statistics::mean(&known));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Object, stream};
    use geometry::Box3;
    use rand::RngExt;

    /// A road that climbs along x and is banked more and more across, with walls and boxes on it, points below it.
    fn banked(seed: u64) -> (Frame, impl Fn(f64, f64) -> f64) {
        let road = |x: f64, y: f64| 0.02 * x + 0.15 * y + 0.002 * y * y.abs();
        let mut rng = stream(seed, "banked", 0, 0);
        let mut frame = Frame { id: "banked".into(), cloud: Cloud::new(4), objects: Vec::new() };
        let mut push = |x: f64, y: f64, z: f64| frame.cloud.values.extend([x as f32, y as f32, z as f32, 0.5]);
        for _ in 0..12_000 {
            let (x, y): (f64, f64) = (rng.random_range(-90.0..90.0), rng.random_range(-25.0..25.0));
            push(x, y, road(x, y) + rng.random_range(-0.02..0.02));
        }
        for _ in 0..1500 {
            let x: f64 = rng.random_range(-90.0..90.0);
            push(x, 25.0, road(x, 25.0) + rng.random_range(0.0..4.0));
        }
        (0..30).for_each(|_| push(rng.random_range(-90.0..90.0), rng.random_range(-25.0..25.0), -40.0));
        for k in 0..10 {
            let (x, y) = (18.0 * k as f64 - 80.0, (7.0 * k as f64) % 40.0 - 20.0);
            for _ in 0..300 {
                let (dx, dy): (f64, f64) = (rng.random_range(-2.4..2.4), rng.random_range(-0.9..0.9));
                push(x + dx, y + dy, road(x, y) + rng.random_range(0.1..1.2));
            }
            let bbox = Box3::from_array([x, y, road(x, y) + 0.6, 4.8, 1.9, 1.2, 0.0]);
            let object = Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None };
            frame.objects.push(object);
        }
        (frame, road)
    }

    #[test]
    fn a_banked_road_is_found_below_cars_walls_and_strays() {
        let (frame, road) = banked(1);
        let ground = GroundHeight::of(&frame.cloud, &GroundConfig::default());
        for x in (-80..=80).step_by(5) {
            for y in (-20..=20).step_by(5) {
                let (x, y) = (f64::from(x), f64::from(y));
                let off = ground.at(x, y) - road(x, y);
                assert!(off.abs() < 0.25, "{off} m at {x}, {y}, where the road is at {}", road(x, y));
            }
        }
        let level = ground.level(&frame);
        let spread = |frame: &Frame| {
            let z: Vec<f64> = frame.objects.iter().map(|o| o.bbox.center[2]).collect();
            statistics::deviation(&z)
        };
        assert!(spread(&frame) > 1.5 && spread(&level) < 0.12, "{} to {}", spread(&frame), spread(&level));
    }

    #[test]
    fn points_and_boxes_move_together() {
        let (frame, _) = banked(2);
        let level = GroundHeight::of(&frame.cloud, &GroundConfig::default()).level(&frame);
        assert_eq!(frame.cloud.len(), level.cloud.len());
        let ground = GroundHeight::of(&frame.cloud, &GroundConfig::default());
        for (before, after) in frame.objects.iter().zip(&level.objects) {
            let [x, y, z] = before.bbox.center;
            assert_eq!(after.bbox, Box3 { center: [x, y, z - ground.at(x, y)], ..before.bbox });
        }
        let (before, after) = (frame.cloud.xyz(77), level.cloud.xyz(77));
        assert_eq!(before[..2], after[..2]);
        let by = f64::from(before[2]) - ground.at(before[0].into(), before[1].into());
        assert!((f64::from(after[2]) - by).abs() < 1e-5);
    }

    #[test]
    fn few_points_give_level_ground() {
        for values in [vec![], vec![1.0, 2.0, 3.0], vec![f32::NAN; 30], vec![1e9; 30], [5.0, 5.0, -1.0].repeat(9)] {
            let cloud = Cloud { values, channels: 3 };
            let ground = GroundHeight::of(&cloud, &GroundConfig::default());
            assert_eq!([ground.at(0.0, 0.0), ground.at(-300.0, 7.0)], [0.0, 0.0], "{cloud:?}");
        }
    }

    #[test]
    fn the_ground_ahead_continues_where_nothing_is_seen() {
        let mut cloud = Cloud::new(3);
        for i in 0..4000 {
            cloud.values.extend([(i % 80) as f32 - 40.0, (i / 80) as f32 - 25.0, -1.5]);
        }
        (0..3).for_each(|_| cloud.values.extend([100.0, 90.0, 3.0]));
        let ground = GroundHeight::of(&cloud, &GroundConfig::default());
        for at in [[39.0, 20.0], [70.0, 24.0], [100.0, 90.0], [-500.0, 0.0]] {
            assert!((ground.at(at[0], at[1]) + 1.5).abs() < 1e-9, "{at:?}");
        }
    }

    #[test]
    fn impossible_values_are_named() {
        assert_eq!(GroundConfig::default().check(), Ok(()));
        let wrong = |cell_m, reach_m| GroundConfig { cell_m, reach_m }.check().unwrap_err();
        assert!(wrong(0.1, 9.0).contains("cell_m") && wrong(f64::NAN, 9.0).contains("cell_m"));
        assert!(wrong(4.0, 3.0).contains("reach_m") && wrong(4.0, 1e3).contains("reach_m"));
    }
}
