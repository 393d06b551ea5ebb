//! The memory allocator of every program that links this crate.

/// Training steps allocate and free large buffers. mimalloc keeps them for reuse; the system allocator would return
/// them to the system.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// mimalloc's `mi_option_purge_delay`: time after which unused memory is returned to the system, ms.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

/// Keeps unused memory for one minute. mimalloc's default is one second, less than a training step of a large network
/// can take; requesting the memory again would then cost up to a fifth of the step. A value from the environment takes
/// precedence.
///
/// # Safety
/// Must be called before any other thread starts.
pub unsafe fn keep_memory() {
    // SAFETY: the caller guarantees that no other thread runs.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, 60_000) };
}
