//! Named random streams from one seed. Random numbers depend neither on the number of workers nor on resuming a run.

use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};
use sha2::{Digest, Sha256};

/// A random number generator.
pub type Stream = ChaCha8Rng;

/// The random stream of a key (seed, purpose, epoch, sample). Equal keys give equal numbers, different keys independent
/// ones. The ChaCha8 key is the SHA-256 of these values.
pub fn stream(seed: u64, purpose: &str, epoch: u64, sample: u64) -> Stream {
    let mut key = Sha256::new();
    key.update(seed.to_le_bytes());
    key.update(epoch.to_le_bytes());
    key.update(sample.to_le_bytes());
    key.update(purpose.as_bytes());
    ChaCha8Rng::from_seed(key.finalize().into())
}
