//! The free path of shots: lone returns in front of surfaces, and how far shots are free to return from there.
//!
//! A shot whose surface lies at range R returns from r < R with the density `rate * f(r)`. The counts of a bin of
//! ranges are Poisson numbers with the mean `rate * f * (metres of free shots in the bin)`.

use super::returns::{NEAREST_M, Odd, free_until_m, is_lone_before, margin_m, odd};
use crate::pairing::{FramePair, Lies};

/// Ratio of the ends of a bin.
const STEP: f64 = 1.25;

/// One bin of ranges.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bin {
    /// Ends, m.
    pub ends_m: [f64; 2],
    /// Lone measured returns.
    pub measured: f64,
    /// Lone simulated returns, for as many shots.
    pub simulated: f64,
    /// Metres of shots without a surface, over all shots.
    pub free_m: f64,
    /// The same in parts of the free path of each shot.
    pub of_path: f64,
    /// Lone returns behind smooth surfaces, of the measured side and of the simulated one for as many shots.
    pub behind: [f64; 2],
    /// Metres of shots behind smooth surfaces, over all shots.
    pub behind_m: f64,
}

/// Measured returns for each simulated one.
pub fn scale(frame: &FramePair) -> f64 {
    frame.measured.len() as f64 / frame.simulated.len().max(1) as f64
}

/// Bins up to `end_m` over some frames; `leave_out` says which returns do not count: by frame, side (0 measured) and
/// place.
pub fn bins(frames: &[&FramePair], end_m: f64, leave_out: &dyn Fn(usize, usize, usize) -> bool) -> Vec<Bin> {
    let number = ((end_m / NEAREST_M).max(1.0).ln() / STEP.ln()).ceil().max(1.0) as usize;
    let end = |k: usize| if k == number { end_m } else { NEAREST_M * STEP.powi(k as i32) };
    let empty = |k: usize| Bin { ends_m: [end(k), end(k + 1)], ..Bin::default() };
    let mut bins: Vec<Bin> = (0..number).map(empty).collect();
    let of = |range_m: f64| {
        let inside = (NEAREST_M..end_m).contains(&range_m);
        inside.then(|| (((range_m / NEAREST_M).ln() / STEP.ln()) as usize).min(number - 1))
    };
    // Shots that are free up to somewhere in the bin: their number, how far they are, and one over that.
    let mut last = vec![[0.0f64; 3]; number];
    // Shots whose surface lies in the bin: their number, and from where on they are behind it.
    let mut first = vec![[0.0f64; 2]; number];
    for (f, frame) in frames.iter().enumerate() {
        for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
            let counts = if side == 0 { 1.0 } else { scale(frame) };
            for (i, ray) in rays.iter().enumerate() {
                let Some(k) = of(ray.own_range_m()).filter(|_| !leave_out(f, side, i)) else { continue };
                let bin = &mut bins[k];
                match side {
                    _ if ray.lies() == Lies::Behind && odd(ray) == Some(Odd::Alone) => bin.behind[side] += counts,
                    _ if !is_lone_before(ray) => (),
                    0 => bin.measured += counts,
                    _ => bin.simulated += counts,
                }
            }
        }
        let all = last.last_mut().expect("at least one bin");
        *all = [all[0] + frame.open, all[1] + frame.open * end_m, all[2] + frame.open / end_m];
        for ray in frame.simulated.iter().filter(|r| r.smooth) {
            let free_m = free_until_m(ray).min(end_m - 1e-6);
            if let Some(k) = of(free_m) {
                last[k] = [last[k][0] + 1.0, last[k][1] + free_m, last[k][2] + 1.0 / free_m];
            }
            let behind_m = ray.own_range_m() + margin_m(ray);
            if let Some(k) = of(behind_m) {
                first[k] = [first[k][0] + 1.0, first[k][1] + behind_m];
            }
        }
    }
    let mut nearer = 0.0;
    for (bin, [shots, from_m]) in bins.iter_mut().zip(&first) {
        let [from, to] = bin.ends_m;
        bin.behind_m = nearer * (to - from) + (shots * to - from_m);
        nearer += shots;
    }
    let mut beyond = [0.0; 2];
    for (bin, [shots, until_m, inverse]) in bins.iter_mut().zip(&last).rev() {
        let [from, to] = bin.ends_m;
        bin.free_m = beyond[0] * (to - from) + (until_m - shots * from);
        bin.of_path = beyond[1] * (to - from) + (shots - inverse * from);
        beyond = [beyond[0] + shots, beyond[1] + inverse];
    }
    bins
}
