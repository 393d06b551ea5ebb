//! Reads TOML files into types. Errors have the file and the line and suggest the correct name for an unknown key.

use crate::DataError;
use serde::de::DeserializeOwned;
use std::path::Path;
use toml::de::{DeTable, DeValue};

/// A key of a TOML has an invalid value.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: {message}")]
pub struct KeyError {
    /// Path of the key, such as `sensor[0].rows`; empty for the file as a whole.
    pub field: String,
    /// What is invalid and what is allowed.
    pub message: String,
}

impl KeyError {
    /// The same error with `prefix.` before the path of the key.
    pub fn below(self, prefix: &str) -> Self {
        let field = if self.field.is_empty() { prefix.into() } else { format!("{prefix}.{}", self.field) };
        KeyError { field, message: self.message }
    }

    /// Converts to an error of the file `path` with the contents `text`, at the line of the key.
    pub fn in_file(self, text: &str, path: &Path) -> DataError {
        let message = if self.field.is_empty() { self.message } else { format!("{}: {}", self.field, self.message) };
        match line_of_key(text, &self.field) {
            Some(line) => DataError::line(path, line, message),
            None => DataError::file(path, message),
        }
    }
}

/// Makes an error for one key.
pub fn wrong(field: impl Into<String>, message: impl Into<String>) -> KeyError {
    KeyError { field: field.into(), message: message.into() }
}

/// An error if `value` is outside of `low..=high` or NaN.
pub fn within(field: &str, value: f64, low: f64, high: f64) -> Result<(), KeyError> {
    if (low..=high).contains(&value) {
        Ok(())
    } else {
        Err(wrong(field, format!("{value} is not between {low} and {high}")))
    }
}

/// Reads a TOML file. An error of `check` is reported at the line of its key.
pub fn read_toml<T: DeserializeOwned>(
    path: &Path,
    check: impl FnOnce(&T) -> Result<(), KeyError>,
) -> Result<T, DataError> {
    parse_toml(&read_text(path)?, path, check)
}

pub use crate::limits::read_text;

/// Parses a TOML. `path` is used in error messages. An error of `check` is reported at the line of its key.
pub fn parse_toml<T: DeserializeOwned>(
    text: &str,
    path: &Path,
    check: impl FnOnce(&T) -> Result<(), KeyError>,
) -> Result<T, DataError> {
    let value: T =
        toml::from_str(text).map_err(|e| DataError::line(path, line_of_error(text, &e), message_at_key(text, &e)))?;
    check(&value).map_err(|error| error.in_file(text, path))?;
    Ok(value)
}

/// The message of a TOML error. For an unknown key or variant it suggests a known one with a similar name.
pub fn message(error: &toml::de::Error) -> String {
    with_suggestion(error.message())
}

/// [`message`] with the path of the key before it, if its value is what is wrong.
fn message_at_key(text: &str, error: &toml::de::Error) -> String {
    let names_a_key = ["unknown field", "missing field", "duplicate"].iter().any(|m| error.message().starts_with(m));
    let key = || key_of_byte(DeTable::parse(text).ok()?.get_ref(), error.span()?.start);
    match if names_a_key { None } else { key() } {
        Some(key) => format!("{key}: {}", message(error)),
        None => message(error),
    }
}

/// Path of the innermost key in whose value a byte is.
fn key_of_byte(table: &DeTable<'_>, byte: usize) -> Option<String> {
    fn within(value: &toml::Spanned<DeValue<'_>>, byte: usize) -> Option<String> {
        match value.get_ref() {
            DeValue::Table(table) => key_of_byte(table, byte).map(|key| format!(".{key}")),
            DeValue::Array(items) => items.iter().enumerate().find_map(|(i, item)| {
                let inner = within(item, byte);
                (inner.is_some() || item.span().contains(&byte)).then(|| format!("[{i}]{}", inner.unwrap_or_default()))
            }),
            _ => None,
        }
    }
    table.iter().find_map(|(key, value)| {
        let inner = within(value, byte);
        (inner.is_some() || value.span().contains(&byte))
            .then(|| format!("{}{}", key.get_ref(), inner.unwrap_or_default()))
    })
}

/// [`message`] and the key concerned, in one line. For tables that were built in memory and have no line numbers.
pub fn message_with_key(error: &toml::de::Error) -> String {
    let text = error.to_string();
    let place = text.strip_prefix(error.message()).unwrap_or_default().trim().replace('\n', " ");
    format!("{} {place}", message(error)).trim_end().to_owned()
}

/// Replaces the list of known names by the most similar one, if it is similar enough to the unknown name.
fn with_suggestion(message: &str) -> String {
    let suggested = || {
        let (found, expected) = message.split_once(", expected ")?;
        if !found.starts_with("unknown field `") && !found.starts_with("unknown variant `") {
            return None;
        }
        let unknown = found.split('`').nth(1)?;
        // The names are between backticks: every second part.
        let known = expected.split('`').skip(1).step_by(2);
        let (distance, nearest) = known.map(|k| (edit_distance(unknown, k), k)).min()?;
        (distance <= unknown.len().div_ceil(4)).then(|| format!("{found}: did you mean `{nearest}`?"))
    };
    suggested().unwrap_or_else(|| message.to_owned())
}

/// Edit distance (Levenshtein) of two keys. A missing or additional unit (`yaw` for `yaw_deg`) counts as 1.
fn edit_distance(unknown: &str, known: &str) -> usize {
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

/// The line of a TOML error. In tables of tagged enums the parser reports the table, not the key: an unknown key is
/// then searched by its name.
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

/// Adds the lines of all keys called `name` in a table and its subtables.
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

/// The line, from 1, of a byte offset.
fn line_of_byte(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|b| **b == b'\n').count()
}

/// The line of a key with a path such as `effect[2].std_m`. If the key does not exist, the line of the innermost table
/// of its path that does; `None` if there is none.
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
    fn lines_of_keys_are_found() {
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
    fn errors_of_a_check_have_the_line_of_their_key() {
        let check = |_: &toml::Table| Err(wrong("b.c", "is too large"));
        let error = parse_toml("a = 1\n[b]\nc = 9\n", Path::new("x.toml"), check).unwrap_err();
        assert_eq!(error.to_string(), "x.toml:3: b.c: is too large");
    }

    #[test]
    fn a_wrong_type_is_reported_with_its_key() {
        #[derive(Debug, Deserialize)]
        struct Item {
            #[serde(rename = "sizes")]
            _sizes: Vec<f64>,
        }
        #[derive(Debug, Deserialize)]
        struct List {
            #[serde(rename = "item")]
            _items: Vec<Item>,
        }
        let parse = |text: &str| parse_toml::<List>(text, Path::new("x.toml"), |_| Ok(())).unwrap_err().to_string();
        for (text, want) in [
            ("item = 3\n", "x.toml:1: item: invalid type: integer `3`"),
            ("[[item]]\nsizes = [1.0]\n[[item]]\nsizes = \"one\"\n", "x.toml:4: item[1].sizes: invalid type: string"),
            ("[[item]]\nsizes = [1.0,\n true]\n", "x.toml:3: item[0].sizes[1]: invalid type: boolean"),
            ("[[item]]\n", "x.toml:1: missing field `sizes`"),
        ] {
            assert!(parse(text).starts_with(want), "{}", parse(text));
        }
    }

    #[test]
    fn a_similar_name_is_suggested_for_an_unknown_key() {
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
    fn an_unknown_key_of_a_tagged_table_is_reported_at_its_line() {
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
