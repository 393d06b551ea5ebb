//! What is reported of an error to programs: its kind, the file, the line, and what to do.

use crate::{DataError, KeyError};
use schemars::JsonSchema;
use serde::Serialize;
use std::io;
use std::path::PathBuf;

/// Kind of an error. The names are stable; new kinds may be added.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ErrorKind {
    /// The command line could not be understood.
    Usage,
    /// A file or folder does not exist.
    Missing,
    /// The content of a file is invalid, or files do not fit each other.
    Invalid,
    /// Another process uses the folder.
    InUse,
    /// A file may not be read or written.
    Permission,
    /// There is no space for a file.
    Full,
    /// Another error of reading or writing.
    Io,
    /// What was asked for cannot be done; the message says why.
    #[default]
    Refused,
    /// A computation failed, such as by a lost device.
    Computation,
    /// A number is NaN or infinite, as after a diverged training.
    NotFinite,
    /// A training was stopped; its checkpoint is saved.
    Stopped,
    /// The command ran, but found something wrong.
    CheckFailed,
    /// The data sets of a diagnosis do not show the same scenes.
    OtherScenes,
}

/// Kind and place of an error.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Place {
    /// Its kind.
    pub kind: ErrorKind,
    /// The file or folder.
    pub file: Option<PathBuf>,
    /// The line, counted from 1.
    pub line: Option<usize>,
}

impl Place {
    /// An error without a file.
    pub fn of_kind(kind: ErrorKind) -> Self {
        Place { kind, ..Place::default() }
    }

    /// An error of a file.
    pub fn in_file(kind: ErrorKind, file: impl Into<PathBuf>) -> Self {
        Place { kind, file: Some(file.into()), line: None }
    }
}

/// An error with a place.
pub trait Located {
    /// Kind, file and line.
    fn place(&self) -> Place;
}

impl Located for io::Error {
    fn place(&self) -> Place {
        Place { kind: self.kind().into(), file: file_of(self), line: None }
    }
}

impl Located for DataError {
    fn place(&self) -> Place {
        match self {
            DataError::Io(error) => error.place(),
            DataError::Line { path, line, .. } => {
                Place { kind: ErrorKind::Invalid, file: Some(path.clone()), line: Some(*line) }
            }
            DataError::File { path, kind, .. } => Place::in_file(*kind, path),
        }
    }
}

impl Located for KeyError {
    fn place(&self) -> Place {
        Place::of_kind(ErrorKind::Invalid)
    }
}

impl From<io::ErrorKind> for ErrorKind {
    fn from(kind: io::ErrorKind) -> Self {
        use io::ErrorKind as E;
        match kind {
            E::NotFound | E::NotADirectory => ErrorKind::Missing,
            E::PermissionDenied | E::ReadOnlyFilesystem => ErrorKind::Permission,
            E::StorageFull | E::QuotaExceeded | E::FileTooLarge => ErrorKind::Full,
            E::InvalidData | E::UnexpectedEof => ErrorKind::Invalid,
            _ => ErrorKind::Io,
        }
    }
}

/// The file of an error of `fs-err`, whose type is private: its message has the path between backticks.
fn file_of(error: &io::Error) -> Option<PathBuf> {
    let text = error.get_ref()?.to_string();
    let (_, rest) = text.strip_prefix("failed to ")?.split_once('`')?;
    Some(rest.rsplit_once('`')?.0.into())
}

/// First words of what to do, in messages of errors.
const TO_DO: &[&str] = &[
    "add", "check", "choose", "close", "convert", "correct", "detect", "diagnose", "did", "draw", "free", "generate",
    "give", "install", "leave", "list", "look", "lower", "make", "name", "pass", "remove", "repeat", "run", "save",
    "say", "see", "set", "sort", "swap", "try", "turn", "use", "wait", "write",
];

/// The part of a message that says what to do: from the first clause that begins with a word of [`TO_DO`] to the end.
pub fn hint(message: &str) -> Option<&str> {
    let begins = |rest: &str| {
        let word = rest.split(|c: char| !c.is_alphabetic()).next().unwrap_or_default();
        // A word that is followed by `_`, `=`, a dot or a slash is a name, not a verb.
        let named = rest[word.len()..].starts_with(['_', '=', '.', '/', ':', '-', '[']);
        !named && TO_DO.contains(&word.to_lowercase().as_str())
    };
    let clauses = message.char_indices().filter(|(_, c)| matches!(c, ';' | ':' | '.'));
    let mut rests = clauses.filter_map(|(at, _)| message[at + 1..].strip_prefix(' '));
    rests.find(|rest| begins(rest)).map(str::trim_end)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_to_do_is_a_part_of_the_message() {
        for (message, want) in [
            (
                "a/b: does not exist; give the folder or the TOML of a data set",
                "give the folder or the TOML of a data set",
            ),
            ("x.toml:3: unknown field `yaw`: did you mean `yaw_deg`?", "did you mean `yaw_deg`?"),
            (
                "v: does not exist: check `root` and `layout` of the data set",
                "check `root` and `layout` of the data set",
            ),
            ("d: has no file; a frame without one is empty. Detect this test set again", "Detect this test set again"),
            (
                "run: is in use by another process (7); wait until it ends, or choose another --out",
                "wait until it ends, or choose another --out",
            ),
            (
                "has no split \"a\" (it has: b); add ImageSets/a.txt, or name its file under [splits]",
                "add ImageSets/a.txt, or name its file under [splits]",
            ),
        ] {
            assert_eq!(hint(message), Some(want));
        }
        for message in [
            "label_2/000001.txt:1: a label line has 15 values; this line has 14",
            "add: give.toml:4: run.epochs is 0",
            "set: name: 3",
            "a: b; c. d",
            "",
        ] {
            assert_eq!(hint(message), None, "{message}");
        }
    }

    #[test]
    fn errors_of_files_have_their_place() {
        let folder = tempfile::tempdir().unwrap();
        let absent = folder.path().join("it's `here`.txt");
        let error = DataError::from(fs_err::read(&absent).unwrap_err());
        assert_eq!(error.place(), Place::in_file(ErrorKind::Missing, &absent));
        let line = DataError::line(&absent, 7, "is wrong");
        assert_eq!(line.place(), Place { line: Some(7), ..Place::in_file(ErrorKind::Invalid, &absent) });
        let io = |kind| DataError::from(io::Error::from(kind)).place();
        assert_eq!(io(io::ErrorKind::StorageFull), Place::of_kind(ErrorKind::Full));
        assert_eq!(io(io::ErrorKind::TimedOut), Place::of_kind(ErrorKind::Io));
        let failed = DataError::io(&absent, "cannot be written", &io::ErrorKind::PermissionDenied.into());
        assert_eq!(failed.place(), Place::in_file(ErrorKind::Permission, &absent));
        assert!(failed.to_string().contains("cannot be written: permission denied"), "{failed}");
    }
}
