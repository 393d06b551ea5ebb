//! Reads labels from folders of KITTI text files, and detections from such folders or from files of detections.

use crate::EvalFrame;
use data::Presence as _;
use data::limits::{MOST_IDS, at_most, check_name, read_text};
use data::{DataError, KittiText, LabelBox, detections_file, read_detections_file, read_kitti_text};
use rayon::prelude::*;
use std::path::Path;

/// Reads the labels and detections of the given frames, in their order. A missing detection file is an error: a frame
/// without detections has an empty file.
pub fn read_frames(labels: &Path, detections: &Path, ids: &[String]) -> Result<Vec<EvalFrame>, DataError> {
    check_folder(labels)?;
    read_detections(|id| read_kitti_text(&labels.join(format!("{id}.txt")), KittiText::Labels), detections, ids)
}

fn check_folder(folder: &Path) -> Result<(), DataError> {
    if folder.may_be_folder() {
        return Ok(());
    }
    let error = if folder.may_exist() { DataError::file } else { DataError::missing };
    Err(error(folder, "is not a folder".to_owned()))
}

/// As [`read_frames`], with the labels that `labels` returns for a frame: those of a data set, whatever its layout is.
pub fn read_detections(
    labels: impl Fn(&str) -> Result<Vec<LabelBox>, DataError> + Sync,
    detections: &Path,
    ids: &[String],
) -> Result<Vec<EvalFrame>, DataError> {
    let found = detections_of(detections, ids)?;
    let read =
        |(id, detections): (&String, Vec<LabelBox>)| Ok(EvalFrame { id: id.clone(), labels: labels(id)?, detections });
    // Collects all results first, so that the first bad frame is reported for any number of threads.
    ids.par_iter().zip(found).map(read).collect::<Vec<_>>().into_iter().collect()
}

/// Reads the detections on the given frames, in their order: from a folder of KITTI text (`ID.txt`), from a file of
/// detections, or from a folder with such a file ([`data::detections_file`]).
///
/// # Errors
/// A file that cannot be read, and a frame without a file or a row.
pub fn detections_of(path: &Path, ids: &[impl AsRef<str> + Sync]) -> Result<Vec<Vec<LabelBox>>, DataError> {
    let Some(file) = detections_file(path) else {
        check_folder(path)?;
        return ids.par_iter().map(|id| text_of(path, id.as_ref())).collect::<Vec<_>>().into_iter().collect();
    };
    let ids: Vec<&str> = ids.iter().map(AsRef::as_ref).collect();
    let found = read_detections_file(&file, &ids)?.frames;
    let missing = ids.iter().zip(&found).filter(|(_, boxes)| boxes.is_none()).map(|(id, _)| *id);
    if let Some(first) = missing.clone().next() {
        let (without, all) = (missing.count(), ids.len());
        let message = format!(
            "has no row of frame {first}; {without} of {all} frames have none. A frame without detections has one row \
             with nothing but its name"
        );
        return Err(DataError::file(&file, message));
    }
    Ok(found.into_iter().flatten().collect())
}

fn text_of(folder: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
    let path = folder.join(format!("{id}.txt"));
    if !path.may_exist() {
        return Err(DataError::missing(&path, "does not exist; a frame without detections has an empty file"));
    }
    read_kitti_text(&path, KittiText::Detections)
}

/// The frame ids of a label folder, sorted: every `.txt` file in it.
pub fn ids_of_folder(labels: &Path) -> Result<Vec<String>, DataError> {
    let mut ids = Vec::new();
    for entry in fs_err::read_dir(labels)? {
        let path = entry?.path();
        if path.extension().is_none_or(|ending| ending != "txt") {
            continue;
        }
        match path.file_stem().and_then(|stem| stem.to_str()) {
            Some(id) => ids.push(id.to_string()),
            None => return Err(DataError::file(&path, "its name is not UTF-8")),
        }
    }
    ids.sort_unstable();
    if ids.is_empty() {
        return Err(DataError::file(labels, "holds no label file (NAME.txt)"));
    }
    Ok(ids)
}

