//! The order of the frames in each epoch, computed when the epoch is reached, and frames in place of those without
//! boxes, drawn when they are needed.

use data::{Stream, stream};
use rand::RngExt as _;
use rand::seq::SliceRandom;
use std::collections::{HashMap, VecDeque};
use std::sync::{Arc, Mutex, PoisonError};

/// Orders that are kept. Frames of the next epoch are loaded while those of the last one are still used.
const KEPT: usize = 2;

/// The orders of the epochs of a run: of each epoch a permutation of the frames that depends on the seed and the epoch
/// alone. Two of them are in memory, 4 bytes a frame each.
pub(crate) struct EpochOrders {
    seed: u64,
    frames: u32,
    known: Mutex<VecDeque<(u64, Arc<[u32]>)>>,
}

impl EpochOrders {
    /// # Panics
    /// With more than 2^32 - 1 frames. A split has at most [`data::limits::MOST_IDS`].
    pub(crate) fn new(seed: u64, frames: usize) -> Self {
        let frames = u32::try_from(frames).expect("the number of frames is limited");
        EpochOrders { seed, frames, known: Mutex::default() }
    }

    /// Indices of all frames in the order of `epoch`.
    pub(crate) fn of(&self, epoch: u64) -> Arc<[u32]> {
        let mut known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, order)) = known.iter().find(|(of, _)| *of == epoch) {
            return order.clone();
        }
        let mut order: Vec<u32> = (0..self.frames).collect();
        order.shuffle(&mut stream(self.seed, "order", epoch, 0));
        let order: Arc<[u32]> = order.into();
        if known.len() == KEPT {
            known.pop_front();
        }
        known.push_back((epoch, order.clone()));
        order
    }
}

/// All frames but one in random order, of which as much is computed as is drawn: the shuffle of Fisher and Yates, whose
/// memory is the exchanges so far.
pub(crate) struct Others {
    without: usize,
    left: usize,
    /// Numbers of the places whose number is not their own.
    moved: HashMap<usize, usize>,
}

impl Others {
    /// The frames 0 to `frames - 1` without the frame `without`.
    pub(crate) fn of(without: usize, frames: usize) -> Self {
        Others { without, left: frames - 1, moved: HashMap::new() }
    }

    /// The next one; `None` after the last one.
    pub(crate) fn draw(&mut self, random: &mut Stream) -> Option<usize> {
        let last = self.left.checked_sub(1)?;
        let place = random.random_range(0..self.left);
        let at_last = self.moved.remove(&last).unwrap_or(last);
        let drawn = if place == last { at_last } else { self.moved.insert(place, at_last).unwrap_or(place) };
        self.left = last;
        // Numbers from the frame on that is left out stand for the frames behind it.
        Some(drawn + usize::from(drawn >= self.without))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn others_are_drawn_once_each_and_alike() {
        for (without, frames) in [(0, 1), (0, 2), (1, 2), (0, 40), (17, 40), (39, 40)] {
            let all = |seed| {
                let (mut others, mut random) = (Others::of(without, frames), stream(seed, "augment", 3, 0));
                std::iter::from_fn(|| others.draw(&mut random)).collect::<Vec<usize>>()
            };
            let (drawn, mut sorted) = (all(1), all(1));
            sorted.sort_unstable();
            assert!(
                sorted.iter().copied().eq((0..frames).filter(|i| *i != without)),
                "{without} of {frames}: {drawn:?}"
            );
            assert!(frames < 40 || drawn != all(2));
        }
        let mut counts = [0; 4];
        for epoch in 0..3000 {
            counts[Others::of(2, 4).draw(&mut stream(1, "augment", epoch, 2)).unwrap()] += 1;
        }
        assert!(counts[2] == 0 && [0, 1, 3].iter().all(|i| (900..1100).contains(&counts[*i])), "{counts:?}");
    }

    #[test]
    fn memory_grows_with_what_is_drawn_not_with_the_frames() {
        let (mut others, mut random) = (Others::of(5, 1_000_000), stream(1, "augment", 0, 5));
        for drawn in 1..=10 {
            others.draw(&mut random).unwrap();
            assert!(others.moved.len() <= drawn);
        }
    }

    #[test]
    fn orders_are_those_of_the_seed() {
        // As the first version of the program had them.
        let orders = EpochOrders::new(1, 8);
        let wanted = [[5, 4, 7, 2, 6, 0, 3, 1], [4, 2, 3, 6, 1, 0, 5, 7], [5, 2, 1, 0, 4, 7, 3, 6]];
        assert_eq!([0, 1, 74].map(|epoch| orders.of(epoch).to_vec()), wanted);
        // A permutation of indices of another size is the same one.
        let orders = EpochOrders::new(7, 1000);
        for epoch in [5, 0, 1, 5, 2] {
            let mut wanted: Vec<usize> = (0..1000).collect();
            wanted.shuffle(&mut stream(7, "order", epoch, 0));
            assert!(orders.of(epoch).iter().map(|i| *i as usize).eq(wanted), "epoch {epoch}");
        }
        assert_eq!(orders.known.lock().unwrap().len(), KEPT);
    }
}
