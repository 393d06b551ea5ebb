//! `cargo xtask bench [NAME]`: the benchmarks that the crates have, and training steps beside PyTorch's.

use crate::bench_mutants::bench_mutants;
use crate::bench_train::bench_train;
use crate::{cargo, tidy::manifests};
use anyhow::{Result, bail};
use std::path::Path;

/// Runs the benchmarks called `name`, those of the crate folder `name`, the training steps beside PyTorch's (`train`; `words` are parts of the ids
/// of the wanted rows), the blind cases with a diagnosis that is broken (`mutants`), or all benchmarks of crates.
pub fn bench(root: &Path, name: Option<&str>, words: &[String]) -> Result<()> {
    if name == Some("train") {
        return bench_train(root, words);
    }
    if name == Some("mutants") {
        return bench_mutants(root, words);
    }
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
                .args(words)
                .status()?;
            if !status.success() {
                bail!("the benchmark {bench} failed");
            }
        }
    }
    known.extend(["mutants".into(), "train".into()]);
    if !ran {
        bail!("no such benchmark; there are: {}", known.join(", "));
    }
    Ok(())
}
