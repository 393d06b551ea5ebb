//! The build of the running program, by which results name what made them.

use crate::checksum::file_sha256;
use std::path::PathBuf;
use std::sync::OnceLock;

static COMMIT: OnceLock<&'static str> = OnceLock::new();
static FEATURES: OnceLock<&'static [&'static str]> = OnceLock::new();
static FILE: OnceLock<PathBuf> = OnceLock::new();

/// Digits of a hash of the program in a build id.
const DIGITS: usize = 12;

/// Names the commit that the program was built from. Programs call this once, before they write anything.
pub fn set_commit(commit: &'static str) {
    COMMIT.get_or_init(|| commit);
}

/// Names the features of cargo that the program was built with. Programs call this once, before they write anything.
pub fn set_features(features: &'static [&'static str]) {
    FEATURES.get_or_init(|| features);
}

/// The features of cargo that this program was built with.
pub fn features() -> &'static [&'static str] {
    FEATURES.get().copied().unwrap_or_default()
}

/// Names the file that has the code of this program, where that is not the executable of the process: a library of an
/// interpreter.
pub fn set_program_file(path: PathBuf) {
    FILE.get_or_init(|| path);
}

/// The build of this program: its version and, behind a `+`, the commit that it was built from, with `-dirty` if files
/// were changed since. A program that was built without a checkout has the first digits of its SHA-256 there.
pub fn build_id() -> &'static str {
    static BUILD: OnceLock<String> = OnceLock::new();
    BUILD.get_or_init(|| {
        let hash = || Some(format!("program-{}", program_sha256()?.get(..DIGITS)?));
        let built_from = COMMIT.get().map(|commit| commit.to_string()).or_else(hash);
        format!("{}+{}", env!("CARGO_PKG_VERSION"), built_from.as_deref().unwrap_or("unknown"))
    })
}

/// SHA-256 of the file of this program, in hexadecimal, computed once; `None` if it cannot be read.
pub fn program_sha256() -> Option<&'static str> {
    static SHA256: OnceLock<Option<String>> = OnceLock::new();
    let file = || FILE.get().cloned().or_else(|| std::env::current_exe().ok());
    SHA256.get_or_init(|| file_sha256(&file()?).ok()).as_deref()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The programs of tests name no commit.
    #[test]
    fn a_program_without_a_commit_is_named_by_its_hash() {
        let program = std::fs::read(std::env::current_exe().unwrap()).unwrap();
        let sha256 = crate::checksum::hex(&<sha2::Sha256 as sha2::Digest>::digest(program));
        assert_eq!(program_sha256(), Some(sha256.as_str()));
        assert_eq!(build_id(), format!("{}+program-{}", env!("CARGO_PKG_VERSION"), &sha256[..12]));
    }
}
