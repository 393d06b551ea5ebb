//! Cases of the loop, in which a diagnosis is applied and diagnosed again: what a seed stands for.

use crate::case::{CAUSES, Kind};
use crate::variant::{Intensity, Variant};

/// First seed of the loop; seeds from here hide an effect.
pub const FIRST_SEED: u64 = 50_001;
/// Seeds from here hide nothing.
pub const FIRST_NULL_SEED: u64 = 59_001;

/// Kind and variant of a seed.
///
/// Seeds from [`FIRST_SEED`] go through the causes, seeds from [`FIRST_NULL_SEED`] have none. The intensity column is
/// that of round + cause / 4 (mod 4). Number of sensors and content of the rig file are the two bits of the number of
/// the column, exclusive-or with those of the cause. In four rounds a cause meets each column once and each of the
/// other levels twice; four causes in a row meet all 16 combinations.
pub fn loop_cell(seed: u64) -> (Kind, Variant) {
    let n = CAUSES.len() as u64;
    let (kind, index, round) = if seed >= FIRST_NULL_SEED {
        (Kind::Null, (seed - FIRST_NULL_SEED) % 4, (seed - FIRST_NULL_SEED) / 4)
    } else {
        let index = (seed - FIRST_SEED) % n;
        (Kind::Single(index as usize), index, (seed - FIRST_SEED) / n)
    };
    let column = (round + index / 4) % 4;
    let bits = column ^ (index % 4);
    let variant = Variant {
        sensors: Some(if bits & 1 == 0 { 1 } else { 3 }),
        intensity: Intensity::ALL[column as usize],
        rig_has_pattern: bits & 2 == 0,
    };
    (kind, variant)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn levels_occur_equally_often() {
        let n = CAUSES.len() as u64;
        let variants =
            |seeds: &mut dyn Iterator<Item = u64>| -> Vec<Variant> { seeds.map(|s| loop_cell(s).1).collect() };
        for cause in 0..n {
            let of_cause = variants(&mut (0..4).map(|round| FIRST_SEED + cause + n * round));
            assert_eq!(of_cause.iter().filter(|v| v.sensors == Some(3)).count(), 2);
            assert_eq!(of_cause.iter().filter(|v| v.rig_has_pattern).count(), 2);
            assert_eq!(of_cause.iter().map(|v| v.intensity.name()).collect::<BTreeSet<_>>().len(), 4);
        }
        let all = |v: &[Variant]| v.iter().map(|v| format!("{v:?}")).collect::<BTreeSet<_>>().len();
        let four = variants(&mut (0..4).flat_map(|c| (0..4).map(move |round| FIRST_SEED + 8 + c + n * round)));
        assert_eq!(all(&four), 16);
        assert_eq!(all(&variants(&mut (FIRST_NULL_SEED..FIRST_NULL_SEED + 16))), 16);
    }
}
