//! Resampling with replacement for the bootstrap: of single members, of runs of consecutive members, of blocks.

use rand::{Rng, RngExt};

/// Draws `n` indices from `0..n` with replacement.
pub fn draw(n: usize, rng: &mut impl Rng) -> Vec<usize> {
    (0..n).map(|_| rng.random_range(0..n)).collect()
}

/// Circular block bootstrap: draws runs of `run` consecutive members, with wrap-around, until `n` members are drawn.
/// The last run is shortened. Returns how often each of the `n` members is drawn.
pub fn draw_runs(n: usize, run: usize, rng: &mut impl Rng) -> Vec<u32> {
    let mut weights = vec![0; n];
    let run = run.clamp(1, n.max(1));
    let mut remaining = n;
    while remaining > 0 {
        let first = rng.random_range(0..n);
        for i in 0..run.min(remaining) {
            weights[(first + i) % n] += 1;
        }
        remaining -= run.min(remaining);
    }
    weights
}

/// Block bootstrap: draws as many blocks as there are, with replacement, and returns their members. `members[b]` lists
/// the members of block b. Blocks may differ in size and are never cut, so the number of drawn members varies.
pub fn draw_blocks(members: &[Vec<usize>], rng: &mut impl Rng) -> Vec<usize> {
    let mut drawn = Vec::new();
    for _ in 0..members.len() {
        drawn.extend(&members[rng.random_range(0..members.len())]);
    }
    drawn
}

/// Groups consecutive members with equal block numbers. Returns the indices of the members of each block.
pub fn blocks_of(numbers: &[usize]) -> Vec<Vec<usize>> {
    let mut members: Vec<Vec<usize>> = Vec::new();
    let mut last = None;
    for (i, number) in numbers.iter().enumerate() {
        if last != Some(number) {
            members.push(Vec::new());
            last = Some(number);
        }
        if let Some(block) = members.last_mut() {
            block.push(i);
        }
    }
    members
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng as _;

    fn rng(seed: u64) -> ChaCha8Rng {
        ChaCha8Rng::seed_from_u64(seed)
    }

    #[test]
    fn every_draw_has_n_members() {
        for run in [1, 7, 1000] {
            let weights = draw_runs(100, run, &mut rng(3));
            assert_eq!(weights.iter().sum::<u32>(), 100);
            let all = run >= 100; // each draw then has every member once
            assert_eq!(weights == draw_runs(100, run, &mut rng(4)), all);
        }
        assert!(draw_runs(0, 1, &mut rng(0)).is_empty() && draw(0, &mut rng(0)).is_empty());
        assert!(draw(9, &mut rng(1)).iter().all(|i| *i < 9));
    }

    #[test]
    fn blocks_stay_whole() {
        let blocks = blocks_of(&[4, 4, 0, 7, 7, 7]);
        assert_eq!(blocks, [vec![0, 1], vec![2], vec![3, 4, 5]]);
        for seed in 0..20 {
            let drawn = draw_blocks(&blocks, &mut rng(seed));
            let of = |i: usize| drawn.iter().filter(|d| **d == i).count();
            assert!(of(0) == of(1) && of(3) == of(4) && of(4) == of(5));
            assert_eq!(of(0) + of(2) + of(3), 3);
        }
        assert!(draw_blocks(&[], &mut rng(0)).is_empty());
    }
}
