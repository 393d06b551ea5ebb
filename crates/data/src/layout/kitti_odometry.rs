//! A sequence of KITTI's odometry benchmark or of SemanticKITTI: poses of the left camera, and classes of points.

use super::file_names::{check_folder, ids_of_files};
use super::pose_text::{LineOfFrame, parse_poses, pose_from_rows};
use super::stamps::parse_stamps;
use super::{DataLayout, Moment, PointDetails};
use crate::limits::{MOST_CLOUD_BYTES, read_file, read_text};
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns, read_cloud};
use geometry::Pose;
use std::path::{Path, PathBuf};

/// The layout of a sequence of KITTI odometry. Read-only.
pub(super) struct KittiOdometry;

const CLOUDS: &str = "velodyne";
const CALIBRATION: &str = "calib.txt";
const STAMPS: &str = "times.txt";
const CLASSES: &str = "labels";
/// Classes of SemanticKITTI above this one are things that move.
const LAST_STATIC_CLASS: u32 = 251;

impl DataLayout for KittiOdometry {
    fn name(&self) -> &'static str {
        "kitti_odometry"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["velodyne/ with calib.txt (a sequence of KITTI odometry or SemanticKITTI)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let config = DatasetConfig { layout: Layout::KittiOdometry, root: folder.into(), ..DatasetConfig::default() };
        let beside = folder.join(CALIBRATION).is_file() || folder.join(CLASSES).is_dir();
        (folder.join(CLOUDS).is_dir() && beside).then_some(config)
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        check_folder(&root.join(CLOUDS))
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        ids_of_files(&root.join(CLOUDS), ".bin")
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(CLOUDS).join(format!("{id}.bin"))
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(CLASSES).join(format!("{id}.label"))
    }

    /// Points have classes, but nothing has a box.
    fn has_labels(&self, _root: &Path) -> bool {
        false
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        read_cloud(&self.cloud_path(root, id), columns)
    }

    fn read_labels(&self, _root: &Path, _id: &str) -> Result<Vec<LabelBox>, DataError> {
        Ok(Vec::new())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let all = self.frame_ids(root)?;
        let poses_path = poses_path(root);
        let poses = match &poses_path {
            Some(path) => parse_poses(&read_text(path)?, path)?,
            None => Vec::new(),
        };
        let cam_from_lidar = if poses.is_empty() { Pose::identity() } else { cam_from_lidar(root)? };
        let stamps_path = root.join(STAMPS);
        let stamps =
            if stamps_path.is_file() { parse_stamps(&read_text(&stamps_path)?, &stamps_path)? } else { Vec::new() };
        let (pose_line, stamp_line) =
            (LineOfFrame::of(poses.len(), all.len()), LineOfFrame::of(stamps.len(), all.len()));
        let moment = |id: &String| {
            let mut moment = Moment::of(id);
            if let Some(path) = &poses_path {
                let first_cam_from_cam = poses[pose_line.line(id, &all, path, poses.len())?];
                // The world is the LiDAR frame of the first pose: z is up.
                moment.world_from_lidar =
                    first_cam_from_cam.map(|pose| cam_from_lidar.inverse() * pose * cam_from_lidar);
            }
            if !stamps.is_empty() {
                moment.stamp_s = Some(stamps[stamp_line.line(id, &all, &stamps_path, stamps.len())?]);
            }
            Ok(moment)
        };
        ids.iter().map(moment).collect()
    }

    /// The clouds of KITTI are freed of the motion of the sensor. SemanticKITTI says which points move.
    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let path = self.labels_path(root, id);
        let moving = if path.is_file() { Some(read_moving(&path, self.count_points_of(root, id)?)?) } else { None };
        Ok(PointDetails { moving, compensated: Some(true), ..PointDetails::default() })
    }
}

impl KittiOdometry {
    fn count_points_of(&self, root: &Path, id: &str) -> Result<usize, DataError> {
        Ok(fs_err::metadata(self.cloud_path(root, id))?.len() as usize / (4 * size_of::<f32>()))
    }
}

/// `poses.txt` of the sequence (SemanticKITTI), else `poses/NN.txt` beside `sequences/NN`.
fn poses_path(root: &Path) -> Option<PathBuf> {
    let name = root.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
    let places = [root.join("poses.txt"), root.join("../../poses").join(format!("{name}.txt"))];
    places.into_iter().find(|path| path.is_file())
}

/// The row `Tr` of the calibration.
fn cam_from_lidar(root: &Path) -> Result<Pose, DataError> {
    let path = root.join(CALIBRATION);
    let text = read_text(&path)?;
    let line = text.lines().enumerate().find_map(|(i, line)| Some((i + 1, line.strip_prefix("Tr:")?)));
    let (number, line) = line.ok_or_else(|| {
        DataError::file(&path, "has no line Tr: (LiDAR to camera), without which the poses of the camera are no use")
    })?;
    let values: Vec<f64> = line.split_ascii_whitespace().filter_map(|word| word.parse().ok()).collect();
    if values.len() != 12 {
        return Err(DataError::line(&path, number, format!("Tr: has {} numbers, not 12", values.len())));
    }
    pose_from_rows(&values).map_err(|message| DataError::line(&path, number, message))
}

