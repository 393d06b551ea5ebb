//! Counts of what both sides show alike, and one of them more of.

/// Gain of a count out of `all` by a rate over another rate, nats (Poisson).
pub fn gain_of_count(count: f64, all: f64, rate: f64, base: f64) -> f64 {
    count * (rate / base).ln() - all * (rate - base)
}

/// Steps by which the factor of a frame is found.
const STEPS: usize = 20;

/// Shape of the gamma distribution of the factor, whose mean is 1: its standard deviation is one half.
const SHAPE: f64 = 4.0;

/// Smallest expected count.
const LEAST: f64 = 1e-6;

/// Logarithm of the likelihood of counts by bin of a frame's measured and simulated side (Poisson), up to a constant.
/// `base` is expected of either side in the mean over frames, `more` on the measured side beyond it.
///
/// Both sides show the same world. Where it has more edges or leaves both count more: `base` has a factor, drawn from a
/// gamma distribution for each frame. The likeliest one is taken, by expectation and maximisation.
pub fn likelihood_of_counts(counts: [&[f64]; 2], base: [&[f64]; 2], more: &[f64]) -> f64 {
    let factor = factor_of_counts(counts, base, more);
    let of_bin = |k: usize| {
        let [measured, simulated] = [0, 1].map(|side| factor * base[side][k].max(LEAST));
        let measured = measured + more[k];
        counts[0][k] * measured.ln() - measured + counts[1][k] * simulated.ln() - simulated
    };
    (0..more.len()).map(of_bin).sum::<f64>() + SHAPE * (factor.ln() - factor)
}

/// The likeliest factor of a frame on what is expected of both sides, as above.
pub fn factor_of_counts(counts: [&[f64]; 2], base: [&[f64]; 2], more: &[f64]) -> f64 {
    let bins = 0..more.len();
    let base_of = |side: usize, k: usize| base[side][k].max(LEAST);
    let all: f64 = bins.clone().map(|k| base_of(0, k) + base_of(1, k)).sum();
    let mut factor = 1.0;
    for _ in 0..STEPS {
        // Of the measured ones those that are of the world.
        let of_world = |k: usize| counts[0][k] * factor * base_of(0, k) / (factor * base_of(0, k) + more[k]);
        let number: f64 = bins.clone().map(|k| of_world(k) + counts[1][k]).sum();
        factor = (number + SHAPE) / (all + SHAPE);
    }
    factor
}

/// Shape of the gamma distribution of the factor between the two sides of what both show alike, in one bin: its
/// standard deviation is 0.35.
const BESIDE_SHAPE: f64 = 8.0;

/// Logarithm of the likelihood of one side's count in a bin (Poisson), up to a constant, and the factor on `base` for
/// which it is largest: the other side shows `base` of the same world, but by other shots and with other noise. `more`
/// is expected beyond it.
pub fn likelihood_beside(count: f64, base: f64, more: f64) -> [f64; 2] {
    let (base, shape) = (base.max(LEAST), BESIDE_SHAPE);
    // Where the derivative by the factor f is zero: count / (f base + more) base - base + shape / f - shape = 0.
    let square = (base + shape) * base;
    let linear = (base + shape) * more - (count + shape) * base;
    let factor = (-linear + (linear * linear + 4.0 * square * shape * more).sqrt()) / (2.0 * square);
    let factor = factor.max(LEAST);
    let expected = factor * base + more;
    [count * expected.ln() - expected + shape * (factor.ln() - factor), factor]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_both_sides_show_more_of_is_no_excess() {
        let gain = |counts: [f64; 2]| {
            let likelihood =
                |more: f64| likelihood_of_counts([&counts[..1], &counts[1..]], [&[100.0], &[100.0]], &[more]);
            likelihood(50.0) - likelihood(0.0)
        };
        assert!(gain([150.0, 100.0]) > 4.0 && gain([350.0, 300.0]) > 1.5, "50 more on the measured side");
        assert!(gain([300.0, 300.0]) < -1.0, "a world with three times as many");
        assert!(gain_of_count(300.0, 1.0, 150.0, 100.0) > 70.0, "of which the mean world says otherwise");
        assert!(gain([100.0, 100.0]) < -2.0 && gain([0.0, 0.0]).is_finite());
        // Where the world has none, no factor makes some of it.
        let likelihood = |more: f64| likelihood_of_counts([&[20.0], &[0.0]], [&[0.01], &[0.01]], &[more]);
        let gain = likelihood(20.0) - likelihood(0.0);
        assert!(gain > 100.0 && gain / gain_of_count(20.0, 1.0, 20.0, 0.01) > 0.8, "{gain}");
    }

    #[test]
    fn the_factor_beside_the_other_side_is_the_likeliest() {
        let of_factor = |f: f64, [count, base, more]: [f64; 3]| {
            let expected = f * base + more;
            count * expected.ln() - expected + BESIDE_SHAPE * (f.ln() - f)
        };
        for case in [[40.0, 30.0, 0.0], [40.0, 30.0, 25.0], [3.0, 300.0, 10.0], [5.0, 0.0, 4.0], [0.0, 20.0, 0.0]] {
            let [likelihood, factor] = likelihood_beside(case[0], case[1], case[2]);
            let base = case[1].max(LEAST);
            let around = [0.9, 1.0, 1.1].map(|k| of_factor(k * factor, [case[0], base, case[2]]));
            assert!(around[1] >= around[0] && around[1] >= around[2], "{case:?} {factor} {around:?}");
            assert!((likelihood - around[1]).abs() < 1e-9);
        }
        // What the world may show more of is no evidence, where there is little of it a surplus is.
        let gain = |count: f64, base: f64, more: f64| {
            likelihood_beside(count, base, more)[0] - likelihood_beside(count, base, 0.0)[0]
        };
        assert!(gain(130.0, 100.0, 30.0) < 1.0 && gain(33.0, 3.0, 30.0) > 8.0);
    }
}
