//! Counts of returns with and without a counterpart on the other side, by direction.

use super::cells::{CELLS, Place, cell};
use super::groups::{Group, GroupSums, Grouping, PARTS, PartedFrame, group_of, part_of};
use super::mask::Mask;
use crate::pairing::{FramePair, Ray};
use rayon::prelude::*;
use sensor::Rig;

/// Counts of one cell of one frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct HitCell {
    /// Simulated returns.
    pub simulated: Place,
    /// Measured returns.
    pub measured: Place,
    /// Those of either with a return of the other side in their direction.
    pub matched: f64,
}

impl HitCell {
    /// Counts a shot.
    fn add(&mut self, [simulated, measured]: Sides, ray: &Ray) {
        if simulated {
            self.simulated.add(ray);
        }
        if measured {
            self.measured.add(ray);
        }
        self.matched += f64::from(u8::from(simulated && measured));
    }

    /// Adds another count.
    pub fn merge(&mut self, other: &HitCell) {
        self.simulated.merge(&other.simulated);
        self.measured.merge(&other.measured);
        self.matched += other.matched;
    }
}

/// Cells of one frame: those that hold something, by number.
pub type HitFrame = Vec<(u32, HitCell)>;

/// Whether a shot has a return on the simulated and on the measured side.
pub type Sides = [bool; 2];

/// Variance of a number of lost returns in units of that of independent ones: neighbours are lost together.
pub const TOGETHER: f64 = 2.0;

/// Every shot with a return, once: where both sides have one, the simulated one stands for both. Its surface is that of
/// its neighbours without itself, as for a shot that only one side has; the measured one would see its counterpart as
/// well, and more often a surface where the returns are few.
pub fn counted(frame: &FramePair) -> impl Iterator<Item = (Sides, &Ray)> {
    let simulated = frame.simulated.iter().map(|r| ([true, r.matched], r));
    let only_measured = frame.only_measured.iter().map(|r| ([false, true], r));
    simulated.chain(only_measured)
}

/// The cells of every frame; hidden rays are left out.
pub fn hit_frames(frames: &[FramePair], mask: &Mask) -> Vec<HitFrame> {
    let one = |frame: &FramePair| -> HitFrame {
        let mut cells = vec![HitCell::default(); CELLS];
        for (sides, ray) in counted(frame) {
            if let Some(c) = cell(ray).filter(|_| !mask.hides(ray)) {
                cells[c].add(sides, ray);
            }
        }
        let held = |c: &HitCell| c.measured.n + c.simulated.n > 0.0;
        cells.into_iter().enumerate().filter(|(_, c)| held(c)).map(|(i, c)| (i as u32, c)).collect()
    };
    frames.par_iter().map(one).collect()
}

/// Sums over frames.
pub fn total<'a>(frames: impl Iterator<Item = &'a HitFrame>) -> Vec<HitCell> {
    let mut sum = vec![HitCell::default(); CELLS];
    for (i, cell) in frames.flatten() {
        sum[*i as usize].merge(cell);
    }
    sum
}

/// Shares of returns that groups of directions lose beyond the share that `kept` gives for each cell, as sums of
/// every frame.
pub fn loss_groups(
    frames: &[FramePair],
    rig: &Rig,
    mask: &Mask,
    grouping: Grouping,
    kept: &(dyn Fn(usize) -> f64 + Sync),
) -> Vec<PartedFrame> {
    let half_fov: Vec<f64> = rig.sensors.iter().map(|s| s.half_fov_rad()).collect();
    let one = |frame: &FramePair| -> PartedFrame {
        // Simulated returns; returns of the simulated and of the measured side without a counterpart; expected losses.
        let mut sums = std::collections::BTreeMap::<(Group, usize), [f64; 4]>::new();
        for (sides, ray) in counted(frame) {
            let (Some(c), Some(g)) = (cell(ray), group_of(ray, grouping)) else { continue };
            if mask.hides(ray) {
                continue;
            }
            let part = part_of(ray, grouping, half_fov[ray.sensor as usize]);
            let [n, alone, odd, lost] = sums.entry((g, part)).or_default();
            match sides {
                [true, measured] => {
                    *n += 1.0;
                    *alone += f64::from(u8::from(!measured));
                    *lost += 1.0 - kept(c);
                }
                [false, _] => *odd += 1.0,
            }
        }
        let mut out: PartedFrame = [const { Vec::new() }; PARTS];
        for ((g, part), [n, alone, odd, lost]) in sums.into_iter().filter(|(_, [n, ..])| *n >= 5.0) {
            let w = n * n / (TOGETHER * (alone + odd + 2.0));
            // The numbers of returns of the two sides differ by as many as the numbers without a counterpart, whatever
            // the matching misses.
            let y = (alone - odd - lost) / n;
            out[part].push((g, GroupSums { gram: [w, 0.0, 0.0], right: [w * y, 0.0], n, weight: w }));
        }
        out
    };
    frames.par_iter().map(one).collect()
}
