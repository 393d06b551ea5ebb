//! Tables as CSV (RFC 4180).

/// A table as CSV. Fields are quoted where they have to be.
///
/// # Panics
/// Where a line has not as many fields as there are columns.
pub fn csv_text(columns: &[&str], lines: &[Vec<String>]) -> String {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let mut write = |fields: &mut dyn Iterator<Item = &str>| writer.write_record(fields);
    write(&mut columns.iter().copied()).expect("a Vec takes everything");
    for line in lines {
        write(&mut line.iter().map(String::as_str)).expect("every line has a field for each column");
    }
    let bytes = writer.into_inner().expect("a Vec takes everything");
    String::from_utf8(bytes).expect("text stays text")
}
