//! `cargo package` of everything that may be published.

use crate::{cargo, ci, tidy};
use anyhow::Result;
use std::path::Path;

/// Puts the packages together as a registry would get them, below `target/package`, without building them and without
/// a network. An error if one depends on what is not published, or if a file or a version is missing.
pub fn package(root: &Path) -> Result<()> {
    let mut command = cargo(root);
    command.args(["package", "--quiet", "--no-verify", "--offline", "--allow-dirty"]);
    for manifest in tidy::manifests(root)?.iter().filter(|manifest| manifest.is_published()) {
        command.args(["--package", &manifest.package]);
    }
    ci::must(&mut command)
}
