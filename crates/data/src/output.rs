//! Writes files atomically, and through everything that is not a regular file.
//!
//! A regular file is written as a temporary file in the same folder, synced and renamed, and its folder is synced. A
//! symbolic link stays, and the file it points to is replaced. A device, a named pipe, a socket or an open file of the
//! process (`/dev/fd/N`) is opened and written to.

use crate::DataError;
use crate::Presence as _;
use std::collections::BTreeSet;
use std::io::{ErrorKind, Result as IoResult, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::Duration;

/// Prefix of the names of temporary files.
pub(crate) const TEMPORARY_PREFIX: &str = ".writing-";

/// Maximum number of symbolic links that are followed.
const MAX_LINKS: usize = 40;

/// Temporary files and folders of this process that exist now.
static TEMPORARY: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

/// A temporary folder, removed when this value is dropped or when a signal ends the process.
#[derive(Debug)]
pub struct TemporaryFolder(tempfile::TempDir);

impl TemporaryFolder {
    /// Creates the folder.
    ///
    /// # Errors
    /// No place for temporary files.
    pub fn new() -> IoResult<Self> {
        // Created while `remove_temporary` waits, which otherwise could miss it.
        let mut all = temporary();
        let folder = tempfile::tempdir()?;
        all.insert(folder.path().to_path_buf());
        Ok(TemporaryFolder(folder))
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
}

impl Drop for TemporaryFolder {
    fn drop(&mut self) {
        temporary().remove(self.0.path());
    }
}

/// A temporary file that is removed when a signal ends the process while this value lives.
struct TemporaryFile(PathBuf);

impl TemporaryFile {
    fn new(path: &Path) -> Self {
        temporary().insert(path.to_path_buf());
        TemporaryFile(path.to_path_buf())
    }
}

impl Drop for TemporaryFile {
    fn drop(&mut self) {
        temporary().remove(&self.0);
    }
}

fn temporary() -> std::sync::MutexGuard<'static, BTreeSet<PathBuf>> {
    TEMPORARY.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
}

/// Removes the temporary files and folders of this process, which has to end then: from now on every thread that writes
/// a file waits for the end.
pub fn remove_temporary() {
    let all = temporary();
    // Each thread may still write one more file into a folder, and make it anew for that: a folder is gone when it is
    // absent twice. Nothing can be done about other errors here; the next writer of a folder removes its temporary
    // files.
    let mut absent = if all.is_empty() { 2 } else { 0 };
    for _ in 0..40 {
        if absent == 2 {
            break;
        }
        for path in all.iter() {
            let _ = if path.is_dir() { std::fs::remove_dir_all(path) } else { std::fs::remove_file(path) };
        }
        std::thread::sleep(Duration::from_millis(10));
        absent = if all.iter().any(|path| path.exists()) { 0 } else { absent + 1 };
    }
    std::mem::forget(all);
}

/// Removes temporary files of killed processes from a folder, which need not exist. No other process may write there.
pub fn remove_unfinished(folder: &Path) -> Result<(), DataError> {
    if folder.may_be_folder() {
        for entry in fs_err::read_dir(folder)? {
            let entry = entry?;
            if entry.file_name().to_string_lossy().starts_with(TEMPORARY_PREFIX) {
                fs_err::remove_file(entry.path())?;
            }
        }
    }
    Ok(())
}

/// Age from which a temporary file is taken for one of a killed process, where other processes may write. Writing takes
/// seconds.
const OLD: Duration = Duration::from_secs(3600);

/// Removes old temporary files of killed processes from a folder that other processes may write to. What cannot be
/// removed stays.
fn remove_old_unfinished(folder: &Path) {
    for entry in std::fs::read_dir(folder).into_iter().flatten().flatten() {
        let is_old = || entry.metadata().ok()?.modified().ok()?.elapsed().ok().map(|age| age > OLD);
        if entry.file_name().to_string_lossy().starts_with(TEMPORARY_PREFIX) && is_old() == Some(true) {
            std::fs::remove_file(entry.path()).ok();
        }
    }
}

/// As [`remove_unfinished`], and from all folders below it.
pub fn remove_unfinished_below(folder: &Path) -> Result<(), DataError> {
    remove_unfinished(folder)?;
    if folder.may_be_folder() {
        for entry in fs_err::read_dir(folder)? {
            let entry = entry?;
            if entry.file_type()?.is_dir() {
                remove_unfinished_below(&entry.path())?;
            }
        }
    }
    Ok(())
}

/// Writes `bytes` to `path` and creates its folder if needed. Readers see the old or the new file, never a part of it.
/// What exists and is no regular file is written to and stays.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), DataError> {
    let failed = |e: std::io::Error| DataError::io(path, "cannot be written", &e);
    match destination(path).map_err(failed)? {
        Destination::File(file) => {
            create_folder(folder_of(&file))?;
            replace(&file, |to| to.write_all(bytes).map_err(failed))?.map_err(failed)
        }
        Destination::Stdout => write_all(&mut std::io::stdout().lock(), bytes).map_err(failed),
        Destination::Stderr => write_all(&mut std::io::stderr().lock(), bytes).map_err(failed),
        Destination::OpenFile(file) => {
            let mut options = std::fs::OpenOptions::new();
            options.append(true).open(&file).and_then(|mut f| write_all(&mut f, bytes)).map_err(failed)
        }
        Destination::Device(file) => {
            let mut options = std::fs::OpenOptions::new();
            options.write(true).open(&file).and_then(|mut f| write_all(&mut f, bytes)).map_err(failed)
        }
    }
}

