//! Where the tests that cross crates find their data.

use std::path::{Path, PathBuf};

/// A file or folder of the workspace.
pub fn workspace(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(path)
}

/// Data that the licence of KITTI keeps out of the repository, in `../shared` beside the workspace.
///
/// `None`, with a line on stderr, where it is absent: the test then has nothing to look at.
pub fn shared(path: &str) -> Option<PathBuf> {
    let found = workspace("../shared").join(path);
    if found.exists() {
        return Some(found);
    }
    eprintln!("not tested: {} does not exist", found.display());
    None
}
