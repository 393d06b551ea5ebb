//! `cargo xtask tidy`: checks the house rules in CONTRIBUTING.md that can be checked automatically.

mod packages;
mod printing;
mod source;
mod wording;
mod writing;

use crate::pages;
use anyhow::{Context, Result};
use fs_err as fs;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// Allowed dependencies: a crate's folder, and the folders on which it may depend directly. Indirect dependencies are
/// allowed as well.
const ARROWS: &[(&str, &[&str])] = &[
    ("configs", &[]),
    ("geometry", &[]),
    ("kernels", &[]),
    ("statistics", &[]),
    ("data", &["geometry", "statistics"]),
    ("sensor", &["data"]),
    ("simulate", &["sensor", "configs"]),
    ("twin", &["simulate"]),
    ("exchange", &["sensor"]),
    ("models", &["data", "kernels", "configs"]),
    ("eval", &["data"]),
    ("train", &["kernels", "models", "eval"]),
    // The simulator is only for its tests.
    ("diagnose", &["sensor", "simulate", "eval"]),
    ("report", &["eval", "diagnose"]),
    ("study", &["simulate", "train", "report"]),
    ("cli", &["study", "twin", "exchange"]),
    ("python", &["cli"]),
    ("checks", &["cli"]),
    ("tests", &["checks"]),
    ("xtask", &["statistics"]),
];

/// Crates that may depend on burn.
const KNOWS_BURN: &[&str] = &["models", "train", "study", "cli", "checks", "tests"];

/// File names without meaning.
const EMPTY_NAMES: &[&str] = &["utils", "util", "common", "base", "helper", "helpers", "manager"];

/// Maximum number of lines of a source file before its tests.
const MAX_LINES: usize = 400;

/// Macros for unfinished work.
const UNDONE: &[&str] = &[concat!("to", "do!("), concat!("unimple", "mented!(")];

/// Prefixes of paths that exist on one machine only.
const MACHINE_PATHS: &[&str] =
    &[concat!("/ho", "me/"), concat!("/ro", "ot/"), concat!("/wo", "rk/"), concat!("/Us", "ers/"), concat!("C:", "\\")];

/// Manifest of a workspace member.
pub struct Manifest {
    /// Name of its folder: `geometry`, `xtask`.
    pub folder: String,
    /// Name of the package.
    pub package: String,
    path: PathBuf,
    toml: toml::Table,
}

impl Manifest {
    /// Reads a `Cargo.toml`.
    pub fn read(path: PathBuf) -> Result<Self> {
        let toml: toml::Table = fs::read_to_string(&path)?.parse().with_context(|| path.display().to_string())?;
        let package = toml.get("package").and_then(|p| p.get("name")).and_then(|n| n.as_str());
        let package = package.with_context(|| format!("{}: no package.name", path.display()))?.to_owned();
        let folder = path.parent().and_then(|p| p.file_name()).context("a manifest without a folder")?;
        Ok(Manifest { folder: folder.to_string_lossy().into(), package, path, toml })
    }

    /// Names of all dependencies, including those for tests and builds.
    fn dependencies(&self) -> BTreeSet<&str> {
        self.dependency_tables().map(|(name, _)| name.as_str()).collect()
    }

    /// Name and value of each dependency, including those for tests and builds.
    fn dependency_tables(&self) -> impl Iterator<Item = (&String, &toml::Value)> {
        ["dependencies", "dev-dependencies", "build-dependencies"]
            .into_iter()
            .filter_map(|kind| self.toml.get(kind)?.as_table())
            .flatten()
    }

    /// Names of its `[[bench]]` entries.
    pub fn benches(&self) -> Vec<String> {
        let entries = self.toml.get("bench").and_then(|b| b.as_array()).into_iter().flatten();
        entries.filter_map(|b| Some(b.get("name")?.as_str()?.to_owned())).collect()
    }

    /// Whether it may be published: it takes no `publish = false`, from the workspace or of its own.
    pub fn is_published(&self) -> bool {
        self.toml.get("package").and_then(|p| p.get("publish")).is_none()
    }

    fn takes_workspace_lints(&self) -> bool {
        self.toml.get("lints").and_then(|l| l.get("workspace")).and_then(|w| w.as_bool()) == Some(true)
    }
}

/// The manifests of all workspace members, sorted by path.
pub fn manifests(root: &Path) -> Result<Vec<Manifest>> {
    let mut paths = ["configs", "tests", "xtask"].map(|folder| root.join(folder).join("Cargo.toml")).to_vec();
    for entry in fs::read_dir(root.join("crates"))? {
        paths.push(entry?.path().join("Cargo.toml"));
    }
    paths.retain(|p| p.is_file());
    paths.sort();
    paths.into_iter().map(Manifest::read).collect()
}

