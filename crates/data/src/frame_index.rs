//! What was read of the frames of a data set, so that it is not read again while the files stay as they are: the
//! classes of the labels, and the hashes of [`Dataset::content_sha256`].
//!
//! A data set of many frames has a file in the cache folder of the user. An entry holds as long as size, time of
//! change, time of status change and number of the inode of its files are the same. Files that were changed within the
//! last seconds get no entry: they could change again without another time. The folder may be removed at any time.

mod file;

use crate::checksum::files_sha256_bytes;
use crate::content::cloud_sha256;
use crate::source::{facts, is_url};
use crate::{DataError, Dataset, FilePart, Layout};
use file::{read_entries, write_entries};
use sha2::{Digest as _, Sha256};
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, LazyLock, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};

/// Number of frames from which an index is kept. Fewer are read in no time.
const LEAST_FRAMES: usize = 1000;

/// Age from which the times of a file tell whether it was changed again.
const SETTLED: Duration = Duration::from_secs(2);

/// The cache folder: `off` or a folder.
const VARIABLE: &str = "LIDARSHIFT_CACHE";

/// SHA-256.
pub(crate) type Sha256Bytes = [u8; 32];

/// What is known of the cloud of a frame, or of its labels and calibration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Entry {
    /// Hash of what is known and of whom.
    key: u64,
    /// Hash of the state of the files.
    state: [u8; 16],
    sha256: Sha256Bytes,
    /// Number of the set of classes of the labels.
    classes: u32,
}

/// The entries of a data set, sorted by key, and the sets of classes: names, each with a line feed after it.
#[derive(Clone, Debug, Default, PartialEq)]
struct Entries {
    entries: Vec<Entry>,
    sets: Vec<Arc<str>>,
}

/// The indices of this process, by their files.
static OPEN: LazyLock<Mutex<HashMap<PathBuf, Arc<Entries>>>> = LazyLock::new(Mutex::default);

/// Reads clouds and labels of a data set for what is to be known of them, or takes it from the index.
pub(crate) struct FrameIndex<'a> {
    dataset: &'a Dataset,
    has_labels: bool,
    /// The file of the index; `None` without an index.
    path: Option<PathBuf>,
    known: Arc<Entries>,
    found: Mutex<Found>,
    /// States of files with many frames.
    shards: Mutex<HashMap<PathBuf, Option<Vec<u8>>>>,
    began: SystemTime,
}

/// What was read.
#[derive(Default)]
struct Found {
    entries: Vec<Entry>,
    sets: BTreeMap<Arc<str>, u32>,
}

/// What an entry is about.
#[derive(Clone, Copy)]
enum What {
    Cloud,
    Labels,
}

impl<'a> FrameIndex<'a> {
    /// The index for reading `frames` frames of a data set.
    pub(crate) fn of(dataset: &'a Dataset, frames: usize) -> Self {
        let folder = (frames >= LEAST_FRAMES).then(cache_folder).flatten();
        Self::within(folder.as_deref(), dataset)
    }

    fn within(folder: Option<&Path>, dataset: &'a Dataset) -> Self {
        let path = folder.and_then(|folder| Some(folder.join(file_name(dataset)?)));
        let known = path.as_ref().map_or_else(Arc::default, |path| {
            let known = open().get(path).cloned();
            known.unwrap_or_else(|| {
                let read = Arc::new(read_entries(path).unwrap_or_default());
                open().entry(path.clone()).or_insert(read).clone()
            })
        });
        let sets = known.sets.iter().cloned().zip(0..).collect();
        let found = Mutex::new(Found { entries: Vec::new(), sets });
        let (shards, began) = (Mutex::default(), SystemTime::now());
        FrameIndex { dataset, has_labels: dataset.has_labels(), path, known, found, shards, began }
    }

    /// Hash of the cloud of a frame, see [`Dataset::content_sha256`].
    ///
    /// # Errors
    /// A cloud that cannot be read.
    pub(crate) fn cloud(&self, id: &str) -> Result<Sha256Bytes, DataError> {
        let state = self.path.as_ref().and_then(|_| self.state(id, &[self.dataset.cloud_place(id).ok()?]));
        if let Some(known) = self.known_entry(What::Cloud, id, state) {
            return Ok(known.sha256);
        }
        let sha256 = cloud_sha256(&self.dataset.cloud_part(id)?)?;
        self.keep(What::Cloud, id, state, sha256, "");
        Ok(sha256)
    }

