//! Results that are cached in files together with a hash of their inputs, and recomputed only if the inputs change.

use crate::error::Result;
use data::Presence as _;
use data::write_atomic;
use serde::Serialize;
use serde::de::DeserializeOwned;
use sha2::{Digest, Sha256};
use std::path::Path;

/// The result of `make`, cached as JSON in `path`. It is read from there if it was made from the same `parts` by the
/// same build of the program.
///
/// # Errors
/// What `make` returns, and files that cannot be written.
pub fn cached<T: Serialize + DeserializeOwned>(
    path: &Path,
    parts: &impl Serialize,
    make: impl FnOnce() -> Result<T>,
) -> Result<T> {
    let mut hash = Sha256::new();
    hash.update(data::build_id());
    hash.update(serde_json::to_vec(parts)?);
    let key: String = hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect();
    let key_path = path.with_extension("key");
    if fs_err::read_to_string(&key_path).is_ok_and(|known| known == key)
        && let Ok(bytes) = fs_err::read(path)
        && let Ok(value) = serde_json::from_slice(&bytes)
    {
        return Ok(value);
    }
    // The key is removed before and written after the value, so that an interrupted update is never taken for a result.
    if key_path.may_be_file() {
        fs_err::remove_file(&key_path)?;
    }
    let value = make()?;
    let mut text = serde_json::to_vec_pretty(&value)?;
    text.push(b'\n');
    write_atomic(path, &text)?;
    write_atomic(&key_path, key.as_bytes())?;
    // Parsed from the JSON, so that the first call returns the same as later ones (JSON has no NaN, for example).
    Ok(serde_json::from_slice(&text)?)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn made_once_and_again_when_the_parts_change() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        let made = |parts: &str, value: i32| cached(&path, &parts, || Ok(value)).unwrap();
        assert_eq!([made("x", 1), made("x", 2), made("y", 3), made("y", 4)], [1, 1, 3, 3]);
        std::fs::write(&path, "half").unwrap();
        assert_eq!(made("y", 5), 5);
    }
}
