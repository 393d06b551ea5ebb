//! Contribution of each region to the Chamfer distance.

use super::{Nearest, Point};
use data::Frame;
use geometry::points_in_boxes;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;

/// A division of a frame into regions: their names, and the region index of each point (m, LiDAR frame).
pub struct Regions<'a> {
    /// Names, used in tables.
    pub names: Vec<String>,
    /// Returns the region index of each point of a frame's cloud.
    #[expect(clippy::type_complexity, reason = "one closure, used once")]
    pub of: Box<dyn Fn(&Frame, &[Point]) -> Vec<usize> + Sync + 'a>,
}

/// Maximum height above the lowest point of the same square metre at which a point counts as ground, m.
const GROUND_M: f32 = 0.4;
/// Number of azimuth bins for the wall search.
const DIRECTIONS: usize = 360;
/// Number of points above ground within [`WALL_M`] of range that count as a wall; fewer may be stray returns.
const WALL_POINTS: usize = 3;
/// Depth of a wall behind its nearest point, m.
const WALL_M: f32 = 2.0;

impl Regions<'static> {
    /// Regions for any labelled cloud: targets, ground, and points above ground up to the first wall in their azimuth
    /// bin or behind it. Every point belongs to exactly one region.
    ///
    /// A wall is the nearest group of at least three points above ground within 2 m of range in an azimuth bin of one
    /// degree, targets excluded.
    pub fn of_scenery() -> Self {
        let names = [
            "targets".to_string(),
            format!("ground (lowest {GROUND_M} m of a m²)"),
            format!("scenery up to the wall (the first that rises in a direction, and {WALL_M} m)"),
            "scenery behind the wall".to_string(),
        ];
        Regions { names: names.into(), of: Box::new(scenery) }
    }
}

fn scenery(frame: &Frame, points: &[Point]) -> Vec<usize> {
    let cell = |p: &Point| (p[0].floor() as i32, p[1].floor() as i32);
    let mut lowest: HashMap<(i32, i32), f32> = HashMap::new();
    for p in points {
        let z = lowest.entry(cell(p)).or_insert(f32::INFINITY);
        *z = z.min(p[2]);
    }
    let boxes: Vec<_> = frame.objects.iter().map(|object| object.bbox).collect();
    let flat: Vec<f32> = points.iter().flatten().copied().collect();
    let rises = |p: &Point| p[2] > lowest[&cell(p)] + GROUND_M;
    let mut regions: Vec<usize> = points.iter().map(|p| if rises(p) { 2 } else { 1 }).collect();
    points_in_boxes(&flat, 3, &boxes, 0.0).into_iter().flatten().for_each(|i| regions[i as usize] = 0);

    let risen = || points.iter().zip(&regions).filter(|(_, region)| **region == 2).map(|(p, _)| p);
    let walls_m = walls_m(risen());
    for (region, p) in regions.iter_mut().zip(points).filter(|(region, _)| **region == 2) {
        *region += usize::from(range_m(p) > walls_m[direction(p)] + WALL_M);
    }
    regions
}

/// Range of the wall in each azimuth bin; infinite without a wall.
fn walls_m<'a>(risen: impl Iterator<Item = &'a Point>) -> Vec<f32> {
    let mut ranges_m = vec![Vec::new(); DIRECTIONS];
    risen.for_each(|p| ranges_m[direction(p)].push(range_m(p)));
    let nearest = |ranges_m: &mut Vec<f32>| {
        ranges_m.sort_unstable_by(f32::total_cmp);
        let wall = ranges_m.windows(WALL_POINTS).find(|near| near[WALL_POINTS - 1] - near[0] <= WALL_M);
        wall.map_or(f32::INFINITY, |near| near[0])
    };
    ranges_m.iter_mut().map(nearest).collect()
}

fn direction(p: &Point) -> usize {
    let turn = p[1].atan2(p[0]) / std::f32::consts::TAU + 0.5;
    ((turn * DIRECTIONS as f32) as usize).min(DIRECTIONS - 1)
}

