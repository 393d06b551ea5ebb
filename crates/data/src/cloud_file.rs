//! Point clouds from disk, with the checks that every reader owes the rest of the program.

use crate::{Cloud, DataError, parse_pcd};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// What a point consists of.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum PointColumns {
    /// x, y, z.
    Xyz,
    /// x, y, z, intensity.
    #[default]
    Xyzi,
}

impl PointColumns {
    /// Values a point.
    pub fn channels(self) -> usize {
        match self {
            PointColumns::Xyz => 3,
            PointColumns::Xyzi => 4,
        }
    }
}

/// Farther than this from the sensor, m, no point and no box is believed.
pub const FARTHEST_M: f32 = 10_000.0;

/// Reads a `.bin` (KITTI: little-endian f32) or a `.pcd`, told apart by their ending.
///
/// `columns` says how wide the points of a `.bin` are; a `.pcd` says so itself, and `Xyz` then drops its intensity.
/// A cloud without a point and points that are not finite or farther than [`FARTHEST_M`] are errors.
pub fn read_cloud(path: &Path, columns: PointColumns) -> Result<Cloud, DataError> {
    let ending = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    match ending.as_deref() {
        Some("bin") => parse_bin(&fs_err::read(path)?, path, columns),
        Some("pcd") => {
            let cloud = parse_pcd(&fs_err::read(path)?, path)?;
            Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud })
        }
        _ => Err(DataError::file(path, "not a point cloud: its name must end in .bin or .pcd")),
    }
}

/// A `.bin` in memory; `path` is for messages.
pub fn parse_bin(bytes: &[u8], path: &Path, columns: PointColumns) -> Result<Cloud, DataError> {
    let channels = columns.channels();
    if !bytes.len().is_multiple_of(channels * 4) {
        return Err(DataError::file(
            path,
            format!(
                "{} bytes are no whole number of points of {channels} x 4 bytes: the file is cut off, or `points` of the data set is wrong",
                bytes.len()
            ),
        ));
    }
    let values = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let cloud = Cloud { values, channels };
    check_cloud(&cloud, path)?;
    Ok(cloud)
}

/// An error for an empty cloud and for the first point that cannot be one.
pub(crate) fn check_cloud(cloud: &Cloud, path: &Path) -> Result<(), DataError> {
    if cloud.is_empty() {
        return Err(DataError::file(path, "the cloud has no point"));
    }
    // Branch-free over all values first: an intensity too must be finite, and none is ever beyond the limit by honest means.
    let sound = |v: f32| v.abs() <= FARTHEST_M;
    if cloud.values.chunks(1024).all(|chunk| chunk.iter().fold(true, |all, v| all & sound(*v))) {
        return Ok(());
    }
    for (i, point) in cloud.points().enumerate() {
        for (name, v) in ["x", "y", "z", "intensity"].into_iter().zip(point) {
            let bad = if name == "intensity" { !v.is_finite() } else { !sound(*v) };
            if bad {
                let why =
                    if v.is_finite() { "farther than 10 km from the sensor" } else { "not a number to measure with" };
                return Err(DataError::file(
                    path,
                    format!("point {i} (from 0): {name} = {v} is {why}; is `points` of the data set right?"),
                ));
            }
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn bytes(values: &[f32]) -> Vec<u8> {
        values.iter().flat_map(|v| v.to_le_bytes()).collect()
    }

    #[test]
    fn bad_bins_are_refused_by_name() {
        let path = Path::new("velodyne/000007.bin");
        let fine = bytes(&[1.0, 2.0, 3.0, 0.5]);
        let cases: [(&[u8], &str); 7] = [
            (&fine[..15], "cut off"),
            (&[], "no point"),
            (&bytes(&[1.0, f32::NAN, 0.0, 0.0]), "point 0 (from 0): y = NaN"),
            (&bytes(&[0.0, 0.0, 0.0, 0.0, 1.0, 0.0, f32::INFINITY, 0.0]), "point 1 (from 0): z = inf"),
            (&bytes(&[-10_001.0, 0.0, 0.0, 0.0]), "10 km"),
            (&bytes(&[0.0, 0.0, 0.0, f32::NAN]), "intensity"),
            (&bytes(&[1.0, 2.0, 3.0]), "no whole number of points"),
        ];
        for (bytes, want) in cases {
            let error = parse_bin(bytes, path, PointColumns::Xyzi).unwrap_err().to_string();
            assert!(error.contains("000007.bin") && error.contains(want), "{error}");
        }
        assert_eq!(parse_bin(&fine, path, PointColumns::Xyzi).unwrap().len(), 1);
        assert!(parse_bin(&bytes(&[0.0, 0.0, 0.0, 65_535.0]), path, PointColumns::Xyzi).is_ok());
    }

    proptest! {
        #[test]
        fn bin_goes_round(values in prop::collection::vec(-9_999.0f32..9_999.0, 1..200)) {
            let columns = if values.len().is_multiple_of(2) { PointColumns::Xyz } else { PointColumns::Xyzi };
            let whole = values.len() / columns.channels() * columns.channels();
            prop_assume!(whole > 0);
            let cloud = Cloud { values: values[..whole].to_vec(), channels: columns.channels() };
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("a.bin");
            crate::write::write_bin(&path, &cloud).unwrap();
            prop_assert_eq!(read_cloud(&path, columns).unwrap(), cloud);
        }

        #[test]
        fn no_bytes_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = parse_bin(&bytes, Path::new("x.bin"), PointColumns::Xyz);
        }
    }
}
