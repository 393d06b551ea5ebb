//! Vectors that several threads fill, without writing zeros first.

use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Makes `out` a vector of `len` values that `write` writes, in the memory that it has, if that is enough.
///
/// # Safety
/// `write` writes every element.
pub(crate) unsafe fn fill<T: Number, R>(
    out: &mut Vec<T>,
    len: usize,
    write: impl FnOnce(&mut [MaybeUninit<T>]) -> R,
) -> R {
    out.clear();
    out.reserve_exact(len);
    let memory = &mut out.spare_capacity_mut()[..len];
    if cfg!(debug_assertions) {
        memory.fill(MaybeUninit::new(T::UNWRITTEN)); // what is left out is seen in tests
    }
    let result = write(memory);
    // SAFETY: the memory is there, and the caller promises that all of it was written.
    unsafe { out.set_len(len) };
    result
}

/// What results are made of.
pub(crate) trait Number: Copy + Send + Sync {
    /// A value that no kernel writes by itself.
    const UNWRITTEN: Self;
}

impl Number for f32 {
    const UNWRITTEN: f32 = f32::NAN;
}

impl Number for u32 {
    const UNWRITTEN: u32 = u32::MAX / 3;
}

/// Memory that several threads write, each to places of its own.
#[derive(Clone, Copy)]
pub(crate) struct Shared<'a, T = f32> {
    start: *mut MaybeUninit<T>,
    len: usize,
    memory: PhantomData<&'a mut [MaybeUninit<T>]>,
}

// SAFETY: whoever writes promises in `write` and `part` that no other thread uses the same place.
unsafe impl<T: Number> Send for Shared<'_, T> {}
// SAFETY: as above.
unsafe impl<T: Number> Sync for Shared<'_, T> {}

impl<'a, T: Number> Shared<'a, T> {
    pub fn new(memory: &'a mut [MaybeUninit<T>]) -> Self {
        Shared { start: memory.as_mut_ptr(), len: memory.len(), memory: PhantomData }
    }

    /// Puts `values` at `at`.
    ///
    /// # Safety
    /// No other thread uses these places until the borrow of the memory ends.
    #[inline(always)]
    pub unsafe fn write(&self, at: usize, values: &[T]) {
        assert!(at <= self.len && values.len() <= self.len - at, "a write outside of the memory");
        // SAFETY: inside of the memory as asserted, nobody else is there as promised, and `values` is other memory.
        unsafe { std::ptr::copy_nonoverlapping(values.as_ptr().cast(), self.start.add(at), values.len()) };
    }

    /// The places `at..at + len`.
    ///
    /// # Safety
    /// No other thread uses these places until the borrow of the memory ends, and this thread asks for them once.
    #[inline(always)]
    pub unsafe fn part(&self, at: usize, len: usize) -> &'a mut [MaybeUninit<T>] {
        assert!(at <= self.len && len <= self.len - at, "a part outside of the memory");
        // SAFETY: inside of the memory as asserted, and nobody else is there as promised.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(at), len) }
    }
}
