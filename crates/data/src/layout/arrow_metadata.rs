//! Metadata of a schema in a file of Arrow's IPC format.
//!
//! The values are texts by the format. Files of other programs have any bytes there, which the library refuses. They
//! are read here, and blanked in what the library sees.

use std::collections::BTreeMap;
use std::ops::Range;

/// Metadata of a schema, by key.
pub(super) type Metadata = BTreeMap<String, Vec<u8>>;

/// The metadata of the schema of a footer. Values that are no text become blanks. What cannot be followed is left to
/// the library, which checks the footer.
pub(super) fn take_metadata(footer: &mut [u8]) -> Metadata {
    let values = places_of_metadata(footer).unwrap_or_default();
    let mut metadata = Metadata::new();
    for (key, place) in values {
        let value = &mut footer[place];
        metadata.insert(key, value.to_vec());
        if std::str::from_utf8(value).is_err() {
            value.fill(b' ');
        }
    }
    metadata
}

/// Keys, and where their values are. The fields of tables in their order: footer: version, schema; schema: endianness,
/// fields, metadata; metadata: key, value.
fn places_of_metadata(footer: &[u8]) -> Option<Vec<(String, Range<usize>)>> {
    let schema = follow(footer, field(footer, follow(footer, 0)?, 1)?)?;
    let list = follow(footer, field(footer, schema, 2)?)?;
    let count = u32_at(footer, list)? as usize;
    let text = |at: usize| {
        let start = follow(footer, at)?;
        let place = start + 4..start + 4 + u32_at(footer, start)? as usize;
        footer.get(place.clone()).map(|bytes| (bytes, place))
    };
    // An entry has 4 bytes at least.
    let entries = (0..count.min(footer.len() / 4)).map(|i| {
        let entry = follow(footer, list + 4 + 4 * i)?;
        let (key, _) = text(field(footer, entry, 0)?)?;
        Some((String::from_utf8(key.to_vec()).ok()?, text(field(footer, entry, 1)?)?.1))
    });
    entries.collect()
}

/// Where a field of a table is; `None` if it is absent.
fn field(bytes: &[u8], table: usize, number: usize) -> Option<usize> {
    let back = u32_at(bytes, table)? as i32;
    let layout = table.checked_add_signed((back as isize).checked_neg()?)?;
    let u16_at = |at: usize| Some(usize::from(u16::from_le_bytes(bytes.get(at..at + 2)?.try_into().ok()?)));
    let slot = 4 + 2 * number;
    let offset = if slot < u16_at(layout)? { u16_at(layout + slot)? } else { 0 };
    (offset > 0).then_some(table + offset)
}

/// The place that an offset points to.
fn follow(bytes: &[u8], at: usize) -> Option<usize> {
    at.checked_add(u32_at(bytes, at)? as usize).filter(|place| *place < bytes.len())
}

/// The number at a place.
pub(super) fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.get(at..at.checked_add(4)?)?.try_into().ok()?))
}
