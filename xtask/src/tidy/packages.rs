//! What a package needs that others install from a registry: a description, and all of its files inside its folder.

use super::Manifest;
use std::path::{Component, Path, PathBuf};

/// Keys that a published package has, of its own or from the workspace.
const KEYS: [&str; 4] = ["description", "license", "readme", "version"];

/// What is missing in the manifest of a published package.
pub fn complaints(manifest: &Manifest) -> Vec<String> {
    let package = manifest.toml.get("package").and_then(|p| p.as_table());
    let missing = KEYS.into_iter().filter(|key| !package.is_some_and(|p| p.contains_key(*key)));
    let mut found: Vec<String> = missing
        .map(|key| format!("a published package needs {key}: add `{key}.workspace = true` or a text of its own"))
        .collect();
    for (name, dependency) in manifest.dependency_tables() {
        if dependency.get("path").is_some() && dependency.get("version").is_none() {
            found.push(format!("the dependency {name} has a path and no version: take it from the workspace"));
        }
    }
    found
}

/// Line number (from 1) and message of each file that a source at `path` includes from outside of the folder of its
/// package, which `cargo package` leaves out. `text` is the source before its tests.
pub fn outside(package: &str, path: &str, text: &str) -> Vec<(usize, String)> {
    let mut found = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let included = ["include_str!(\"", "include_bytes!(\"", "include!(\""]
            .iter()
            .find_map(|call| line.split_once(call)?.1.split_once('"').map(|(name, _)| name));
        let Some(name) = included else { continue };
        if !resolved(&Path::new(path).with_file_name(name)).starts_with(package) {
            let message = format!("{name} is outside of the package {package}: move it into one");
            found.push((i + 1, message));
        }
    }
    found
}

/// The path without `..`.
fn resolved(path: &Path) -> PathBuf {
    let mut parts = PathBuf::new();
    for part in path.components() {
        match part {
            Component::ParentDir => {
                parts.pop();
            }
            other => parts.push(other),
        }
    }
    parts
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_other_packages_are_refused() {
        for (package, path, line, complaints) in [
            ("crates/a/", "crates/a/src/b.rs", "include_str!(\"c.toml\")", 0),
            ("crates/a/", "crates/a/src/b.rs", "include_str!(\"../c.toml\")", 0),
            ("crates/a/", "crates/a/src/b.rs", "(1, include_bytes!(\"../../c.bin\")),", 1),
            ("crates/a/", "crates/a/src/b/c.rs", "include_str!(\"../../../../configs/d.toml\")", 1),
            ("configs/", "configs/lib.rs", "include_str!(\"../README.md\")", 1),
        ] {
            assert_eq!(outside(package, path, line).len(), complaints, "{path}: {line}");
        }
    }

    #[test]
    fn a_published_package_says_what_it_is() {
        let manifest = |rest: &str| Manifest {
            folder: "a".into(),
            package: "lidarshift-a".into(),
            path: PathBuf::new(),
            toml: format!("[package]\nname = \"lidarshift-a\"\n{rest}").parse().unwrap(),
        };
        let whole = "description = \"A\"\nlicense.workspace = true\nreadme.workspace = true\nversion = \"1.0.0\"\n";
        assert_eq!(complaints(&manifest(whole)), Vec::<String>::new());
        let found = complaints(&manifest("description = \"A\"\nversion = \"1.0.0\"\n"));
        assert!(found.len() == 2 && found[0].contains("license.workspace = true"), "{found:?}");
        let found = complaints(&manifest(&format!("{whole}[dependencies]\nb = {{ path = \"../b\" }}\n")));
        assert!(found.len() == 1 && found[0].contains("dependency b"), "{found:?}");
        assert!(manifest(whole).is_published() && !manifest("publish.workspace = true\n").is_published());
    }
}
