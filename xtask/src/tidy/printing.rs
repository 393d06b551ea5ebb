//! Refuses macros that panic if stdout or stderr is closed or full.

use super::source::Line;

/// Macros that panic on an error, or are for debugging.
const MACROS: &[&str] = &["println!", "eprintln!", "print!", "eprint!", "dbg!"];

/// The crates whose code is checked: what runs in the program and in its checks.
const CHECKED: &str = "crates/";

/// Line number (from 1) and message of each violation in the lines of a file before its tests.
pub fn complaints(path: &str, lines: &[Line]) -> Vec<(usize, String)> {
    let is_source = path.starts_with(CHECKED) && path.contains("/src/");
    let lines = lines.iter().enumerate().filter(|_| is_source);
    let found = lines.filter_map(|(i, line)| {
        let name = MACROS.iter().find(|name| is_called(&line.code, name))?;
        Some((
            i + 1,
            format!("{name} panics if its stream is closed: use outln!, out! or errln! of lidarshift::console"),
        ))
    });
    found.collect()
}

/// Whether a macro is called, and not one whose name ends like its name.
fn is_called(code: &str, name: &str) -> bool {
    code.match_indices(name).any(|(at, _)| !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_'))
}

#[cfg(test)]
mod tests {
    use super::super::source::lines;
    use super::*;

    #[test]
    fn printing_is_refused_in_programs_and_libraries() {
        let bang = |name: &str| format!("fn f() {{ {name}!(\"x\") }}\n");
        for (path, text, expected) in [
            ("crates/a/src/b.rs", bang("println"), 1),
            ("crates/a/src/b.rs", bang("eprint"), 1),
            ("crates/a/src/b.rs", bang("std::dbg"), 1),
            ("crates/a/src/b.rs", bang("outln"), 0),
            ("crates/a/src/b.rs", bang("my_println"), 0),
            ("crates/a/src/b.rs", "// println!\nfn f() { g(\"println!\") }\n".into(), 0),
            ("crates/a/benches/b.rs", bang("println"), 0),
            ("xtask/src/main.rs", bang("println"), 0),
        ] {
            let found = complaints(path, &lines(path, &text));
            assert_eq!(found.len(), expected, "{path}: {text}: {found:?}");
        }
    }
}
