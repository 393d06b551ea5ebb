//! Detections made elsewhere: read from a folder of KITTI text, a file of detections or a `result.pkl`, checked against
//! the frames and classes of a data set, and converted to its label frame.

use super::results::results_by_frame;
use crate::config::FrozenDetector;
use crate::error::{Result, refused};
use data::Presence as _;
use data::{
    DETECTIONS_FILE, DONT_CARE, DataError, Dataset, KittiText, LabelBox, detections_file, frames_of_detections,
    parse_kitti_text,
};
use eval::matrix::TestSet;
use eval::{EvalFrame, detections_of};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Detections of a frozen detector on the test split of a data set.
pub(super) struct Source<'a> {
    pub frozen: &'a FrozenDetector,
    /// Folder or file.
    pub path: PathBuf,
    pub dataset: &'a Dataset,
    /// Name of the data set in the study.
    pub test_set: &'a str,
    pub labels: &'a TestSet,
}

impl Source<'_> {
    /// The frames of the split, with labels and detections, in the order of the split.
    ///
    /// # Errors
    /// A file that cannot be read; detections of frames that are not there, or frames without detections; a class that
    /// the data set does not have.
    pub(super) fn read(&self, known_classes: &[String]) -> Result<Vec<EvalFrame>> {
        let classes = Classes::new(self, known_classes);
        if let Some(file) = detections_file(&self.path) {
            return self.read_table(&file, &classes);
        }
        if self.path.may_be_folder() {
            return self.read_folder(&classes);
        }
        if !self.path.may_be_file() {
            return Err(refused(format!(
                "{}: does not exist; detections of frozen {} on {} are a folder of KITTI text, a {DETECTIONS_FILE} or a \
                 result.pkl of OpenPCDet",
                self.path.display(),
                self.frozen.name,
                self.test_set
            )));
        }
        self.read_pickle(&classes)
    }

    fn ids(&self) -> impl Iterator<Item = &str> {
        self.labels.frames().iter().map(|frame| frame.id.as_str())
    }

    fn read_folder(&self, classes: &Classes) -> Result<Vec<EvalFrame>> {
        let mut found = BTreeSet::new();
        for entry in fs_err::read_dir(&self.path)? {
            let path = entry?.path();
            if path.extension().is_some_and(|ending| ending == "txt") {
                let stem = path.file_stem().and_then(|stem| stem.to_str()).map(String::from);
                found.insert(stem.ok_or_else(|| DataError::file(&path, "its name is not UTF-8"))?);
            }
        }
        let of_id = |id: &str| self.path.join(format!("{id}.txt"));
        self.check_ids(&found, &|id| of_id(id).display().to_string())?;
        let read = |frame: &EvalFrame| {
            let path = of_id(&frame.id);
            let text = fs_err::read_to_string(&path)?;
            let lines = parse_kitti_text(&text, &path, KittiText::Detections)?;
            let place = |k: usize| {
                let numbered = text.lines().enumerate().filter(|(_, line)| !line.trim_ascii().is_empty());
                numbered.map(|(i, _)| i + 1).nth(k).unwrap_or(0)
            };
            classes.check(&lines).map_err(|(k, message)| DataError::line(&path, place(k), message))?;
            let detections = self.frozen.in_classes_of_labels(lines);
            Ok(EvalFrame { id: frame.id.clone(), labels: frame.labels.clone(), detections })
        };
        // Collects all results first, so that the first bad frame is reported for any number of threads.
        let frames: Vec<Result<EvalFrame, DataError>> = self.labels.frames().par_iter().map(read).collect();
        Ok(frames.into_iter().collect::<Result<_, _>>()?)
    }

    fn read_table(&self, file: &Path, classes: &Classes) -> Result<Vec<EvalFrame>> {
        let of_id = |id: &str| format!("{}: frame {id}", file.display());
        self.check_ids(&frames_of_detections(file)?, &of_id)?;
        let ids: Vec<&str> = self.ids().collect();
        let with = |(frame, detections): (&EvalFrame, Vec<LabelBox>)| {
            classes.check(&detections).map_err(|(k, message)| {
                DataError::file(file, format!("frame {}, detection {k}: {message}", frame.id))
            })?;
            let detections = self.frozen.in_classes_of_labels(detections);
            Ok(EvalFrame { id: frame.id.clone(), labels: frame.labels.clone(), detections })
        };
        self.labels.frames().iter().zip(detections_of(file, &ids)?).map(with).collect()
    }

    fn read_pickle(&self, classes: &Classes) -> Result<Vec<EvalFrame>> {
        let found = results_by_frame(&self.path, self.dataset)?;
        let of_id = |id: &str| format!("{}: frame {id}", self.path.display());
        self.check_ids(&found.keys().cloned().collect(), &of_id)?;
        let read = |frame: &EvalFrame| {
            let none = Vec::new();
            let detections = self.dataset.detection_boxes(&frame.id, found.get(&frame.id).unwrap_or(&none))?;
            classes.check(&detections).map_err(|(k, message)| {
                DataError::file(&self.path, format!("frame {}, detection {k}: {message}", frame.id))
            })?;
            let detections = self.frozen.in_classes_of_labels(detections);
            Ok(EvalFrame { id: frame.id.clone(), labels: frame.labels.clone(), detections })
        };
        let frames: Vec<Result<EvalFrame, DataError>> = self.labels.frames().par_iter().map(read).collect();
        Ok(frames.into_iter().collect::<Result<_, _>>()?)
    }

    /// Refuses detections of frames that the data set does not have, and frames of the split without detections.
    /// Detections of other frames of the data set are not used.
    fn check_ids(&self, found: &BTreeSet<String>, place: &dyn Fn(&str) -> String) -> Result<()> {
        let split: BTreeSet<&str> = self.ids().collect();
        let unused: Vec<&String> = found.iter().filter(|id| !split.contains(id.as_str())).collect();
        if !unused.is_empty() {
            let all: BTreeSet<String> = self.dataset.all_ids()?.into_iter().collect();
            let unknown: Vec<&&String> = unused.iter().filter(|id| !all.contains(**id)).collect();
            if let Some(first) = unknown.first() {
                let own = all.first().map_or("none", String::as_str);
                return Err(refused(format!(
                    "{}: data set {} has no such frame; {} of {} frames with detections are not in it (a frame of the \
                     data set is called {own:?}). Give the detections the ids of the data set, or remove those of \
                     other recordings",
                    place(first),
                    self.test_set,
                    unknown.len(),
                    found.len()
                )));
            }
        }
        let missing: Vec<&str> = split.iter().copied().filter(|id| !found.contains(*id)).collect();
        match missing.first() {
            None => Ok(()),
            Some(first) => Err(refused(format!(
                "{}: does not exist; {} of the {} test frames of data set {} have no detections. A frame without \
                 detections has an empty file, an entry with empty arrays, or a row with nothing but its name",
                place(first),
                missing.len(),
                split.len(),
                self.test_set
            ))),
        }
    }
}

