//! `cargo xtask format`: rustfmt on every source file. `cargo fmt` does not find files that are named in a macro
//! (`effects!`, `commands!`, `figures!`).

use crate::tidy::texts;
use anyhow::{Context, Result, bail};
use std::path::Path;
use std::process::{Command, Stdio};

/// Formats all sources, or only checks them with `check`. Prints a note if rustfmt is not installed.
pub fn format(root: &Path, check: bool) -> Result<()> {
    let there = Command::new("rustfmt").arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !there.is_ok_and(|status| status.success()) {
        eprintln!("rustfmt is not installed: skipped (rustup component add rustfmt)");
        return Ok(());
    }
    let sources = texts(root)?.into_iter().filter(|path| path.extension().is_some_and(|ending| ending == "rs"));
    let mut rustfmt = Command::new("rustfmt");
    rustfmt.args(["--edition", "2024"]).args(check.then_some("--check")).args(sources).current_dir(root);
    if !rustfmt.status().context("rustfmt could not be started")?.success() {
        bail!("rustfmt: `cargo xtask format` formats all sources");
    }
    Ok(())
}
