//! The program `lidarshift`.

use std::process::ExitCode;

/// Networks allocate and free large buffers every step; this allocator reuses them where the system's returns them.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// mimalloc's `mi_option_purge_delay`: milliseconds after which unused memory goes back to the system.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;

fn main() -> ExitCode {
    // A step of a large network may take longer than mimalloc's own second, and getting its memory back a fifth of the step.
    // SAFETY: no other thread runs yet. A value from the environment goes first.
    unsafe { libmimalloc_sys::mi_option_set_default(PURGE_DELAY, 60_000) };
    lidarshift::run()
}
