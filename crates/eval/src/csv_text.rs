//! Tables as CSV (RFC 4180).

use std::borrow::Cow;

/// Formats a table as CSV. Fields are quoted where necessary. Text that a spreadsheet would evaluate as a formula
/// begins with an apostrophe.
///
/// # Panics
/// If a line has a different number of fields than there are columns.
pub fn csv_text(columns: &[&str], lines: &[Vec<String>]) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let mut write = |fields: &mut dyn Iterator<Item = &str>| {
        let fields: Vec<Cow<'_, str>> = fields.map(as_text).collect();
        writer.write_record(fields.iter().map(|field| &**field)).expect("every line has a field for each column");
    };
    write(&mut columns.iter().copied());
    lines.iter().for_each(|line| write(&mut line.iter().map(String::as_str)));
    let bytes = writer.into_inner().expect("writing to a Vec does not fail");
    String::from_utf8(bytes).expect("CSV of UTF-8 fields is UTF-8")
}

/// A field with an apostrophe before it if it is no number and begins as a formula does. Control characters are
/// escaped.
fn as_text(field: &str) -> Cow<'_, str> {
    let is_formula = field.starts_with(['=', '+', '-', '@']) && field.len() > 1 && field.parse::<f64>().is_err();
    let is_strange = |c: char| c.is_control() && c != '\n';
    match (is_formula, field.contains(is_strange)) {
        (false, false) => Cow::Borrowed(field),
        (_, strange) => {
            let mut text = if is_formula { String::from("'") } else { String::new() };
            for c in field.chars() {
                if strange && is_strange(c) { text.extend(c.escape_unicode()) } else { text.push(c) }
            }
            Cow::Owned(text)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_are_text_and_numbers_stay() {
        for (field, want) in [
            ("=1+1", "'=1+1"),
            ("@SUM(A1)", "'@SUM(A1)"),
            ("+cmd", "'+cmd"),
            ("-cmd", "'-cmd"),
            ("-1.5", "-1.5"),
            ("+1e-3", "+1e-3"),
            ("-", "-"),
            ("", ""),
            ("a=b", "a=b"),
            ("a\u{1b}b\tc", "a\\u{1b}b\\u{9}c"),
        ] {
            assert_eq!(as_text(field), want);
        }
        assert_eq!(csv_text(&["=a"], &[vec!["=1, 2".into()]]), "'=a\n\"'=1, 2\"\n");
    }
}
