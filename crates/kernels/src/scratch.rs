//! Thread-local scratch memory for intermediate values.

use std::cell::RefCell;

/// Floats in a cache line.
const LINE: usize = 16;

thread_local! {
    static KEPT: RefCell<Vec<Vec<f32>>> = const { RefCell::new(Vec::new()) };
}

/// Lends buffers of these lengths, aligned to cache lines, with undefined contents.
///
/// Nested calls inside `work` get other memory.
pub(crate) fn with<const N: usize, R>(lengths: [usize; N], work: impl FnOnce([&mut [f32]; N]) -> R) -> R {
    let mut memory = KEPT.with_borrow_mut(Vec::pop).unwrap_or_default();
    let needed = lengths.iter().map(|n| n.next_multiple_of(LINE)).sum::<usize>() + LINE;
    if memory.len() < needed {
        memory = vec![0.0; needed];
    }
    let start = memory.as_ptr().align_offset(LINE * size_of::<f32>()).min(LINE);
    let mut rest = &mut memory[start..];
    let result = work(lengths.map(|n| {
        let (buffer, behind) = std::mem::take(&mut rest).split_at_mut(n.next_multiple_of(LINE));
        rest = behind;
        &mut buffer[..n]
    }));
    KEPT.with_borrow_mut(|kept| kept.push(memory));
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn buffers_are_aligned_apart_and_kept() {
        let first = with([3, 40, 0], |[a, b, c]| {
            assert_eq!((a.len(), b.len(), c.len()), (3, 40, 0));
            assert!(a.as_ptr().addr().is_multiple_of(64) && b.as_ptr().addr().is_multiple_of(64));
            a.fill(1.0);
            b.fill(2.0);
            with([3], |[d]| d.fill(3.0));
            assert!(a.iter().all(|&v| v == 1.0) && b.iter().all(|&v| v == 2.0));
            a.as_ptr() as usize
        });
        assert_eq!(with([2], |[a]| a.as_ptr() as usize), first);
    }
}
