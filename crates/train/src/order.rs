//! The order of the frames in each epoch, computed when the epoch is reached.

use data::stream;
use rand::seq::SliceRandom;
use std::collections::VecDeque;
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

#[cfg(test)]
mod tests {
    use super::*;

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
