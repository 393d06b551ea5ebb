//! Whether surfaces in all directions say the same of a hypothesis. A surface that stands elsewhere than the simulation
//! has it does so in all frames that show it: frames do not tell that from an error of the sensor or of the vehicle,
//! but other directions do, which show other surfaces.

use super::hypotheses::Hypothesis;
use super::sums::Sums;
use crate::channels::mean::{Compared, OWN};
use crate::inference::choice::directions_agree;
use crate::pairing::OCTANTS;
use crate::search::Context;
use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

/// Whether the directions agree on the last of some hypotheses, fitted together on some frames. True of offsets of
/// groups, which are compared by their parts, and where too few directions show the effect.
pub(super) fn agree(
    context: &Context,
    sums: &Sums,
    frames: &[usize],
    blocks: &[usize],
    hypotheses: &[Hypothesis],
) -> bool {
    let Some(Hypothesis::Linear { columns, .. }) = hypotheses.last() else { return true };
    let [gains, expected] = by_direction(context, sums, frames, blocks, (hypotheses, columns));
    directions_agree(&gains, &expected)
}

/// Gain of each direction by some columns beside all others that are fitted, and what it is expected to gain, nats.
/// What the other columns take up of the effect m is taken out of it first. With errors of variance `V = R + Z P Z'`,
/// of which P is that of the frame's own pose, the gain is `m' V^-1 (r + m / 2)` of residuals r, and `V^-1 m` is what
/// the own pose does not take up of m, over the variance R of the rays: each ray has its term of that sum.
fn by_direction(
    context: &Context,
    sums: &Sums,
    frames: &[usize],
    blocks: &[usize],
    (hypotheses, columns): (&[Hypothesis], &[usize]),
) -> [[f64; OCTANTS]; 2] {
    let fitted = sums.fit_all(frames, blocks, hypotheses);
    let p = sums.columns.len();
    let (mut theta, mut effect) = (DVector::zeros(p), DVector::zeros(p));
    for (&c, &by) in fitted.columns.iter().zip(fitted.theta.iter()) {
        theta[c] = by;
        effect[c] = if columns.contains(&c) { by } else { 0.0 };
    }
    let others: Vec<usize> = fitted.columns.iter().copied().filter(|c| !columns.contains(c)).collect();
    let gram: DMatrix<f64> = frames.iter().map(|&f| &sums.linear[f].gram).sum();
    let taken_up = sums.taken_up(&gram, &(&gram * &effect), &others);
    others.iter().zip(taken_up.iter()).for_each(|(&c, by)| effect[c] -= by);
    theta -= &sums.undone;
    let compared = Compared { rig: context.rig, columns: &sums.columns, noise_m: sums.noise_m, design: sums.design };
    let of_frame = |&f: &usize| {
        let mean = &sums.whole[f];
        let taken_up = mean.own(&sums.own_prior, &(&mean.gram * &effect));
        let mut rest = effect.clone();
        (0..OWN).for_each(|k| rest[k] -= taken_up[k]);
        let mut out = [[0.0; OCTANTS]; 2];
        compared.for_each(&context.frames[f], &sums.poses[f], &sums.moments.of_frames[f], |ray, x, y, w| {
            let by = |of: &DVector<f64>| x.iter().map(|&(k, v)| v * of[k]).sum::<f64>();
            let (moved, rest, left) = (by(&effect), by(&rest), y - by(&theta));
            let at = ray.octant();
            out[0][at] += w * rest * (0.5 * moved + left);
            out[1][at] += 0.5 * w * moved * rest;
        });
        out
    };
    let add = |a: [[f64; OCTANTS]; 2], b: [[f64; OCTANTS]; 2]| {
        [0, 1].map(|i: usize| std::array::from_fn(|k| a[i][k] + b[i][k]))
    };
    frames.par_iter().map(of_frame).reduce(Default::default, add)
}
