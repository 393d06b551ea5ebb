//! Reads point clouds and checks them: not empty, values finite, points within 10 km.

use crate::limits::{MOST_CLOUD_BYTES, MOST_POINTS, at_most, read_file};
use crate::{Cloud, DataError, parse_pcd};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Columns of a point.
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
    /// Number of values per point.
    pub fn channels(self) -> usize {
        match self {
            PointColumns::Xyz => 3,
            PointColumns::Xyzi => 4,
        }
    }
}

/// Largest absolute coordinate of a valid point, m.
pub const FARTHEST_M: f32 = 10_000.0;

/// Reads a `.bin` (KITTI: little-endian f32) or a `.pcd`. The file name extension decides.
///
/// `columns` gives the columns of a `.bin`. The columns of a `.pcd` are in its header; with [`PointColumns::Xyz`] its
/// intensity is dropped. Errors: an empty cloud, values that are not finite, coordinates beyond [`FARTHEST_M`], and a
/// scan of nuScenes, which has five values a point.
pub fn read_cloud(path: &Path, columns: PointColumns) -> Result<Cloud, DataError> {
    let ending = path.extension().and_then(|e| e.to_str()).map(str::to_ascii_lowercase);
    let most = match ending.as_deref() {
        Some("bin") => (MOST_POINTS * columns.channels() * size_of::<f32>()) as u64,
        Some("pcd") => MOST_CLOUD_BYTES,
        _ => return Err(DataError::file(path, "not a point cloud: its name must end in .bin or .pcd")),
    };
    parse_cloud(&read_file(path, most)?, path, columns)
}

/// Parses the bytes of a `.pcd`, if the name of `path` ends so, or of a `.bin`.
pub(crate) fn parse_cloud(bytes: &[u8], path: &Path, columns: PointColumns) -> Result<Cloud, DataError> {
    if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("pcd")) {
        let cloud = parse_pcd(bytes, path)?;
        return Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud });
    }
    parse_bin(bytes, path, columns)
}

/// Parses a `.bin`. `path` is used in error messages.
pub fn parse_bin(bytes: &[u8], path: &Path, columns: PointColumns) -> Result<Cloud, DataError> {
    let channels = columns.channels();
    if !bytes.len().is_multiple_of(channels * 4) {
        return Err(DataError::file(
            path,
            format!(
                "{} bytes is not a multiple of the point size ({channels} x 4 bytes): the file is truncated, \
                 or `points` in the data set's TOML is wrong",
                bytes.len()
            ),
        ));
    }
    if path.to_string_lossy().ends_with(".pcd.bin") || has_five_columns(bytes) {
        let message = format!(
            "has five values a point (x y z intensity ring, as in nuScenes), not {channels}: use the layout nuscenes_scans"
        );
        return Err(DataError::file(path, message));
    }
    at_most(path, "points", (bytes.len() / channels / 4) as u64, MOST_POINTS)?;
    let values = bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect();
    let cloud = Cloud { values, channels };
    check_cloud(&cloud, path)?;
    Ok(cloud)
}

/// Whether bytes are points of nuScenes: every fifth value is a ring, every fourth of five a whole intensity to 255.
///
/// A file of 34,688 such points is also one of 43,360 points of four values.
fn has_five_columns(bytes: &[u8]) -> bool {
    const POINT_BYTES: usize = 5 * size_of::<f32>();
    // Fewer points may look so by chance.
    const FEWEST_POINTS: usize = 100;
    let value = |point: &[u8], column: usize| f32::from_le_bytes(std::array::from_fn(|byte| point[4 * column + byte]));
    let whole = |v: f32, most: f32| v.fract() == 0.0 && (0.0..=most).contains(&v);
    let mut fewest_ring = f32::INFINITY;
    let mut most_ring = f32::NEG_INFINITY;
    let points = bytes.chunks_exact(POINT_BYTES);
    let count = points.len();
    for point in points {
        let (intensity, ring) = (value(point, 3), value(point, 4));
        if !(whole(ring, 255.0) && whole(intensity, 255.0)) {
            return false;
        }
        (fewest_ring, most_ring) = (fewest_ring.min(ring), most_ring.max(ring));
    }
    bytes.len().is_multiple_of(POINT_BYTES) && count >= FEWEST_POINTS && most_ring > fewest_ring
}

/// An error if the cloud is empty, or for the first invalid point.
pub(crate) fn check_cloud(cloud: &Cloud, path: &Path) -> Result<(), DataError> {
    if cloud.is_empty() {
        return Err(DataError::file(path, "the cloud has no point"));
    }
    // Fast test without branches over all values. An intensity beyond the limit is valid: the loop below decides then.
    let in_range = |v: f32| v.abs() <= FARTHEST_M;
    if cloud.values.chunks(1024).all(|chunk| chunk.iter().fold(true, |all, v| all & in_range(*v))) {
        return Ok(());
    }
    for (i, point) in cloud.points().enumerate() {
        for (name, v) in ["x", "y", "z", "intensity"].into_iter().zip(point) {
            let bad = if name == "intensity" { !v.is_finite() } else { !in_range(*v) };
            if bad {
                let why = if v.is_finite() { "farther than 10 km from the sensor" } else { "not finite" };
                return Err(DataError::file(
                    path,
                    format!("point {i} (from 0): {name} = {v} is {why}; check `points` in the data set's TOML"),
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
            (&fine[..15], "truncated"),
            (&[], "no point"),
            (&bytes(&[1.0, f32::NAN, 0.0, 0.0]), "point 0 (from 0): y = NaN"),
            (&bytes(&[0.0, 0.0, 0.0, 0.0, 1.0, 0.0, f32::INFINITY, 0.0]), "point 1 (from 0): z = inf"),
            (&bytes(&[-10_001.0, 0.0, 0.0, 0.0]), "10 km"),
            (&bytes(&[0.0, 0.0, 0.0, f32::NAN]), "intensity"),
            (&bytes(&[1.0, 2.0, 3.0]), "not a multiple of the point size"),
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
        fn bin_round_trips(values in prop::collection::vec(-9_999.0f32..9_999.0, 1..200)) {
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
        fn arbitrary_bytes_do_not_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = parse_bin(&bytes, Path::new("x.bin"), PointColumns::Xyz);
        }
    }
}
