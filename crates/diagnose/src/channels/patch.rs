//! Patches of directions of a sensor with more losses than the same surfaces elsewhere, as by dirt on a window.

use super::cells::cell;
use super::mask::{AZIMUTH_RAD, DirectionCell, ELEVATION_RAD, Mask, SIDES, direction_cell, neighbours, take_together};
use crate::pairing::FramePair;
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};

/// Returns in a direction: simulated and measured ones, simulated ones that the usual losses leave, and the excess of
/// those without a counterpart over the usual number for such surfaces.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Losses {
    simulated: f64,
    left: f64,
    alone: f64,
    measured: f64,
    odd: f64,
}

impl Losses {
    /// Adds another sum.
    pub fn add(&mut self, other: &Losses) {
        self.simulated += other.simulated;
        self.left += other.left;
        self.alone += other.alone;
        self.measured += other.measured;
        self.odd += other.odd;
    }

    /// So many losses of simulated returns, with every return that is measured in its place.
    #[cfg(test)]
    pub fn of(simulated: f64, lost: f64) -> Losses {
        Losses { simulated, left: simulated, alone: lost, measured: simulated - lost, odd: 0.0 }
    }

    /// Simulated returns that the usual losses leave.
    pub fn left(&self) -> f64 {
        self.left
    }

    /// Losses beyond the usual ones. One-to-one matching leaves as many returns without a counterpart on both sides.
    pub fn lost(&self) -> f64 {
        self.alone - self.odd * self.simulated / self.measured.max(1.0)
    }

    /// The same as a share of what the usual losses leave.
    pub fn share(&self) -> f64 {
        self.lost() / self.left.max(1.0)
    }
}

/// Losses by direction.
pub type DirectionLosses = BTreeMap<DirectionCell, Losses>;

/// Sums over some frames. `usual` holds for each cell of covariates the shares of simulated and of measured returns
/// without a counterpart. Objects are left out: they are more frequent in some directions.
pub fn direction_losses(frames: &[FramePair], which: &[usize], mask: &Mask, usual: &[[f64; 2]]) -> DirectionLosses {
    let one = |i: &usize| {
        let mut sums = DirectionLosses::new();
        for (side, rays) in frames[*i].for_losses().into_iter().enumerate() {
            for ray in rays.into_iter().filter(|r| r.object == u16::MAX && !mask.hides(r)) {
                let Some(c) = cell(ray) else { continue };
                let sum = sums.entry(direction_cell(ray)).or_default();
                let alone = f64::from(u8::from(!ray.matched)) - usual[c][side];
                if side == 0 {
                    sum.simulated += 1.0;
                    sum.left += 1.0 - usual[c][side];
                    sum.alone += alone;
                } else {
                    sum.measured += 1.0;
                    sum.odd += alone;
                }
            }
        }
        sums
    };
    let merge = |mut a: DirectionLosses, b: DirectionLosses| {
        b.iter().for_each(|(k, v)| a.entry(*k).or_default().add(v));
        a
    };
    // In the order of the frames: sums must not depend on the number of threads.
    let all: Vec<DirectionLosses> = which.par_iter().map(one).collect();
    all.into_iter().fold(DirectionLosses::new(), merge)
}

/// Sum over some cells.
fn sum(losses: &DirectionLosses, cells: impl IntoIterator<Item = DirectionCell>) -> Losses {
    total(cells.into_iter().filter_map(|c| losses.get(&c)))
}

/// Sum of losses.
pub fn total<'a>(losses: impl Iterator<Item = &'a Losses>) -> Losses {
    losses.fold(Losses::default(), |mut all, l| {
        all.add(l);
        all
    })
}

/// Thresholds of the excess loss for connected cells, in the order in which they are tried.
const SHARES: [f64; 6] = [0.06, 0.09, 0.13, 0.19, 0.27, 0.4];

/// Fewest returns of a share.
const FEWEST: f64 = 40.0;

/// Fewest cells of a patch.
const FEWEST_CELLS: usize = 4;

/// Largest width and height of a patch, rad.
pub(super) const LARGEST_RAD: [f64; 2] = [1.0, 0.35];

/// Largest loss beside a patch, as a share of its own.
const AROUND: f64 = 0.35;

/// Directions with more losses than those around them.
#[derive(Clone, Debug, PartialEq)]
pub struct Patch {
    /// Cells with more than half of the loss in the middle.
    pub cells: BTreeSet<DirectionCell>,
}

impl Patch {
    /// Its sensor.
    pub fn sensor(&self) -> u8 {
        self.cells.first().map_or(0, |c| c.0)
    }

