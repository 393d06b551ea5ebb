//! KITTI's tracking benchmark: several sequences, labels with tracks in the camera frame, the log of the GPS and IMU.

use super::file_names::{check_folder, ids_of_files};
use super::oxts::{Oxts, Track};
use super::pose_text::pose_from_rows;
use super::{DataLayout, Moment, PointDetails, Sequence, TrackedObject};
use crate::kitti_text::{KittiText, parse_kitti_line};
use crate::limits::{MOST_BOXES, at_most, read_text};
use crate::{Calibration, Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns, read_cloud};
use geometry::Pose;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The layout of KITTI's tracking benchmark. The id of a frame is `SSSS_FFFFFF`: sequence and frame. Read-only.
pub(super) struct KittiTracking;

const CLOUDS: &str = "velodyne";
const LABELS: &str = "label_02";
const SECONDS_PER_FRAME: f64 = 0.1;

impl DataLayout for KittiTracking {
    fn name(&self) -> &'static str {
        "kitti_tracking"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["velodyne/ with label_02/ (KITTI tracking)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let root = [folder.to_path_buf(), folder.join("training")]
            .into_iter()
            .find(|root| root.join(CLOUDS).is_dir() && root.join(LABELS).is_dir())?;
        Some(DatasetConfig { layout: Layout::KittiTracking, root, ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        check_folder(&root.join(CLOUDS))
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        Ok(self.sequences(root)?.into_iter().flat_map(|sequence| sequence.ids).collect())
    }

    fn sequences(&self, root: &Path) -> Result<Vec<Sequence>, DataError> {
        let folder = root.join(CLOUDS);
        let mut sequences = Vec::new();
        for entry in fs_err::read_dir(&folder)? {
            let path = entry?.path();
            let Some(name) = path.file_name().and_then(|name| name.to_str()).filter(|_| path.is_dir()) else {
                continue;
            };
            let ids = ids_of_files(&path, ".bin")?.into_iter().map(|frame| format!("{name}_{frame}")).collect();
            sequences.push(Sequence { name: name.into(), ids });
        }
        if sequences.is_empty() {
            return Err(DataError::file(&folder, "has no folder of a sequence"));
        }
        sequences.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(sequences)
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        let (sequence, frame) = id.rsplit_once('_').unwrap_or(("", id));
        root.join(CLOUDS).join(sequence).join(format!("{frame}.bin"))
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        of_sequence(root, LABELS, id)
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(LABELS).is_dir()
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        read_cloud(&self.cloud_path(root, id), columns)
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let objects = read_objects(root, id)?.remove(&frame_number(root, id)?);
        Ok(objects.iter().flatten().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let Some(first) = ids.first() else { return Ok(Vec::new()) };
        let sequence = |id: &str| id.rsplit_once('_').map(|(sequence, _)| sequence.to_string());
        if let Some(other) = ids.iter().find(|id| sequence(id) != sequence(first)) {
            let message = format!(
                "the frames {first} and {other} are of two sequences, which share no world: list those of one in a split"
            );
            return Err(DataError::file(root, message));
        }
        let objects = if self.has_labels(root) { read_objects(root, first)? } else { BTreeMap::new() };
        let poses = read_poses(root, first)?;
        let moment = |id: &String| {
            let number = frame_number(root, id)?;
            Ok(Moment {
                // The benchmark has no stamps: 10 Hz.
                stamp_s: Some(number as f64 * SECONDS_PER_FRAME),
                world_from_lidar: poses.get(number).copied().flatten(),
                objects: objects.get(&number).cloned().unwrap_or_default(),
                ..Moment::of(id)
            })
        };
        ids.iter().map(moment).collect()
    }

    /// The clouds of KITTI are freed of the motion of the sensor and have neither rows nor times.
    fn read_point_details(&self, _root: &Path, _id: &str) -> Result<PointDetails, DataError> {
        Ok(PointDetails { compensated: Some(true), ..PointDetails::default() })
    }
}

/// The file of the sequence of a frame in a folder.
fn of_sequence(root: &Path, folder: &str, id: &str) -> PathBuf {
    let sequence = id.rsplit_once('_').map_or(id, |(sequence, _)| sequence);
    root.join(folder).join(format!("{sequence}.txt"))
}

fn frame_number(root: &Path, id: &str) -> Result<usize, DataError> {
    let number = id.rsplit_once('_').and_then(|(_, frame)| frame.parse().ok());
    number.ok_or_else(|| DataError::file(root, format!("frame {id}: ids of KITTI tracking are SSSS_FFFFFF")))
}

/// The tracked boxes of each frame of a sequence, in the LiDAR frame.
fn read_objects(root: &Path, id: &str) -> Result<BTreeMap<usize, Vec<TrackedObject>>, DataError> {
    let path = of_sequence(root, LABELS, id);
    let (calibration, _) = read_calibration(root, id)?;
    let mut frames: BTreeMap<usize, Vec<TrackedObject>> = BTreeMap::new();
    for (i, line) in read_text(&path)?.lines().enumerate().filter(|(_, line)| !line.trim_ascii().is_empty()) {
        let wrong = |message: String| DataError::line(&path, i + 1, message);
        let mut words = line.trim_ascii_start().splitn(3, ' ');
        let (frame, track, rest) = (words.next(), words.next(), words.next().unwrap_or_default());
        let number = frame.and_then(|frame| frame.parse().ok());
        let (number, track) = number.zip(track).ok_or_else(|| wrong("begins with no frame and track".into()))?;
        let label = parse_kitti_line(rest, KittiText::Labels).map_err(wrong)?;
        if label.is_dont_care() {
            continue;
        }
        let objects = frames.entry(number).or_default();
        at_most(&path, "boxes of a frame", objects.len() as u64 + 1, MOST_BOXES)?;
        let (track, class, bbox) = (track.to_string(), label.class.clone(), calibration.lidar_box(&label));
        objects.push(TrackedObject { track, class, bbox });
    }
    Ok(frames)
}

/// The poses of the LiDAR in each frame of a sequence; none without a log.
fn read_poses(root: &Path, id: &str) -> Result<Vec<Option<Pose>>, DataError> {
    let path = of_sequence(root, "oxts", id);
    if !path.is_file() {
        return Ok(Vec::new());
    }
    let (_, imu_from_lidar) = read_calibration(root, id)?;
    let text = read_text(&path)?;
    let lines: Result<Vec<Option<Oxts>>, DataError> =
        text.trim_end().lines().enumerate().map(|(i, line)| Oxts::parse(line, &path, i + 1)).collect();
    let lines = lines?;
    let Some(first) = lines.iter().flatten().next() else { return Ok(Vec::new()) };
    let track = Track::new(first, imu_from_lidar);
    Ok(lines.iter().map(|line| line.as_ref().map(|oxts| track.pose(oxts))).collect())
}

/// The calibration of a sequence, and the pose of the LiDAR in the frame of the IMU. The keys have other names than in
/// the object benchmark, and some have no colon.
fn read_calibration(root: &Path, id: &str) -> Result<(Calibration, Pose), DataError> {
    let path = of_sequence(root, "calib", id);
    let mut text = String::new();
    let mut imu_from_lidar = Pose::identity();
    for (i, line) in read_text(&path)?.lines().enumerate() {
        let Some((key, values)) = line.trim_ascii().split_once(' ') else { continue };
        let key = match key.trim_end_matches(':') {
            "R_rect" => "R0_rect",
            "Tr_velo_cam" => "Tr_velo_to_cam",
            key => key,
        };
        if key == "Tr_imu_velo" || key == "Tr_imu_to_velo" {
            let values: Vec<f64> = values.split_ascii_whitespace().filter_map(|word| word.parse().ok()).collect();
            let wrong = |message: String| DataError::line(&path, i + 1, format!("{key}: {message}"));
            if values.len() != 12 {
                return Err(wrong(format!("has {} numbers, not 12", values.len())));
            }
            imu_from_lidar = pose_from_rows(&values).map_err(wrong)?.inverse();
        }
        text += &format!("{key}: {values}\n");
    }
    Ok((Calibration::parse(&text, &path)?, imu_from_lidar))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Dataset;
    use crate::write::write_bin;

    #[test]
    fn sequences_have_poses_and_tracks() {
        let folder = tempfile::tempdir().unwrap();
        let root = folder.path().join("training");
        let write = |name: &str, text: &str| {
            std::fs::create_dir_all(root.join(name).parent().unwrap()).unwrap();
            std::fs::write(root.join(name), text).unwrap();
        };
        let calib = crate::calibration::tests::MADE_UP;
        let calib = calib.replace("R0_rect:", "R_rect").replace("Tr_velo_to_cam:", "Tr_velo_cam");
        let imu = "Tr_imu_velo 1 0 0 -0.8 0 1 0 0.3 0 0 1 -0.8\n";
        for sequence in ["0000", "0003"] {
            for frame in ["000000", "000001"] {
                let cloud = Cloud { values: vec![1.0, 2.0, 3.0, 0.5], channels: 4 };
                write_bin(&root.join(format!("velodyne/{sequence}/{frame}.bin")), &cloud).unwrap();
            }
            write(&format!("calib/{sequence}.txt"), &format!("{}\n{imu}", calib.trim_end()));
            let label = "0 0 -1.79 296.7 161.7 455.2 292.3 2 1.8 4.4 -4.5 1.8 13.4 -2.1";
            let text = format!(
                "0 2 Van {label}\n1 2 Van {label}\n1 -1 DontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n"
            );
            write(&format!("label_02/{sequence}.txt"), &text);
            write(&format!("oxts/{sequence}.txt"), "49 8.4 116 0 0 0 1\n49.00001 8.4 116 0 0 0 1\n");
        }
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(
            (dataset.config.layout, &dataset.config.classes[..]),
            (Layout::KittiTracking, &["Van".to_string()][..])
        );
        let sequences = dataset.sequences().unwrap();
        assert_eq!(sequences.iter().map(|s| s.name.as_str()).collect::<Vec<_>>(), ["0000", "0003"]);
        assert_eq!(sequences[1].ids, ["0003_000000", "0003_000001"]);
        let moments = dataset.moments(&sequences[1].ids).unwrap();
        let at = |i: usize| moments[i].world_from_lidar.unwrap().translation.vector;
        assert!((at(0) - nalgebra::Vector3::new(0.8, -0.3, 0.8)).norm() < 1e-9);
        assert!(((at(1) - at(0)).y - 1.113).abs() < 1e-3, "{}", at(1) - at(0));
        let object = &moments[1].objects[0];
        assert_eq!((moments[1].objects.len(), object.track.as_str(), object.bbox.size), (1, "2", [4.4, 1.8, 2.0]));
        assert_eq!(dataset.load("0003_000001").unwrap().objects[0].bbox, object.bbox);
        let error = dataset.moments(&dataset.all_ids().unwrap()).unwrap_err().to_string();
        assert!(error.contains("0000_000000 and 0003_000000 are of two sequences"), "{error}");
        std::fs::write(root.join("label_02/0000.txt"), "0 2 Van 0 0\n").unwrap();
        let error = dataset.moments(&["0000_000000".into()]).unwrap_err().to_string();
        assert!(error.contains("0000.txt:1: ") && error.contains("15 values; this line has 3"), "{error}");
    }
}
