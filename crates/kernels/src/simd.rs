//! Which vector instructions the kernels use, found at run time.

use pulp::{Scalar128b, Simd, WithSimd};
use std::ops::{Add, Mul, Sub};
use std::sync::LazyLock;

/// The environment variable that limits the instruction set: `portable`, `neon`, `avx2` or `avx512`.
pub const VARIABLE: &str = "LIDARSHIFT_SIMD";

/// A set of vector instructions. The last digits of a sum depend on it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum InstructionSet {
    /// Four lanes in plain Rust, for every compiler target; no fused multiply-add.
    Portable,
    /// ARM: four lanes, fused multiply-add, 32 registers.
    Neon,
    /// x86-64-v3: eight lanes, fused multiply-add, 16 registers.
    Avx2,
    /// x86-64-v4: sixteen lanes, fused multiply-add, 32 registers.
    Avx512,
}

/// The variable [`VARIABLE`] does not hold the name of an instruction set.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{VARIABLE} is \"{0}\"; it may be portable, neon, avx2 or avx512, or not set at all")]
pub struct UnknownInstructionSet(pub String);

impl InstructionSet {
    /// The set in use: the fastest one of this processor, limited by [`VARIABLE`].
    ///
    /// # Errors
    /// An unknown name in the variable. The kernels then use the fastest set.
    pub fn in_use() -> Result<Self, UnknownInstructionSet> {
        IN_USE.clone()
    }

    /// The sets of this processor, slowest first.
    pub fn available() -> Vec<Self> {
        let mut sets = vec![InstructionSet::Portable];
        #[cfg(target_arch = "x86_64")]
        {
            sets.extend(pulp::x86::V3::try_new().map(|_| InstructionSet::Avx2));
            sets.extend(pulp::x86::V4::try_new().map(|_| InstructionSet::Avx512));
        }
        #[cfg(target_arch = "aarch64")]
        sets.extend(pulp::aarch64::Neon::try_new().map(|_| InstructionSet::Neon));
        sets
    }

    /// Its name in [`VARIABLE`].
    pub fn name(self) -> &'static str {
        match self {
            InstructionSet::Portable => "portable",
            InstructionSet::Neon => "neon",
            InstructionSet::Avx2 => "avx2",
            InstructionSet::Avx512 => "avx512",
        }
    }

    fn not_above(name: &str) -> Result<Self, UnknownInstructionSet> {
        use InstructionSet::{Avx2, Avx512, Neon, Portable};
        let named = [Portable, Neon, Avx2, Avx512].into_iter().find(|set| set.name() == name);
        let most = named.ok_or_else(|| UnknownInstructionSet(name.into()))?;
        Ok(Self::available().into_iter().rfind(|&set| set <= most).unwrap_or(Portable))
    }
}

static IN_USE: LazyLock<Result<InstructionSet, UnknownInstructionSet>> = LazyLock::new(|| {
    let name = std::env::var_os(VARIABLE).map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    InstructionSet::not_above(if name.is_empty() { InstructionSet::Avx512.name() } else { &name })
});

/// The token of pulp which proves that the processor has the instructions.
#[derive(Clone, Copy)]
enum Token {
    Portable,
    #[cfg(target_arch = "aarch64")]
    Neon(pulp::aarch64::Neon),
    #[cfg(target_arch = "x86_64")]
    Avx2(pulp::x86::V3),
    #[cfg(target_arch = "x86_64")]
    Avx512(pulp::x86::V4),
}

static TOKEN: LazyLock<Token> = LazyLock::new(|| {
    let best = InstructionSet::available().last().copied().unwrap_or(InstructionSet::Portable);
    let token = match InstructionSet::in_use().unwrap_or(best) {
        #[cfg(target_arch = "aarch64")]
        InstructionSet::Neon => pulp::aarch64::Neon::try_new().map(Token::Neon),
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx2 => pulp::x86::V3::try_new().map(Token::Avx2),
        #[cfg(target_arch = "x86_64")]
        InstructionSet::Avx512 => pulp::x86::V4::try_new().map(Token::Avx512),
        _ => None,
    };
    token.unwrap_or(Token::Portable)
});

