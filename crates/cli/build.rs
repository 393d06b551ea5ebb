//! Names the commit of the checkout that the program is built from, in the variable `LIDARSHIFT_COMMIT` of its
//! compilation. Without a checkout, or if the caller has set that variable, nothing is asked.
//!
//! Only this crate is compiled again after a commit. It is compiled again after a change of any file of the program in
//! any case.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

/// Name of the variable.
const VARIABLE: &str = "LIDARSHIFT_COMMIT";

fn main() {
    println!("cargo::rerun-if-env-changed={VARIABLE}");
    let manifest = Path::new(env!("CARGO_MANIFEST_DIR"));
    // A package of a registry lies among packages of others, and belongs to no checkout.
    let Some(root) = manifest.ancestors().nth(2).filter(|root| root.join("crates").join("cli") == manifest) else {
        return;
    };
    let sources = sources(root, &root.join("crates"));
    for path in &sources {
        println!("cargo::rerun-if-changed={}", path.display());
    }
    if std::env::var_os(VARIABLE).is_some() {
        return;
    }
    // Changed by every commit, checkout and reset. A path that does not exist would make every build run this program.
    let moves = ["logs/HEAD", "HEAD"].into_iter().filter_map(|name| git(root, &["rev-parse", "--git-path", name]));
    if let Some(path) = moves.map(|path| root.join(path)).find(|path| path.is_file()) {
        println!("cargo::rerun-if-changed={}", path.display());
    }
    if let Some(commit) = commit(root, &sources) {
        println!("cargo::rustc-env={VARIABLE}={commit}");
    }
}

/// Files and folders that the program is made of.
fn sources(root: &Path, crates: &Path) -> Vec<PathBuf> {
    let mut found = ["Cargo.toml", "Cargo.lock", "configs"].map(|name| root.join(name)).to_vec();
    let mut folders: Vec<PathBuf> = fs::read_dir(crates).into_iter().flatten().flatten().map(|e| e.path()).collect();
    // The others depend on the program.
    folders.retain(|folder| !folder.ends_with("python") && !folder.ends_with("checks"));
    folders.sort();
    for folder in folders {
        found.extend(["Cargo.toml", "build.rs", "src", "templates", "assets"].map(|name| folder.join(name)));
    }
    found.retain(|path| path.exists());
    found
}

/// The commit, with `-dirty` if a source was changed since; `None` if the sources do not belong to a checkout.
fn commit(root: &Path, sources: &[PathBuf]) -> Option<String> {
    git(root, &["ls-files", "--error-unmatch", "Cargo.toml"])?;
    let commit = git(root, &["rev-parse", "--short=12", "HEAD"])?;
    let mut status = vec!["status", "--porcelain", "--"];
    status.extend(sources.iter().filter_map(|path| path.to_str()));
    let dirty = if git(root, &status)?.is_empty() { "" } else { "-dirty" };
    Some(format!("{commit}{dirty}"))
}

/// What git prints; `None` if it fails or is not installed.
fn git(root: &Path, arguments: &[&str]) -> Option<String> {
    let output = Command::new("git").arg("--no-optional-locks").args(arguments).current_dir(root).output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    output.status.success().then(|| text.trim().to_string())
}
