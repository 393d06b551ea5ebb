//! Whether surfaces in all directions say the same of a hypothesis. A surface that stands elsewhere than the simulation
//! has it does so in all frames that show it: frames do not tell that from an error of the sensor or of the vehicle,
//! but other directions do, which show other surfaces.

use super::Search;
use super::beside_rows::BesideRows;
use super::hypotheses::Hypothesis;
use super::sums::Sums;
use crate::channels::mean::{MeanFrame, OWN};
use crate::inference::choice::directions_agree;
use crate::inference::linear::LinearFit;
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
    let compared = sums.compared(context.rig);
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
    // In the order of the frames: sums must not depend on the number of threads.
    let all: Vec<[[f64; OCTANTS]; 2]> = frames.par_iter().map(of_frame).collect();
    all.into_iter().fold(Default::default(), add)
}

/// Covariance of a fit on the estimating frames by what leaving out each direction changes (jackknife): errors of the
/// surfaces in one direction are the same in all frames. Zero where fewer than three directions show a surface.
/// Offsets of rows that were fitted as well are integrated out.
pub(super) fn scatter(search: &Search, fitted: &LinearFit, rows: Option<&BesideRows>) -> DMatrix<f64> {
    let k = fitted.columns.len();
    let mut theta = DVector::zeros(search.sums.columns.len());
    fitted.columns.iter().zip(fitted.theta.iter()).for_each(|(&c, by)| theta[c] += by);
    let context = search.paired();
    let nothing = || vec![(MeanFrame::zeros(k), 0.0); OCTANTS];
    let of_frame = |&f: &usize| {
        let of_directions = in_directions(search, &context, f, (fitted, &theta), rows);
        let mut out = nothing();
        for (left_out, (sums, seen)) in out.iter_mut().enumerate() {
            let others = of_directions.iter().enumerate().filter(|(d, _)| *d != left_out);
            let mut all = MeanFrame::zeros(OWN + k);
            others.for_each(|(_, direction)| all.add(direction));
            let (gram, right) = all.without_own(&search.sums.own_prior);
            *sums = MeanFrame { gram: gram.view((OWN, OWN), (k, k)).into(), right: right.rows(OWN, k).into() };
            *seen = of_directions[left_out].gram.trace();
        }
        out
    };
    let frames: Vec<Vec<(MeanFrame, f64)>> = search.estimate.par_iter().map(of_frame).collect();
    let mut without = nothing();
    for frame in frames {
        for ((sums, seen), (more, by)) in without.iter_mut().zip(frame) {
            sums.add(&more);
            *seen += by;
        }
    }
    without.retain(|(_, seen)| *seen > 0.0);
    let n = without.len() as f64;
    let precision = |i: usize| search.sums.precision[fitted.columns[i]];
    let prior = DMatrix::from_diagonal(&DVector::from_fn(k, |i, _| precision(i)));
    let of_prior = &prior * &fitted.theta;
    let changes: Option<Vec<DVector<f64>>> =
        without.iter().map(|(sums, _)| (&sums.gram + &prior).lu().solve(&(&sums.right - &of_prior))).collect();
    let Some(changes) = changes.filter(|changes| changes.len() > 2) else { return DMatrix::zeros(k, k) };
    let middle = changes.iter().sum::<DVector<f64>>() / n;
    let squares = changes.iter().map(|change| (change - &middle) * (change - &middle).transpose());
    squares.sum::<DMatrix<f64>>() * ((n - 1.0) / n)
}

/// Sums of each direction of a frame, of what the fit leaves: by what the frame has of its own, then by the columns of
/// the fit.
fn in_directions(
    search: &Search,
    context: &Context,
    frame: usize,
    (fitted, theta): (&LinearFit, &DVector<f64>),
    rows: Option<&BesideRows>,
) -> Vec<MeanFrame> {
    let sums = &search.sums;
    let size = OWN + fitted.columns.len();
    let place: Vec<Option<usize>> =
        (0..sums.columns.len()).map(|c| fitted.columns.iter().position(|f| *f == c)).collect();
    let theta = theta - &sums.undone;
    let compared = sums.compared(context.rig);
    let mut out = vec![MeanFrame::zeros(size); OCTANTS];
    let mut levers = DVector::zeros(size);
    let (pose, moment) = (&sums.poses[frame], &sums.moments.of_frames[frame]);
    compared.for_each(&context.frames[frame], pose, moment, |ray, x, y, w| {
        levers.fill(0.0);
        for &(c, v) in x {
            if c < OWN {
                levers[c] = v;
            }
            place[c].into_iter().for_each(|i| levers[OWN + i] = v);
        }
        let by_columns: f64 = x.iter().map(|&(c, v)| v * theta[c]).sum();
        let by_row = rows.map_or(0.0, |rows| rows.add_response(ray, &mut levers.rows_mut(OWN, size - OWN)));
        let direction = &mut out[ray.octant()];
        direction.gram.ger(w, &levers, &levers, 1.0);
        direction.right.axpy(w * (y - by_columns - by_row), &levers, 1.0);
    });
    out
}
