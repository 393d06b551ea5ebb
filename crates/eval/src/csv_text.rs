//! Tables as CSV (RFC 4180).

/// Formats a table as CSV. Fields are quoted where necessary.
///
/// # Panics
/// If a line has a different number of fields than there are columns.
pub fn csv_text(columns: &[&str], lines: &[Vec<String>]) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let mut write = |fields: &mut dyn Iterator<Item = &str>| writer.write_record(fields);
    write(&mut columns.iter().copied()).expect("writing to a Vec does not fail");
    for line in lines {
        write(&mut line.iter().map(String::as_str)).expect("every line has a field for each column");
    }
    let bytes = writer.into_inner().expect("writing to a Vec does not fail");
    String::from_utf8(bytes).expect("CSV of UTF-8 fields is UTF-8")
}
