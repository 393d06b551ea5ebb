//! Rules for wording in comments, Markdown and names, and for the length of comment lines.

use super::source::{Line, lines};
use crate::pages;

/// Folders and files that follow these rules. Empty: everything.
const CLEAN: &[&str] = &[];

/// Maximum length of a line with a comment, characters. For Markdown see [`crate::pages`].
const MAX_COLUMNS: usize = 120;

/// Phrases that may not stand in comments and Markdown, and the term to use. Compared by whole words, in any case.
const PHRASES: &[(&str, &str)] = &[
    ("told", "reported, known, given, or distinguished (told apart)"),
    ("comes to lie", "is located, falls"),
    ("come to lie", "are located, fall"),
    ("what leaves", "lost returns, fraction lost"),
    ("left over", "unmatched, remaining"),
    ("leftover", "unmatched, remaining"),
    ("leftovers", "unmatched points, remaining points"),
    ("is no hole", "is not a dropout region"),
    ("that slide", "unobservable along the surface"),
    ("speaks", "supports, is evidence for"),
    ("speak for", "support, are evidence for"),
    ("suspect", "candidate cause"),
    ("suspects", "candidate causes"),
    ("surer", "more significant, more confident"),
    ("surest", "most significant, most confident"),
    ("own car", "ego vehicle"),
    ("own cars", "ego vehicle"),
    ("own speed", "ego speed"),
    ("own motion", "ego motion, or motion of the target"),
    ("squarely", "at normal incidence"),
    ("without a word", "silently"),
    ("by lot", "at random"),
    ("hears", "is called with"),
];

/// Parts of names, and the term to use. Compared by whole parts of `snake_case` and `CamelCase`.
const NAME_PARTS: &[(&str, &str)] = &[
    ("told", "reported, known, given"),
    ("comes_to_lie", "is_located"),
    ("leftover", "unmatched, remaining"),
    ("leftovers", "unmatched, remaining"),
    ("speaks", "supports"),
    ("suspect", "candidate"),
    ("suspects", "candidates"),
    ("surer", "more_significant"),
];

/// Names that no function, module, type or variant may have, and the term to use.
const NAMES: &[(&str, &str)] = &[
    ("put", "a verb for what happens: write, insert, apply"),
    ("words", "what the texts are: names, report_text, arguments"),
    ("Sliding", "Observability"),
    ("Perhaps", "Uncertain, or an Option"),
];

/// Line number (from 1) and message of each violation.
pub fn complaints(path: &str, text: &str) -> Vec<(usize, String)> {
    if CLEAN.is_empty() || CLEAN.iter().any(|start| path.starts_with(start)) { check(path, text) } else { Vec::new() }
}

fn check(path: &str, text: &str) -> Vec<(usize, String)> {
    let is_page = path.ends_with(".md");
    if is_page && pages::is_generated(text) {
        return Vec::new();
    }
    let mut found = Vec::new();
    let lines = lines(path, text);
    for (i, (line, raw)) in lines.iter().zip(text.lines()).enumerate() {
        let columns = without_links(raw).chars().count();
        if line.wraps && !is_page && columns > MAX_COLUMNS {
            found.push((i + 1, format!("{columns} characters, more than {MAX_COLUMNS}: wrap the line")));
        }
        let phrases = phrases_in(line, lines.get(i + 1));
        found.extend(phrases.map(|(phrase, term)| (i + 1, format!("\"{phrase}\": use {term}"))));
        found.extend(names_in(&line.code).into_iter().map(|(name, term)| (i + 1, format!("`{name}`: use {term}"))));
    }
    found
}

/// Banned phrases that begin in `line`; they may end in the next one.
fn phrases_in(line: &Line, next: Option<&Line>) -> impl Iterator<Item = (&'static str, &'static str)> {
    let words = |line: &Line| -> Vec<String> {
        let parts = line.prose.split(|c: char| !c.is_alphanumeric() && c != '_');
        parts.filter(|word| !word.is_empty()).map(str::to_lowercase).collect()
    };
    let mut text = words(line);
    let own = text.len();
    text.extend(next.map(words).unwrap_or_default());
    PHRASES.iter().copied().filter(move |(phrase, _)| {
        let phrase: Vec<&str> = phrase.split(' ').collect();
        (0..own).any(|at| text[at..].len() >= phrase.len() && text[at..].iter().zip(&phrase).all(|(a, b)| a == b))
    })
}

