//! Shared by the tests of all kernels: random values, comparison with f64, comparison of thread counts.

/// Values in [-1, 1), the same on every machine (xorshift).
pub fn random(n: usize, seed: u64) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let next = |_| {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    (0..n).map(next).collect()
}

/// Asserts that the largest difference is at most `tolerance` times the largest value.
pub fn assert_close(got: &[f32], want: &[f64], tolerance: f64, what: &str) {
    assert_eq!(got.len(), want.len(), "elements of {what}");
    let largest = want.iter().fold(0.0f64, |m, v| m.max(v.abs())).max(1e-30);
    for (i, (&got, &want)) in got.iter().zip(want).enumerate() {
        let error = (got as f64 - want).abs() / largest;
        assert!(error <= tolerance, "{what}, element {i}: {got} instead of {want}, error {error:.1e} of {largest}");
    }
}

/// Asserts that one, two and three threads give the same bits.
pub fn assert_same_for_threads<const N: usize>(work: impl Fn() -> [Vec<f32>; N] + Sync) {
    let bits = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
        pool.install(&work).map(|values| values.into_iter().map(f32::to_bits).collect::<Vec<_>>())
    };
    let one = bits(1);
    assert!(one.iter().any(|values| !values.is_empty()));
    for threads in [2, 3] {
        assert!(bits(threads) == one, "{threads} threads give different bits");
    }
}
