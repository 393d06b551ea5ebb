//! Whether added noise is the same on the ground and on standing surfaces: that of a sensor is, rough surfaces are not.

use super::Term;
use crate::channels::cells::zone_of;
use crate::channels::roughness::{RoughFrame, rough_frames, scales, total};
use crate::inference::noise::NoiseTable;
use crate::search::{Context, REPETITIONS};
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

/// The excess on the ground and on standing surfaces; `None` of a kind without enough returns.
pub fn by_surface(context: &Context, laws: &[Term]) -> [Option<SurfaceShare>; 2] {
    let rough = rough_frames(context.frames, &scales(context.frames));
    let table = NoiseTable::new(total(rough.iter()), 0.0);
    let sums: Vec<Sums> = rough.iter().map(|frame| of_frame(&table, frame, laws)).collect();
    let every: Vec<usize> = (0..sums.len()).collect();
    let ratio = |zone: usize, frames: &[usize]| {
        let [excess, expected] = frames.iter().fold([0.0; 2], |s, &i| [0, 1].map(|k: usize| s[k] + sums[i][zone][k]));
        (expected > 0.0).then(|| excess / expected)
    };
    let members = blocks_of(&context.blocks(&every));
    [0, 1].map(|zone| {
        let mut rng = data::stream(0, "diagnose surfaces", zone as u64, 0);
        let drawn = (0..REPETITIONS).filter_map(|_| ratio(zone, &draw_blocks(&members, &mut rng)));
        Some(SurfaceShare { ratio: ratio(zone, &every)?, ci95: interval_nearest(drawn.collect())? })
    })
}

fn of_frame(table: &NoiseTable, frame: &RoughFrame, laws: &[Term]) -> Sums {
    let mut sums = Sums::default();
    for (cell, held) in frame {
        let zone = zone_of(*cell as usize);
        let (Some([va, vb]), Some(sum)) = (table.variances(*cell as usize), sums.get_mut(zone)) else { continue };
        let (na, nb) = (held.measured.n, held.simulated.n);
        if na < 3.0 || nb < 3.0 {
            continue;
        }
        let [ya, yb] = held.variances();
        let (range_m, cos) = held.measured.mean();
        let expected: f64 = laws.iter().map(|(law, theta)| theta * law.variance(range_m, cos)).sum();
        let weight = 1.0 / (2.0 * va * va / na + 2.0 * vb * vb / nb);
        *sum = [sum[0] + weight * expected * (ya - yb), sum[1] + weight * expected * expected];
    }
    sums
}
