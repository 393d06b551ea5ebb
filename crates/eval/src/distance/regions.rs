//! Which part of the Chamfer distance comes from which region.

use super::Nearest;
use data::Frame;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Regions of a frame: their names, and which one a point belongs to (m, LiDAR frame), an index into the names.
pub struct Regions<'a> {
    /// For tables.
    pub names: Vec<String>,
    /// The region of a point.
    #[expect(clippy::type_complexity, reason = "one closure, said once")]
    pub of: Box<dyn Fn(&Frame, [f32; 3]) -> usize + Sync + 'a>,
}

/// What one region contributes to the Chamfer sum, over all frames.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RegionRow {
    /// Its name.
    pub region: String,
    /// Points of A in it.
    pub points_a: u64,
    /// Points of B in it.
    pub points_b: u64,
    /// Sum of the squared distances of A's points in it to the nearest of B, m2.
    pub a_to_b_m2: f64,
    /// Of B's points in it to the nearest of A, m2.
    pub b_to_a_m2: f64,
    /// Its share of the Chamfer sum, 0 to 1.
    pub share: f64,
}

/// Points and sums of each region, while frames are added.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct RegionSums(Vec<[(u64, f64); 2]>);

impl RegionSums {
    /// Of one frame. `sides` are A and B: region and nearest point of each point.
    pub fn new(n_regions: usize, sides: [(&[usize], &[Nearest]); 2]) -> Self {
        let mut sums = vec![[(0, 0.0); 2]; n_regions];
        for (side, (regions, nearest)) in sides.into_iter().enumerate() {
            for (region, nearest) in regions.iter().zip(nearest) {
                // A region that the closure does not know is the last one's business: nothing is left out.
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
