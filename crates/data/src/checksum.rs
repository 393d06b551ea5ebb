//! SHA-256 of files.

use crate::Presence as _;
use crate::{DataError, FilePart};
use sha2::{Digest, Sha256};
use std::io::Read as _;
use std::path::Path;

/// A hash in hexadecimal.
pub fn hex(digest: &[u8]) -> String {
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// SHA-256 of a file in hexadecimal. The file is read in pieces.
///
/// # Errors
/// A file that cannot be read, or is no regular file.
pub fn file_sha256(path: &Path) -> Result<String, DataError> {
    let mut hash = Sha256::new();
    add(&mut hash, &path.into())?;
    Ok(hex(&hash.finalize()))
}

/// SHA-256 over several files or parts of files, in hexadecimal. A file that does not exist counts as such.
///
/// # Errors
/// As [`file_sha256`].
pub fn files_sha256<P: Into<FilePart>>(parts: impl IntoIterator<Item = P>) -> Result<String, DataError> {
    Ok(hex(&files_sha256_bytes(parts)?))
}

/// As [`files_sha256`], the bytes of the hash.
pub(crate) fn files_sha256_bytes<P: Into<FilePart>>(parts: impl IntoIterator<Item = P>) -> Result<[u8; 32], DataError> {
    let mut hash = Sha256::new();
    for part in parts {
        let part = part.into();
        if part.path.may_exist() {
            hash.update(part.length()?.to_le_bytes());
            add(&mut hash, &part)?;
        } else {
            hash.update(u64::MAX.to_le_bytes());
        }
    }
    Ok(hash.finalize().into())
}

fn add(hash: &mut Sha256, part: &FilePart) -> Result<(), DataError> {
    let mut file = part.open()?;
    // Most files are labels of some lines.
    let mut piece = vec![0; file.length().clamp(1, 1 << 18) as usize];
    loop {
        match file.read(&mut piece) {
            Ok(0) => return Ok(()),
            Ok(n) => hash.update(&piece[..n]),
            Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
            Err(e) => return Err(e.into()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hashes_of_files() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("a"), "abc").unwrap();
        let want = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(file_sha256(&path("a")).unwrap(), want);
        std::fs::write(path("b"), vec![7; 600_000]).unwrap();
        let of = |names: &[&str]| files_sha256(names.iter().map(|n| path(n))).unwrap();
        assert_ne!(of(&["a", "b"]), of(&["b", "a"]));
        assert_ne!(of(&["a", "missing"]), of(&["a"]));
        assert!(file_sha256(&path("missing")).is_err() && file_sha256(folder.path()).is_err());
    }
}
