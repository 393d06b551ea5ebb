//! Largest sizes of what is read, and reads of files within them.
//!
//! The page `reference/limits.md` of the book lists all limits of the program.

use crate::DataError;
use crate::source::{Source, facts, is_url};
use std::io::Read as _;
use std::path::Path;

/// Points of a cloud.
pub const MOST_POINTS: usize = 20_000_000;

/// Bytes of a file with a cloud or with data of its points.
pub const MOST_CLOUD_BYTES: u64 = 2 << 30;

/// Fields of a PCD.
pub const MOST_PCD_FIELDS: usize = 256;

/// Bytes of a text: configurations, labels, calibrations, tables and lists of frames.
pub const MOST_TEXT_BYTES: u64 = 256 << 20;

/// Boxes of a frame, labelled or detected.
pub const MOST_BOXES: usize = 100_000;

/// Rows of a file of detections.
pub const MOST_DETECTIONS: usize = 1_000_000_000;

/// Frames of a split or of a list.
pub const MOST_IDS: usize = 10_000_000;

/// Bytes of a name of a file or folder.
pub const MOST_NAME_BYTES: usize = 100;

/// Side of a camera's image, px.
pub const MOST_IMAGE_SIDE_PX: u32 = 65_536;

/// Reads a whole file of at most `most` bytes.
///
/// # Errors
/// A file that is no regular file, such as a FIFO or a device, or that is larger. It is then not read.
pub fn read_file(path: &Path, most: u64) -> Result<Vec<u8>, DataError> {
    let length = length_of_file(path, most)?;
    let mut bytes = Vec::with_capacity(length as usize);
    // A file that grows meanwhile is read up to one byte beyond the limit.
    Source::open(path, None)?.take(most + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > most {
        return Err(too_large(path, bytes.len() as u64, most));
    }
    Ok(bytes)
}

/// Reads a text of at most [`MOST_TEXT_BYTES`].
///
/// # Errors
/// As [`read_file`], and a text that is not UTF-8.
pub fn read_text(path: &Path) -> Result<String, DataError> {
    String::from_utf8(read_file(path, MOST_TEXT_BYTES)?).map_err(|_| DataError::file(path, "is not UTF-8 text"))
}

/// Length of a regular file of at most `most` bytes.
///
/// # Errors
/// As [`read_file`].
pub fn length_of_file(path: &Path, most: u64) -> Result<u64, DataError> {
    if is_url(path) {
        let bytes = facts(path)?.bytes;
        return if bytes > most { Err(too_large(path, bytes, most)) } else { Ok(bytes) };
    }
    // Opening a FIFO would wait for a writer.
    let metadata = fs_err::metadata(path)?;
    if !metadata.is_file() {
        let what = if metadata.is_dir() { "is a folder" } else { "is not a regular file" };
        return Err(DataError::file(path, format!("{what}; only regular files are read")));
    }
    if metadata.len() > most { Err(too_large(path, metadata.len(), most)) } else { Ok(metadata.len()) }
}

fn too_large(path: &Path, length: u64, most: u64) -> DataError {
    DataError::file(path, format!("has {length} bytes; at most {most} are read from such a file"))
}

/// An error of `path` if there are more than `most`. `what` names them.
pub fn at_most(path: &Path, what: &str, count: u64, most: usize) -> Result<(), DataError> {
    if count > most as u64 {
        return Err(DataError::file(path, format!("has {count} {what}; at most {most} are supported")));
    }
    Ok(())
}

/// Checks a name that becomes a file or a folder.
///
/// # Errors
/// What is wrong with it, without the name of its key: a name that is empty, is a path, begins with a full stop, has a
/// control character, or is longer than [`MOST_NAME_BYTES`].
pub fn check_name(name: &str) -> Result<(), String> {
    let problem = if name.is_empty() {
        "it must not be empty".to_string()
    } else if name.contains(['/', '\\']) {
        "it must not contain a path separator".into()
    } else if name.starts_with('.') {
        "it must not begin with a full stop".into()
    } else if name.chars().any(char::is_control) {
        "it must not contain a control character".into()
    } else if name.len() > MOST_NAME_BYTES {
        format!("it has {} bytes; at most {MOST_NAME_BYTES} are allowed", name.len())
    } else {
        return Ok(());
    };
    let shown: String = name.chars().take(MOST_NAME_BYTES).collect();
    Err(format!("{shown:?} is not a name for a file or folder: {problem}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_files() {
        for name in ["car", "000001", "sim-noise", "Straße 1", "a.b", &"n".repeat(100)] {
            assert_eq!(check_name(name), Ok(()), "{name}");
        }
        let long = "n".repeat(101);
        for (name, want) in [
            ("", "empty"),
            ("..", "full stop"),
            (".hidden", "full stop"),
            ("../x", "separator"),
            ("/etc/passwd", "separator"),
            ("a\\b", "separator"),
            ("a\u{1b}[31m", "control"),
            ("a\nb", "control"),
            ("a\0", "control"),
            (&long, "101 bytes"),
        ] {
            let error = check_name(name).unwrap_err();
            assert!(error.contains(want) && !error.contains(['\u{1b}', '\n', '\0']), "{error}");
        }
    }

    #[test]
    fn files_beyond_the_limit_are_not_read() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("sparse.bin");
        std::fs::File::create(&path).unwrap().set_len(1 << 40).unwrap();
        let error = read_file(&path, MOST_CLOUD_BYTES).unwrap_err().to_string();
        assert!(error.contains("sparse.bin: has 1099511627776 bytes; at most 2147483648"), "{error}");
        let error = read_file(folder.path(), 10).unwrap_err().to_string();
        assert!(error.contains("is a folder"), "{error}");
        std::fs::write(&path, "text").unwrap();
        assert_eq!(read_file(&path, 4).unwrap(), b"text");
        assert!(read_file(&path, 3).is_err());
    }
}