fn range_m(p: &Point) -> f32 {
    p[0].hypot(p[1])
}

/// Contribution of one region to the Chamfer sum, over all frames.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RegionRow {
    /// Its name.
    pub region: String,
    /// Points of A in it.
    pub points_a: u64,
    /// Points of B in it.
    pub points_b: u64,
    /// Sum of the squared distances of A's points in the region to their nearest neighbours in B, m2.
    pub a_to_b_m2: f64,
    /// Same for B's points to their nearest neighbours in A, m2.
    pub b_to_a_m2: f64,
    /// Fraction of the Chamfer sum, 0 to 1. The fractions of all regions add up to 1.
    pub share: f64,
}

/// Accumulated points and sums of each region.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct RegionSums(Vec<[(u64, f64); 2]>);

impl RegionSums {
    /// Sums of one frame. `sides` are A and B: region and nearest neighbour of each point.
    pub fn new(n_regions: usize, sides: [(&[usize], &[Nearest]); 2]) -> Self {
        let mut sums = vec![[(0, 0.0); 2]; n_regions];
        for (side, (regions, nearest)) in sides.into_iter().enumerate() {
            for (region, nearest) in regions.iter().zip(nearest) {
                // An out-of-range region index is counted in the last region, so that no point is lost.
                let sum = &mut sums[(*region).min(n_regions - 1)][side];
                *sum = (sum.0 + 1, sum.1 + f64::from(nearest.squared_m2));
            }
        }
        RegionSums(sums)
    }

    pub fn add(&mut self, other: &RegionSums) {
        if self.0.is_empty() {
            self.0 = vec![[(0, 0.0); 2]; other.0.len()];
        }
        for (sum, more) in self.0.iter_mut().flatten().zip(other.0.iter().flatten()) {
            *sum = (sum.0 + more.0, sum.1 + more.1);
        }
    }

    pub fn rows(&self, names: &[String]) -> Vec<RegionRow> {
        let all: f64 = self.0.iter().flatten().map(|(_, sum)| sum).sum();
        let row = |(name, [a, b]): (&String, &[(u64, f64); 2])| RegionRow {
            region: name.clone(),
            points_a: a.0,
            points_b: b.0,
            a_to_b_m2: a.1,
            b_to_a_m2: b.1,
            share: if all > 0.0 { (a.1 + b.1) / all } else { 0.0 },
        };
        names.iter().zip(&self.0).map(row).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use data::{Cloud, Object};
    use geometry::Box3;

    #[test]
    fn every_point_has_its_region() {
        let car = Box3::from_array([10.0, 4.0, 0.75, 4.5, 1.9, 1.1, 0.0]);
        let object = Object { class: "Car".into(), bbox: car, truncation: None, occlusion: None, image_box: None };
        let frame = Frame { id: "0".into(), cloud: Cloud::new(3), objects: vec![object] };
        let mut points: Vec<(Point, usize)> = vec![([5.0, 0.5, 0.0], 1), ([10.0, 4.0, 0.8], 0), ([5.5, 0.5, 0.3], 1)];
        for i in 0..100 {
            let y = -4.95 + 0.1 * i as f32;
            // A wall at 20 m with ground in front of it, a fence on top that leans back, and a grandstand behind.
            points.extend([([20.2, y, 0.0], 1), ([20.4, y, 0.9], 2), ([21.4, y, 0.0], 1), ([21.4, y, 2.5], 2)]);
            points.extend([([50.5, y, 1.0], 1), ([50.5, y, 6.0], 3)]);
        }
        // A single stray return in the air is no wall, and without a wall there is no region behind it.
        points.extend([([8.5, -1.5, 0.0], 1), ([8.5, -1.5, 1.5], 2), ([-60.5, 0.5, 0.0], 1), ([-60.5, 0.5, 3.0], 2)]);
        let positions: Vec<Point> = points.iter().map(|(p, _)| *p).collect();
        for ((p, want), found) in points.iter().zip(scenery(&frame, &positions)) {
            assert_eq!(found, *want, "{p:?}");
        }
    }
}
