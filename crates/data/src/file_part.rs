//! A file, or a part of a file that has several frames.

use crate::DataError;
use crate::limits::length_of_file;
use crate::source::Source;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

/// Where the bytes of a cloud or of labels are: a file, or a range of one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FilePart {
    /// The file.
    pub path: PathBuf,
    /// First byte and length of the part; `None`: the whole file.
    pub range: Option<(u64, u64)>,
}

impl From<PathBuf> for FilePart {
    fn from(path: PathBuf) -> Self {
        FilePart { path, range: None }
    }
}

impl From<&Path> for FilePart {
    fn from(path: &Path) -> Self {
        path.to_path_buf().into()
    }
}

impl FilePart {
    /// Number of bytes.
    ///
    /// # Errors
    /// A file that does not exist or is no regular file.
    pub fn length(&self) -> Result<u64, DataError> {
        match self.range {
            Some((_, length)) => Ok(length),
            None => length_of_file(&self.path, u64::MAX),
        }
    }

    /// Reads all bytes, of which there are at most `most`.
    ///
    /// # Errors
    /// A file that cannot be read, is shorter than the end of the part, or a part that is larger than `most`.
    pub fn read(&self, most: u64) -> Result<Vec<u8>, DataError> {
        let Some((_, length)) = self.range else { return crate::limits::read_file(&self.path, most) };
        if length > most {
            let message = format!("a part of it has {length} bytes; at most {most} are read");
            return Err(DataError::file(&self.path, message));
        }
        let mut bytes = Vec::with_capacity(length as usize);
        self.open()?.read_to_end(&mut bytes)?;
        if bytes.len() as u64 != length {
            return Err(DataError::file(&self.path, "ends within one of its parts: it is truncated"));
        }
        Ok(bytes)
    }

    /// Opens the file at the first byte of the part; what is read ends with the part.
    ///
    /// # Errors
    /// A file that cannot be opened or is no regular file.
    pub(crate) fn open(&self) -> Result<PartReader, DataError> {
        let (start, length) = match self.range {
            Some(range) => range,
            None => (0, length_of_file(&self.path, u64::MAX)?),
        };
        let mut file = Source::open(&self.path, Some(start + length))?;
        if start > 0 {
            file.seek(SeekFrom::Start(start))?;
        }
        Ok(PartReader { file, start, length, at: 0 })
    }
}

/// Reads a part of a file.
pub(crate) struct PartReader {
    file: Source,
    start: u64,
    length: u64,
    at: u64,
}

impl PartReader {
    /// Number of bytes of the part when it was opened.
    pub(crate) fn length(&self) -> u64 {
        self.length
    }

    /// Goes to a byte of the part, counted from its first one.
    pub(crate) fn seek(&mut self, to: u64) -> std::io::Result<()> {
        self.file.seek(SeekFrom::Start(self.start + to))?;
        self.at = to;
        Ok(())
    }
}

impl std::io::Read for PartReader {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let left = usize::try_from(self.length.saturating_sub(self.at)).unwrap_or(usize::MAX);
        let wanted = buffer.len().min(left);
        let read = self.file.read(&mut buffer[..wanted])?;
        self.at += read as u64;
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::checksum::files_sha256;

    #[test]
    fn parts_are_read_as_files_of_their_own() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        std::fs::write(path("whole"), "before|inside|after").unwrap();
        std::fs::write(path("alone"), "inside").unwrap();
        let part = FilePart { path: path("whole"), range: Some((7, 6)) };
        let alone = FilePart::from(path("alone"));
        assert_eq!((part.read(6).unwrap(), part.length().unwrap()), (b"inside".to_vec(), 6));
        assert_eq!(files_sha256([part.clone()]).unwrap(), files_sha256([alone]).unwrap());
        assert!(part.read(5).unwrap_err().to_string().contains("a part of it has 6 bytes; at most 5"));
        let beyond = FilePart { range: Some((14, 6)), ..part };
        assert!(beyond.read(6).unwrap_err().to_string().contains("truncated"));
    }
}