    /// Hash of the labels and of the calibration of a frame.
    ///
    /// # Errors
    /// Labels or a calibration that cannot be read.
    pub(crate) fn labels(&self, id: &str) -> Result<Sha256Bytes, DataError> {
        let state = self.labels_state(id);
        if let Some(known) = self.known_entry(What::Labels, id, state) {
            return Ok(known.sha256);
        }
        let sha256 = self.hash_labels(id)?;
        if state.is_some() {
            self.keep(What::Labels, id, state, sha256, &self.read_classes(id));
        }
        Ok(sha256)
    }

    /// Adds the classes of the labels of a frame to `found`. Labels that cannot be read have none; the error is
    /// reported when their frame is loaded.
    pub(crate) fn add_classes(&self, id: &str, found: &mut BTreeSet<String>) {
        let state = self.labels_state(id);
        let known = self.known_entry(What::Labels, id, state);
        let set = known.and_then(|known| self.known.sets.get(known.classes as usize).cloned());
        let set = set.unwrap_or_else(|| {
            let set = self.read_classes(id);
            if let Some((state, sha256)) = state.zip(self.hash_labels(id).ok()) {
                self.keep(What::Labels, id, Some(state), sha256, &set);
            }
            set.into()
        });
        for class in set.lines() {
            if !found.contains(class) {
                found.insert(class.into());
            }
        }
    }

    /// Adds what was read to the index of this process and, with `save`, to its file. A file that cannot be written
    /// costs time, but is no error.
    pub(crate) fn finish(self, save: bool) {
        let Some(path) = self.path else { return };
        let found = self.found.into_inner().unwrap_or_else(PoisonError::into_inner);
        let mut open = open();
        let known = open.remove(&path).unwrap_or_default();
        let merged = if found.entries.is_empty() { known } else { Arc::new(merge(&known, &self.known, found)) };
        open.insert(path.clone(), merged.clone());
        drop(open);
        if save && read_entries(&path).is_none_or(|saved| saved != *merged) {
            let _ = write_entries(&path, &merged);
        }
    }

    fn read_classes(&self, id: &str) -> String {
        let lines = self.dataset.labels(id).unwrap_or_default();
        let classes: BTreeSet<String> =
            lines.into_iter().filter(|line| !line.is_dont_care()).map(|line| line.class).collect();
        classes.iter().map(|class| format!("{class}\n")).collect()
    }

    fn hash_labels(&self, id: &str) -> Result<Sha256Bytes, DataError> {
        let labels = self.has_labels.then(|| self.dataset.labels_part(id)).transpose()?;
        files_sha256_bytes(labels.into_iter().chain(self.dataset.calibration_path(id).map(FilePart::from)))
    }

    fn labels_state(&self, id: &str) -> Option<[u8; 16]> {
        self.path.as_ref()?;
        let labels = if self.has_labels { Some(self.dataset.labels_place(id).ok()?) } else { None };
        let parts: Vec<FilePart> =
            labels.into_iter().chain(self.dataset.calibration_path(id).map(FilePart::from)).collect();
        self.state(id, &parts)
    }

    /// Hash of the state of files; `None` if it does not tell whether they will have been changed.
    fn state(&self, id: &str, parts: &[FilePart]) -> Option<[u8; 16]> {
        let mut hash = Sha256::new();
        hash.update(id);
        for part in parts {
            let state = match part.range {
                None => state_of_file(&part.path, self.began),
                Some(_) => {
                    let mut shards = self.shards.lock().unwrap_or_else(PoisonError::into_inner);
                    match shards.get(&part.path) {
                        Some(state) => state.clone(),
                        None => {
                            let state = state_of_file(&part.path, self.began);
                            shards.insert(part.path.clone(), state.clone());
                            state
                        }
                    }
                }
            };
            let (first, length) = part.range.unwrap_or_default();
            hash.update(state?);
            hash.update([first.to_le_bytes(), length.to_le_bytes()].concat());
        }
        let digest: Sha256Bytes = hash.finalize().into();
        digest[..16].try_into().ok()
    }

    fn known_entry(&self, what: What, id: &str, state: Option<[u8; 16]>) -> Option<&Entry> {
        let (state, key) = (state?, key(what, id));
        let found = self.known.entries.binary_search_by_key(&key, |entry| entry.key).ok()?;
        Some(&self.known.entries[found]).filter(|entry| entry.state == state)
    }

    fn keep(&self, what: What, id: &str, state: Option<[u8; 16]>, sha256: Sha256Bytes, set: &str) {
        let Some(state) = state else { return };
        let mut found = self.found.lock().unwrap_or_else(PoisonError::into_inner);
        let number = found.sets.len() as u32;
        let classes = match found.sets.get(set) {
            Some(known) => *known,
            None => *found.sets.entry(set.into()).or_insert(number),
        };
        found.entries.push(Entry { key: key(what, id), state, sha256, classes });
    }
}