/// Reads a list of frame ids: file names without extension, one per line. Blank lines are skipped.
pub fn read_ids(path: &Path) -> Result<Vec<String>, DataError> {
    let text = read_text(path)?;
    let mut ids: Vec<String> = Vec::new();
    let mut known = std::collections::HashSet::new();
    for (i, id) in text.lines().map(str::trim).enumerate().filter(|(_, id)| !id.is_empty()) {
        let wrong = |problem: String| DataError::line(path, i + 1, format!("frame id {problem}"));
        check_name(id).map_err(wrong)?;
        if !known.insert(id) {
            return Err(wrong(format!("{id:?} is there twice")));
        }
        at_most(path, "frame ids", known.len() as u64, MOST_IDS)?;
        ids.push(id.into());
    }
    if ids.is_empty() {
        return Err(DataError::file(path, "names no frame"));
    }
    Ok(ids)
}

#[cfg(test)]
mod tests {
    use super::*;

    const LABEL: &str = "Car 0 0 0 0 0 50 50 1.2 1.9 4.9 10 2 0 0.1";

    fn folder() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (name, text) in [("labels/a.txt", LABEL.to_string()), ("found/a.txt", format!("{LABEL} 0.5\n"))] {
            let path = folder.path().join(name);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        }
        folder
    }

    #[test]
    fn bad_files_are_named() {
        let folder = folder();
        let (labels, found) = (folder.path().join("labels"), folder.path().join("found"));
        assert_eq!(ids_of_folder(&labels).unwrap(), ["a"]);
        assert_eq!(read_frames(&labels, &found, &["a".into()]).unwrap()[0].detections[0].score, Some(0.5));

        std::fs::write(labels.join("b.txt"), "").unwrap();
        let ids = ids_of_folder(&labels).unwrap();
        let error = read_frames(&labels, &found, &ids).unwrap_err().to_string();
        assert!(error.contains("found/b.txt: does not exist"), "{error}");

        std::fs::write(found.join("b.txt"), format!("\n{LABEL}\n")).unwrap();
        let error = read_frames(&labels, &found, &ids).unwrap_err().to_string();
        assert!(error.contains("found/b.txt:2: a detection has 16 values"), "{error}");

        std::fs::write(found.join("b.txt"), "").unwrap();
        std::fs::remove_file(labels.join("b.txt")).unwrap();
        let error = read_frames(&labels, &found, &ids).unwrap_err().to_string();
        assert!(error.contains("labels/b.txt"), "{error}");
        assert!(read_frames(&labels.join("none"), &found, &ids).unwrap_err().to_string().contains("is not a folder"));
    }

    #[test]
    fn a_file_of_detections_stands_for_a_folder_of_text() {
        let folder = folder();
        let (labels, found) = (folder.path().join("labels"), folder.path().join("found"));
        let ids = ["a".to_string()];
        let text = read_frames(&labels, &found, &ids).unwrap();
        let table = folder.path().join("other/detections.parquet");
        data::write_detections::<DataError>(&table, |to| to.frame("a", &text[0].detections)).unwrap();
        for path in [&table, table.parent().unwrap()] {
            assert_eq!(read_frames(&labels, path, &ids).unwrap(), text);
        }
        let ids = [&ids[..], &["b".into(), "c".into()]].concat();
        let error = detections_of(&table, &ids).unwrap_err().to_string();
        let wanted = "other/detections.parquet: has no row of frame b; 2 of 3 frames have none. A frame without";
        assert!(error.contains(wanted), "{error}");
    }

    #[test]
    fn bad_lists_are_named() {
        let folder = folder();
        let list = folder.path().join("val.txt");
        for (text, message) in [
            ("a\n../b\n", "val.txt:2: frame id \"../b\" is not a name for a file"),
            ("a\n\nb\na\n", "val.txt:4: frame id \"a\" is there twice"),
            (" \n", "val.txt: names no frame"),
        ] {
            std::fs::write(&list, text).unwrap();
            let error = read_ids(&list).unwrap_err().to_string();
            assert!(error.contains(message), "{error}");
        }
        std::fs::write(&list, " b \r\n\na").unwrap();
        assert_eq!(read_ids(&list).unwrap(), ["b", "a"]);
    }
}
