//! The opacity of surfels: shots of the recording that ended at them against shots that went through.

use super::{SeenShot, SurfelMap};
use nalgebra::Vector3;
use rayon::prelude::*;
use std::sync::atomic::{AtomicU32, Ordering};

/// Counts are integers, so that their sums depend on no order; a shot through the centre of a surfel is this much.
const UNIT: f32 = 256.0;

/// Shots that are added to both counts.
const PRIOR: f32 = 0.3;

/// Depth of a surfel that lies on no plane, m.
const ROUGH_DEPTH_M: f32 = 0.1;

/// How far behind the end of a shot surfels are looked at, m: they may be before it by their depth.
const BEHIND_M: f32 = super::GRAZING.1;

/// Weight of a shot that meets a surfel at a squared distance `off` from its centre, in half axes.
pub(super) fn kernel(off: f32) -> f32 {
    (1.0 - off) * (1.0 - off)
}

/// -ln(1 - opacity) of each surfel; `None` without shots.
pub(super) fn density(map: &SurfelMap, shots: impl IntoIterator<Item = Vec<SeenShot>>) -> Option<Vec<f32>> {
    let zeros = || (0..map.surfels.len()).map(|_| AtomicU32::new(0)).collect::<Vec<_>>();
    let (ended, passed) = (zeros(), zeros());
    let mut any = false;
    for frame in shots {
        any |= !frame.is_empty();
        frame.par_iter().with_min_len(512).for_each(|shot| {
            let along = Vector3::from(shot.direction);
            let far = shot.range_m + BEHIND_M;
            map.tree.through(shot.origin, shot.direction, far, |id, range_m, off| {
                let rough = if map.surfels[id as usize].is_smooth() { 0.0 } else { ROUGH_DEPTH_M };
                let count = (UNIT * kernel(off)) as u32;
                if (range_m - shot.range_m).abs() <= map.depth(id, &along).max(rough) {
                    ended[id as usize].fetch_add(count, Ordering::Relaxed);
                } else if range_m < shot.range_m {
                    passed[id as usize].fetch_add(count, Ordering::Relaxed);
                }
                far
            });
        });
    }
    let of = |counts: &[AtomicU32], i: usize| counts[i].load(Ordering::Relaxed) as f32 / UNIT + PRIOR;
    any.then(|| (0..ended.len()).map(|i| -(of(&passed, i) / (of(&ended, i) + of(&passed, i))).ln()).collect())
}
