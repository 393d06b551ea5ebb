//! Which frames of the runs are kept, and in which split each one is.

use super::config::SplitKind;
use crate::scenario::Run;
use data::{DataError, stream};
use rand::seq::SliceRandom;
use std::path::Path;

/// Names of the splits and their shares.
pub const SPLITS: [(&str, usize); 3] = [("train", 4), ("val", 1), ("test", 1)];

/// A frame that is kept.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct FrameKey {
    /// Number among all frames of all runs; also its name.
    pub number: usize,
    /// The run.
    pub run: usize,
    /// Number within the run.
    pub frame: usize,
    /// Place in [`SPLITS`].
    pub split: usize,
}

impl FrameKey {
    /// The file name without ending; the same in every data set of the race.
    pub fn id(&self) -> String {
        format!("{:06}", self.number)
    }

    /// Name of its split.
    pub fn split_name(&self) -> &'static str {
        SPLITS[self.split].0
    }
}

/// `kept` frames at an even stride over all runs, in the order of their numbers.
///
/// By blocks each run gives its share of every split one after the other; frames that are not kept lie between the blocks, so that the last
/// frame of one and the first of the next do not show the same moment.
pub fn choose(runs: &[Run], kept: usize, kind: SplitKind, seed: u64) -> Result<Vec<FrameKey>, DataError> {
    let total: usize = runs.iter().map(|r| r.frames).sum();
    let stride = total / kept;
    let candidates: Vec<usize> = runs.iter().map(|r| r.frames / stride.max(1)).collect();
    if stride == 0 || candidates.iter().sum::<usize>() < kept {
        return Err(DataError::file(Path::new("frames"), format!("{kept} are more than the {total} of the runs")));
    }
    let split_sizes = shared(kept, &SPLITS.map(|(_, share)| share));
    let mut keys = Vec::with_capacity(kept);
    let mut left = split_sizes.clone();
    let mut first = 0;
    for (run, candidates) in candidates.iter().enumerate() {
        // What this run gives to each split: in proportion to its candidates among those not yet given out.
        let rest: usize = (run..runs.len()).map(|r| runs[r].frames / stride).sum();
        let own: Vec<usize> =
            left.iter().map(|n| if run + 1 == runs.len() { *n } else { n * candidates / rest }).collect();
        left.iter_mut().zip(&own).for_each(|(n, own)| *n -= own);
        let own_total: usize = own.iter().sum();
        if own_total > *candidates {
            return Err(DataError::file(
                Path::new("frames"),
                format!("run {run} has {candidates} frames for {own_total}"),
            ));
        }
        let gap = (candidates - own_total) / SPLITS.len();
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

/// `total` in these shares, at least one each; the first takes what rounding leaves.
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
        let keys = choose(&runs, 600, SplitKind::Blocks, 1).unwrap();
        assert_eq!((keys.len(), count(&keys)), (600, vec![400, 100, 100]));
        assert!(keys.windows(2).all(|w| w[0].number < w[1].number));
        assert!(keys.iter().all(|k| k.frame % 5 == 0 && k.frame < runs[k.run].frames));
        // Neighbours in different splits are farther apart than neighbours in one.
        for pair in keys.windows(2).filter(|w| w[0].run == w[1].run) {
            let apart = pair[1].frame - pair[0].frame;
            assert!(if pair[0].split == pair[1].split { apart == 5 } else { apart > 25 }, "{pair:?}");
        }
        assert!(keys.iter().map(|k| k.run).collect::<BTreeSet<_>>().len() == 3);
    }

    #[test]
    fn by_lot_the_numbers_are_the_same() {
        let runs = runs(900);
        let keys = choose(&runs, 61, SplitKind::Random, 1).unwrap();
        assert_eq!((keys.len(), count(&keys)), (61, vec![41, 10, 10]));
        let mixed = keys.windows(2).filter(|w| w[0].split != w[1].split).count();
        assert!(mixed > 15, "{mixed}");
        assert_eq!(keys, choose(&runs, 61, SplitKind::Random, 1).unwrap());
        assert_ne!(keys, choose(&runs, 61, SplitKind::Random, 2).unwrap());
    }

    #[test]
    fn more_than_there_are_is_refused() {
        assert!(choose(&runs(100), 101, SplitKind::Blocks, 1).is_err());
        for kept in [18, 19, 50, 99, 100] {
            assert_eq!(choose(&runs(100), kept, SplitKind::Blocks, 1).unwrap().len(), kept, "{kept}");
        }
    }
}
