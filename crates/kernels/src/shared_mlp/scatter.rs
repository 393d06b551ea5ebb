//! Scatter-add of rows: the gradient of a gather.

use crate::output::{Shared, fill};
use crate::simd::vectorized;
use rayon::prelude::*;

/// Destination rows a task.
const PLACES: usize = 64;

/// For each of `places` destinations the sum of the rows with that `source`, in their order. `out`, `[places,
/// channels]`, is overwritten.
pub(super) fn add_up(rows: &[f32], source: &[u32], places: usize, channels: usize, out: &mut Vec<f32>) {
    // The rows sorted by destination.
    let mut begin = vec![0usize; places + 1];
    for &place in source {
        begin[place as usize + 1] += 1;
    }
    for place in 0..places {
        begin[place + 1] += begin[place];
    }
    let mut next = begin.clone();
    let mut sorted = vec![0u32; source.len()];
    for (row, &place) in source.iter().enumerate() {
        sorted[next[place as usize]] = row as u32;
        next[place as usize] += 1;
    }
    let sum_of = |place: usize, sum: &mut [f32]| {
        sum.fill(0.0);
        for &row in &sorted[begin[place]..begin[place + 1]] {
            for (sum, value) in sum.iter_mut().zip(&rows[row as usize * channels..][..channels]) {
                *sum += value;
            }
        }
    };
    // SAFETY: the tasks cover all places.
    unsafe {
        fill(out, places * channels, |out| {
            let out = Shared::new(out);
            (0..places.div_ceil(PLACES)).into_par_iter().for_each(|task| {
                let mut sum = vec![0.0; channels];
                for place in task * PLACES..places.min((task + 1) * PLACES) {
                    vectorized(|| sum_of(place, &mut sum));
                    // SAFETY: no place is in two tasks.
                    out.write(place * channels, &sum);
                }
            });
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn adds_rows_of_the_same_source() {
        let rows = [1.0, 2.0, 10.0, 20.0, 100.0, 200.0];
        let mut out = vec![9.0];
        add_up(&rows, &[2, 0, 2], 4, 2, &mut out);
        assert_eq!(out, [10.0, 20.0, 0.0, 0.0, 101.0, 202.0, 0.0, 0.0]);
    }
}
