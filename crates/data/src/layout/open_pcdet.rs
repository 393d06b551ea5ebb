//! OpenPCDet's custom data sets: `points/*.npy` and `labels/*.txt`.
//!
//! Points are N x 4 or wider: x, y, z, intensity. A label is `x y z dx dy dz heading name`: the centre, the sizes
//! along, across and up (m) and the heading (rad), in the frame x forward, y left, z up. Source:
//! `CUSTOM_DATASET_TUTORIAL.md` and `custom_dataset.py` of OpenPCDet.

use super::DataLayout;
use crate::cloud_file::check_cloud;
use crate::limits::{MOST_BOXES, MOST_CLOUD_BYTES, MOST_POINTS, at_most, read_file, read_text};
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns, write_atomic};
use geometry::Box3;
use npyz::{DType, NpyFile, Order};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};

/// OpenPCDet's custom data sets.
pub(super) struct OpenPcdet;

const POINTS: &str = "points";
const LABELS: &str = "labels";

/// Widest array of points.
const MOST_COLUMNS: u64 = 64;

impl DataLayout for OpenPcdet {
    fn name(&self) -> &'static str {
        "open_pcdet"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["points/*.npy (OpenPCDet)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        self.frame_ids(folder).ok()?;
        Some(DatasetConfig { layout: Layout::OpenPcdet, root: folder.into(), ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        self.frame_ids(root).map(drop)
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        let folder = root.join(POINTS);
        if !folder.is_dir() {
            return Err(DataError::missing(&folder, "does not exist: check `root` and `layout` of the data set"));
        }
        let mut ids = BTreeSet::new();
        for entry in fs_err::read_dir(&folder)? {
            let path = entry?.path();
            if path.extension().is_some_and(|e| e == "npy") {
                let id = path.file_stem().and_then(|id| id.to_str());
                ids.insert(id.ok_or_else(|| DataError::file(&path, "its name is not UTF-8"))?.to_string());
            }
        }
        if ids.is_empty() {
            return Err(DataError::file(&folder, "has no .npy file"));
        }
        Ok(ids.into_iter().collect())
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(POINTS).join(format!("{id}.npy"))
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(LABELS).join(format!("{id}.txt"))
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(LABELS).is_dir()
    }

    /// From the shape of the first array.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        let path = self.cloud_path(root, &self.frame_ids(root)?[0]);
        let bytes = read_file(&path, MOST_CLOUD_BYTES)?;
        Ok(shape(&array(&bytes, &path)?, &path)?[1] > 3)
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let path = self.cloud_path(root, id);
        let cloud = parse_npy_cloud(&read_file(&path, MOST_CLOUD_BYTES)?, &path)?;
        Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud })
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let path = self.labels_path(root, id);
        parse_labels(&read_text(&path)?, &path)
    }

    fn folders(&self) -> &'static [&'static str] {
        &[POINTS, LABELS]
    }

    fn write_cloud(&self, root: &Path, id: &str, cloud: &Cloud) -> Result<(), DataError> {
        write_atomic(&self.cloud_path(root, id), &encode_npy(cloud))
    }

    /// Truncation, occlusion and image boxes have no place in this format.
    fn write_labels(&self, root: &Path, id: &str, labels: &[LabelBox]) -> Result<(), DataError> {
        let mut text = String::new();
        for label in labels.iter().filter(|label| !label.is_dont_care()) {
            let Box3 { center: [x, y, z], size: [dx, dy, dz], yaw_rad } = label.lidar_box();
            let _ = writeln!(text, "{x} {y} {z} {dx} {dy} {dz} {yaw_rad} {}", label.class);
        }
        write_atomic(&self.labels_path(root, id), text.as_bytes())
    }
}

fn array<'a>(bytes: &'a [u8], path: &Path) -> Result<NpyFile<&'a [u8]>, DataError> {
    NpyFile::new(bytes).map_err(|e| DataError::file(path, format!("is no .npy array: {e}")))
}

