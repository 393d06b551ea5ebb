//! The maximum over a group of rows, appended to each of its rows (OpenPCDet: `PFNLayer`).

use crate::output::{Shared, fill};
use crate::simd::vectorized;
use rayon::prelude::*;
use std::ops::Range;

/// Number of parts that the groups are divided into, for any number of threads.
const PARTS: usize = 32;

/// Rows and their groups.
#[derive(Clone, Copy, Debug)]
pub struct GroupedRows<'a> {
    /// Channels of a row, C.
    pub channels: usize,
    /// End of each of the G groups; the first begins at row 0, and none may be empty.
    pub ends: &'a [u32],
}

impl GroupedRows<'_> {
    /// Writes each row of `x` followed by the maximum over its group to `out`, which is overwritten. Returns the row of
    /// each maximum, `[G, C]`, the first of equal ones. NaN propagates.
    ///
    /// # Shapes
    /// `x`: `[N, C]`; `out`: `[N, 2 C]`.
    pub fn append_maximum(&self, x: &[f32], out: &mut Vec<f32>) -> Vec<u32> {
        let c = self.channels;
        assert_eq!(x.len(), self.rows() * c, "elements of x");
        let mut sources = Vec::new();
        // SAFETY: the parts cover all groups, and these all rows.
        unsafe {
            fill(&mut sources, self.ends.len() * c, |sources| {
                let sources = Shared::new(sources);
                fill(out, 2 * x.len(), |out| {
                    let out = Shared::new(out);
                    self.parts(|groups| {
                        let (mut best, mut places) = (vec![0.0f32; c], vec![0u32; c]);
                        for group in groups {
                            let rows = self.group(group);
                            vectorized(|| maximum(x, rows.clone(), &mut best, &mut places));
                            // SAFETY: no group is in two parts, and no row in two groups.
                            sources.write(group * c, &places);
                            for row in rows {
                                out.write(2 * row * c, &x[row * c..(row + 1) * c]);
                                out.write((2 * row + 1) * c, &best);
                            }
                        }
                    });
                });
            });
        }
        sources
    }

    /// The gradient with respect to `x` from that with respect to the result of [`GroupedRows::append_maximum`] and the
    /// rows it returned. `dx` is overwritten.
    ///
    /// # Shapes
    /// `dy`: `[N, 2 C]`; `dx`: `[N, C]`.
    pub fn gradient(&self, dy: &[f32], sources: &[u32], dx: &mut Vec<f32>) {
        let c = self.channels;
        assert_eq!((dy.len(), sources.len()), (2 * self.rows() * c, self.ends.len() * c), "elements of dy");
        // SAFETY: the parts cover all groups, and these all rows.
        unsafe {
            fill(dx, self.rows() * c, |dx| {
                let dx = Shared::new(dx);
                self.parts(|groups| {
                    let (mut sums, mut own) = (vec![0.0f32; c], Vec::new());
                    for group in groups {
                        let rows = self.group(group);
                        sums.fill(0.0);
                        own.clear();
                        for row in rows.clone() {
                            let (of_row, of_maximum) = dy[2 * row * c..2 * (row + 1) * c].split_at(c);
                            own.extend_from_slice(of_row);
                            sums.iter_mut().zip(of_maximum).for_each(|(sum, value)| *sum += value);
                        }
                        for (channel, (&source, sum)) in sources[group * c..].iter().zip(&sums).enumerate() {
                            own[(source as usize - rows.start) * c + channel] += sum;
                        }
                        // SAFETY: no group is in two parts, and no row in two groups.
                        dx.write(rows.start * c, &own);
                    }
                });
            });
        }
    }

    fn rows(&self) -> usize {
        self.ends.last().map_or(0, |&end| end as usize)
    }

    fn group(&self, group: usize) -> Range<usize> {
        let begin = if group == 0 { 0 } else { self.ends[group - 1] as usize };
        let end = self.ends[group] as usize;
        assert!(begin < end, "groups of at least one row, in order");
        begin..end
    }

    fn parts(&self, work: impl Fn(Range<usize>) + Sync) {
        let groups = self.ends.len();
        (0..PARTS).into_par_iter().for_each(|part| work(groups * part / PARTS..groups * (part + 1) / PARTS));
    }
}

/// The maximum over the rows, and the row of each.
#[inline(always)]
fn maximum(x: &[f32], rows: Range<usize>, best: &mut [f32], places: &mut [u32]) {
    let channels = best.len();
    best.copy_from_slice(&x[rows.start * channels..(rows.start + 1) * channels]);
    places.fill(rows.start as u32);
    for row in rows.skip(1) {
        let values = &x[row * channels..(row + 1) * channels];
        for ((best, place), &value) in best.iter_mut().zip(places.iter_mut()).zip(values) {
            let takes = value > *best || value.is_nan();
            *best = if takes { value } else { *best };
            *place = if takes { row as u32 } else { *place };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_same_for_threads, random};

    fn ends(sizes: &[u32]) -> Vec<u32> {
        let sum = |total: &mut u32, &size: &u32| {
            *total += size;
            Some(*total)
        };
        sizes.iter().scan(0, sum).collect()
    }

    #[test]
    fn equals_the_definition() {
        let rows = GroupedRows { channels: 2, ends: &[2, 3] };
        let mut out = vec![7.0];
        let sources = rows.append_maximum(&[1.0, 5.0, 3.0, 5.0, -1.0, -2.0], &mut out);
        assert_eq!(out, [1.0, 5.0, 3.0, 5.0, 3.0, 5.0, 3.0, 5.0, -1.0, -2.0, -1.0, -2.0]);
        assert_eq!(sources, [1, 0, 2, 2]);
        let mut dx = vec![7.0];
        let dy: Vec<f32> = (1..=12).map(|v| v as f32).collect();
        rows.gradient(&dy, &sources, &mut dx);
        // Rows 0 and 1 give 3 + 7 = 10 to the maximum of the first channel, and 4 + 8 = 12 to that of the second.
        assert_eq!(dx, [1.0, 2.0 + 12.0, 5.0 + 10.0, 6.0, 9.0 + 11.0, 10.0 + 12.0]);
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        let sizes: Vec<u32> = random(700, 3).into_iter().map(|v| 1 + ((v + 1.0) * 8.0) as u32).collect();
        let ends = ends(&sizes);
        let rows = GroupedRows { channels: 19, ends: &ends };
        let n = rows.rows();
        let (x, dy) = (random(n * 19, 1), random(n * 38, 2));
        assert_same_for_threads(|| {
            let (mut y, mut dx) = (Vec::new(), Vec::new());
            let sources = rows.append_maximum(&x, &mut y);
            rows.gradient(&dy, &sources, &mut dx);
            [y, dx]
        });
    }

    #[test]
    fn no_rows_and_what_is_no_number() {
        let mut out = vec![7.0];
        let none = GroupedRows { channels: 3, ends: &[] };
        assert!(none.append_maximum(&[], &mut out).is_empty() && out.is_empty());
        none.gradient(&[], &[], &mut out);
        assert!(out.is_empty());
        let rows = GroupedRows { channels: 1, ends: &[3, 4] };
        rows.append_maximum(&[1.0, f32::NAN, 2.0, 5.0], &mut out);
        assert!(out[1].is_nan() && out[3].is_nan() && out[5].is_nan() && out[7] == 5.0, "{out:?}");
    }
}
