//! The program `lidarshift`.

use std::process::ExitCode;

/// Networks allocate and free large buffers every step; this allocator reuses them where the system's returns them.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    lidarshift::run()
}
