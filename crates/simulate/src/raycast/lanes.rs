//! The vector operations of the traversal for any width, and their portable implementation.

/// `WIDTH` f32 values processed in parallel.
///
/// # Safety
/// The CPU must support the instructions of the implementing type; pointers must be valid for `WIDTH` values.
pub(super) trait Lanes: Copy {
    const WIDTH: usize;
    type Mask: Copy;
    unsafe fn splat(v: f32) -> Self;
    unsafe fn load(from: *const f32) -> Self;
    unsafe fn store(self, to: *mut f32);
    unsafe fn add(self, b: Self) -> Self;
    unsafe fn sub(self, b: Self) -> Self;
    unsafe fn mul(self, b: Self) -> Self;
    unsafe fn div(self, b: Self) -> Self;
    /// `self * b + c` with a single rounding.
    unsafe fn mul_add(self, b: Self, c: Self) -> Self;
    unsafe fn min(self, b: Self) -> Self;
    unsafe fn max(self, b: Self) -> Self;
    unsafe fn le(self, b: Self) -> Self::Mask;
    unsafe fn lt(self, b: Self) -> Self::Mask;
    unsafe fn eq(self, b: Self) -> Self::Mask;
    unsafe fn and(a: Self::Mask, b: Self::Mask) -> Self::Mask;
    /// Bit i is set if lane i is set.
    unsafe fn bits(mask: Self::Mask) -> u32;
    /// `b` where the mask is set, otherwise `a`.
    unsafe fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
}

/// Lanes without special instructions: identical results, slower.
#[derive(Clone, Copy)]
pub(super) struct Portable([f32; 8]);

macro_rules! lanewise {
    ($a:expr, $b:expr, $op:expr) => {
        Portable(std::array::from_fn(|i| $op($a.0[i], $b.0[i])))
    };
}

macro_rules! compare {
    ($a:expr, $b:expr, $op:tt) => {
        (0..8).fold(0, |bits, i| bits | u32::from($a.0[i] $op $b.0[i]) << i)
    };
}

impl Lanes for Portable {
    const WIDTH: usize = 8;
    type Mask = u32;
    unsafe fn splat(v: f32) -> Self {
        Portable([v; 8])
    }
    unsafe fn load(from: *const f32) -> Self {
        Portable(unsafe { from.cast::<[f32; 8]>().read() })
    }
    unsafe fn store(self, to: *mut f32) {
        unsafe { to.cast::<[f32; 8]>().write(self.0) }
    }
    unsafe fn add(self, b: Self) -> Self {
        lanewise!(self, b, |a: f32, b: f32| a + b)
    }
    unsafe fn sub(self, b: Self) -> Self {
        lanewise!(self, b, |a: f32, b: f32| a - b)
    }
    unsafe fn mul(self, b: Self) -> Self {
        lanewise!(self, b, |a: f32, b: f32| a * b)
    }
    unsafe fn div(self, b: Self) -> Self {
        lanewise!(self, b, |a: f32, b: f32| a / b)
    }
    unsafe fn mul_add(self, b: Self, c: Self) -> Self {
        Portable(std::array::from_fn(|i| self.0[i].mul_add(b.0[i], c.0[i])))
    }
    unsafe fn min(self, b: Self) -> Self {
        lanewise!(self, b, |a: f32, b: f32| if a < b { a } else { b })
    }
    unsafe fn max(self, b: Self) -> Self {
        lanewise!(self, b, |a: f32, b: f32| if a > b { a } else { b })
    }
    unsafe fn le(self, b: Self) -> u32 {
        compare!(self, b, <=)
    }
    unsafe fn lt(self, b: Self) -> u32 {
        compare!(self, b, <)
    }
    unsafe fn eq(self, b: Self) -> u32 {
        compare!(self, b, ==)
    }
    unsafe fn and(a: u32, b: u32) -> u32 {
        a & b
    }
    unsafe fn bits(mask: u32) -> u32 {
        mask
    }
    unsafe fn select(mask: u32, a: Self, b: Self) -> Self {
        Portable(std::array::from_fn(|i| if mask >> i & 1 != 0 { b.0[i] } else { a.0[i] }))
    }
}
