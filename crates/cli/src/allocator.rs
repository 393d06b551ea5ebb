//! The allocator of every program that links this crate.

/// Networks allocate and free large buffers every step; this allocator reuses them where the system's returns them.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// mimalloc's `mi_option_purge_delay`: milliseconds after which unused memory goes back to the system.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

/// Keeps unused memory for a minute: a step of a large network may take longer than mimalloc's own second, and getting its memory back a
/// fifth of the step. A value from the environment goes first.
///
/// # Safety
/// No other thread runs yet.
pub unsafe fn keep_memory() {
    // SAFETY: as the caller promises.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, 60_000) };
}
