//! Copies of rows and maxima over groups of rows, whose gradients are gathers as well.
//!
//! The gradient of burn's `select` adds the rows one after the other, on a GPU with one thread for each channel; that
//! of `max_dim` scatters. Here the indices are known on the host, so that both directions of an operation read rows in
//! any order and write each value once. Sums have a fixed order: the same bits in every run on the same device.

#[expect(deprecated, reason = "NdArray is kept as long as burn has it")]
mod backend;
mod segments;

use backend::RowOps as _;
use burn::backend::Dispatch;
use burn::tensor::Tensor;
use std::sync::Arc;

/// The index of a row of zeros.
pub const ZERO: u32 = u32::MAX;

/// Copies of rows.
///
/// # Shapes
/// `x`: `[R, C]`; `index`: N rows of `x`, or [`ZERO`]; result `[N, C]`.
///
/// # Panics
/// An index that is neither below R nor [`ZERO`].
pub fn gather(x: Tensor<2>, index: &Arc<[u32]>) -> Tensor<2> {
    let rows = x.dims()[0];
    assert!(index.iter().all(|&i| (i as usize) < rows || i == ZERO), "an index is not below {rows}");
    Tensor::from_dispatch(Dispatch::gather_rows(x.into_dispatch(), index.clone()))
}

/// Rows that go to distinct places among rows of zeros.
///
/// # Shapes
/// `x`: `[N, C]`; `places`: N; result `[count, C]`.
///
/// # Panics
/// Another number of places, or one that is not below `count`.
pub fn place(x: Tensor<2>, places: &Arc<[u32]>, count: usize) -> Tensor<2> {
    assert_eq!(x.dims()[0], places.len(), "a place for each row");
    assert!(places.iter().all(|&place| (place as usize) < count), "a place is not below {count}");
    Tensor::from_dispatch(Dispatch::rows_at(x.into_dispatch(), places.clone(), count))
}

/// Begin and end of groups with these ends.
fn spans(ends: &[u32]) -> impl Iterator<Item = (u32, u32)> {
    std::iter::once(0).chain(ends.iter().copied()).zip(ends.iter().copied())
}

/// Groups of consecutive rows. Rows after the last group belong to none.
#[derive(Clone, Debug, PartialEq)]
pub struct RowGroups {
    /// End of each group; the first begins at 0.
    ends: Vec<u32>,
    /// Rows of the largest group.
    most: usize,
}

impl RowGroups {
    /// From the end of each group.
    ///
    /// # Panics
    /// A group without rows.
    pub fn new(ends: &[u32]) -> Self {
        let most = spans(ends).map(|(begin, end)| end.checked_sub(begin).expect("ends rise")).max().unwrap_or(0);
        assert!(spans(ends).all(|(begin, end)| begin < end), "a group has no rows");
        RowGroups { ends: ends.to_vec(), most: most as usize }
    }

    /// The rows of each group, filled up to the size of the largest with its first row, which changes no maximum.
    fn places(&self) -> impl Iterator<Item = u32> {
        let place = |begin: u32, end: u32, slot: u32| if begin + slot < end { begin + slot } else { begin };
        spans(&self.ends).flat_map(move |(begin, end)| (0..self.most as u32).map(move |slot| place(begin, end, slot)))
    }

    /// Number of groups.
    pub fn len(&self) -> usize {
        self.ends.len()
    }

    /// Whether there is no group.
    pub fn is_empty(&self) -> bool {
        self.ends.is_empty()
    }

    /// The group of each of `rows` rows; 0 for rows that belong to none.
    fn group_of_row(&self, rows: usize) -> Vec<u32> {
        let mut groups: Vec<u32> = Vec::with_capacity(rows);
        for (group, &end) in self.ends.iter().enumerate() {
            groups.resize(end as usize, group as u32);
        }
        groups.resize(rows, 0);
        groups
    }
}

/// The maximum over each group. Its gradient goes to one row of a group.
///
/// # Shapes
/// `x`: `[N, C]`; result `[G, C]`.
///
/// # Panics
/// Groups that end after the last row.
pub fn group_max(x: Tensor<2>, groups: &Arc<RowGroups>) -> Tensor<2> {
    assert!(groups.ends.last().is_none_or(|&end| end as usize <= x.dims()[0]), "a group ends after the last row");
    Tensor::from_dispatch(Dispatch::max_of_groups(x.into_dispatch(), groups.clone()))
}

#[cfg(test)]
#[expect(clippy::disallowed_methods, reason = "burn's own operations are the reference")]
mod tests;