/// Whether each point moves: the class is in the low 16 bits of a word, the instance in the high ones.
fn read_moving(path: &Path, points: usize) -> Result<Vec<bool>, DataError> {
    let bytes = read_file(path, MOST_CLOUD_BYTES)?;
    if bytes.len() != points * 4 {
        let message = format!("has {} bytes; {points} points of the cloud need {}", bytes.len(), points * 4);
        return Err(DataError::file(path, message));
    }
    let class = |word: &[u8]| u32::from(u16::from_le_bytes([word[0], word[1]]));
    Ok(bytes.chunks_exact(4).map(|word| class(word) > LAST_STATIC_CLASS).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Dataset;
    use crate::write::write_bin;

    #[test]
    fn poses_of_the_camera_become_poses_of_the_lidar() {
        let above = tempfile::tempdir().unwrap();
        let root = above.path().join("sequences/07");
        for id in ["000000", "000001"] {
            let cloud = Cloud { values: vec![1.0, 2.0, 3.0, 0.5, 4.0, 5.0, 6.0, 0.5], channels: 4 };
            write_bin(&root.join(format!("velodyne/{id}.bin")), &cloud).unwrap();
        }
        // The camera is 0.3 m before the LiDAR: x right, y down, z forward.
        std::fs::write(root.join(CALIBRATION), "P0: 1\nTr: 0 -1 0 0 0 0 -1 -0.1 1 0 0 -0.3\n").unwrap();
        std::fs::write(root.join(STAMPS), "0.0\n0.104\n").unwrap();
        std::fs::create_dir(above.path().join("poses")).unwrap();
        // The camera drives 2 m along its z and turns left by 90 degrees, about its y from z to -x.
        let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n0 0 -1 0 0 1 0 0 1 0 0 2\n";
        std::fs::write(above.path().join("poses/07.txt"), poses).unwrap();
        let dataset = Dataset::open(&root).unwrap();
        assert_eq!(dataset.config.layout, Layout::KittiOdometry);
        let moments = dataset.moments(&dataset.all_ids().unwrap()).unwrap();
        let pose = moments[1].world_from_lidar.unwrap();
        assert!((geometry::yaw_rad(&pose) - std::f64::consts::FRAC_PI_2).abs() < 1e-9);
        // The LiDAR is 0.3 m behind the camera: after the turn, at y = -0.3.
        assert!((pose.translation.vector - nalgebra::Vector3::new(2.3, -0.3, 0.0)).norm() < 1e-9, "{pose}");
        assert!((moments[1].stamp_s.unwrap() - 0.104).abs() < 1e-9);
        std::fs::write(root.join(CALIBRATION), "P0: 1\n").unwrap();
        let error = dataset.moments(&["000001".into()]).unwrap_err().to_string();
        assert!(error.contains("calib.txt: has no line Tr:"), "{error}");

        std::fs::create_dir(root.join(CLASSES)).unwrap();
        let words = [251u32 | 7 << 16, 252];
        let bytes: Vec<u8> = words.iter().flat_map(|w| w.to_le_bytes()).collect();
        std::fs::write(root.join("labels/000001.label"), &bytes).unwrap();
        assert_eq!(dataset.point_details("000001").unwrap().moving, Some(vec![false, true]));
        assert_eq!(dataset.point_details("000000").unwrap().moving, None);
        std::fs::write(root.join("labels/000001.label"), &bytes[..4]).unwrap();
        let error = dataset.point_details("000001").unwrap_err().to_string();
        assert!(error.contains("000001.label: has 4 bytes; 2 points of the cloud need 8"), "{error}");
    }

    #[test]
    fn a_real_scan_has_classes() {
        let real = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/semantickitti"));
        if !real.exists() {
            return eprintln!("skipped: {} is not there", real.display());
        }
        let folder = tempfile::tempdir().unwrap();
        for (inside, ending) in [("velodyne", "bin"), ("labels", "label")] {
            std::fs::create_dir(folder.path().join(inside)).unwrap();
            let from = real.join(format!("semantickitti_08_000000.{ending}"));
            std::fs::write(folder.path().join(format!("{inside}/000000.{ending}")), std::fs::read(from).unwrap())
                .unwrap();
        }
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(dataset.config.layout, Layout::KittiOdometry);
        let moving = dataset.point_details("000000").unwrap().moving.unwrap();
        assert_eq!(moving.len(), dataset.load("000000").unwrap().cloud.len());
        assert!(moving.iter().filter(|m| **m).count() < moving.len() / 4);
    }
}