    /// Sum over its cells.
    pub fn sum(&self, losses: &DirectionLosses) -> Losses {
        sum(losses, self.cells.iter().copied())
    }
}

/// Patches, the one with the most losses first.
pub fn patches(losses: &DirectionLosses) -> Vec<Patch> {
    let known = losses.keys().map(|c| (*c, sum(losses, neighbours(*c)))).filter(|(_, l)| l.left >= FEWEST);
    let shares: BTreeMap<DirectionCell, f64> = known.map(|(c, l)| (c, l.share())).collect();
    let mut found: Vec<Patch> = Vec::new();
    // Cells without returns between two rows do not part a patch.
    let beside = |cell, side| next(losses, cell, side);
    for share in SHARES {
        let mut high: BTreeSet<DirectionCell> = shares.iter().filter(|(_, s)| **s > share).map(|(c, _)| *c).collect();
        while let Some(first) = high.first().copied() {
            let cells = take_together(&mut high, first, beside);
            let Some(middle) = cells.iter().max_by(|a, b| shares[a].total_cmp(&shares[b])) else { continue };
            let new = found.iter().all(|f| f.cells.is_disjoint(&cells));
            if new && shares[middle] > 1.5 * share && stands_alone(losses, &cells) {
                // Cells beside it with small losses do not belong to it.
                let half = 0.5 * shares[middle];
                let mut more: BTreeSet<DirectionCell> = cells.iter().filter(|c| shares[c] > half).copied().collect();
                let cells = take_together(&mut more, *middle, beside);
                if cells.len() >= FEWEST_CELLS {
                    found.push(Patch { cells });
                }
            }
        }
    }
    found.sort_by(|a, b| b.sum(losses).lost().total_cmp(&a.sum(losses).lost()));
    found
}

/// Cells without any return that may lie between two rows of a sensor with few rows.
const BETWEEN_ROWS: i32 = 4;

/// The next cell on one side that has returns, across cells between two rows.
fn next(losses: &DirectionLosses, (s, az, el): DirectionCell, (a, e): (i32, i32)) -> Option<DirectionCell> {
    let reach = if e == 0 { 1 } else { BETWEEN_ROWS };
    (1..=reach).map(|k| (s, az + k * a, el + k * e)).find(|c| losses.contains_key(c))
}

/// Whether losses are small on all sides of a patch. Below it the field of view may end, or what is near be cut off, so
/// that too few returns are left to tell; not above, where scenes end.
fn stands_alone(losses: &DirectionLosses, patch: &BTreeSet<DirectionCell>) -> bool {
    let span = |f: fn(&DirectionCell) -> i32, step: f64| {
        let [low, high] = [patch.iter().map(f).min(), patch.iter().map(f).max()].map(Option::unwrap_or_default);
        f64::from(high - low + 1) * step
    };
    let small = span(|c| c.1, AZIMUTH_RAD) <= LARGEST_RAD[0] && span(|c| c.2, ELEVATION_RAD) <= LARGEST_RAD[1];
    if patch.len() < FEWEST_CELLS || !small {
        return false;
    }
    let own = sum(losses, patch.iter().copied()).share();
    // The next cell may belong to it in part: the two after it count.
    let beside = |a: i32, e: i32| {
        let ring: BTreeSet<DirectionCell> = patch
            .iter()
            .flat_map(|&(s, az, el)| (2..4).map(move |k| (s, az + k * a, el + k * e)))
            .filter(|c| !patch.contains(c))
            .collect();
        sum(losses, ring)
    };
    let open = |l: &Losses| l.left >= FEWEST && l.share() < AROUND * own;
    let [left, right, up, down] = SIDES.map(|(a, e)| beside(a, e));
    open(&left) && open(&right) && open(&up) && (open(&down) || down.left < FEWEST)
}

#[cfg(test)]
pub(super) mod testing {
    use super::*;

    /// A field of view with 100 returns in each cell; `lost` gives the loss.
    pub fn field(lost: impl Fn(&DirectionCell) -> f64) -> DirectionLosses {
        let cells = (-30..30).flat_map(|az| (-12..6).map(move |el| (0, az, el)));
        cells.map(|c: DirectionCell| (c, Losses::of(100.0, 100.0 * lost(&c)))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::testing::field;
    use super::*;

    #[test]
    fn a_band_a_side_and_nothing_are_no_patches() {
        assert!(patches(&field(|c| if (-2..2).contains(&c.2) { 0.4 } else { 0.0 })).is_empty(), "a band");
        assert!(patches(&field(|c| if c.1 < -23 { 0.4 } else { 0.0 })).is_empty(), "a side");
        assert!(patches(&field(|_| 0.02)).is_empty(), "nothing");
    }
}