/// Rows and columns.
fn shape(npy: &NpyFile<&[u8]>, path: &Path) -> Result<[u64; 2], DataError> {
    let &[rows, columns] = npy.shape() else {
        let shape = npy.shape();
        return Err(DataError::file(path, format!("has the shape {shape:?}; an array of points is N x 4 or wider")));
    };
    if !(3..=MOST_COLUMNS).contains(&columns) {
        return Err(DataError::file(path, format!("has {columns} columns; points have at least x, y, z")));
    }
    at_most(path, "points", rows, MOST_POINTS)?;
    Ok([rows, columns])
}

/// Parses an array of points, N x 3 or wider, of 4 or 8 byte floats. Columns behind the intensity are left out. `path`
/// is used in error messages.
///
/// # Errors
/// An array of another kind, a file that is shorter or longer than its shape, and the checks of [`crate::read_cloud`].
pub fn parse_npy_cloud(bytes: &[u8], path: &Path) -> Result<Cloud, DataError> {
    let npy = array(bytes, path)?;
    let [rows, columns] = shape(&npy, path)?;
    let order = npy.order();
    let kind = match npy.dtype() {
        DType::Plain(kind) => kind.to_string(),
        other => other.descr(),
    };
    let values: Vec<f32> = match kind.trim_start_matches(['<', '>', '=', '|']) {
        "f4" => npy.into_vec::<f32>(),
        "f8" => npy.into_vec::<f64>().map(|all| all.into_iter().map(|v| v as f32).collect()),
        _ => {
            let message = format!("has values of the type {kind}; points are float32 or float64 (numpy: astype)");
            return Err(DataError::file(path, message));
        }
    }
    .map_err(|e| DataError::file(path, format!("its {rows} x {columns} values cannot be read: {e}")))?;
    let (rows, columns) = (rows as usize, columns as usize);
    let channels = columns.min(4);
    let at = |row: usize, column: usize| match order {
        Order::C => row * columns + column,
        Order::Fortran => column * rows + row,
    };
    let cloud = Cloud {
        values: (0..rows).flat_map(|row| (0..channels).map(move |c| (row, c))).map(|(r, c)| values[at(r, c)]).collect(),
        channels,
    };
    check_cloud(&cloud, path)?;
    Ok(cloud)
}

/// Encodes a cloud as `.npy` of version 1.0: little-endian float32, N x channels, in C order.
fn encode_npy(cloud: &Cloud) -> Vec<u8> {
    let head = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}, {}), }}", cloud.len(), cloud.channels);
    // Magic, version and length are 10 bytes; the header is padded so that the data begin at a multiple of 64.
    let padded = (10 + head.len() + 1).next_multiple_of(64) - 10;
    let mut out = b"\x93NUMPY\x01\x00".to_vec();
    out.extend((padded as u16).to_le_bytes());
    out.extend(format!("{head:<0$}\n", padded - 1).into_bytes());
    out.extend(cloud.values.iter().flat_map(|v| v.to_le_bytes()));
    out
}

