//! TOML files that people write: one typed reading for all of them, and errors that name the file, the line and the key
//! that was meant.

use crate::DataError;
use serde::de::DeserializeOwned;
use std::path::Path;
use toml::de::{DeTable, DeValue};

/// The value of a key cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct KeyError {
    /// The key with all tables above it, as `sensor[0].rows`; empty for the file as a whole.
    pub field: String,
    /// What is wrong and what would be right.
    pub message: String,
}

impl KeyError {
    /// The same error with `prefix.` before the key.
    pub fn below(self, prefix: &str) -> Self {
        let field = if self.field.is_empty() { prefix.into() } else { format!("{prefix}.{}", self.field) };
        KeyError { field, message: self.message }
    }

    /// As an error of the file `path` with this text, at the line of the key.
    pub fn in_file(self, text: &str, path: &Path) -> DataError {
        let message = if self.field.is_empty() { self.message } else { format!("{}: {}", self.field, self.message) };
        match line_of_key(text, &self.field) {
            Some(line) => DataError::line(path, line, message),
            None => DataError::file(path, message),
        }
    }
}

/// The error of one key.
pub fn wrong(field: impl Into<String>, message: impl Into<String>) -> KeyError {
    KeyError { field: field.into(), message: message.into() }
}

/// Refuses a number outside of `low..=high`; not-a-number as well.
pub fn within(field: &str, value: f64, low: f64, high: f64) -> Result<(), KeyError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(wrong(field, format!("{value} is not between {low} and {high}")))
    }
}

/// Reads a TOML file; what `check` refuses is reported at the line of its key.
pub fn read_toml<T: DeserializeOwned>(
    path: &Path,
    check: impl FnOnce(&T) -> Result<(), KeyError>,
) -> Result<T, DataError> {
    parse_toml(&read_text(path)?, path, check)
}

/// The text of a file; bytes that are no UTF-8 are an error of the file.
pub fn read_text(path: &Path) -> Result<String, DataError> {
    String::from_utf8(fs_err::read(path)?).map_err(|_| DataError::file(path, "is not text"))
}

/// A TOML in memory; `path` is for messages. What `check` refuses is reported at the line of its key.
pub fn parse_toml<T: DeserializeOwned>(
    text: &str,
    path: &Path,
    check: impl FnOnce(&T) -> Result<(), KeyError>,
) -> Result<T, DataError> {
    let value: T = toml::from_str(text).map_err(|e| DataError::line(path, line_of_error(text, &e), message(&e)))?;
    check(&value).map_err(|error| error.in_file(text, path))?;
    Ok(value)
}

/// The message of a TOML error; of an unknown key or name with the known one that was probably meant.
pub fn message(error: &toml::de::Error) -> String {
    with_suggestion(error.message())
}

/// [`message`] and the table that it speaks of, in one line: for a table that was put together in memory and has no
/// lines.
pub fn message_with_key(error: &toml::de::Error) -> String {
    let text = error.to_string();
    let place = text.strip_prefix(error.message()).unwrap_or_default().trim().replace('\n', " ");
    format!("{} {place}", message(error)).trim_end().to_owned()
}

/// Replaces the list of what is known by the name that was probably meant, where one is near enough.
fn with_suggestion(message: &str) -> String {
    let suggested = || {
        let (found, expected) = message.split_once(", expected ")?;
        if !found.starts_with("unknown field `") && !found.starts_with("unknown variant `") {
            return None;
        }
        let unknown = found.split('`').nth(1)?;
        // Names stand between backticks: every second part.
        let known = expected.split('`').skip(1).step_by(2);
        let (distance, meant) = known.map(|k| (distance_of_keys(unknown, k), k)).min()?;
        (distance <= unknown.len().div_ceil(4)).then(|| format!("{found}: did you mean `{meant}`?"))
    };
    suggested().unwrap_or_else(|| message.to_owned())
}

/// Letters to change, add or take away between two keys; a key without its unit (`yaw` for `yaw_deg`), or with one too
/// many, counts as 1.
fn distance_of_keys(unknown: &str, known: &str) -> usize {
    let without = |long: &str, short: &str| long.strip_prefix(short).is_some_and(|unit| unit.starts_with('_'));
    if !unknown.is_empty() && (without(known, unknown) || without(unknown, known)) {
        return 1;
    }
    let known: Vec<char> = known.chars().collect();
    let mut row: Vec<usize> = (0..=known.len()).collect();
    for (i, a) in unknown.chars().enumerate() {
        let mut diagonal = std::mem::replace(&mut row[0], i + 1);
        for (j, b) in known.iter().enumerate() {
            let changed = diagonal + usize::from(a != *b);
            diagonal = row[j + 1];
            row[j + 1] = changed.min(row[j] + 1).min(diagonal + 1);
        }
    }
    row[known.len()]
}