/// As [`write_atomic`], for a file that is too large to be in memory: `fill` writes it piece by piece.
///
/// # Errors
/// Those of `fill`, a file that cannot be written, and a path that is no regular file.
pub fn write_atomic_with<E: From<DataError>>(
    path: &Path,
    fill: impl FnOnce(&mut std::fs::File) -> Result<(), E>,
) -> Result<(), E> {
    let failed = |e: std::io::Error| DataError::io(path, "cannot be written", &e);
    let Destination::File(file) = destination(path).map_err(failed)? else {
        return Err(DataError::file(path, "is no regular file; it is written in pieces, which needs one").into());
    };
    create_folder(folder_of(&file))?;
    Ok(replace(&file, fill)?.map_err(failed)?)
}

/// Checks that `path` can be written, without changing it: before long work whose result is written there.
///
/// # Errors
/// A folder in which no file can be created, or a path that is a folder.
pub fn check_writable(path: &Path) -> Result<(), DataError> {
    let failed = |e: std::io::Error| DataError::io(path, "cannot be written", &e);
    if let Destination::File(file) = destination(path).map_err(failed)? {
        let folder = folder_of(&file);
        create_folder(folder)?;
        remove_old_unfinished(folder);
        let probe = tempfile::Builder::new().prefix(TEMPORARY_PREFIX).tempfile_in(folder).map_err(failed)?;
        let _registered = TemporaryFile::new(probe.path());
        probe.close().map_err(failed)?;
    }
    Ok(())
}

/// Where the bytes of a path go.
#[derive(Debug, PartialEq, Eq)]
enum Destination {
    /// A regular file that exists or does not exist, after following symbolic links.
    File(PathBuf),
    /// The stdout of this process.
    Stdout,
    /// The stderr of this process.
    Stderr,
    /// An open file of a process, such as `/dev/fd/63`.
    OpenFile(PathBuf),
    /// A device, a named pipe or a socket.
    Device(PathBuf),
}

fn destination(path: &Path) -> IoResult<Destination> {
    let mut at = path.to_path_buf();
    for _ in 0..MAX_LINKS {
        if let Some(open) = open_file(&at) {
            return Ok(open);
        }
        let kind = match std::fs::symlink_metadata(&at) {
            Ok(metadata) => metadata.file_type(),
            Err(e) if e.kind() == ErrorKind::NotFound => return Ok(Destination::File(at)),
            Err(e) if e.kind() == ErrorKind::NotADirectory => return Ok(Destination::File(at)),
            Err(e) => return Err(e),
        };
        if !kind.is_symlink() {
            return match () {
                () if kind.is_file() => Ok(Destination::File(at)),
                () if kind.is_dir() => Err(std::io::Error::new(ErrorKind::IsADirectory, "it is a folder")),
                () => Ok(Destination::Device(at)),
            };
        }
        at = folder_of(&at).join(std::fs::read_link(&at)?);
    }
    Err(std::io::Error::other("it is a chain of too many symbolic links"))
}