/// Runs `kernel` with the instruction set in use. Every function that it calls must be `#[inline(always)]` to be
/// compiled with this set. Do not use registers in closures passed to the standard library (`array::from_fn`, `map`):
/// these are separate functions.
pub(crate) fn dispatch<K: WithSimd>(kernel: K) -> K::Output {
    match *TOKEN {
        #[cfg(target_arch = "aarch64")]
        Token::Neon(simd) => Simd::vectorize(simd, kernel),
        #[cfg(target_arch = "x86_64")]
        Token::Avx2(simd) => Simd::vectorize(simd, kernel),
        #[cfg(target_arch = "x86_64")]
        Token::Avx512(simd) => Simd::vectorize(simd, kernel),
        Token::Portable => Simd::vectorize(Scalar128b, kernel),
    }
}

/// Runs a closure compiled with the instruction set in use, so that the compiler vectorises its loops over `f32`.
pub(crate) fn vectorized<R>(work: impl FnOnce() -> R) -> R {
    struct Work<F>(F);
    impl<R, F: FnOnce() -> R> WithSimd for Work<F> {
        type Output = R;

        #[inline(always)]
        fn with_simd<S: Simd>(self, _: S) -> R {
            (self.0)()
        }
    }
    dispatch(Work(work))
}

/// One register of values with overloaded arithmetic operators.
#[derive(Clone, Copy)]
pub(crate) struct Lanes<S: Simd> {
    simd: S,
    /// The register.
    pub values: S::f32s,
}

impl<S: Simd> Lanes<S> {
    #[inline(always)]
    pub fn new(simd: S, values: S::f32s) -> Self {
        Lanes { simd, values }
    }
}

impl<S: Simd> Add for Lanes<S> {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        Lanes { simd: self.simd, values: self.simd.add_f32s(self.values, other.values) }
    }
}

impl<S: Simd> Sub for Lanes<S> {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        Lanes { simd: self.simd, values: self.simd.sub_f32s(self.values, other.values) }
    }
}

impl<S: Simd> Mul<f32> for Lanes<S> {
    type Output = Self;

    #[inline(always)]
    fn mul(self, factor: f32) -> Self {
        Lanes { simd: self.simd, values: self.simd.mul_f32s(self.values, self.simd.splat_f32s(factor)) }
    }
}

/// `a b + c`, fused if the instruction set has fused multiply-add.
#[inline(always)]
pub(crate) fn multiply_add<S: Simd>(simd: S, a: S::f32s, b: S::f32s, c: S::f32s) -> S::f32s {
    // In pulp's portable set the fused form is a function call for each lane.
    if std::any::TypeId::of::<S>() == std::any::TypeId::of::<Scalar128b>() {
        simd.add_f32s(simd.mul_f32s(a, b), c)
    } else {
        simd.mul_add_e_f32s(a, b, c)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_restricts_the_set() {
        let best = *InstructionSet::available().last().unwrap();
        assert_eq!(InstructionSet::not_above("portable"), Ok(InstructionSet::Portable));
        assert_eq!(InstructionSet::not_above("avx512"), Ok(best));
        for set in InstructionSet::available() {
            assert_eq!(InstructionSet::not_above(set.name()), Ok(set));
        }
        let error = InstructionSet::not_above("avx9").unwrap_err();
        assert_eq!(
            error.to_string(),
            "LIDARSHIFT_SIMD is \"avx9\"; it may be portable, neon, avx2 or avx512, or not set at all"
        );
    }

    /// Runs the comparisons with the definitions in one process per set, because the set is chosen once per process.
    #[test]
    fn kernels_equal_their_definitions_with_older_instructions() {
        if std::env::var_os(VARIABLE).is_some() {
            return;
        }
        let mut sets = InstructionSet::available();
        sets.pop();
        for set in sets {
            let tests = std::env::current_exe().unwrap();
            let run = std::process::Command::new(tests)
                .args(["equals_the", "nan_propagates", "the_named_set_is_in_use"])
                .env(VARIABLE, set.name())
                .output()
                .unwrap();
            let said = String::from_utf8_lossy(&run.stdout);
            assert!(run.status.success() && said.contains("the_named_set_is_in_use ... ok"), "{}: {said}", set.name());
        }
    }

    #[test]
    fn the_named_set_is_in_use() {
        if let Ok(name) = std::env::var(VARIABLE) {
            assert_eq!(InstructionSet::in_use().unwrap().name(), name);
        }
    }

    #[test]
    fn closures_run_with_the_set() {
        let values: Vec<f32> = (0..100).map(|i| i as f32).collect();
        assert_eq!(vectorized(|| values.iter().sum::<f32>()), 4950.0);
    }
}
