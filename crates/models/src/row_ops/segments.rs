//! Sums of the rows that have the same index, as gathers: the gradient of a gather. Runs on the host.

use super::ZERO;

/// Rows that are added at once. Segments with more are added in levels.
const WIDTH: usize = 8;

/// Sums of rows by index: each level gathers blocks of rows, filled up with rows of zeros, and adds each block.
#[derive(Clone, Debug, PartialEq)]
pub struct SegmentSums {
    /// In order.
    pub levels: Vec<Level>,
    /// Row of the last level for each result, [`ZERO`] where no row has its index; `None` if these are all rows in
    /// order.
    pub last: Option<Vec<u32>>,
}

/// Sums of blocks of rows.
#[derive(Clone, Debug, PartialEq)]
pub struct Level {
    /// Rows of a block.
    pub width: usize,
    /// Rows of the level before, one block after the other.
    pub index: Vec<u32>,
}

impl SegmentSums {
    /// Result r is the sum of the rows whose index is r, of `results` results. Rows with index [`ZERO`] are left out.
    pub fn new(index: &[u32], results: usize) -> Self {
        let (mut members, mut ends) = sorted(index, results);
        let mut levels = Vec::new();
        let mut rows = index.len();
        loop {
            let mut begin = 0;
            let longest = ends.iter().map(|&end| end - std::mem::replace(&mut begin, end)).max().unwrap_or(0) as usize;
            if longest <= 1 {
                break;
            }
            let width = longest.min(WIDTH);
            let mut level = Vec::new();
            let mut begin = 0;
            for end in &mut ends {
                for block in members[begin..*end as usize].chunks(width) {
                    level.extend_from_slice(block);
                    level.resize(level.len().next_multiple_of(width), ZERO);
                }
                begin = *end as usize;
                *end = (level.len() / width) as u32;
            }
            rows = level.len() / width;
            members = (0..rows as u32).collect();
            levels.push(Level { width, index: level });
        }
        let mut begin = 0;
        let of_segment = |&end: &u32| {
            let begin = std::mem::replace(&mut begin, end);
            if begin < end { members[begin as usize] } else { ZERO }
        };
        let last: Vec<u32> = ends.iter().map(of_segment).collect();
        let in_order = last.len() == rows && last.iter().enumerate().all(|(i, &row)| i == row as usize);
        SegmentSums { levels, last: (!in_order).then_some(last) }
    }
}

/// The positions in `index` by their value, in order, and the end of those of each value.
fn sorted(index: &[u32], values: usize) -> (Vec<u32>, Vec<u32>) {
    let mut next = vec![0u32; values + 1];
    for &value in index.iter().filter(|&&value| value != ZERO) {
        next[value as usize + 1] += 1;
    }
    for value in 0..values {
        next[value + 1] += next[value];
    }
    let mut members = vec![0; next[values] as usize];
    for (position, &value) in index.iter().enumerate().filter(|(_, value)| **value != ZERO) {
        let place = &mut next[value as usize];
        members[*place as usize] = position as u32;
        *place += 1;
    }
    next.truncate(values); // where the next one would be: the end
    (members, next)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sums of `values` by the plan.
    fn sums(plan: &SegmentSums, values: &[u64]) -> Vec<u64> {
        let at = |values: &[u64], row: u32| if row == ZERO { 0 } else { values[row as usize] };
        let mut values = values.to_vec();
        for level in &plan.levels {
            let blocks = level.index.chunks_exact(level.width);
            values = blocks.map(|block| block.iter().map(|&row| at(&values, row)).sum()).collect();
        }
        plan.last.as_ref().map_or(values.clone(), |last| last.iter().map(|&row| at(&values, row)).collect())
    }

    #[test]
    fn sums_of_segments_of_any_length() {
        for (rows, results) in [(0, 3), (1, 1), (5, 9), (40, 3), (700, 2), (1000, 150)] {
            let value_of = |i: u32| (i.wrapping_mul(2_654_435_761) >> 7) % (results + 1);
            let index: Vec<u32> = (0..rows).map(value_of).map(|v| if v == results { ZERO } else { v }).collect();
            let values: Vec<u64> = (0..u64::from(rows)).map(|i| i * i + 1).collect();
            let mut want = vec![0; results as usize];
            for (&result, value) in index.iter().zip(&values).filter(|(result, _)| **result != ZERO) {
                want[result as usize] += value;
            }
            let plan = SegmentSums::new(&index, results as usize);
            assert_eq!(sums(&plan, &values), want, "{rows} rows, {results} results");
            assert!(plan.levels.iter().all(|level| level.width <= WIDTH && level.index.len() % level.width == 0));
        }
    }

    #[test]
    fn distinct_rows_are_one_gather_and_whole_segments_need_no_last_one() {
        let plan = SegmentSums::new(&[4, 0, 2], 5);
        assert_eq!(plan, SegmentSums { levels: vec![], last: Some(vec![1, ZERO, 2, ZERO, 0]) });
        let plan = SegmentSums::new(&[0, 0, 1, 1, 1], 2);
        assert_eq!(plan.levels, [Level { width: 3, index: vec![0, 1, ZERO, 2, 3, 4] }]);
        assert_eq!(plan.last, None);
    }
}