/// The line of a TOML error. Within tagged tables the parser knows the table alone; an unknown key is then looked for
/// by its name.
fn line_of_error(text: &str, error: &toml::de::Error) -> usize {
    let at = error.span().map_or(0, |span| span.start);
    let unknown = error.message().strip_prefix("unknown field `").and_then(|m| m.split('`').next());
    if let Some(key) =
        unknown.filter(|key| !text[at.min(text.len())..].trim_start_matches(['"', '\'']).starts_with(key))
    {
        let mut lines = Vec::new();
        if let Ok(root) = DeTable::parse(text) {
            lines_of_name(text, root.get_ref(), key, &mut lines);
        }
        if let [line] = lines[..] {
            return line;
        }
    }
    line_of_byte(text, at)
}

/// Lines of all keys of a name, in this table and below.
fn lines_of_name(text: &str, table: &DeTable<'_>, name: &str, lines: &mut Vec<usize>) {
    fn below(text: &str, value: &DeValue<'_>, name: &str, lines: &mut Vec<usize>) {
        match value {
            DeValue::Table(table) => lines_of_name(text, table, name, lines),
            DeValue::Array(items) => items.iter().for_each(|item| below(text, item.get_ref(), name, lines)),
            _ => (),
        }
    }
    for (key, value) in table {
        if key.get_ref() == name {
            lines.push(line_of_byte(text, key.span().start));
        }
        below(text, value.get_ref(), name, lines);
    }
}

fn line_of_byte(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|b| **b == b'\n').count()
}

/// The line of a key as `effect[2].std_m`, or of the nearest table above it that is written down; `None` when nothing
/// of it is.
fn line_of_key(text: &str, key: &str) -> Option<usize> {
    let root = DeTable::parse(text).ok()?;
    let mut line = None;
    let mut at: Option<&DeTable<'_>> = Some(root.get_ref());
    for part in key.split('.') {
        let (name, index) = match part.strip_suffix(']').and_then(|p| p.split_once('[')) {
            Some((name, index)) => (name, index.parse::<usize>().ok()),
            None => (part, None),
        };
        let Some(mut value) = at.and_then(|table| table.get(name)) else { break };
        if let (DeValue::Array(items), Some(index)) = (value.get_ref(), index) {
            match items.get(index) {
                Some(item) => value = item,
                None => break,
            }
        }
        line = Some(line_of_byte(text, value.span().start));
        at = value.get_ref().as_table();
    }
    line
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;

    #[test]
    fn keys_have_lines() {
        let text = "a = 1\n[b]\nc = 2\n\n[[d]]\ne = 3\n[[d]]\ne = 4\nf = [1,\n 2]\n";
        for (key, line) in [
            ("a", Some(1)),
            ("b.c", Some(3)),
            ("d[0].e", Some(6)),
            ("d[1].e", Some(8)),
            ("d[1].missing", Some(7)),
            ("d[1].f[1]", Some(10)),
            ("nowhere", None),
        ] {
            assert_eq!(line_of_key(text, key), line, "{key}");
        }
    }

    #[test]
    fn a_check_is_reported_at_its_line() {
        let check = |_: &toml::Table| Err(wrong("b.c", "is too large"));
        let error = parse_toml("a = 1\n[b]\nc = 9\n", Path::new("x.toml"), check).unwrap_err();
        assert_eq!(error.to_string(), "x.toml:3: b.c: is too large");
    }

    #[test]
    fn unknown_keys_are_answered_with_the_one_that_was_meant() {
        for (message, want) in [
            ("unknown field `yaw`, expected one of `name`, `yaw_deg`", "unknown field `yaw`: did you mean `yaw_deg`?"),
            ("unknown field `position_m`, expected `position`", "unknown field `position_m`: did you mean `position`?"),
            ("unknown field `epoch`, expected `epochs` or `seeds`", "unknown field `epoch`: did you mean `epochs`?"),
            ("unknown field `colour`, expected `name` or `yaw`", "unknown field `colour`, expected `name` or `yaw`"),
            ("unknown variant `nose`, expected `noise`", "unknown variant `nose`: did you mean `noise`?"),
            ("missing field `name`", "missing field `name`"),
        ] {
            assert_eq!(with_suggestion(message), want);
        }
    }

    #[test]
    fn an_unknown_key_of_a_tagged_table_has_its_own_line() {
        #[derive(Debug, Deserialize)]
        #[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
        enum Item {
            One {
                #[serde(default, rename = "size_m")]
                _size_m: f64,
            },
        }
        #[derive(Debug, Deserialize)]
        struct List {
            #[serde(rename = "item")]
            _items: Vec<Item>,
        }
        let parse = |text: &str| parse_toml::<List>(text, Path::new("x.toml"), |_| Ok(())).unwrap_err().to_string();
        let one = "[[item]]\nkind = \"one\"\n\n[[item]]\nkind = \"one\"\nsize = 1\n";
        assert_eq!(parse(one), "x.toml:6: unknown field `size`: did you mean `size_m`?");
    }
}
