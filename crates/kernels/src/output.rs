//! Output vectors that several threads fill without zero initialisation.

use std::marker::PhantomData;
use std::mem::MaybeUninit;

/// Resizes `out` to `len` values written by `write`, and reuses its memory if it is large enough.
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
        memory.fill(MaybeUninit::new(T::UNWRITTEN)); // tests detect elements that were not written
    }
    let result = write(memory);
    // SAFETY: the memory is allocated, and the caller guarantees that all of it was written.
    unsafe { out.set_len(len) };
    result
}

/// Element type of results.
pub(crate) trait Number: Copy + Send + Sync {
    /// A value that no kernel computes.
    const UNWRITTEN: Self;
}

impl Number for f32 {
    const UNWRITTEN: f32 = f32::NAN;
}

impl Number for u32 {
    const UNWRITTEN: u32 = u32::MAX / 3;
}

/// Memory that several threads write at disjoint positions.
#[derive(Clone, Copy)]
pub(crate) struct Shared<'a, T = f32> {
    start: *mut MaybeUninit<T>,
    len: usize,
    memory: PhantomData<&'a mut [MaybeUninit<T>]>,
}

// SAFETY: callers of `write` and `part` guarantee that no other thread uses the same positions.
unsafe impl<T: Number> Send for Shared<'_, T> {}
// SAFETY: as above.
unsafe impl<T: Number> Sync for Shared<'_, T> {}

impl<'a, T: Number> Shared<'a, T> {
    pub fn new(memory: &'a mut [MaybeUninit<T>]) -> Self {
        Shared { start: memory.as_mut_ptr(), len: memory.len(), memory: PhantomData }
    }

    /// Pointer to the first element.
    #[inline(always)]
    pub fn start(&self) -> *const T {
        self.start.cast()
    }

    /// Writes `values` at `at`.
    ///
    /// # Safety
    /// No other thread uses these positions until the borrow of the memory ends.
    #[inline(always)]
    pub unsafe fn write(&self, at: usize, values: &[T]) {
        assert!(at <= self.len && values.len() <= self.len - at, "write out of bounds");
        // SAFETY: in bounds as asserted, exclusive as the caller guarantees, and `values` does not overlap.
        unsafe { std::ptr::copy_nonoverlapping(values.as_ptr().cast(), self.start.add(at), values.len()) };
    }

    /// The elements `at..at + len`.
    ///
    /// # Safety
    /// No other thread uses these elements until the borrow of the memory ends, and this thread borrows them once.
    #[inline(always)]
    pub unsafe fn part(&self, at: usize, len: usize) -> &'a mut [MaybeUninit<T>] {
        assert!(at <= self.len && len <= self.len - at, "range out of bounds");
        // SAFETY: in bounds as asserted, and exclusive as the caller guarantees.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(at), len) }
    }
}
