//! Vectors that several threads fill, without writing zeros first.

use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Makes `out` a vector of `len` values that `write` writes, in the memory that it has, if that is enough.
///
/// # Safety
/// `write` writes every element.
pub(crate) unsafe fn fill<R>(out: &mut Vec<f32>, len: usize, write: impl FnOnce(&mut [MaybeUninit<f32>]) -> R) -> R {
    out.clear();
    out.reserve_exact(len);
    let memory = &mut out.spare_capacity_mut()[..len];
    if cfg!(debug_assertions) {
        memory.fill(MaybeUninit::new(f32::NAN)); // what is left out is seen in tests
    }
    let result = write(memory);
    // SAFETY: the memory is there, and the caller promises that all of it was written.
    unsafe { out.set_len(len) };
    result
}

/// Memory that several threads write, each to places of its own.
#[derive(Clone, Copy)]
pub(crate) struct Shared<'a> {
    start: *mut MaybeUninit<f32>,
    len: usize,
    memory: PhantomData<&'a mut [MaybeUninit<f32>]>,
}

// SAFETY: whoever writes promises in `write` and `part` that no other thread uses the same place.
unsafe impl Send for Shared<'_> {}
// SAFETY: as above.
unsafe impl Sync for Shared<'_> {}

impl<'a> Shared<'a> {
    pub fn new(memory: &'a mut [MaybeUninit<f32>]) -> Self {
        Shared { start: memory.as_mut_ptr(), len: memory.len(), memory: PhantomData }
    }

    /// Puts `values` at `at`.
    ///
    /// # Safety
    /// No other thread uses these places until the borrow of the memory ends.
    #[inline(always)]
    pub unsafe fn write(&self, at: usize, values: &[f32]) {
        assert!(at <= self.len && values.len() <= self.len - at, "a write outside of the memory");
        // SAFETY: inside of the memory as asserted, nobody else is there as promised, and `values` is other memory.
        unsafe { std::ptr::copy_nonoverlapping(values.as_ptr().cast(), self.start.add(at), values.len()) };
    }

    /// The places `at..at + len`.
    ///
    /// # Safety
    /// No other thread uses these places until the borrow of the memory ends, and this thread asks for them once.
    #[inline(always)]
    pub unsafe fn part(&self, at: usize, len: usize) -> &'a mut [MaybeUninit<f32>] {
        assert!(at <= self.len && len <= self.len - at, "a part outside of the memory");
        // SAFETY: inside of the memory as asserted, and nobody else is there as promised.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(at), len) }
    }
}
