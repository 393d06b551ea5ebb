//! Refuses writes of the program that bypass `data::output`, which writes files whole, syncs them, follows links and
//! removes what is unfinished.

use super::source::Line;

/// Calls that write, move or make files and folders.
const CALLS: &[&str] = &[
    "fs::write(",
    "fs_err::write(",
    "fs::copy(",
    "fs_err::copy(",
    "fs::rename(",
    "fs_err::rename(",
    "fs::hard_link(",
    "fs_err::hard_link(",
    "symlink(",
    "symlink_file(",
    "File::create(",
    "File::create_new(",
    "File::options()",
    "OpenOptions::new()",
    "create_dir(",
    "create_dir_all(",
    "tempdir(",
    "tempdir_in(",
    "tempfile::",
    "NamedTempFile",
];

/// Files in which they are allowed, and why.
const EXCEPTIONS: &[(&str, &str)] = &[
    ("crates/data/src/output.rs", "the layer itself"),
    ("crates/data/src/folder_lock.rs", "files of locks hold no content that can be lost"),
    ("crates/data/src/frame_records.rs", "appends to the journal `frames.jsonl`; a torn line is ignored"),
    ("crates/train/src/metrics.rs", "appends to `metrics.jsonl`; lines after the checkpoint are removed on resume"),
    ("crates/train/src/memory.rs", "resets a counter of the kernel below /proc"),
    ("crates/study/src/local.rs", "appends the output of processes to `log.txt`"),
    ("crates/study/src/frozen/checkpoint.rs", "the log of a process"),
    ("crates/checks/src/fuzz.rs", "mutated inputs in memory, which no user sees"),
    ("crates/checks/src/fuzz/recordings.rs", "mutated inputs in a temporary folder, which no user sees"),
    ("crates/checks/src/fuzz/scenes.rs", "mutated inputs in memory, which no user sees"),
    ("crates/checks/src/fuzz/shards.rs", "mutated inputs in memory, which no user sees"),
    ("crates/checks/src/fuzz/targets.rs", "mutated inputs in memory, which no user sees"),
];

/// Line number (from 1) and message of each violation in the lines of a file before its tests.
pub fn complaints(path: &str, lines: &[Line]) -> Vec<(usize, String)> {
    let is_source = path.starts_with("crates/") && path.contains("/src/");
    if !is_source || EXCEPTIONS.iter().any(|(file, _)| *file == path) {
        return Vec::new();
    }
    let found = lines.iter().enumerate().filter_map(|(i, line)| {
        let call = CALLS.iter().find(|call| is_used(&line.code, call))?;
        let call = call.trim_end_matches(['(', ')', ':']);
        let instead = "use write_atomic, create_folder, rename or TemporaryFolder of data::output, or enter the file and \
                       the reason in xtask/src/tidy/writing.rs";
        Some((i + 1, format!("{call} bypasses data::output: {instead}")))
    });
    found.collect()
}

/// Exceptions whose files do not exist or have nothing to allow. `lines_of` gives the lines of a file before its tests.
pub fn stale_exceptions(lines_of: impl Fn(&str) -> Option<Vec<Line>>) -> Vec<String> {
    let is_needed = |file: &str| {
        let lines = lines_of(file).unwrap_or_default();
        lines.iter().any(|line| CALLS.iter().any(|call| is_used(&line.code, call)))
    };
    let stale = EXCEPTIONS.iter().filter(|(file, _)| !is_needed(file));
    stale.map(|(file, _)| format!("xtask/src/tidy/writing.rs: {file} is an exception and writes nothing")).collect()
}

/// Whether code has a call, and not one whose name ends like its name.
fn is_used(code: &str, call: &str) -> bool {
    code.match_indices(call).any(|(at, _)| !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_'))
}

#[cfg(test)]
mod tests {
    use super::super::source::lines;
    use super::*;

    #[test]
    fn writes_beside_the_output_layer_are_refused() {
        for (path, code, expected) in [
            ("crates/a/src/b.rs", "std::fs::write(path, bytes)", 1),
            ("crates/a/src/b.rs", "fs_err::rename(a, b)?", 1),
            ("crates/a/src/b.rs", "let file = File::create(path)?;", 1),
            ("crates/a/src/b.rs", "fs_err::OpenOptions::new().append(true)", 1),
            ("crates/a/src/b.rs", "std::fs::create_dir_all(folder)", 1),
            ("crates/a/src/b.rs", "let folder = tempfile::tempdir()?;", 1),
            ("crates/a/src/b.rs", "std::os::unix::fs::symlink(a, b)", 1),
            ("crates/a/src/b.rs", "output::rename(a, b)?; write_atomic(path, bytes)", 0),
            ("crates/a/src/b.rs", "let text = fs_err::read(path)?; my_fs::write(x)", 0),
            ("crates/a/src/b.rs", "// std::fs::write(path, bytes)", 0),
            ("crates/a/src/b.rs", "say(\"std::fs::write(path)\")", 0),
            ("crates/a/tests/b.rs", "std::fs::write(path, bytes)", 0),
            ("xtask/src/b.rs", "std::fs::write(path, bytes)", 0),
            ("crates/data/src/output.rs", "std::fs::write(path, bytes)", 0),
        ] {
            let found = complaints(path, &lines(path, &format!("fn f() {{ {code} }}\n")));
            assert_eq!(found.len(), expected, "{path}: {code}: {found:?}");
        }
    }

    #[test]
    fn exceptions_that_are_not_needed_are_named() {
        let with = |code: &'static str| move |path: &str| Some(lines(path, code));
        assert!(stale_exceptions(with("fn f() { std::fs::write(a, b) }\n")).is_empty());
        assert_eq!(stale_exceptions(with("fn f() {}\n")).len(), EXCEPTIONS.len());
        assert_eq!(stale_exceptions(|_| None).len(), EXCEPTIONS.len());
    }
}
