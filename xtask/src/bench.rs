//! `cargo xtask bench [NAME]`: benchmarks of the crates, and training steps compared with PyTorch.

use crate::bench_gpu::bench_gpu;
use crate::bench_kills::bench_kills;
use crate::bench_mutants::bench_mutants;
use crate::bench_train::bench_train;
use crate::cargo;
use crate::tidy::{Manifest, manifests};
use anyhow::{Result, bail};
use std::path::Path;

/// Folders in `tests` whose benchmarks draw pairs with hidden differences and diagnose them.
const GENERATORS: &[&str] = &["blind", "town"];

/// Runs the benchmark `name`, the benchmarks of the crate folder `name`, the comparison of training steps with PyTorch
/// (`train`; `args` are parts of the row ids), the networks on the GPU of this machine (`gpu`), the blind cases with
/// mutated diagnosis code (`mutants`), commands that are ended by signals (`kills`), or all benchmarks of the crates.
/// Pairs with hidden differences (`blind`, `loop`, `town`) run only by name.
pub fn bench(root: &Path, name: Option<&str>, args: &[String]) -> Result<()> {
    if name == Some("train") {
        return bench_train(root, args);
    }
    if name == Some("gpu") {
        return bench_gpu(root, args);
    }
    if name == Some("mutants") {
        return bench_mutants(root, args);
    }
    if name == Some("kills") {
        return bench_kills(root, args);
    }
    let mut known = Vec::new();
    let mut ran = false;
    let mut all = manifests(root)?;
    if name.is_some() {
        for folder in GENERATORS {
            all.push(Manifest::read(root.join("tests").join(folder).join("Cargo.toml"))?);
        }
    }
    for manifest in all {
        for bench in manifest.benches() {
            // The folders of the generators have the names of some of their benchmarks.
            let of_folder = name == Some(&manifest.folder) && !GENERATORS.contains(&manifest.folder.as_str());
            let wanted = name.is_none_or(|name| name == bench) || of_folder;
            known.push(bench.clone());
            if !wanted {
                continue;
            }
            ran = true;
            let status = cargo(root)
                .args(["bench", "--quiet", "--package", &manifest.package, "--bench", &bench, "--"])
                .args(args)
                .status()?;
            if !status.success() {
                bail!("the benchmark {bench} failed");
            }
        }
    }
    known.extend(["gpu", "kills", "mutants", "train"].map(String::from));
    if !ran {
        bail!("no such benchmark; available: {}", known.join(", "));
    }
    Ok(())
}
