//! A drive of KITTI raw (synced): clouds, the log of the GPS and IMU, and tracklets.

use super::file_names::{check_folder, ids_of_files};
use super::oxts::{Oxts, Track};
use super::pose_text::{LineOfFrame, pose_from_rows};
use super::stamps::parse_stamps;
use super::tracklets::read_tracklets;
use super::{DataLayout, Moment, PointDetails, TrackedObject};
use crate::limits::read_text;
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns, read_cloud};
use geometry::Pose;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The layout of a drive of KITTI raw. Read-only.
pub(super) struct KittiRaw;

const CLOUDS: &str = "velodyne_points/data";
const STAMPS: &str = "velodyne_points/timestamps.txt";
const OXTS: &str = "oxts/data";
const TRACKLETS: &str = "tracklet_labels.xml";
const CALIBRATION: &str = "calib_imu_to_velo.txt";

impl DataLayout for KittiRaw {
    fn name(&self) -> &'static str {
        "kitti_raw"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["velodyne_points/data/ (a drive of KITTI raw)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let config = DatasetConfig { layout: Layout::KittiRaw, root: folder.into(), ..DatasetConfig::default() };
        folder.join(CLOUDS).is_dir().then_some(config)
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

    fn labels_path(&self, root: &Path, _id: &str) -> PathBuf {
        root.join(TRACKLETS)
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(TRACKLETS).is_file()
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        read_cloud(&self.cloud_path(root, id), columns)
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let frames = read_tracklets(&root.join(TRACKLETS))?;
        let objects = frames.get(&number(root, id)?);
        Ok(objects.into_iter().flatten().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let all = self.frame_ids(root)?;
        let stamps_path = root.join(STAMPS);
        let stamps =
            if stamps_path.is_file() { parse_stamps(&read_text(&stamps_path)?, &stamps_path)? } else { Vec::new() };
        let line = LineOfFrame::of(stamps.len(), all.len());
        let track = track(root)?;
        let tracklets = if self.has_labels(root) { read_tracklets(&root.join(TRACKLETS))? } else { BTreeMap::new() };
        let moment = |id: &String| {
            let mut moment = Moment::of(id);
            if !stamps.is_empty() {
                moment.stamp_s = Some(stamps[line.line(id, &all, &stamps_path, stamps.len())?]);
            }
            if let Some(track) = &track {
                moment.world_from_lidar = oxts(root, id)?.map(|oxts| track.pose(&oxts));
            }
            moment.objects = tracklets.get(&number(root, id)?).cloned().unwrap_or_default();
            Ok(moment)
        };
        ids.iter().map(moment).collect()
    }

    /// The synced clouds of KITTI are freed of the motion of the sensor and have neither rows nor times.
    fn read_point_details(&self, _root: &Path, _id: &str) -> Result<PointDetails, DataError> {
        Ok(PointDetails { compensated: Some(true), ..PointDetails::default() })
    }
}

fn number(root: &Path, id: &str) -> Result<usize, DataError> {
    id.parse().map_err(|_| {
        DataError::file(&root.join(CLOUDS), format!("frame {id}: the names of KITTI raw are numbers of frames"))
    })
}

/// The log of a frame; `None` in a gap of the GPS, where the file does not exist or has `nan`.
fn oxts(root: &Path, id: &str) -> Result<Option<Oxts>, DataError> {
    let path = root.join(OXTS).join(format!("{id}.txt"));
    if path.is_file() { Oxts::parse(&read_text(&path)?, &path, 1) } else { Ok(None) }
}

/// The frame of the drive, from its first file; `None` without a log.
fn track(root: &Path) -> Result<Option<Track>, DataError> {
    if !root.join(OXTS).is_dir() {
        return Ok(None);
    }
    let imu_from_lidar = imu_from_lidar(root)?;
    for id in ids_of_files(&root.join(OXTS), ".txt")? {
        if let Some(first) = oxts(root, &id)? {
            return Ok(Some(Track::new(&first, imu_from_lidar)));
        }
    }
    Ok(None)
}

/// The pose of the LiDAR in the frame of the IMU, from `calib_imu_to_velo.txt` of the drive or of its day. Without it
/// the poses of the IMU stand for those of the LiDAR.
fn imu_from_lidar(root: &Path) -> Result<Pose, DataError> {
    let places = [root.join(CALIBRATION), root.join("..").join(CALIBRATION)];
    let Some(path) = places.iter().find(|path| path.is_file()) else { return Ok(Pose::identity()) };
    let text = read_text(path)?;
    let values = |key: &str, count: usize| {
        let line = text.lines().enumerate().find_map(|(i, line)| Some((i + 1, line.strip_prefix(key)?)));
        let (number, line) = line.ok_or_else(|| DataError::file(path, format!("has no line {key}")))?;
        let values: Vec<f64> = line.split_ascii_whitespace().filter_map(|word| word.parse().ok()).collect();
        if values.len() != count {
            return Err(DataError::line(path, number, format!("{key} has {} numbers, not {count}", values.len())));
        }
        Ok(values)
    };
    let (r, t) = (values("R:", 9)?, values("T:", 3)?);
    let rows: Vec<f64> = (0..3).flat_map(|i| [r[3 * i], r[3 * i + 1], r[3 * i + 2], t[i]]).collect();
    let lidar_from_imu = pose_from_rows(&rows).map_err(|message| DataError::file(path, message))?;
    Ok(lidar_from_imu.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Dataset;
    use crate::write::write_bin;

    fn write(root: &Path, name: &str, text: &str) {
        let path = root.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }

    #[test]
    fn a_drive_has_stamps_poses_and_tracklets() {
        let day = tempfile::tempdir().unwrap();
        let root = day.path().join("2011_09_26_drive_0042_sync");
        let cloud = Cloud { values: vec![1.0, 2.0, 3.0, 0.5], channels: 4 };
        for (i, id) in ["0000000000", "0000000001", "0000000003"].iter().enumerate() {
            write_bin(&root.join(format!("{CLOUDS}/{id}.bin")), &cloud).unwrap();
            if i != 1 {
                write(&root, &format!("{OXTS}/{id}.txt"), &format!("49.0 {} 116 0 0 0 1 2 3", 8.4 + 1e-5 * i as f64));
            }
        }
        write(day.path(), CALIBRATION, "calib_time: x\nR: 1 0 0 0 1 0 0 0 1\nT: -0.8 0.3 -0.8\n");
        let stamp = |s: f64| format!("2011-09-26 13:02:{s:012.9}\n");
        write(&root, STAMPS, &[25.9, 26.0, 26.1, 26.2].map(stamp).concat());
        write(&root, TRACKLETS, super::super::tracklets::MADE_UP);
        let dataset = Dataset::open(&root).unwrap();
        assert_eq!(dataset.config.layout, Layout::KittiRaw);
        let moments = dataset.moments(&dataset.all_ids().unwrap()).unwrap();
        let stamps: Vec<f64> = moments.iter().map(|m| (m.stamp_s.unwrap() * 1e6).round() / 1e6).collect();
        assert_eq!(stamps, [0.0, 0.1, 0.3], "a scan is missing and its line is there");
        assert!(moments[1].world_from_lidar.is_none(), "a gap of the GPS");
        let at = |i: usize| moments[i].world_from_lidar.unwrap().translation.vector;
        assert!((at(0) - nalgebra::Vector3::new(0.8, -0.3, 0.8)).norm() < 1e-9, "{}", at(0));
        // 2e-5 degrees of longitude at a latitude of 49 degrees.
        assert!(((at(2) - at(0)).x - 1.4607).abs() < 1e-3, "{}", at(2) - at(0));
        assert_eq!((moments[0].objects.len(), moments[2].objects.len()), (0, 1));
        assert_eq!(dataset.load("0000000003").unwrap().objects[0].bbox, moments[2].objects[0].bbox);
        write(day.path(), CALIBRATION, "R: 1 0 0 0 1 0 0 0\nT: 0 0 0\n");
        let error = dataset.moments(&["0000000000".into()]).unwrap_err().to_string();
        assert!(error.contains("calib_imu_to_velo.txt:1: R: has 8 numbers, not 9"), "{error}");
    }

    /// The log of a real drive gives the poses that were made of it with the calibration of the day, but for the lever
    /// between IMU and LiDAR.
    #[test]
    fn a_real_log_gives_the_path_of_the_drive() {
        let real = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti_raw_0001"));
        if !real.exists() {
            return eprintln!("skipped: {} is not there", real.display());
        }
        let folder = tempfile::tempdir().unwrap();
        let cloud = Cloud { values: vec![1.0, 2.0, 3.0, 0.5], channels: 4 };
        let text = std::fs::read_to_string(real.join("oxts_ts_lat_lon_alt_roll_pitch_yaw.txt")).unwrap();
        for (i, line) in text.lines().enumerate() {
            let (_, values) = line.split_once(' ').unwrap();
            write(folder.path(), &format!("{OXTS}/{i:010}.txt"), values);
            write_bin(&folder.path().join(format!("{CLOUDS}/{i:010}.bin")), &cloud).unwrap();
        }
        let dataset = Dataset::open(folder.path()).unwrap();
        let poses: Vec<Pose> =
            dataset.moments(&dataset.all_ids().unwrap()).unwrap().iter().map(|m| m.world_from_lidar.unwrap()).collect();
        let want = std::fs::read_to_string(real.join("poses.txt")).unwrap();
        let want = super::super::pose_text::parse_poses(&want, Path::new("poses.txt")).unwrap();
        assert_eq!(poses.len(), want.len());
        let first = want[0].unwrap();
        for (pose, want) in poses.iter().zip(&want) {
            let (got, want) = (poses[0].inverse() * pose, first.inverse() * want.unwrap());
            let off = got.translation.vector.norm() - want.translation.vector.norm();
            assert!(off.abs() < 0.1, "{off} m");
            assert!((got.rotation.angle() - want.rotation.angle()).abs() < 1e-4);
        }
    }
}
