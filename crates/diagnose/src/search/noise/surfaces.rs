//! Whether added noise is the same on the ground and on standing surfaces: that of a sensor is, rough surfaces are not.

use super::{Search, Term};
use crate::channels::cells::zone_of;
use crate::channels::roughness::RoughFrame;
use crate::inference::noise::{NoiseLaw, NoiseTable};
use crate::search::REPETITIONS;
use nalgebra::DVector;
use statistics::{blocks_of, draw_blocks, interval_nearest};

/// Excess of the measured variance on one kind of surface, in units of what laws say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceShare {
    /// 1 where the laws hold.
    pub ratio: f64,
    /// From a bootstrap over blocks of frames.
    pub ci95: [f64; 2],
}

/// Weighted products of the laws' variance with the measured excess, and with themselves, by zone.
type Sums = [[f64; 2]; 2];

impl Search<'_> {
    /// The excess on the ground and on standing surfaces; `None` of a kind without enough returns.
    pub(super) fn by_surface(&self, laws: &[Term]) -> [Option<SurfaceShare>; 2] {
        let every: Vec<usize> = (0..self.rough.len()).collect();
        let table = self.table(&every);
        let sums: Vec<Sums> =
            self.rough.iter().map(|frame| [0, 1].map(|zone| of_zone(&table, frame, zone, laws))).collect();
        let ratio = |zone: usize, frames: &[usize]| {
            let [excess, expected] =
                frames.iter().fold([0.0; 2], |s, &i| [0, 1].map(|k: usize| s[k] + sums[i][zone][k]));
            (expected > 0.0).then(|| excess / expected)
        };
        let members = blocks_of(&self.context.blocks(&every));
        [0, 1].map(|zone| {
            let mut rng = data::stream(0, "diagnose surfaces", zone as u64, 0);
            let drawn = (0..REPETITIONS).filter_map(|_| ratio(zone, &draw_blocks(&members, &mut rng)));
            Some(SurfaceShare { ratio: ratio(zone, &every)?, ci95: interval_nearest(drawn.collect())? })
        })
    }
}

/// The sums of one zone of a frame.
fn of_zone(table: &NoiseTable, frame: &RoughFrame, zone: usize, laws: &[Term]) -> [f64; 2] {
    let cells: RoughFrame = frame.iter().filter(|(cell, _)| zone_of(*cell as usize) == zone).copied().collect();
    let (forms, theta): (Vec<NoiseLaw>, Vec<f64>) = laws.iter().copied().unzip();
    let (linear, theta) = (table.linear(&cells, &forms), DVector::from_vec(theta));
    [theta.dot(&linear.right), theta.dot(&(&linear.gram * &theta))]
}
