//! Sums of the rows that have the same index, as gathers: the gradient of a gather. Runs on the host.

use super::ZERO;

/// Rows that are added at once. Segments with more are added in levels.
const WIDTH: usize = 8;

/// Results for each index above which indices are compared and not counted: about the steps of a sort.
const COUNTED: usize = 16;

/// Sums of rows by index: each level gathers blocks of rows, filled up with rows of zeros, and adds each block.
#[derive(Clone, Debug, PartialEq)]
pub struct SegmentSums {
    /// In order.
    pub levels: Vec<Level>,
    /// Where the rows of the last level go; `None` if these are all results in order.
    pub last: Option<Places>,
}

/// Rows that go to distinct places among rows of zeros.
#[derive(Clone, Debug, PartialEq)]
pub struct Places {
    /// Rows that are copied.
    pub rows: Vec<u32>,
    /// The place of each, ascending.
    pub places: Vec<u32>,
    /// Number of places.
    pub count: usize,
}

impl Places {
    /// The row at each place, [`ZERO`] for none.
    pub fn index(&self) -> Vec<u32> {
        let mut index = vec![ZERO; self.count];
        self.rows.iter().zip(&self.places).for_each(|(&row, &place)| index[place as usize] = row);
        index
    }
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
        let (mut members, mut ends, places) = sorted(index, results);
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
        // One row a segment is left.
        let in_order = |values: &[u32]| values.iter().enumerate().all(|(i, &value)| i == value as usize);
        let is_whole = [rows, places.len()] == [results; 2] && in_order(&members) && in_order(&places);
        SegmentSums { levels, last: (!is_whole).then_some(Places { rows: members, places, count: results }) }
    }
}

/// The positions in `index` by their value, in order, the end of those of each value that occurs, and these values.
fn sorted(index: &[u32], results: usize) -> (Vec<u32>, Vec<u32>, Vec<u32>) {
    // Counting takes a pass over all results, of which few may occur.
    let members = if results / COUNTED > index.len() { by_comparison(index) } else { by_counting(index, results) };
    let value = |i: u32| index[i as usize];
    let (mut ends, mut values) = (Vec::new(), Vec::new());
    for segment in members.chunk_by(|&a, &b| value(a) == value(b)) {
        values.push(value(segment[0]));
        ends.push(ends.last().unwrap_or(&0) + segment.len() as u32);
    }
    (members, ends, values)
}

fn by_comparison(index: &[u32]) -> Vec<u32> {
    let mut members: Vec<u32> = (0..index.len() as u32).filter(|&i| index[i as usize] != ZERO).collect();
    members.sort_by_key(|&i| index[i as usize]);
    members
}

fn by_counting(index: &[u32], results: usize) -> Vec<u32> {
    let mut next = vec![0u32; results + 1];
    for &value in index.iter().filter(|&&value| value != ZERO) {
        next[value as usize + 1] += 1;
    }
    for value in 0..results {
        next[value + 1] += next[value];
    }
    let mut members = vec![0; next[results] as usize];
    for (position, &value) in index.iter().enumerate().filter(|(_, value)| **value != ZERO) {
        let place = &mut next[value as usize];
        members[*place as usize] = position as u32;
        *place += 1;
    }
    members
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
        let place = |places: &Places| places.index().iter().map(|&row| at(&values, row)).collect();
        plan.last.as_ref().map_or(values.clone(), place)
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
    fn both_ways_to_sort_agree() {
        let index: Vec<u32> = (0..500u32).map(|i| i.wrapping_mul(2_654_435_761) >> 26).collect();
        let with_zeros: Vec<u32> = index.iter().map(|&value| if value == 3 { ZERO } else { value }).collect();
        for index in [index, with_zeros] {
            assert_eq!(by_comparison(&index), by_counting(&index, 64));
        }
    }

    #[test]
    fn distinct_rows_are_one_gather_and_whole_segments_need_no_last_one() {
        let plan = SegmentSums::new(&[4, 0, 2], 5);
        let last = Places { rows: vec![1, 2, 0], places: vec![0, 2, 4], count: 5 };
        assert_eq!(last.index(), [1, ZERO, 2, ZERO, 0]);
        assert_eq!(plan, SegmentSums { levels: vec![], last: Some(last) });
        let plan = SegmentSums::new(&[0, 0, 1, 1, 1], 2);
        assert_eq!(plan.levels, [Level { width: 3, index: vec![0, 1, ZERO, 2, 3, 4] }]);
        assert_eq!(plan.last, None);
    }
}
