//! Selection of frames from the runs and their assignment to splits.

use super::config::SplitKind;
use crate::scenario::Run;
use data::{DataError, stream};
use rand::seq::SliceRandom;
use std::path::Path;

/// Names of the splits.
pub const SPLITS: [&str; 3] = ["train", "val", "test"];

/// A selected frame.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct FrameKey {
    /// Index among all frames of all runs; also its name.
    pub number: usize,
    /// Index of the run.
    pub run: usize,
    /// Frame index within the run.
    pub frame: usize,
    /// Index in [`SPLITS`].
    pub split: usize,
}

impl FrameKey {
    /// File name without extension; the same in every data set of the race.
    pub fn id(&self) -> String {
        format!("{:06}", self.number)
    }

    /// Name of the split.
    pub fn split_name(&self) -> &'static str {
        SPLITS[self.split]
    }
}

/// Numbers of frames of the splits when `kept` frames are split in the proportions `shares`.
pub(super) fn split_sizes(kept: usize, shares: [usize; 3]) -> Vec<usize> {
    shared(kept, &shares)
}

/// Selects `kept` frames at an even stride over all runs, in ascending order.
///
/// With blocks, each run contributes its share of every split as one block. Unused frames are placed between the
/// blocks, so that the end of one block and the start of the next do not show the same moment.
pub fn choose(
    runs: &[Run],
    kept: usize,
    (kind, shares): (SplitKind, [usize; 3]),
    seed: u64,
) -> Result<Vec<FrameKey>, DataError> {
    let total: usize = runs.iter().map(|r| r.frames).sum();
    if kept > total || kept < SPLITS.len() * runs.len() {
        let message = format!("{kept} are not between {} and the {total} of the runs", SPLITS.len() * runs.len());
        return Err(DataError::file(Path::new("frames"), message));
    }
    let candidates_at = |stride: usize| runs.iter().map(|r| r.frames.div_ceil(stride)).collect::<Vec<usize>>();
    // At a stride of 1 there are as many candidates as frames.
    let mut stride = total / kept;
    while candidates_at(stride).iter().sum::<usize>() < kept {
        stride -= 1;
    }
    let candidates = candidates_at(stride);
    let split_sizes = split_sizes(kept, shares);
    let mut keys = Vec::with_capacity(kept);
    let mut first = 0;
    for (run, own) in over_runs(&split_sizes, &candidates).into_iter().enumerate() {
        let gap = (candidates[run] - own.iter().sum::<usize>()) / SPLITS.len();
        let mut at = 0;
        for (split, n) in own.iter().enumerate() {
            keys.extend((at..at + n).map(|i| FrameKey { number: first + i * stride, run, frame: i * stride, split }));
            at += n + gap;
        }
        first += runs[run].frames;
    }
    if kind == SplitKind::Random {
        let mut splits: Vec<usize> = split_sizes.iter().enumerate().flat_map(|(split, n)| vec![split; *n]).collect();
        splits.shuffle(&mut stream(seed, "splits", 0, 0));
        keys.iter_mut().zip(splits).for_each(|(key, split)| key.split = split);
    }
    Ok(keys)
}

/// Number of frames per run and split: proportional to the run's candidates and at most their number.
fn over_runs(split_sizes: &[usize], candidates: &[usize]) -> Vec<Vec<usize>> {
    let all: usize = candidates.iter().sum();
    let mut before = 0;
    let mut own: Vec<Vec<usize>> = Vec::new();
    for n in candidates {
        let upto = before + n;
        own.push(split_sizes.iter().map(|size| size * upto / all - size * before / all).collect());
        before = upto;
    }
    let given = |own: &[usize]| own.iter().sum::<usize>();
    while let Some(from) = (0..own.len()).find(|r| given(&own[*r]) > candidates[*r]) {
        let to = (0..own.len()).find(|r| given(&own[*r]) < candidates[*r]).expect("all candidates together are enough");
        let split = (0..split_sizes.len()).max_by_key(|s| own[from][*s]).expect("there are splits");
        own[from][split] -= 1;
        own[to][split] += 1;
    }
    own
}

/// Splits `total` in these proportions, at least one each; the first gets the rounding remainder.
fn shared(total: usize, shares: &[usize]) -> Vec<usize> {
    let sum: usize = shares.iter().sum();
    let mut parts: Vec<usize> = shares.iter().map(|s| (total * s / sum).max(1)).collect();
    parts[0] = total - parts[1..].iter().sum::<usize>();
    parts
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::RaceModel;
    use crate::track::{Track, las_vegas};
    use std::collections::BTreeSet;

    fn runs(frames: usize) -> Vec<Run> {
        let model = RaceModel { frames, rivals: 0, ..RaceModel::default() };
        model.runs(&Track { line: las_vegas(), seed: 0 }, 1)
    }

    fn count(keys: &[FrameKey]) -> Vec<usize> {
        (0..3).map(|s| keys.iter().filter(|k| k.split == s).count()).collect()
    }

    #[test]
    fn the_paper_s_numbers() {
        // 32,951 frames, every fifth, 6,000 kept.
        let runs = runs(3295);
        let keys = choose(&runs, 600, (SplitKind::Blocks, [4, 1, 1]), 1).unwrap();
        assert_eq!((keys.len(), count(&keys)), (600, vec![400, 100, 100]));
        assert!(keys.windows(2).all(|w| w[0].number < w[1].number));
        assert!(keys.iter().all(|k| k.frame % 5 == 0 && k.frame < runs[k.run].frames));
        // Neighbouring frames in different splits are farther apart than neighbours in one split.
        for pair in keys.windows(2).filter(|w| w[0].run == w[1].run) {
            let apart = pair[1].frame - pair[0].frame;
            assert!(if pair[0].split == pair[1].split { apart == 5 } else { apart > 25 }, "{pair:?}");
        }
        assert!(keys.iter().map(|k| k.run).collect::<BTreeSet<_>>().len() == 3);
    }

    #[test]
    fn more_frames_may_be_tested_on() {
        let keys = choose(&runs(3295), 1600, (SplitKind::Blocks, [10, 1, 5]), 1).unwrap();
        assert_eq!(count(&keys), [1000, 100, 500]);
        assert_eq!(split_sizes(1601, [10, 1, 5]), [1001, 100, 500]);
    }

    #[test]
    fn by_lot_the_numbers_are_the_same() {
        let runs = runs(900);
        let keys = choose(&runs, 61, (SplitKind::Random, [4, 1, 1]), 1).unwrap();
        assert_eq!((keys.len(), count(&keys)), (61, vec![41, 10, 10]));
        let mixed = keys.windows(2).filter(|w| w[0].split != w[1].split).count();
        assert!(mixed > 15, "{mixed}");
        assert_eq!(keys, choose(&runs, 61, (SplitKind::Random, [4, 1, 1]), 1).unwrap());
        assert_ne!(keys, choose(&runs, 61, (SplitKind::Random, [4, 1, 1]), 2).unwrap());
    }

    #[test]
    fn more_than_there_are_is_refused() {
        assert!(choose(&runs(100), 101, (SplitKind::Blocks, [4, 1, 1]), 1).is_err());
        for kept in [18, 19, 50, 99, 100] {
            assert_eq!(choose(&runs(100), kept, (SplitKind::Blocks, [4, 1, 1]), 1).unwrap().len(), kept, "{kept}");
        }
    }
}
