//! The file of an index: [`MAGIC`], the number of entries, the entries, the sets of classes, and the SHA-256 of all
//! before it. Numbers are little-endian.

use super::{Entries, Entry};
use crate::DataError;
use crate::limits::{MOST_CLOUD_BYTES, read_file};
use crate::output::{check_writable, write_atomic_with};
use sha2::{Digest as _, Sha256};
use std::io::{BufWriter, Write as _};
use std::path::Path;
use std::sync::Arc;

/// First bytes. The number is increased when the format or the contents change.
const MAGIC: &[u8; 8] = b"LSFRAM01";

/// Reads a file; `None` if it does not exist, is damaged or of another version.
pub(super) fn read_entries(path: &Path) -> Option<Entries> {
    let bytes = read_file(path, MOST_CLOUD_BYTES).ok()?;
    let (bytes, digest) = bytes.split_last_chunk::<32>()?;
    if Sha256::digest(bytes)[..] != digest[..] {
        return None;
    }
    let mut rest = bytes.strip_prefix(MAGIC)?;
    let count = u64::from_le_bytes(*take(&mut rest)?);
    let mut entries = Vec::new();
    for _ in 0..count {
        let key = u64::from_le_bytes(*take(&mut rest)?);
        let (state, sha256) = (*take(&mut rest)?, *take(&mut rest)?);
        entries.push(Entry { key, state, sha256, classes: u32::from_le_bytes(*take(&mut rest)?) });
    }
    let mut sets = Vec::new();
    while !rest.is_empty() {
        let length = u32::from_le_bytes(*take(&mut rest)?);
        let (set, behind) = rest.split_at_checked(length as usize)?;
        sets.push(Arc::from(std::str::from_utf8(set).ok()?));
        rest = behind;
    }
    let is_sound = entries.is_sorted_by_key(|entry| entry.key);
    (is_sound && entries.iter().all(|entry| (entry.classes as usize) < sets.len())).then_some(Entries { entries, sets })
}

/// Writes a file.
pub(super) fn write_entries(path: &Path, Entries { entries, sets }: &Entries) -> Result<(), DataError> {
    // Also removes old temporary files.
    check_writable(path)?;
    write_atomic_with(path, |file| {
        let failed = |e: std::io::Error| DataError::io(path, "cannot be written", &e);
        let (mut out, mut hash) = (BufWriter::new(file), Sha256::new());
        let mut write = |bytes: &[u8]| {
            hash.update(bytes);
            out.write_all(bytes).map_err(failed)
        };
        write(MAGIC)?;
        write(&(entries.len() as u64).to_le_bytes())?;
        for Entry { key, state, sha256, classes } in entries {
            write(&[&key.to_le_bytes()[..], state, sha256, &classes.to_le_bytes()].concat())?;
        }
        for set in sets {
            write(&(set.len() as u32).to_le_bytes())?;
            write(set.as_bytes())?;
        }
        let digest = hash.finalize();
        out.write_all(&digest).and_then(|()| out.flush()).map_err(failed)
    })
}

fn take<'a, const N: usize>(rest: &mut &'a [u8]) -> Option<&'a [u8; N]> {
    let (head, tail) = rest.split_first_chunk()?;
    *rest = tail;
    Some(head)
}