/// Whether a path names an open file of a process: a file in `/proc/PID/fd` or `/dev/fd`. Its link does not have to
/// name a file, so it cannot be followed.
fn open_file(path: &Path) -> Option<Destination> {
    let number = path.file_name()?.to_str().filter(|name| name.bytes().all(|b| b.is_ascii_digit()))?;
    let folder = folder_of(path).canonicalize().ok()?;
    let in_proc = folder.starts_with("/proc") && folder.ends_with("fd");
    if !in_proc && folder != Path::new("/dev/fd") {
        return None;
    }
    let own = !in_proc || Path::new("/proc/self/fd").canonicalize().is_ok_and(|own| own == folder);
    Some(match number {
        "1" if own => Destination::Stdout,
        "2" if own => Destination::Stderr,
        _ => Destination::OpenFile(path.to_path_buf()),
    })
}

fn write_all(to: &mut dyn Write, bytes: &[u8]) -> IoResult<()> {
    to.write_all(bytes)?;
    to.flush()
}

/// Replaces a file by what `fill` writes. The outer error is that of `fill`.
fn replace<E: From<DataError>>(
    path: &Path,
    fill: impl FnOnce(&mut std::fs::File) -> Result<(), E>,
) -> Result<IoResult<()>, E> {
    let folder = folder_of(path);
    let mut builder = tempfile::Builder::new();
    builder.prefix(TEMPORARY_PREFIX);
    #[cfg(unix)]
    let permissions = <std::fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666);
    #[cfg(unix)]
    builder.permissions(permissions); // before the umask; temporary files have 0600 by default
    let mut file = match builder.tempfile_in(folder) {
        Ok(file) => file,
        Err(e) => return Ok(Err(e)),
    };
    let _registered = TemporaryFile::new(file.path());
    fill(file.as_file_mut())?;
    Ok(keep(file, path, folder))
}

fn keep(file: tempfile::NamedTempFile, path: &Path, folder: &Path) -> IoResult<()> {
    file.as_file().sync_all()?;
    // Not `persist`, which calls the system without the C library: tests put a layer between that makes calls fail.
    let temporary = file.into_temp_path();
    std::fs::rename(&temporary, path)?;
    temporary.keep().map_err(|e| e.error)?; // it has no file any more
    sync_folder(folder)
}

/// Replaces `name` by a hard link to `file` of the same file system, or by a copy if it has no links, and syncs the
/// folder.
///
/// # Errors
/// Files that cannot be read or written; the message names them.
pub fn link(file: &Path, name: &Path) -> Result<(), DataError> {
    let temporary = name.with_file_name(format!("{TEMPORARY_PREFIX}link-{}", std::process::id()));
    if fs_err::hard_link(file, &temporary).is_err() {
        return write_atomic(name, &fs_err::read(file)?);
    }
    rename(&temporary, name)?;
    // Both names were the same file: POSIX defines that the rename then does nothing.
    match fs_err::remove_file(&temporary) {
        Err(e) if e.kind() != ErrorKind::NotFound => Err(e.into()),
        _ => Ok(()),
    }
}

/// Renames a file within its folder, and syncs the folder.
///
/// # Errors
/// A file that cannot be renamed; the message names it.
pub fn rename(from: &Path, to: &Path) -> Result<(), DataError> {
    fs_err::rename(from, to)?;
    let folder = folder_of(to);
    sync_folder(folder).map_err(|e| DataError::io(folder, "the folder cannot be synced", &e))
}

