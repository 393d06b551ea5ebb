//! The program `lidarshift`.

use std::process::ExitCode;

fn main() -> ExitCode {
    // SAFETY: no other thread runs yet.
    unsafe { lidarshift::allocator::keep_memory() };
    lidarshift::run()
}
