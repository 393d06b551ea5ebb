//! Writes the files of data sets, each as a whole (see [`crate::output`]).

use crate::kitti_text::to_kitti_text;
use crate::output::write_atomic;
use crate::{Cloud, DataError, DatasetConfig, Frame, LabelBox, PcdEncoding, encode_pcd};
use serde::Serialize;
use std::path::{Path, PathBuf};

/// Writes a value as indented JSON with a final line feed.
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), DataError> {
    let mut text = serde_json::to_vec_pretty(value)
        .map_err(|e| DataError::file(path, format!("cannot be written as JSON: {e}")))?;
    text.push(b'\n');
    write_atomic(path, &text)
}

/// Writes a cloud as KITTI's `.bin`: little-endian f32, one point after the other.
pub fn write_bin(path: &Path, cloud: &Cloud) -> Result<(), DataError> {
    let bytes: Vec<u8> = cloud.values.iter().flat_map(|v| v.to_le_bytes()).collect();
    write_atomic(path, &bytes)
}

/// Writes a cloud as PCD v0.7, see [`encode_pcd`].
pub fn write_pcd(path: &Path, cloud: &Cloud, encoding: PcdEncoding) -> Result<(), DataError> {
    write_atomic(path, &encode_pcd(cloud, encoding))
}

/// The labels of a frame's objects in [`crate::LabelFrame::Lidar`].
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

/// Folder of the true boxes in a made data set with automatic labels.
pub const TRUE_LABELS: &str = "true_labels";

/// Endings of the names of the folders with repaired labels: the estimate, and the correction at both ends, the square
/// root of three standard errors below and above. The estimate with a weight of 2/3 and each end with 1/6 have the mean
/// and the variance of the correction.
pub const REPAIRED_ENDINGS: [&str; 3] = ["", "_low", "_high"];

/// Path of a frame's true boxes in a made data set.
pub fn true_labels_path(root: &Path, id: &str) -> PathBuf {
    root.join(TRUE_LABELS).join(format!("{id}.txt"))
}

/// Writes labels as KITTI text.
pub fn write_kitti_text(path: &Path, labels: &[LabelBox]) -> Result<(), DataError> {
    write_atomic(path, to_kitti_text(labels).as_bytes())
}

/// Writes a data set's TOML. [`crate::Dataset::open`] reads `dataset.toml` of a folder.
pub fn write_dataset_toml(path: &Path, config: &DatasetConfig) -> Result<(), DataError> {
    let text = toml::to_string_pretty(config).map_err(|e| DataError::file(path, e.to_string()))?;
    write_atomic(path, text.as_bytes())
}

/// Writes a split: frame ids, one a line.
pub fn write_split<S: AsRef<str>>(path: &Path, ids: &[S]) -> Result<(), DataError> {
    let text: String = ids.iter().flat_map(|id| [id.as_ref(), "\n"]).collect();
    write_atomic(path, text.as_bytes())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_replaced_and_temporary_files_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a/b/split.txt");
        write_split(&path, &["000001", "000002"]).unwrap();
        write_split(&path, &["000003"]).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "000003\n");
        assert_eq!(std::fs::read_dir(path.parent().unwrap()).unwrap().count(), 1);
    }

    #[test]
    fn json_ends_with_a_line_feed_and_errors_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.json");
        write_json(&path, &[1, 2]).unwrap();
        assert_eq!(std::fs::read_to_string(&path).unwrap(), "[\n  1,\n  2\n]\n");
        let unsupported_keys = std::collections::BTreeMap::from([([1u8, 2], 3)]);
        let error = write_json(&path, &unsupported_keys).unwrap_err().to_string();
        assert!(error.contains("a.json") && error.contains("cannot be written as JSON"), "{error}");
    }
}