/// The folder of a file; `.` for a bare name.
fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Creates a folder with the folders above it, if they do not exist, and syncs the folders that hold new entries.
///
/// # Errors
/// A folder that cannot be created; the message names it.
pub fn create_folder(folder: &Path) -> Result<(), DataError> {
    let is_missing = |f: &&Path| !f.as_os_str().is_empty() && !f.is_dir();
    let missing: Vec<&Path> = folder.ancestors().take_while(is_missing).collect();
    if !missing.is_empty() {
        fs_err::create_dir_all(folder)?;
    }
    for made in missing {
        let above = folder_of(made);
        let failed = |e| DataError::io(made, "the folder that has this one cannot be synced", &e);
        sync_folder(above).map_err(failed)?;
    }
    Ok(())
}

/// Writes the entries of a folder to the disk, so that a renamed file has its name after a power failure.
#[cfg(unix)]
fn sync_folder(folder: &Path) -> IoResult<()> {
    match std::fs::File::open(folder).and_then(|folder| folder.sync_all()) {
        // Some file systems cannot sync a folder, and some folders can be written but not be opened.
        Err(e) if matches!(e.kind(), ErrorKind::InvalidInput | ErrorKind::Unsupported) => Ok(()),
        Err(e) if e.kind() == ErrorKind::PermissionDenied => Ok(()),
        done => done,
    }
}

#[cfg(not(unix))]
fn sync_folder(_folder: &Path) -> IoResult<()> {
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn write_errors_name_the_file() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("plain"), b"").unwrap();
        for (path, want) in [(folder.path().join("plain/x.txt"), "plain"), (folder.path().into(), "it is a folder")] {
            for error in [write_atomic(&path, b""), check_writable(&path)] {
                let error = error.unwrap_err().to_string();
                assert!(error.contains(want), "{error}");
            }
        }
    }

    #[test]
    fn a_path_is_checked_without_a_trace() {
        let folder = tempfile::tempdir().unwrap();
        check_writable(&folder.path().join("a.json")).unwrap();
        assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
    }

    #[test]
    fn old_temporary_files_beside_an_output_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for name in [".writing-old", ".writing-new", "old"] {
            std::fs::write(at(name), "").unwrap();
        }
        let before = std::time::SystemTime::now() - 2 * OLD;
        for name in [".writing-old", "old"] {
            std::fs::File::options().write(true).open(at(name)).unwrap().set_modified(before).unwrap();
        }
        check_writable(&at("a.json")).unwrap();
        assert!(!at(".writing-old").exists() && at(".writing-new").exists() && at("old").exists());
    }

    #[cfg(unix)]
    #[test]
    fn links_stay_and_their_targets_are_replaced() {
        use std::os::unix::fs::symlink;
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        std::fs::create_dir(at("elsewhere")).unwrap();
        symlink("elsewhere/target", at("link")).unwrap();
        symlink(at("link"), at("second")).unwrap();
        symlink("round", at("round")).unwrap();
        for (path, text) in [("second", "new"), ("link", "newer")] {
            write_atomic(&at(path), text.as_bytes()).unwrap();
            assert!(at("link").is_symlink() && at("second").is_symlink() && !at("elsewhere/target").is_symlink());
            assert_eq!(std::fs::read_to_string(at("elsewhere/target")).unwrap(), text);
        }
        assert!(write_atomic(&at("round"), b"").unwrap_err().to_string().contains("symbolic links"));
        // A named pipe and an open file.
        assert!(std::process::Command::new("mkfifo").arg(at("pipe")).status().unwrap().success());
        let reader = std::thread::spawn({
            let pipe = at("pipe");
            move || std::fs::read_to_string(pipe).unwrap()
        });
        write_atomic(&at("pipe"), b"through").unwrap();
        assert_eq!(reader.join().unwrap(), "through");
        assert!(!std::fs::metadata(at("pipe")).unwrap().is_file());
        write_atomic(Path::new("/dev/null"), b"through").unwrap();
        assert_eq!(destination(Path::new("/dev/stdout")).unwrap(), Destination::Stdout);
    }
}
