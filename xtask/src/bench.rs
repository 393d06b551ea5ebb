//! `cargo xtask bench [NAME]`: the benchmarks that the crates have.

use crate::{cargo, tidy::manifests};
use anyhow::{Result, bail};
use std::path::Path;

/// Runs the benchmarks called `name`, those of the crate folder `name`, or all.
pub fn bench(root: &Path, name: Option<&str>, criterion: &[String]) -> Result<()> {
    let mut known = Vec::new();
    let mut ran = false;
    for manifest in manifests(root)? {
        for bench in manifest.benches() {
            let wanted = name.is_none_or(|name| name == bench || name == manifest.folder);
            known.push(bench.clone());
            if !wanted {
                continue;
            }
            ran = true;
            let status = cargo(root)
                .args(["bench", "--quiet", "--package", &manifest.package, "--bench", &bench, "--"])
                .args(criterion)
                .status()?;
            if !status.success() {
                bail!("the benchmark {bench} failed");
            }
        }
    }
    if !ran {
        bail!("no such benchmark; there are: {}", if known.is_empty() { "none".into() } else { known.join(", ") });
    }
    Ok(())
}
