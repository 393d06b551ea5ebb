//! TOML files that people write: one typed reading, and errors that name file and line, also for values that only a check finds wrong.

use crate::SimulateError;
use data::DataError;
use serde::de::DeserializeOwned;
use std::path::Path;
use toml::de::{DeTable, DeValue};

/// Reads a TOML; what `check` refuses is reported at the line of its key.
pub(crate) fn read_toml<T: DeserializeOwned>(
    path: &Path,
    check: impl FnOnce(&T) -> Result<(), SimulateError>,
) -> Result<T, SimulateError> {
    let bytes = fs_err::read(path)?;
    let text = std::str::from_utf8(&bytes).map_err(|_| DataError::file(path, "is not text"))?;
    parse_toml(text, path, check)
}

/// A TOML in memory; `path` is for messages.
pub(crate) fn parse_toml<T: DeserializeOwned>(
    text: &str,
    path: &Path,
    check: impl FnOnce(&T) -> Result<(), SimulateError>,
) -> Result<T, SimulateError> {
    let value: T = toml::from_str(text).map_err(|e| {
        let line = e.span().map_or(1, |span| line_of_byte(text, span.start));
        DataError::line(path, line, e.message())
    })?;
    check(&value).map_err(|error| match error {
        SimulateError::Config { field, message } => {
            let message = if field.is_empty() { message } else { format!("{field}: {message}") };
            match line_of_key(text, &field) {
                Some(line) => DataError::line(path, line, message).into(),
                None => DataError::file(path, message).into(),
            }
        }
        other => other,
    })?;
    Ok(value)
}

fn line_of_byte(text: &str, byte: usize) -> usize {
    1 + text.as_bytes()[..byte.min(text.len())].iter().filter(|b| **b == b'\n').count()
}

/// The line of a key as `effect[2].std_m`, or of the nearest table above it that is written down; `None` when nothing of it is.
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
        let check = |_: &toml::Table| Err(crate::error::wrong("b.c", "is too large"));
        let error = parse_toml("a = 1\n[b]\nc = 9\n", Path::new("x.toml"), check).unwrap_err();
        assert_eq!(error.to_string(), "x.toml:3: b.c: is too large");
    }
}
