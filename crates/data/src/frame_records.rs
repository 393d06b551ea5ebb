//! `frames.jsonl` of a generated data set: of each frame the SHA-256 of its files and of what it was made from, and the
//! build of the program that wrote it.
//!
//! A line is appended when a frame is written, so that an interrupted run knows which frames are whole. A line that
//! cannot be read is ignored: its frame is made again. At the end the file is sorted.

use crate::Presence as _;
use crate::checksum::file_sha256;
use crate::{DataError, build_id, write_atomic};
use fs_err::{File, OpenOptions};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// Name of the file.
pub const FRAMES_FILE: &str = "frames.jsonl";

/// The files of one frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct FrameRecord {
    /// Id of the frame.
    id: String,
    /// SHA-256 of what the frame was made from, if it was made from files.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    source: Option<String>,
    /// [`build_id`] of the program that wrote it. Earlier versions have none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    build: Option<String>,
    /// SHA-256 of each file by its path below the root.
    files: BTreeMap<String, String>,
}

/// What [`FrameRecords::finish`] tells of the frames.
pub(crate) struct Finished {
    /// SHA-256 of the file.
    pub(crate) sha256: String,
    /// The builds that wrote the frames, sorted.
    pub(crate) builds: Vec<String>,
}

/// The records of a data set that is being written.
pub(crate) struct FrameRecords {
    root: PathBuf,
    known: Mutex<BTreeMap<String, FrameRecord>>,
    journal: Mutex<File>,
}

impl FrameRecords {
    /// Reads what an earlier run recorded.
    pub(crate) fn open(root: &Path) -> Result<Self, DataError> {
        let path = root.join(FRAMES_FILE);
        let text = if path.may_be_file() { fs_err::read(&path)? } else { Vec::new() };
        let mut journal = OpenOptions::new().create(true).append(true).open(&path)?;
        if text.last().is_some_and(|last| *last != b'\n') {
            journal.write_all(b"\n")?;
        }
        let records = records_of(&text).map(|record| (record.id.clone(), record));
        Ok(FrameRecords { root: root.into(), known: Mutex::new(records.collect()), journal: Mutex::new(journal) })
    }

    /// Whether a folder has the file, without any record. Earlier versions wrote frames without it.
    pub(crate) fn is_empty(root: &Path) -> bool {
        fs_err::read(root.join(FRAMES_FILE)).is_ok_and(|text| records_of(&text).next().is_none())
    }

    /// Whether an earlier run recorded a frame.
    pub(crate) fn has(&self, id: &str) -> bool {
        self.known.lock().expect("no thread panics with the records").contains_key(id)
    }

    /// Whether a frame was made from `source` and consists of these files, unchanged.
    pub(crate) fn is_whole(&self, id: &str, source: Option<&str>, files: &[PathBuf]) -> bool {
        let known = self.known.lock().expect("no thread panics with the records").get(id).cloned();
        known.is_some_and(|known| {
            known.source.as_deref() == source && sha256_of(&self.root, files).is_ok_and(|now| now == known.files)
        })
    }

    /// Records a frame that was written.
    pub(crate) fn add(&self, id: &str, source: Option<&str>, files: &[PathBuf]) -> Result<(), DataError> {
        let files = sha256_of(&self.root, files)?;
        let record =
            FrameRecord { id: id.into(), source: source.map(String::from), build: Some(build_id().into()), files };
        self.journal.lock().expect("no thread panics with the journal").write_all(line_of(&record).as_bytes())?;
        self.known.lock().expect("no thread panics with the records").insert(id.into(), record);
        Ok(())
    }

    /// Writes the records of the frames `ids`, sorted.
    pub(crate) fn finish(&self, ids: &[String]) -> Result<Finished, DataError> {
        let mut known = self.known.lock().expect("no thread panics with the records");
        let wanted: BTreeSet<&String> = ids.iter().collect();
        known.retain(|id, _| wanted.contains(id));
        let text: String = known.values().map(line_of).collect();
        let path = self.root.join(FRAMES_FILE);
        write_atomic(&path, text.as_bytes())?;
        let builds: BTreeSet<&String> = known.values().filter_map(|record| record.build.as_ref()).collect();
        Ok(Finished { sha256: file_sha256(&path)?, builds: builds.into_iter().cloned().collect() })
    }
}

fn line_of(record: &FrameRecord) -> String {
    format!("{}\n", serde_json::to_string(record).expect("a record is plain data"))
}

fn records_of(text: &[u8]) -> impl Iterator<Item = FrameRecord> {
    text.split(|byte| *byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok())
}

fn sha256_of(root: &Path, files: &[PathBuf]) -> Result<BTreeMap<String, String>, DataError> {
    let of = |path: &PathBuf| {
        let below = path.strip_prefix(root).unwrap_or(path);
        Ok((below.to_string_lossy().into_owned(), file_sha256(path)?))
    };
    files.iter().map(of).collect()
}

/// Compares every frame of a generated data set with its record; returns the number of frames.
///
/// # Errors
/// Files that were changed or are missing; a data set that is not complete or has no records.
pub fn verify_frames(root: &Path) -> Result<usize, DataError> {
    let wrong = |message: String| DataError::file(root, message);
    let manifest_path = root.join("manifest.json");
    let manifest: serde_json::Value = serde_json::from_str(&crate::limits::read_text(&manifest_path)?)
        .map_err(|e| DataError::line(&manifest_path, e.line(), e.to_string()))?;
    if manifest["complete"] != true {
        return Err(wrong("is not complete; run the same command again without --verify".into()));
    }
    let path = root.join(FRAMES_FILE);
    if !path.may_be_file() || manifest["frames_sha256"] != file_sha256(&path)? {
        let message = "is missing or is not the file that belongs to manifest.json; run the same command again \
                       without --verify, which makes the frames anew";
        return Err(DataError::file(&path, message));
    }
    let records: Vec<FrameRecord> = records_of(&fs_err::read(&path)?).collect();
    let damaged = |record: &FrameRecord| {
        let differs = |(file, sha): &(&String, &String)| file_sha256(&root.join(file)).ok().as_ref() != Some(*sha);
        record.files.iter().filter(differs).map(|(file, _)| file.clone()).collect::<Vec<_>>()
    };
    let damaged: Vec<String> = records.par_iter().flat_map_iter(damaged).collect();
    if damaged.is_empty() {
        return Ok(records.len());
    }
    let first = damaged.iter().take(5).map(String::as_str).collect::<Vec<_>>().join(", ");
    Err(wrong(format!(
        "{} files are missing or were changed after they were written (first: {first}); run the same command again \
         without --verify, which makes their frames anew",
        damaged.len()
    )))
}