/// Hash of the detections at a path, in hexadecimal: a file, also in a folder ([`detections_file`]), or the text files
/// of a folder with their names.
///
/// # Errors
/// A file that cannot be read.
pub(super) fn source_sha256(path: &Path) -> Result<String> {
    let mut hash = Sha256::new();
    if let Some(file) = detections_file(path) {
        return Ok(data::checksum::file_sha256(&file)?);
    }
    if path.may_be_folder() {
        let mut files: Vec<PathBuf> =
            fs_err::read_dir(path)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<_>>()?;
        files.retain(|file| file.extension().is_some_and(|ending| ending == "txt"));
        files.sort_unstable();
        for file in files {
            let content = fs_err::read(&file)?;
            hash.update(file.file_name().unwrap_or_default().as_encoded_bytes());
            hash.update([0]);
            hash.update((content.len() as u64).to_le_bytes());
            hash.update(content);
        }
    } else {
        hash.update(fs_err::read(path)?);
    }
    Ok(hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
}

/// The classes of a data set, and how those of the detections are renamed.
struct Classes<'a> {
    frozen: &'a FrozenDetector,
    test_set: &'a str,
    known: Vec<String>,
}

impl<'a> Classes<'a> {
    fn new(source: &Source<'a>, known_classes: &[String]) -> Self {
        let mut known = source.dataset.config.classes.clone();
        known.extend(known_classes.iter().cloned());
        for label in source.labels.frames().iter().flat_map(|frame| &frame.labels) {
            if !known.iter().any(|class| class.eq_ignore_ascii_case(&label.class)) {
                known.push(label.class.clone());
            }
        }
        known.retain(|class| class != DONT_CARE);
        let mut seen = BTreeSet::new();
        known.retain(|class| seen.insert(class.to_ascii_lowercase()));
        Classes { frozen: source.frozen, test_set: source.test_set, known }
    }

    /// The index of the first detection of an unknown class, with a message.
    fn check(&self, detections: &[LabelBox]) -> Result<(), (usize, String)> {
        let is_known = |class: &str| self.known.iter().any(|known| known.eq_ignore_ascii_case(class));
        let is_unknown = |detection: &LabelBox| {
            let class = &detection.class;
            let renamed = self.frozen.classes.get(class).unwrap_or(class);
            !detection.is_dont_care() && !self.frozen.ignored_classes.contains(class) && !is_known(renamed)
        };
        let Some(k) = detections.iter().position(is_unknown) else { return Ok(()) };
        let class = &detections[k].class;
        let example = self.known.first().map_or("Car", String::as_str);
        Err((
            k,
            format!(
                "class {class:?} is not one of data set {} ({}); in [[frozen]] {}, rename it with classes = {{ {class:?} \
                 = {example:?} }}, or leave it out with ignored_classes = [{class:?}]",
                self.test_set,
                self.known.join(", "),
                self.frozen.name
            ),
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_hash_knows_names_and_contents() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).unwrap();
        write("a.txt", "1");
        let first = source_sha256(folder.path()).unwrap();
        write("notes.md", "not read");
        assert_eq!(source_sha256(folder.path()).unwrap(), first);
        write("a.txt", "2");
        let second = source_sha256(folder.path()).unwrap();
        std::fs::rename(folder.path().join("a.txt"), folder.path().join("b.txt")).unwrap();
        let third = source_sha256(folder.path()).unwrap();
        assert!(first != second && second != third && first != third);
    }
}
