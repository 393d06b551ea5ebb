//! Draws with replacement: of single members, of runs that follow each other, and of blocks.

use rand::{Rng, RngExt};

/// `n` draws out of `0..n`.
pub fn draw(n: usize, rng: &mut impl Rng) -> Vec<usize> {
    (0..n).map(|_| rng.random_range(0..n)).collect()
}

/// How often each of `n` members is drawn when runs of `run` members that follow each other are drawn, around the end where needed,
/// until there are `n`. The last run is cut.
pub fn draw_runs(n: usize, run: usize, rng: &mut impl Rng) -> Vec<u32> {
    let mut weights = vec![0; n];
    let run = run.clamp(1, n.max(1));
    let mut left = n;
    while left > 0 {
        let first = rng.random_range(0..n);
        for i in 0..run.min(left) {
            weights[(first + i) % n] += 1;
        }
        left -= run.min(left);
    }
    weights
}

/// The members of as many blocks as there are, drawn with replacement; `members[b]` lists the members of block b, which may be of
/// different size. Unlike [`draw_runs`] it never cuts a block, so draws differ in their number of members.
pub fn draw_blocks(members: &[Vec<usize>], rng: &mut impl Rng) -> Vec<usize> {
    let mut drawn = Vec::new();
    for _ in 0..members.len() {
        drawn.extend(&members[rng.random_range(0..members.len())]);
    }
    drawn
}

/// The blocks of members that follow each other with the same number: which members each block has.
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
    fn every_draw_has_as_many_members() {
        for run in [1, 7, 1000] {
            let weights = draw_runs(100, run, &mut rng(3));
            assert_eq!(weights.iter().sum::<u32>(), 100);
            let all = run >= 100; // every draw is then all members, once
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