/// All violations of the house rules, one message each, sorted by path.
pub fn complaints(root: &Path) -> Result<Vec<String>> {
    let (mut found, mut published) = (Vec::new(), Vec::new());
    for manifest in manifests(root)? {
        let path = shown(root, &manifest.path);
        found.extend(manifest_complaints(&manifest).into_iter().map(|c| format!("{path}: {c}")));
        if manifest.is_published() {
            published.push(path.trim_end_matches("Cargo.toml").to_owned());
            found.extend(packages::complaints(&manifest).into_iter().map(|c| format!("{path}: {c}")));
        }
    }
    let files = texts(root)?;
    let pages: Vec<PathBuf> = files.iter().filter(|f| f.extension().is_some_and(|e| e == "md")).cloned().collect();
    found.extend(pages::complaints(root, &pages)?);
    for file in files {
        let path = shown(root, &file);
        let text = fs::read_to_string(&file)?;
        let mut of_file = text_complaints(&path, &text);
        of_file.extend(wording::complaints(&path, &text));
        if path.ends_with(".rs") && !is_test(&path) {
            let code = code_before_tests(&path, &text);
            of_file.extend(printing::complaints(&path, &code));
            of_file.extend(writing::complaints(&path, &code));
            let before_tests: Vec<&str> = text.lines().take(lines_before_tests(&text)).collect();
            if let Some(package) = published.iter().find(|package| path.starts_with(*package)) {
                of_file.extend(packages::outside(package, &path, &before_tests.join("\n")));
            }
        }
        of_file.sort_by_key(|(line, _)| *line);
        found.extend(of_file.into_iter().map(|(line, c)| format!("{path}:{line}: {c}")));
    }
    let lines_of = |path: &str| Some(code_before_tests(path, &fs::read_to_string(root.join(path)).ok()?));
    found.extend(writing::stale_exceptions(lines_of));
    Ok(found)
}

/// The lines of a source file up to its tests.
fn code_before_tests(path: &str, text: &str) -> Vec<source::Line> {
    let mut lines = source::lines(path, text);
    lines.truncate(lines_before_tests(text));
    lines
}

fn shown(root: &Path, path: &Path) -> String {
    path.strip_prefix(root).unwrap_or(path).display().to_string()
}

fn manifest_complaints(manifest: &Manifest) -> Vec<String> {
    let mut found = Vec::new();
    if !manifest.takes_workspace_lints() {
        found.push("the lints of the workspace are missing: add `[lints] workspace = true`".into());
    }
    let known: BTreeSet<&str> = ARROWS.iter().map(|(folder, _)| *folder).collect();
    let Some(allowed) = may_know(&manifest.folder) else {
        found.push(format!(
            "{} is missing from the crate map: add it to ARROWS in xtask and to ARCHITECTURE.md",
            manifest.folder
        ));
        return found;
    };
    for dependency in manifest.dependencies() {
        let folder = if dependency == "lidarshift" { "cli" } else { dependency };
        if known.contains(folder) && !allowed.contains(folder) {
            found.push(format!("{} may not depend on {folder}; allowed: {}", manifest.folder, list(&allowed)));
        }
        if dependency == "burn" && !KNOWS_BURN.contains(&manifest.folder.as_str()) {
            found.push(format!("{} may not depend on burn", manifest.folder));
        }
    }
    found
}

fn list(names: &BTreeSet<&str>) -> String {
    if names.is_empty() { "none".into() } else { names.iter().copied().collect::<Vec<_>>().join(", ") }
}

/// All crates that `folder` may depend on; `None` if it is not in [`ARROWS`].
fn may_know(folder: &str) -> Option<BTreeSet<&'static str>> {
    let arrows: BTreeMap<_, _> = ARROWS.iter().copied().collect();
    let mut open = arrows.get(folder)?.to_vec();
    let mut known = BTreeSet::new();
    while let Some(next) = open.pop() {
        if known.insert(next) {
            open.extend(arrows[next]);
        }
    }
    Some(known)
}

/// Line number (from 1) and message.
fn text_complaints(path: &str, text: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    for (i, line) in text.lines().enumerate() {
        if let Some(prefix) = MACHINE_PATHS.iter().find(|p| names_path(line, p)) {
            found.push((i + 1, format!("a path of one machine ({prefix}...): make it relative")));
        }
    }
    if !path.ends_with(".rs") {
        return found;
    }
    for (i, line) in text.lines().enumerate() {
        if let Some(name) = UNDONE.iter().find(|u| line.contains(**u)) {
            found.push((i + 1, format!("{name}...): finish it or return an error")));
        }
    }
    let stem = Path::new(path).file_stem().map(|s| s.to_string_lossy().into_owned()).unwrap_or_default();
    if EMPTY_NAMES.contains(&stem.as_str()) {
        found.push((1, format!("`{stem}` has no meaning: name the file after its content")));
    }
    let lines = lines_before_tests(text);
    if lines > MAX_LINES && !is_test(path) {
        found.push((
            MAX_LINES + 1,
            format!("{lines} lines before the tests, more than {MAX_LINES}: a file is one idea"),
        ));
    }
    found
}

