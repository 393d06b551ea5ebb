//! Rules for Markdown pages: relative links have a target, the book's table of contents is complete, lines are short.

use anyhow::Result;
use fs_err as fs;
use std::collections::BTreeSet;
use std::path::{Component, Path, PathBuf};

/// Folder of the book's pages, relative to the repository.
const BOOK: &str = "docs/src";

/// Table of contents of the book.
const SUMMARY: &str = "docs/src/SUMMARY.md";

/// Maximum line length outside tables and code.
const MAX_WIDTH: usize = 120;

/// All violations of the rules for pages. `pages` are the paths of all Markdown files, below `root`.
pub fn complaints(root: &Path, pages: &[PathBuf]) -> Result<Vec<String>> {
    let mut found = Vec::new();
    for page in pages {
        let text = fs::read_to_string(page)?;
        let name = page.strip_prefix(root).unwrap_or(page).display().to_string();
        for link in links(&text) {
            if let Some(what) = broken(page, &text, &link.target) {
                found.push(format!("{name}:{}: the link {} {what}", link.line, link.target));
            }
        }
        if !is_generated(&text) {
            found.extend(wide_lines(&text).map(|n| format!("{name}:{n}: longer than {MAX_WIDTH} characters")));
        }
    }
    found.extend(not_in_summary(root, pages)?);
    Ok(found)
}

/// A link of a page.
#[derive(Debug, PartialEq)]
struct Link {
    /// Line number, from 1.
    line: usize,
    /// As written: a path, a path with an anchor, an anchor, or a URL.
    target: String,
}

/// Lines outside code fences, with line numbers from 1.
fn prose(text: &str) -> impl Iterator<Item = (usize, &str)> {
    let mut in_code = false;
    text.lines().enumerate().filter_map(move |(i, line)| {
        let fence = line.trim_start().starts_with("```");
        in_code ^= fence;
        (!in_code && !fence).then_some((i + 1, line))
    })
}

/// Links, images and included files of a page, outside code.
fn links(text: &str) -> Vec<Link> {
    let mut found = Vec::new();
    for (number, line) in prose(text) {
        let line = without_code(line);
        for (start, end) in [("](", ")"), ("{{#include ", "}}")] {
            for part in line.split(start).skip(1) {
                let target = part.split(end).next().unwrap_or_default().trim();
                found.push(Link { line: number, target: target.into() });
            }
        }
    }
    found
}

/// The line without inline code.
fn without_code(line: &str) -> String {
    line.split('`').step_by(2).collect::<Vec<_>>().join("`")
}

/// What is wrong with a link of the page at `page`; `None` if it leads to a file, to a heading, or out of the
/// repository.
fn broken(page: &Path, text: &str, target: &str) -> Option<&'static str> {
    if target.contains("://") || target.starts_with("mailto:") {
        return None;
    }
    let (path, anchor) = target.split_once('#').unwrap_or((target, ""));
    let file = if path.is_empty() { page.to_owned() } else { page.parent().unwrap_or(page).join(path) };
    if !file.exists() {
        return Some("leads to no file");
    }
    if anchor.is_empty() || file.extension().is_none_or(|e| e != "md") {
        return None;
    }
    let there = if path.is_empty() { text.to_owned() } else { fs::read_to_string(&file).unwrap_or_default() };
    let known = prose(&there).any(|(_, line)| heading_anchor(line).is_some_and(|a| a == anchor));
    (!known).then_some("leads to no heading of that page")
}

/// The anchor that mdBook and GitHub assign to a heading; `None` for other lines.
fn heading_anchor(line: &str) -> Option<String> {
    let title = line.trim_start_matches('#');
    if title.len() == line.len() || !title.starts_with(' ') {
        return None;
    }
    let letters = title.trim().chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
    Some(letters.map(|c| if c == ' ' { '-' } else { c }).flat_map(char::to_lowercase).collect())
}

/// Whether the page is generated.
pub fn is_generated(text: &str) -> bool {
    text.lines().take(4).any(|l| l.starts_with("Generated "))
}