/// What other threads found since (`now`), and then what was found from `before` on.
fn merge(now: &Entries, before: &Entries, found: Found) -> Entries {
    let mut sets_found: Vec<Arc<str>> = vec!["".into(); found.sets.len()];
    for (set, number) in found.sets {
        sets_found[number as usize] = set;
    }
    let all = sets_found.iter().chain(&now.sets).chain(&before.sets).cloned();
    let sets: Vec<Arc<str>> = all.collect::<BTreeSet<_>>().into_iter().collect();
    let number_of = |set: &Arc<str>| sets.binary_search(set).unwrap_or_default() as u32;
    let renumbered = |old: &[Arc<str>]| -> Vec<u32> { old.iter().map(number_of).collect() };
    let (numbers_found, numbers_now) = (renumbered(&sets_found), renumbered(&now.sets));
    let with = |entry: &Entry, numbers: &[u32]| Entry {
        classes: numbers.get(entry.classes as usize).copied().unwrap_or_default(),
        ..*entry
    };
    let mut entries: Vec<Entry> = found.entries.iter().map(|entry| with(entry, &numbers_found)).collect();
    entries.extend(now.entries.iter().map(|entry| with(entry, &numbers_now)));
    // Stable: of one key the first stays, which was found now.
    entries.sort_by_key(|entry| entry.key);
    entries.dedup_by_key(|entry| entry.key);
    Entries { entries, sets }
}

fn open() -> MutexGuard<'static, HashMap<PathBuf, Arc<Entries>>> {
    OPEN.lock().unwrap_or_else(PoisonError::into_inner)
}

fn key(what: What, id: &str) -> u64 {
    let digest: Sha256Bytes = Sha256::digest([&[what as u8], id.as_bytes()].concat()).into();
    u64::from_le_bytes([0, 1, 2, 3, 4, 5, 6, 7].map(|i| digest[i]))
}

/// Name of the file of a data set; `None` for layouts whose labels lie in tables.
fn file_name(dataset: &Dataset) -> Option<String> {
    let config = &dataset.config;
    let indexed = [Layout::Kitti, Layout::S2rDad, Layout::OpenPcdet, Layout::Carla, Layout::Shards];
    let root = if is_url(&config.root) { config.root.clone() } else { config.root.canonicalize().ok()? };
    if !indexed.contains(&config.layout) {
        return None;
    }
    let described = format!("{root:?}\n{}\n{:?}\n", config.layout.name(), config.labels);
    let digest = crate::checksum::hex(&Sha256::digest(described));
    Some(format!("frames-{}.bin", &digest[..32]))
}

/// Size and times of a file, or that it does not exist; `None` if it was changed a moment before `now`, or cannot be
/// asked for.
fn state_of_file(path: &Path, now: SystemTime) -> Option<Vec<u8>> {
    if is_url(path) {
        // An entity tag tells at any time.
        let facts = facts(path).ok().filter(|facts| facts.tag.is_some())?;
        return Some(format!("{facts:?}").into_bytes());
    }
    let metadata = match std::fs::metadata(path) {
        Ok(metadata) => metadata,
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => return Some(b"absent".to_vec()),
        Err(_) => return None,
    };
    let since_1970 = |time: SystemTime| time.duration_since(SystemTime::UNIX_EPOCH).ok();
    let (changed, now) = (since_1970(metadata.modified().ok()?)?, since_1970(now)?);
    #[cfg(unix)]
    let (status_ns, inode) = {
        use std::os::unix::fs::MetadataExt as _;
        (i128::from(metadata.ctime()) * 1_000_000_000 + i128::from(metadata.ctime_nsec()), metadata.ino())
    };
    #[cfg(not(unix))]
    let (status_ns, inode) = (0, 0u64);
    let newest_ns = (changed.as_nanos() as i128).max(status_ns);
    let is_settled = newest_ns + SETTLED.as_nanos() as i128 <= now.as_nanos() as i128;
    let state = || {
        [
            &metadata.len().to_le_bytes()[..],
            &changed.as_nanos().to_le_bytes(),
            &status_ns.to_le_bytes(),
            &inode.to_le_bytes(),
        ]
        .concat()
    };
    is_settled.then(state)
}

/// The cache folder of the user; `None` if there is none or it is switched off.
fn cache_folder() -> Option<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).map(PathBuf::from).filter(|folder| folder.is_absolute());
    match std::env::var_os(VARIABLE) {
        Some(value) if value.is_empty() || value == "off" => None,
        Some(value) => std::path::absolute(value).ok(),
        None => {
            let usual = folder("XDG_CACHE_HOME").or_else(|| folder("LOCALAPPDATA"));
            Some(usual.or_else(|| folder("HOME").map(|home| home.join(".cache")))?.join("lidarshift"))
        }
    }
}

#[cfg(test)]
mod tests;