/// Whether `line` contains `prefix` at the beginning of a path.
fn names_path(line: &str, prefix: &str) -> bool {
    line.match_indices(prefix).any(|(at, _)| {
        let before = line[..at].chars().next_back();
        !before.is_some_and(|c| c.is_alphanumeric() || "._-~/:".contains(c))
    })
}

/// Whether a file contains only tests.
fn is_test(path: &str) -> bool {
    path.starts_with("tests/") || path.contains("/tests/") || path.ends_with("/tests.rs")
}

/// Number of lines up to `#[cfg(test)] mod ...`, which may be public within the crate.
fn lines_before_tests(text: &str) -> usize {
    let lines: Vec<&str> = text.lines().collect();
    let is_module = |line: &str| line.starts_with("mod ") || line.starts_with("pub(") && line.contains(") mod ");
    let tests = lines.windows(2).position(|w| w[0] == "#[cfg(test)]" && is_module(w[1]));
    tests.unwrap_or(lines.len())
}

/// All files written by hand, sorted by path: sources, manifests, scripts, documents; not generated output.
pub fn texts(root: &Path) -> Result<Vec<PathBuf>> {
    let (mut open, mut files) = (vec![root.to_owned()], Vec::new());
    while let Some(folder) = open.pop() {
        for entry in fs::read_dir(&folder)? {
            let entry = entry?;
            let (path, name) = (entry.path(), entry.file_name().to_string_lossy().into_owned());
            if entry.file_type()?.is_dir() {
                let made = folder == root && matches!(name.as_str(), "target" | "runs" | "bench")
                    || folder == root.join("datasets")
                    || name.starts_with('.') && !matches!(name.as_str(), ".cargo" | ".ci");
                if !made {
                    open.push(path);
                }
            } else if [".rs", ".toml", ".md", ".sh"].iter().any(|end| name.ends_with(end)) || folder.ends_with(".ci") {
                files.push(path);
            }
        }
    }
    files.sort();
    Ok(files)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_repository_is_tidy() {
        let found = complaints(&crate::root()).unwrap();
        assert!(found.is_empty(), "\n{}\n", found.join("\n"));
    }

    fn manifest(folder: &str, rest: &str) -> Manifest {
        let toml = format!("[package]\nname = \"lidarshift-{folder}\"\n{rest}").parse().unwrap();
        Manifest { folder: folder.into(), package: String::new(), path: PathBuf::new(), toml }
    }

    #[test]
    fn arrows_run_one_way() {
        let lints = "[lints]\nworkspace = true\n";
        for (folder, dependency, allowed) in [
            ("data", "geometry", true),
            ("geometry", "data", false),
            ("eval", "models", false),
            ("models", "eval", false),
            ("eval", "burn", false),
            ("models", "burn", true),
            ("train", "geometry", true),
            ("kernels", "geometry", false),
            ("report", "simulate", true),
            ("simulate", "sensor", true),
            ("sensor", "simulate", false),
            ("report", "train", false),
            ("cli", "geometry", true),
            ("study", "report", true),
            ("eval", "study", false),
            ("study", "lidarshift", false),
            ("checks", "lidarshift", true),
            ("lidarshift", "checks", false),
            ("tests", "lidarshift", true),
            ("train", "lidarshift", false),
            ("xtask", "geometry", false),
            ("geometry", "serde", true),
            ("unheard-of", "serde", false),
        ] {
            for kind in ["dependencies", "dev-dependencies"] {
                let text = format!("{lints}[{kind}]\n{dependency}.workspace = true\n");
                let found = manifest_complaints(&manifest(folder, &text));
                assert_eq!(found.is_empty(), allowed, "{folder} -> {dependency}: {found:?}");
            }
        }
        assert_eq!(manifest_complaints(&manifest("data", "")).len(), 1);
    }

    #[test]
    fn each_text_rule_bites() {
        let long = "x\n".repeat(MAX_LINES + 1);
        let [h, undone] = [MACHINE_PATHS[0], UNDONE[0]];
        for (path, text, complaints) in [
            ("crates/a/src/lib.rs", "fn f() {}\n".to_owned(), 0),
            ("crates/a/src/utils.rs", "fn f() {}\n".to_owned(), 1),
            ("crates/a/src/lib.rs", format!("fn f() {{ {undone}) }}\n"), 1),
            ("README.md", format!("see {h}me/data\n"), 1),
            ("README.md", format!("see https://example.org{h}page\n"), 0),
            ("crates/a/src/lib.rs", long.clone(), 1),
            ("crates/a/tests/all.rs", long.clone(), 0),
            ("crates/a/src/lib.rs", format!("#[cfg(test)]\nmod tests {{\n{long}}}\n"), 0),
            ("crates/a/src/lib.rs", format!("#[cfg(test)]\npub(super) mod tests {{\n{long}}}\n"), 0),
        ] {
            let found = text_complaints(path, &text);
            assert_eq!(found.len(), complaints, "{path}: {found:?}");
        }
    }
}
