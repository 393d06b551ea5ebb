//! Splits a file into prose (comments, Markdown text) and code without string literals.

/// One line of a file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Line {
    /// Text of the comment, or of the Markdown line; without inline code.
    pub prose: String,
    /// Rust code with the contents of string and character literals removed; empty for other files.
    pub code: String,
    /// Whether the line can be wrapped: it has prose and is no table row, HTML element or part of a code fence.
    pub wraps: bool,
}

/// The lines of a file, by the kind of file that `path` names.
pub fn lines(path: &str, text: &str) -> Vec<Line> {
    let mut lines = if path.ends_with(".rs") {
        rust(text)
    } else if path.ends_with(".md") {
        text.lines().map(|line| Line { prose: line.into(), ..Line::default() }).collect()
    } else {
        text.lines().map(|line| Line { prose: hash_comment(line).into(), ..Line::default() }).collect()
    };
    let mut fenced = false;
    for line in &mut lines {
        let prose = line.prose.trim();
        let fence = prose.starts_with("```") || prose.starts_with("~~~");
        line.wraps = !prose.is_empty() && !prose.starts_with(['|', '<']) && !fenced && !fence;
        fenced = if fence { !fenced } else { fenced && line.code.trim().is_empty() };
        line.prose =
            if line.wraps || prose.starts_with(['|', '<']) { without_inline_code(prose) } else { String::new() };
    }
    lines
}

/// The comment of a TOML or shell line, from the first `#` outside quotes.
fn hash_comment(line: &str) -> &str {
    let mut quote = None;
    for (at, c) in line.char_indices() {
        match quote {
            Some(open) if c == open => quote = None,
            None if c == '"' || c == '\'' => quote = Some(c),
            None if c == '#' => return line[at..].trim_start_matches(['#', '!']),
            _ => {}
        }
    }
    ""
}

/// Removes text between backticks on the same line.
fn without_inline_code(line: &str) -> String {
    let parts: Vec<&str> = line.split('`').collect();
    let closed = !parts.len().is_multiple_of(2);
    let kept = |i: usize| i.is_multiple_of(2) || !closed && i == parts.len() - 1;
    (0..parts.len()).filter(|i| kept(*i)).map(|i| parts[i]).collect::<Vec<_>>().join(" ")
}

enum State {
    Code,
    LineComment,
    /// Nesting depth.
    BlockComment(usize),
    /// Number of hashes of a raw string; `None` for a string with escapes.
    Text(Option<usize>),
}

fn rust(text: &str) -> Vec<Line> {
    let chars: Vec<char> = text.chars().collect();
    let (mut lines, mut line, mut state, mut i) = (Vec::new(), Line::default(), State::Code, 0);
    let at = |i: usize, pattern: &str| pattern.chars().enumerate().all(|(k, c)| chars.get(i + k) == Some(&c));
    while i < chars.len() {
        let c = chars[i];
        let mut step = 1;
        if c == '\n' {
            if matches!(state, State::LineComment) {
                state = State::Code;
            }
            lines.push(std::mem::take(&mut line));
            i += 1;
            continue;
        }
        match state {
            State::Code if at(i, "//") => {
                state = State::LineComment;
                step = 2 + chars[i + 2..].iter().take_while(|c| matches!(c, '/' | '!')).count();
            }
            State::Code if at(i, "/*") => (state, step) = (State::BlockComment(1), 2),
            State::Code => {
                line.code.push(c);
                if let Some(hashes) = raw_string(&chars, i) {
                    (state, step) = (State::Text(Some(hashes)), hashes + 2);
                } else if c == '"' {
                    state = State::Text(None);
                } else if c == '\'' {
                    step = char_literal(&chars, i);
                }
            }
            State::LineComment => line.prose.push(c),
            State::BlockComment(1) if at(i, "*/") => (state, step) = (State::Code, 2),
            State::BlockComment(depth) if at(i, "*/") => (state, step) = (State::BlockComment(depth - 1), 2),
            State::BlockComment(depth) if at(i, "/*") => (state, step) = (State::BlockComment(depth + 1), 2),
            State::BlockComment(_) => line.prose.push(c),
            State::Text(None) if c == '\\' && chars.get(i + 1) != Some(&'\n') => step = 2,
            State::Text(None) if c == '"' => state = State::Code,
            State::Text(Some(hashes)) if c == '"' && at(i + 1, &"#".repeat(hashes)) => {
                (state, step) = (State::Code, 1 + hashes);
            }
            State::Text(_) => {}
        }
        i += step;
    }
    if !line.prose.is_empty() || !line.code.is_empty() {
        lines.push(line);
    }
    lines
}

/// Number of hashes if a raw string (`r"`, `r#"`) starts at `i`.
fn raw_string(chars: &[char], i: usize) -> Option<usize> {
    let inside_name = i > 0 && (chars[i - 1].is_alphanumeric() || chars[i - 1] == '_') && chars[i - 1] != 'b';
    if chars[i] != 'r' || inside_name {
        return None;
    }
    let hashes = chars[i + 1..].iter().take_while(|c| **c == '#').count();
    (chars.get(i + 1 + hashes) == Some(&'"')).then_some(hashes)
}

/// Length of the character literal that starts at `i`; 1 for a lifetime.
fn char_literal(chars: &[char], i: usize) -> usize {
    if chars.get(i + 1) == Some(&'\\') {
        return chars[i + 3..].iter().position(|c| *c == '\'').map_or(1, |end| end + 4);
    }
    if chars.get(i + 2) == Some(&'\'') { 3 } else { 1 }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(path: &str, text: &str) -> Vec<(String, String, bool)> {
        lines(path, text).into_iter().map(|l| (l.prose.trim().into(), l.code.trim().into(), l.wraps)).collect()
    }

    #[test]
    fn rust_is_split_into_comments_and_code_without_literals() {
        let text = concat!(
            "//! One `two` three\n",
            "let a = \"// no \\\" comment\"; // four\n",
            "let b = (r#\"a \"b\" // c\"#, b'\"', '\\'', 'x', &'a str); /* five\n",
            "six */ f();\n",
            "/// | table |\n",
            "/// ```\n",
            "/// code\n",
            "/// ```\n",
            "/// seven\n",
        );
        let want = [
            ("One   three", "", true),
            ("four", "let a = \";", true),
            ("five", "let b = (r, b', ', ', &'a str);", true),
            ("six", "f();", true),
            ("| table |", "", false),
            ("", "", false),
            ("", "", false),
            ("", "", false),
            ("seven", "", true),
        ];
        assert_eq!(split("a.rs", text), want.map(|(p, c, w)| (p.to_owned(), c.to_owned(), w)));
    }

    #[test]
    fn fences_and_tables_of_markdown_do_not_wrap() {
        let text = "text\n\n```sh\nrun\n\nrun\n```\n| a | b |\nmore\n";
        let wraps: Vec<bool> = lines("a.md", text).into_iter().map(|l| l.wraps).collect();
        assert_eq!(wraps, [true, false, false, false, false, false, false, false, true]);
        assert_eq!(split("a.toml", "key = \"#1\" # one\n")[0].0, "one");
    }
}
