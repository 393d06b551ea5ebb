//! Which returns have a counterpart on the other side, by direction.

use super::cells::{CELLS, Place, cell};
use crate::pairing::FramePair;
use rayon::prelude::*;

/// Counts of one cell of one frame.
#[derive(Clone, Copy, Debug, Default)]
pub struct HitCell {
    /// Simulated returns.
    pub simulated: Place,
    /// Those of them with a measured return in their direction.
    pub simulated_matched: f64,
    /// Measured returns.
    pub measured: Place,
    /// Those of them with a simulated return in their direction.
    pub measured_matched: f64,
}

impl HitCell {
    /// Adds another count.
    pub fn merge(&mut self, other: &HitCell) {
        self.simulated.merge(&other.simulated);
        self.measured.merge(&other.measured);
        self.simulated_matched += other.simulated_matched;
        self.measured_matched += other.measured_matched;
    }
}

/// Cells of one frame: those that hold something, by number.
pub type HitFrame = Vec<(u32, HitCell)>;

/// The cells of every frame.
pub fn hit_frames(frames: &[FramePair]) -> Vec<HitFrame> {
    let one = |frame: &FramePair| -> HitFrame {
        let mut cells = vec![HitCell::default(); CELLS];
        for ray in &frame.simulated {
            if let Some(c) = cell(ray) {
                cells[c].simulated.add(ray);
                cells[c].simulated_matched += f64::from(u8::from(ray.matched));
            }
        }
        for ray in &frame.measured {
            if let Some(c) = cell(ray) {
                cells[c].measured.add(ray);
                cells[c].measured_matched += f64::from(u8::from(ray.matched));
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
