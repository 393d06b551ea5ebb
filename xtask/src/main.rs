//! The program `lidarshift`.
fn main() {}
