//! Scans of nuScenes without tables: a folder of `*.pcd.bin`.
//!
//! A point has five values: x right, y forward, z up (m), intensity 0 to 255, ring.

use super::file_names::ids_of_files;
use super::stamps::StampUnit;
use super::{DataLayout, Moment, PointDetails};
use crate::cloud_file::check_cloud;
use crate::limits::{MOST_POINTS, read_file};
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use std::path::{Path, PathBuf};

/// The layout of a folder of scans of nuScenes. Read-only.
pub(super) struct NuscenesScans;

/// The ending of the names of clouds.
pub(super) const ENDING: &str = ".pcd.bin";

const POINT_BYTES: usize = 5 * size_of::<f32>();

impl DataLayout for NuscenesScans {
    fn name(&self) -> &'static str {
        "nuscenes_scans"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["*.pcd.bin (scans of nuScenes)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let config = DatasetConfig { layout: Layout::NuscenesScans, root: folder.into(), ..DatasetConfig::default() };
        (folder.is_dir() && ids_of_files(folder, ENDING).is_ok()).then_some(config)
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        ids_of_files(root, ENDING).map(|_| ())
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        ids_of_files(root, ENDING)
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(format!("{id}{ENDING}"))
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(format!("{id}.txt"))
    }

    fn has_labels(&self, _root: &Path) -> bool {
        false
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        Ok(read_scan(&self.cloud_path(root, id))?.0.with_channels(columns.channels()))
    }

    fn read_labels(&self, _root: &Path, _id: &str) -> Result<Vec<LabelBox>, DataError> {
        Ok(Vec::new())
    }

    /// The name of a scan ends with its time stamp in us.
    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let stamp_us = |id: &str| id.rsplit("__").next().and_then(|stamp| stamp.parse::<i64>().ok());
        let start_us = self.frame_ids(root)?.iter().filter_map(|id| stamp_us(id)).min().unwrap_or(0);
        let stamp_s = |us: i64| us.wrapping_sub(start_us) as f64 * StampUnit::Microseconds.seconds();
        Ok(ids.iter().map(|id| Moment { stamp_s: stamp_us(id).map(stamp_s), ..Moment::of(id) }).collect())
    }

    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let ring = read_scan(&self.cloud_path(root, id))?.1;
        Ok(PointDetails { ring: Some(ring), ..PointDetails::default() })
    }
}

/// Reads a scan: x forward, y left, z up, intensity from 0 to 1; and the rings of its points.
pub(super) fn read_scan(path: &Path) -> Result<(Cloud, Vec<u16>), DataError> {
    let bytes = read_file(path, (MOST_POINTS * POINT_BYTES) as u64)?;
    if !bytes.len().is_multiple_of(POINT_BYTES) {
        let message = format!("{} bytes is not a multiple of the point size (5 x 4 bytes) of nuScenes", bytes.len());
        return Err(DataError::file(path, message));
    }
    let mut cloud = Cloud { values: Vec::with_capacity(bytes.len() / POINT_BYTES * 4), channels: 4 };
    let mut rings = Vec::with_capacity(bytes.len() / POINT_BYTES);
    for (i, point) in bytes.chunks_exact(POINT_BYTES).enumerate() {
        let value = |column: usize| f32::from_le_bytes(std::array::from_fn(|byte| point[4 * column + byte]));
        let [right, forward, up, intensity, ring] = [0, 1, 2, 3, 4].map(value);
        if !((0.0..=255.0).contains(&ring) && ring.fract() == 0.0) {
            let message = format!(
                "point {i} (from 0): the fifth value {ring} is no ring: the points of nuScenes are x y z intensity ring"
            );
            return Err(DataError::file(path, message));
        }
        cloud.values.extend([forward, -right, up, intensity / 255.0]);
        rings.push(ring as u16);
    }
    check_cloud(&cloud, path)?;
    Ok((cloud, rings))
}

/// Bytes of points of five values.
#[cfg(test)]
pub(super) fn bytes(points: &[[f32; 5]]) -> Vec<u8> {
    points.iter().flatten().flat_map(|v| v.to_le_bytes()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Dataset, read_cloud};

    #[test]
    fn scans_are_turned_to_x_forward() {
        let folder = tempfile::tempdir().unwrap();
        for (stamp, points) in
            [(1_532_402_927_647_951i64, vec![[1.0, 2.0, 3.0, 51.0, 31.0]]), (1_532_402_927_697_951, vec![[0.5; 5]])]
        {
            std::fs::write(folder.path().join(format!("n015__LIDAR_TOP__{stamp}.pcd.bin")), bytes(&points)).unwrap();
        }
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(dataset.config.layout, Layout::NuscenesScans);
        let ids = dataset.all_ids().unwrap();
        assert_eq!(dataset.load(&ids[0]).unwrap().cloud.values, [2.0, -1.0, 3.0, 0.2]);
        assert_eq!(dataset.point_details(&ids[0]).unwrap().ring, Some(vec![31]));
        assert!((dataset.moments(&ids).unwrap()[1].stamp_s.unwrap() - 0.05).abs() < 1e-9);
        let error = dataset.load(&ids[1]).unwrap_err().to_string();
        assert!(error.contains("point 0 (from 0): the fifth value 0.5 is no ring"), "{error}");
        std::fs::write(dataset.cloud_path(&ids[1]), [0; 16]).unwrap();
        let error = dataset.load(&ids[1]).unwrap_err().to_string();
        assert!(error.contains("16 bytes is not a multiple of the point size (5 x 4 bytes)"), "{error}");
    }

    #[test]
    fn a_real_keyframe_is_read_and_refused_as_four_columns() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/nuscenes_keyframe"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        let dataset = Dataset::open(root).unwrap();
        let id = &dataset.all_ids().unwrap()[0];
        let cloud = dataset.load(id).unwrap().cloud;
        let rings = dataset.point_details(id).unwrap().ring.unwrap();
        assert_eq!((cloud.len(), rings.len(), rings.iter().max()), (34_688, 34_688, Some(&31)));
        // The returns of the vehicle itself lie along its length: before and behind the sensor.
        let near = |axis: usize| cloud.points().filter(|p| p[axis].abs() < 0.6 && p[0].hypot(p[1]) < 2.5).count();
        assert!(near(1) > near(0), "{} beside x, {} beside y", near(1), near(0));
        assert!(cloud.points().all(|p| (0.0..=1.0).contains(&p[3])));
        let folder = tempfile::tempdir().unwrap();
        let scan = std::fs::read(dataset.cloud_path(id)).unwrap();
        for name in ["000000.bin", "scan.pcd.bin"] {
            let path = folder.path().join(name);
            std::fs::write(&path, &scan).unwrap();
            let error = read_cloud(&path, PointColumns::Xyzi).unwrap_err().to_string();
            assert!(error.contains(name) && error.contains("five values a point"), "{error}");
            assert!(error.contains("nuscenes_scans"), "{error}");
        }
    }
}
