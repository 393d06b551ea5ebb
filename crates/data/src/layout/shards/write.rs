//! Writes shards and their index.

use super::index::{INDEX, ShardIndex};
use crate::output::write_atomic_with;
use crate::{DataError, Presence as _, write_atomic};
use std::io::{BufWriter, Write as _};
use std::path::Path;

/// A frame as it is written.
pub(crate) struct ShardFrame {
    pub id: String,
    /// The content of `ID.bin`.
    pub cloud: Vec<u8>,
    /// The content of `ID.txt`; `None` if the data set has no labels.
    pub labels: Option<String>,
}

/// Name of a shard, by its number from 0.
pub(crate) fn shard_name(number: usize) -> String {
    format!("shard-{number:06}.tar")
}

/// Writes a shard. Its bytes depend on the frames alone.
pub(crate) fn write_shard(
    path: &Path,
    frames: impl Iterator<Item = Result<ShardFrame, DataError>>,
) -> Result<(), DataError> {
    let failed = |e: std::io::Error| DataError::file(path, format!("cannot be written: {e}"));
    write_atomic_with(path, |file| {
        let mut builder = tar::Builder::new(BufWriter::new(file));
        for frame in frames {
            let frame = frame?;
            let labels = frame.labels.as_ref().map(|text| ("txt", text.as_bytes()));
            for (ending, bytes) in std::iter::once(("bin", &frame.cloud[..])).chain(labels) {
                let mut header = tar::Header::new_gnu();
                header.set_size(bytes.len() as u64);
                header.set_mode(0o644);
                builder.append_data(&mut header, format!("{}.{ending}", frame.id), bytes).map_err(failed)?;
            }
        }
        builder.into_inner().and_then(|mut file| file.flush()).map_err(failed)
    })
}

/// Writes the index of the shards of a folder beside them.
pub(crate) fn write_index(folder: &Path) -> Result<(), DataError> {
    write_atomic(&folder.join(INDEX), ShardIndex::scan(folder)?.to_lines().as_bytes())
}

/// Removes shards with the numbers from `count` on, which an earlier run wrote for more frames.
pub(crate) fn remove_other_shards(folder: &Path, count: usize) -> Result<(), DataError> {
    if !folder.may_be_folder() {
        return Ok(());
    }
    for entry in fs_err::read_dir(folder)? {
        let entry = entry?;
        let name = entry.file_name();
        let number = name.to_str().and_then(|name| name.strip_prefix("shard-")?.strip_suffix(".tar")?.parse().ok());
        if number.is_some_and(|number: usize| number >= count && name == *shard_name(number)) {
            fs_err::remove_file(entry.path())?;
        }
    }
    Ok(())
}
