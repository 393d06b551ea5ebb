//! What stays in memory of files that are read again and again.

use crate::DataError;
use std::collections::VecDeque;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;

/// Values that stay in memory, or as many as there are threads: each may read frames one after the other.
const MOST_RECENT: usize = 8;

/// Length and time of change of files.
pub(super) type State = Vec<(u64, Option<SystemTime>)>;

/// The state of files. What is remembered of them is valid as long as it is the same.
///
/// # Errors
/// A file that cannot be read. `missing` says what to do about one that does not exist.
pub(super) fn state(paths: &[&Path], missing: &str) -> Result<State, DataError> {
    let of = |path: &&Path| match std::fs::metadata(path) {
        Ok(found) => Ok((found.len(), found.modified().ok())),
        Err(e) if e.kind() == std::io::ErrorKind::NotFound => Err(DataError::missing(path, missing)),
        Err(e) => Err(DataError::io(path, "cannot be read", &e)),
    };
    paths.iter().map(of).collect()
}

/// Values that were used last, the newest one at the end.
pub(super) struct Recent<K, V>(Mutex<VecDeque<(K, Arc<V>)>>);

impl<K: PartialEq, V> Recent<K, V> {
    /// Nothing yet.
    pub(super) const fn new() -> Self {
        Recent(Mutex::new(VecDeque::new()))
    }

    /// A value that is known, or made. Threads that ask for it at the same time may each make it.
    pub(super) fn get(&self, key: K, make: impl FnOnce() -> Result<V, DataError>) -> Result<Arc<V>, DataError> {
        let lock = || self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, value)) = lock().iter().find(|(known, _)| *known == key) {
            return Ok(value.clone());
        }
        let value = Arc::new(make()?);
        let mut known = lock();
        if known.len() >= MOST_RECENT.max(rayon::current_num_threads()) {
            known.pop_front();
        }
        known.push_back((key, value.clone()));
        Ok(value)
    }
}