/// Line numbers of lines that are too long, outside tables and code.
fn wide_lines(text: &str) -> impl Iterator<Item = usize> {
    let too_wide = |line: &str| !line.starts_with('|') && line.chars().count() > MAX_WIDTH;
    prose(text).filter(move |(_, line)| too_wide(line)).map(|(number, _)| number)
}

/// Pages of the book that are missing from its table of contents.
fn not_in_summary(root: &Path, pages: &[PathBuf]) -> Result<Vec<String>> {
    let (book, summary) = (root.join(BOOK), root.join(SUMMARY));
    if !summary.is_file() {
        return Ok(Vec::new());
    }
    let named: BTreeSet<PathBuf> =
        links(&fs::read_to_string(&summary)?).iter().map(|l| tidied(&book.join(&l.target))).collect();
    let missing = pages.iter().filter(|p| p.starts_with(&book) && **p != summary && !named.contains(*p));
    let relative = |p: &PathBuf| p.strip_prefix(root).unwrap_or(p).display().to_string();
    Ok(missing.map(|p| format!("{}: is not in {SUMMARY}", relative(p))).collect())
}

/// The path without `.` components.
fn tidied(path: &Path) -> PathBuf {
    path.components().filter(|c| *c != Component::CurDir).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_of_a_page() {
        let text =
            "[a](b.md) and ![c](d.svg)\n```\n[not](this.md)\n```\n`[nor](that.md)` [e](f.md#g)\n{{#include ../h.md}}\n";
        let found: Vec<_> = links(text).into_iter().map(|l| (l.line, l.target)).collect();
        let expected = [(1, "b.md"), (1, "d.svg"), (5, "f.md#g"), (6, "../h.md")];
        assert_eq!(found, expected.map(|(line, target)| (line, target.to_owned())));
    }

    #[test]
    fn anchors_of_headings() {
        for (line, anchor) in [
            ("## Two causes", Some("two-causes")),
            ("### Does a detector gain?", Some("does-a-detector-gain")),
            ("# t-SNE", Some("t-sne")),
            ("## rig: configs/NAME.toml", Some("rig-configsnametoml")),
            ("no heading", None),
            ("#no-heading", None),
        ] {
            assert_eq!(heading_anchor(line).as_deref(), anchor, "{line}");
        }
    }

    #[test]
    fn each_rule_for_pages_bites() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path();
        let wide = "x ".repeat(61);
        for (path, text) in [
            ("docs/src/SUMMARY.md", "# Summary\n\n[Start](start.md)\n- [Guide](./guide/a.md)\n".to_owned()),
            ("docs/src/start.md", "# Start\n\n[a](guide/a.md#part-two)\n[b](https://example.org)\n".into()),
            ("docs/src/guide/a.md", "# A\n\n## Part two\n\n[up](../start.md#start) [here](#part-two)\n".into()),
            ("docs/src/lost.md", "# Lost\n".into()),
            ("README.md", format!("[gone](gone.md)\n[x](docs/src/start.md#none)\n[y](#none)\n{wide}\n")),
            ("wide.md", format!("| {wide} |\n```\n{wide}\n```\n")),
            ("made.md", format!("# Made\n\nGenerated by a program.\n{wide}\n")),
        ] {
            fs::create_dir_all(root.join(path).parent().unwrap()).unwrap();
            fs::write(root.join(path), text).unwrap();
        }
        let pages = |names: &[&str]| -> Vec<PathBuf> { names.iter().map(|n| root.join(n)).collect() };
        let good = ["docs/src/SUMMARY.md", "docs/src/start.md", "docs/src/guide/a.md", "wide.md", "made.md"];
        assert_eq!(complaints(root, &pages(&good)).unwrap(), Vec::<String>::new());
        let bad = complaints(root, &pages(&["README.md", "docs/src/lost.md"])).unwrap();
        let expected = [
            "README.md:1: the link gone.md leads to no file",
            "README.md:2: the link docs/src/start.md#none leads to no heading of that page",
            "README.md:3: the link #none leads to no heading of that page",
            "README.md:4: longer than 120 characters",
            "docs/src/lost.md: is not in docs/src/SUMMARY.md",
        ];
        assert_eq!(bad, expected);
    }
}
