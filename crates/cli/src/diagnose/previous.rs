//! The files of an earlier diagnosis in the output folder, which may be of other data sets.

use anyhow::Result;
use data::DataError;
use data::Presence as _;
use data::output::remove_unfinished;
use data::write::REPAIRED_ENDINGS;
use std::path::Path;

/// Written first by a diagnosis and removed last here. Without it no file of the folder is taken for one of a
/// diagnosis.
const MARK: &str = "diagnosis.json";

/// Name of the folder with repaired labels, without its ending.
pub(super) const LABELS: &str = "label_2";

/// Removes what an earlier diagnosis wrote into `out`: figures, repaired labels, lists of effects and numbers. Files
/// with other names stay, and so does the study of `--detectors`, which is resumed.
///
/// # Errors
/// A file that cannot be removed.
pub(super) fn remove(out: &Path) -> Result<(), DataError> {
    let folders = REPAIRED_ENDINGS.map(|ending| out.join(format!("{LABELS}{ending}")));
    for folder in &folders {
        remove_unfinished(folder)?;
    }
    if !out.join(MARK).may_be_file() {
        return Ok(());
    }
    for folder in folders.iter().filter(|folder| folder.may_be_folder()) {
        remove_files(folder, |name| name.ends_with(".txt"))?;
        // A folder with other files stays.
        std::fs::remove_dir(folder).ok();
    }
    let is_figure = |name: &str| name.starts_with("finding-") && (name.ends_with(".svg") || name.ends_with(".png"));
    let is_list =
        |name: &str| matches!(name, "extended.toml" | "extended_detectors.toml" | "verification.json" | "report.html");
    remove_files(out, |name| is_figure(name) || is_list(name))?;
    Ok(fs_err::remove_file(out.join(MARK))?)
}

fn remove_files(folder: &Path, is_own: impl Fn(&str) -> bool) -> Result<(), DataError> {
    for entry in fs_err::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_str().is_some_and(&is_own) {
            fs_err::remove_file(entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn known_files_are_removed_and_others_stay() {
        let folder = tempfile::tempdir().unwrap();
        let labels = ["label_2/a.txt", "label_2_low/a.txt"];
        let own = ["finding-1-rain.svg", "extended.toml", "report.html", labels[0], labels[1], "diagnosis.json"];
        let others = ["thesis.txt", "finding-2.txt", "label_2/notes.md", "detectors/study.toml"];
        let write = |name: &&str| data::write_atomic(&folder.path().join(name), b"").unwrap();
        own[..5].iter().chain(&others).for_each(write);
        remove(folder.path()).unwrap();
        assert!(own[..5].iter().all(|name| folder.path().join(name).exists()), "without a diagnosis");
        write(&own[5]);
        remove(folder.path()).unwrap();
        assert!(own.iter().all(|name| !folder.path().join(name).exists()));
        assert!(others.iter().all(|name| folder.path().join(name).exists()));
        assert!(!folder.path().join("label_2_low").exists());
    }
}
