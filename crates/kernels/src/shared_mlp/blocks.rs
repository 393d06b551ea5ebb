//! Division of rows into blocks that fit the cache, and of blocks into parts whose sums are added in order.

use super::RowGroups;
use rayon::prelude::*;
use std::borrow::Cow;
use std::ops::Range;

/// Rows of a block, unless a group is larger.
const ROWS: usize = 256;

/// Number of parts, for any number of threads.
const PARTS: usize = 16;

/// A range of rows that holds whole groups.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Block {
    pub rows: Range<usize>,
    pub groups: Range<usize>,
}

/// All rows.
#[derive(Clone, Debug)]
pub(super) struct Blocks<'a> {
    all: Vec<Block>,
    ends: Option<&'a [u32]>,
    counts: Cow<'a, [f32]>,
    /// Sum of the counts, at least 1.
    pub total: f64,
    /// Rows.
    pub rows: usize,
    /// Rows of the largest block.
    pub most_rows: usize,
}

impl<'a> Blocks<'a> {
    pub fn new(rows: usize, groups: RowGroups<'a>) -> Self {
        let counts = groups.counts.map_or_else(|| Cow::Owned(vec![1.0; rows]), Cow::Borrowed);
        assert_eq!(counts.len(), rows, "one count a row");
        let mut all = Vec::new();
        match groups.ends {
            None => all.extend(
                (0..rows).step_by(ROWS).map(|r| r..rows.min(r + ROWS)).map(|r| Block { rows: r.clone(), groups: r }),
            ),
            Some(ends) => {
                let mut block = Block { rows: 0..0, groups: 0..0 };
                for &end in ends {
                    let end = end as usize;
                    assert!(end > block.rows.end && end <= rows, "groups of at least one row, in order");
                    if end - block.rows.start > ROWS && !block.rows.is_empty() {
                        let next =
                            Block { rows: block.rows.end..block.rows.end, groups: block.groups.end..block.groups.end };
                        all.push(std::mem::replace(&mut block, next));
                    }
                    block.rows.end = end;
                    block.groups.end += 1;
                }
                assert_eq!(block.rows.end, rows, "the last group ends at the last row");
                all.extend((!block.rows.is_empty()).then_some(block));
            }
        }
        let most_rows = all.iter().map(|b| b.rows.len()).max().unwrap_or(0);
        let total = counts.iter().map(|&c| c as f64).sum::<f64>().max(1.0);
        Blocks { all, ends: groups.ends, counts, total, rows, most_rows }
    }

    /// Runs `work` for the blocks of each part on all threads. The results are in the order of the parts.
    pub fn parts<R: Send>(&self, work: impl Fn(&[Block]) -> R + Sync) -> Vec<R> {
        let parts = self.all.len().min(PARTS);
        let of_part = |part: usize| work(&self.all[self.all.len() * part / parts..self.all.len() * (part + 1) / parts]);
        (0..parts).into_par_iter().map(of_part).collect()
    }

    /// Multiplicity of each row of a block.
    pub fn counts(&self, block: &Block) -> &[f32] {
        &self.counts[block.rows.clone()]
    }

    /// The rows of a group.
    pub fn group(&self, group: usize) -> Range<usize> {
        let end = |g: usize| self.ends.map_or(g + 1, |ends| ends[g] as usize);
        if group == 0 { 0..end(0) } else { end(group - 1)..end(group) }
    }

    /// Number of groups.
    pub fn groups(&self) -> usize {
        self.ends.map_or(self.rows, <[u32]>::len)
    }
}

/// The sum of the parts' values, added in order.
pub(super) fn sum(parts: impl IntoIterator<Item = Vec<f32>>, len: usize) -> Vec<f32> {
    let mut parts = parts.into_iter();
    let mut total = parts.next().unwrap_or_else(|| vec![0.0; len]);
    for part in parts {
        for (total, part) in total.iter_mut().zip(part) {
            *total += part;
        }
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_have_whole_groups() {
        let ends = [100, 200, 256, 257, 900, 901, 1000];
        let blocks = Blocks::new(1000, RowGroups { ends: Some(&ends), counts: None });
        let rows: Vec<_> = blocks.all.iter().map(|b| (b.rows.clone(), b.groups.clone())).collect();
        assert_eq!(rows, [(0..256, 0..3), (256..257, 3..4), (257..900, 4..5), (900..1000, 5..7)]);
        assert_eq!((blocks.most_rows, blocks.group(4), blocks.groups()), (643, 257..900, 7));
        let blocks = Blocks::new(600, RowGroups { ends: None, counts: None });
        assert_eq!(blocks.all[2], Block { rows: 512..600, groups: 512..600 });
        assert_eq!((blocks.group(3), blocks.groups(), blocks.total), (3..4, 600, 600.0));
    }
}