/// Banned names in a line of code.
fn names_in(code: &str) -> Vec<(&str, &'static str)> {
    let names: Vec<&str> = code.split(|c: char| !c.is_alphanumeric() && c != '_').filter(|n| !n.is_empty()).collect();
    let mut found = Vec::new();
    for (i, name) in names.iter().enumerate() {
        let parts = format!("_{}_", snake_case(name));
        let part = NAME_PARTS.iter().find(|(part, _)| parts.contains(&format!("_{part}_")));
        let type_name = name.starts_with(char::is_uppercase);
        let defined = type_name || i > 0 && matches!(names[i - 1], "fn" | "mod");
        let whole = NAMES.iter().find(|(banned, _)| defined && banned == name);
        found.extend(part.or(whole).map(|(_, term)| (*name, *term)));
    }
    found
}

fn snake_case(name: &str) -> String {
    let mut out = String::new();
    for c in name.chars() {
        if c.is_uppercase() && !out.is_empty() && !out.ends_with('_') {
            out.push('_');
        }
        out.extend(c.to_lowercase());
    }
    out
}

/// The line without the targets of links, which cannot be wrapped.
fn without_links(line: &str) -> String {
    let mut out = String::new();
    let mut rest = line;
    while let Some(at) = rest.find("](").map(|at| at + 2).into_iter().chain(rest.find("://")).min() {
        let (before, target) = rest.split_at(at);
        out.push_str(before);
        let end = if before.ends_with("](") { target.find(')') } else { target.find([' ', ')', '>', '`']) };
        rest = &target[end.unwrap_or(target.len())..];
    }
    out + rest
}

#[cfg(test)]
mod tests {
    use super::*;

    fn terms(path: &str, text: &str) -> Vec<String> {
        check(path, text).into_iter().map(|(line, complaint)| format!("{line}: {complaint}")).collect()
    }

    #[test]
    fn private_phrases_are_found_in_prose_alone() {
        for (path, text, count) in [
            ("a.rs", "/// What is told.\nfn f() {}\n", 1),
            ("a.rs", "fn f() {} // the own\n", 0),
            ("a.rs", "// of the own\n// car's pose\n", 1),
            ("a.rs", "// the pose of the Own Car\n", 1),
            ("a.rs", "/// `told` is a name, \"output\" and keywords are fine, a stoldest is not told.\n", 1),
            ("a.rs", "let text = \"what is told\"; // a stolen one\n", 0),
            ("a.md", "What comes to\nlie there.\n", 1),
            ("a.md", "```\ntold\n```\n", 0),
            ("a.toml", "key = \"told\" # told\n", 1),
        ] {
            assert_eq!(terms(path, text).len(), count, "{text}: {:?}", terms(path, text));
        }
        for (phrase, _) in PHRASES {
            assert_eq!(terms("a.rs", &format!("// A {phrase} b\n")).len(), 1, "{phrase}");
        }
    }

    #[test]
    fn private_names_are_found_in_code_alone() {
        for (code, count) in [
            ("fn put() {}", 1),
            ("mod words;", 1),
            ("let told = 1;", 1),
            ("fn what_is_told() {}", 1),
            ("struct ToldCause;", 1),
            ("enum A { Sliding, Perhaps }", 2),
            ("fn comes_to_lie() {}", 1),
            ("let words = map.put(1, output, keywords, stolder);", 0),
            ("let s = \"told\"; let sliding_window = 'p';", 0),
        ] {
            assert_eq!(terms("a.rs", code).len(), count, "{code}: {:?}", terms("a.rs", code));
        }
    }

    #[test]
    fn long_lines_are_found_where_they_can_be_wrapped() {
        let long = "word ".repeat(30);
        for (path, text, count) in [
            ("a.rs", format!("// {long}\n"), 1),
            ("a.rs", format!("f(\"{long}\");\n"), 0),
            ("a.rs", format!("f(); // {long}\n"), 1),
            ("a.rs", format!("//! | {long} |\n//! ```\n//! {long}\n//! ```\n"), 0),
            ("a.rs", format!("// see [this](https://example.org/{})\n", "x".repeat(120)), 0),
            ("a.rs", format!("// see https://example.org/{} {long}\n", "x".repeat(120)), 1),
            ("a.toml", format!("# {long}\n"), 1),
        ] {
            assert_eq!(terms(path, &text).len(), count, "{path}: {text}");
        }
    }

    #[test]
    fn only_clean_folders_are_checked_unless_the_list_is_empty() {
        let complaints = |path: &str| complaints(path, "// told\n").len();
        assert_eq!((complaints("xtask/src/a.rs"), complaints("unlisted/a.rs")), (1, usize::from(CLEAN.is_empty())));
    }
}
