//! One seed, named streams: no random number depends on how many workers there are or where a run was resumed.

use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use sha2::{Digest, Sha256};

/// A stream of random numbers.
pub type Stream = ChaCha8Rng;

/// The stream of (seed, purpose, epoch, sample): equal keys give equal numbers, different keys unrelated ones.
pub fn stream(seed: u64, purpose: &str, epoch: u64, sample: u64) -> Stream {
    let mut key = Sha256::new();
    key.update(seed.to_le_bytes());
    key.update(epoch.to_le_bytes());
    key.update(sample.to_le_bytes());
    key.update(purpose.as_bytes());
    ChaCha8Rng::from_seed(key.finalize().into())
}
