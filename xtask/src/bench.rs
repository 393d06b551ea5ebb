//! `cargo xtask bench [NAME]`: the benchmarks that the crates have, and a training step of every detector by stage.

use crate::{cargo, program, tidy::manifests};
use anyhow::{Result, bail};
use std::ffi::OsString;
use std::path::Path;

/// Detectors whose training step is timed.
const DETECTORS: [&str; 2] = ["pointpillars_small", "pointpillars"];

/// Runs the benchmarks called `name`, those of the crate folder `name`, the training steps (`train`), or all.
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
    if name.is_none_or(|name| name == "train") {
        ran = true;
        // Each in a process of its own, whose memory is measured.
        for detector in DETECTORS {
            program::run(root, &["bench-step", "--detector", detector].map(OsString::from))?;
        }
    }
    known.push("train".into());
    if !ran {
        bail!("no such benchmark; there are: {}", known.join(", "));
    }
    Ok(())
}
