//! Locates the data of tests that cross crates.

use std::path::{Path, PathBuf};

/// A file or folder of the workspace.
pub fn workspace(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Data that must not be in the repository because of KITTI's licence, in `../shared` next to the workspace.
///
/// `None`, with a line on stderr, if it is absent: the test is then skipped.
pub fn shared(path: &str) -> Option<PathBuf> {
    let found = workspace("../shared").join(path);
    if found.exists() {
        return Some(found);
    }
    eprintln!("not tested: {} does not exist", found.display());
    None
}
