//! Files appear whole or not at all: temporary file in the same folder, sync, rename.

use crate::kitti_text::to_kitti_text;
use crate::{Cloud, DataError, DatasetConfig, Frame, LabelBox, PcdEncoding, encode_pcd};
use serde::Serialize;
use std::io::Write as _;
use std::path::Path;

/// Begins the names of files that are not whole yet.
const UNFINISHED: &str = ".writing-";

/// Removes what writers that were killed left in a folder, which need not exist. Nobody may be writing there.
pub fn remove_unfinished(folder: &Path) -> Result<(), DataError> {
    if folder.is_dir() {
        for entry in fs_err::read_dir(folder)? {
            let entry = entry?;
            if entry.file_name().to_string_lossy().starts_with(UNFINISHED) {
                fs_err::remove_file(entry.path())?;
            }
        }
    }
    Ok(())
}

/// Writes `bytes` to `path`, making its folder where needed. A reader sees the old file or the new one, never a part of it.
pub fn write_atomic(path: &Path, bytes: &[u8]) -> Result<(), DataError> {
    let failed = |e: std::io::Error| DataError::file(path, format!("cannot be written: {e}"));
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    fs_err::create_dir_all(folder)?;
    let mut builder = tempfile::Builder::new();
    builder.prefix(UNFINISHED);
    #[cfg(unix)]
    let permissions = <std::fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666);
    #[cfg(unix)]
    builder.permissions(permissions); // the umask still applies; the default of temporary files is 0600
    let mut file = builder.tempfile_in(folder).map_err(failed)?;
    file.write_all(bytes).map_err(failed)?;
    file.as_file().sync_all().map_err(failed)?;
    file.persist(path).map_err(|e| failed(e.error))?;
    Ok(())
}

/// JSON that people can read, with an end of line.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), DataError> {
    let mut text = serde_json::to_vec_pretty(value).map_err(|e| DataError::file(path, format!("is no JSON: {e}")))?;
    text.push(b'\n');
    write_atomic(path, &text)
}

/// KITTI's `.bin`: the cloud's values as little-endian f32, point after point.
pub fn write_bin(path: &Path, cloud: &Cloud) -> Result<(), DataError> {
    let bytes: Vec<u8> = cloud.values.iter().flat_map(|v| v.to_le_bytes()).collect();
    write_atomic(path, &bytes)
}

/// PCD v0.7 with the fields x, y, z and, for four channels, intensity.
pub fn write_pcd(path: &Path, cloud: &Cloud, encoding: PcdEncoding) -> Result<(), DataError> {
    write_atomic(path, &encode_pcd(cloud, encoding))
}

/// Labels of a frame in the label frame "lidar": location = box centre, rotation = yaw counter-clockwise from +x.
pub fn label_boxes(frame: &Frame) -> Vec<LabelBox> {
    let label = |object: &crate::Object| {
        let mut label = LabelBox::from_box(&object.class, &object.bbox, None);
        label.truncation = object.truncation.unwrap_or(label.truncation);
        label.occlusion = object.occlusion.map_or(label.occlusion, f64::from);
        label.image_box = object.image_box.unwrap_or(label.image_box);
        label
    };
    frame.objects.iter().map(label).collect()
}

/// KITTI text, a line a box.
pub fn write_kitti_text(path: &Path, labels: &[LabelBox]) -> Result<(), DataError> {
    write_atomic(path, to_kitti_text(labels).as_bytes())
}

/// A data set's TOML; the file name that [`crate::Dataset::open`] looks for in a folder is `dataset.toml`.
pub fn write_dataset_toml(path: &Path, config: &DatasetConfig) -> Result<(), DataError> {
    let text = toml::to_string_pretty(config).map_err(|e| DataError::file(path, e.to_string()))?;
    write_atomic(path, text.as_bytes())
}

/// A split: frame ids, one a line.
pub fn write_split<S: AsRef<str>>(path: &Path, ids: &[S]) -> Result<(), DataError> {
    let text: String = ids.iter().flat_map(|id| [id.as_ref(), "\n"]).collect();
    write_atomic(path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn writes_whole_files_and_leaves_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a/b/split.txt");
        write_split(&path, &["000001", "000002"]).unwrap();
        write_split(&path, &["000003"]).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "000003\n");
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn json_ends_its_line_and_what_is_no_json_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        write_json(&path, &[1, 2]).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "[\n  1,\n  2\n]\n");
        let no_text = std::collections::BTreeMap::from([([1u8, 2], 3)]);
        let error = write_json(&path, &no_text).unwrap_err().to_string();
        assert!(error.contains("a.json") && error.contains("is no JSON"), "{error}");
    }

    #[test]
    fn a_file_that_cannot_be_written_is_named() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("plain"), b"").unwrap();
        let error = write_atomic(&folder.path().join("plain/x.txt"), b"").unwrap_err();
        assert!(error.to_string().contains("plain"), "{error}");
    }
}
