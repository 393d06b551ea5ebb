//! Paths of the data that the tests of several crates share.