fn parse_labels(text: &str, path: &Path) -> Result<Vec<LabelBox>, DataError> {
    let mut labels = Vec::new();
    for (at, line) in text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty()) {
        let wrong = |message: String| DataError::line(path, at + 1, message);
        let words: Vec<&str> = line.split_whitespace().collect();
        let [numbers @ .., name] = &words[..] else { continue };
        if numbers.len() != 7 {
            return Err(wrong(format!("has {} values; a label is: x y z dx dy dz heading name", words.len())));
        }
        let mut values = [0.0f64; 7];
        for (value, word) in values.iter_mut().zip(numbers) {
            let number = word.parse::<f64>().ok().filter(|v| v.is_finite());
            *value = number.ok_or_else(|| wrong(format!("{word:?} is not a number")))?;
        }
        let [x, y, z, dx, dy, dz, heading] = values;
        if [dx, dy, dz].iter().any(|v| !(*v > 0.0)) {
            return Err(wrong(format!("its size {dx} {dy} {dz} is not positive")));
        }
        if heading.abs() > 7.0 {
            return Err(wrong(format!("its heading {heading} is more than a turn: headings are in radians")));
        }
        labels.push(LabelBox::from_box(name, &Box3 { center: [x, y, z], size: [dx, dy, dz], yaw_rad: heading }, None));
        at_most(path, "boxes", labels.len() as u64, MOST_BOXES)?;
    }
    Ok(labels)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn npy(head: &str, data: &[u8]) -> Vec<u8> {
        let mut out = b"\x93NUMPY\x01\x00".to_vec();
        out.extend((head.len() as u16 + 1).to_le_bytes());
        out.extend(head.as_bytes());
        out.push(b'\n');
        out.extend(data);
        out
    }

    fn parsed(bytes: &[u8]) -> Result<Cloud, String> {
        parse_npy_cloud(bytes, Path::new("points/7.npy")).map_err(|e| e.to_string())
    }

    #[test]
    fn arrays_of_both_orders_types_and_byte_orders() {
        let floats = |v: &[f32]| v.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>();
        let head = "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 5), }";
        let cloud = parsed(&npy(head, &floats(&[1.0, 2.0, 3.0, 0.5, 9.0, 4.0, 5.0, 6.0, 0.25, 8.0]))).unwrap();
        let want = Cloud { values: vec![1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.25], channels: 4 };
        assert_eq!(cloud, want);
        let head = "{'descr': '<f4', 'fortran_order': True, 'shape': (2, 4), }";
        assert_eq!(parsed(&npy(head, &floats(&[1.0, 4.0, 2.0, 5.0, 3.0, 6.0, 0.5, 0.25]))).unwrap(), want);
        let head = "{'descr': '>f8', 'fortran_order': False, 'shape': (2, 4), }";
        let big: Vec<u8> = want.values.iter().flat_map(|v| f64::from(*v).to_be_bytes()).collect();
        assert_eq!(parsed(&npy(head, &big)).unwrap(), want);
        assert_eq!(parsed(&encode_npy(&want)).unwrap(), want);
        assert!(encode_npy(&want).len() % 64 == want.values.len() * 4 % 64);
    }

    #[test]
    fn wrong_arrays_are_errors() {
        let head =
            |shape: &str, kind: &str| format!("{{'descr': '{kind}', 'fortran_order': False, 'shape': {shape}, }}");
        let data = [0u8; 32];
        for (shape, kind, want) in [
            ("(8,)", "<f4", "has the shape [8]"),
            ("(4, 2)", "<f4", "has 2 columns"),
            ("(2, 4)", "<i4", "values of the type"),
            ("(3, 4)", "<f4", "3 x 4 values cannot be read"),
            ("(99999999, 4)", "<f4", "at most"),
        ] {
            let error = parsed(&npy(&head(shape, kind), &data)).unwrap_err();
            assert!(error.contains("7.npy") && error.contains(want), "{error}, not {want}");
        }
        assert!(parsed(b"not an array").unwrap_err().contains("is no .npy array"));
    }

    #[test]
    fn labels_have_sizes_along_across_and_up() {
        let text = "1.5 -2 0.5 4.2 1.8 1.6 0.3 Car\n\n3 4 0 0.8 0.6 1.7 -1.2 Pedestrian\n";
        let labels = parse_labels(text, Path::new("l.txt")).unwrap();
        assert_eq!(labels.iter().map(|l| l.class.as_str()).collect::<Vec<_>>(), ["Car", "Pedestrian"]);
        let bbox = labels[0].lidar_box();
        assert_eq!((bbox.center, bbox.size, bbox.yaw_rad), ([1.5, -2.0, 0.5], [4.2, 1.8, 1.6], 0.3));
        for (line, want) in [
            ("1 2 3 4 5 6 Car", "has 7 values"),
            ("1 2 3 4 5 x 0 Car", "\"x\" is not a number"),
            ("1 2 3 4 0 6 0 Car", "is not positive"),
            ("1 2 3 4 5 6 90 Car", "headings are in radians"),
        ] {
            let error = parse_labels(&format!("{text}{line}\n"), Path::new("l.txt")).unwrap_err().to_string();
            assert!(error.contains("l.txt:4") && error.contains(want), "{error}");
        }
    }

    proptest! {
        #[test]
        fn damaged_arrays_do_not_panic(at in any::<prop::sample::Index>(), byte in any::<u8>()) {
            let cloud = Cloud { values: (0..40).map(|i| i as f32).collect(), channels: 4 };
            let mut bytes = encode_npy(&cloud);
            let at = at.index(bytes.len());
            let _ = parsed(&bytes[..at]);
            bytes[at] = byte;
            let _ = parsed(&bytes);
        }
    }
}
