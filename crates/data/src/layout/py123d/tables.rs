//! What is read of the tables of a log besides the points: sensors, poses, boxes.

use super::super::arrow_file::ArrowFile;
use super::super::pose_text::pose_from_quaternion;
use super::classes;
use super::log::BOXES;
use crate::DataError;
use crate::limits::{MOST_BOXES, at_most};
use geometry::Pose;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// Rows that a sensor may have. Those of a sensor follow those of the sensor before.
pub(super) const RINGS: u16 = 256;

/// What the metadata of a LiDAR say. A table of several LiDARs has them by number.
#[derive(Deserialize)]
struct Sensor {
    lidar_id: i64,
    /// x y z (m) qw qx qy qz.
    lidar_to_imu_se3: Vec<f64>,
}

#[derive(Deserialize)]
struct OfBoxes {
    box_detection_label_class: String,
}

/// A labelled box.
pub(super) struct WorldBox {
    /// Its track.
    pub track: String,
    /// Its class.
    pub class: String,
    /// Its pose in the world.
    pub world_from_box: Pose,
    /// Length, width, height, m.
    pub size: [f64; 3],
}

/// The name of a table, which begins the names of its columns.
pub(super) fn stem(file: &str) -> &str {
    file.trim_end_matches(".arrow")
}

/// The poses of the sensors of a table in the frame of the IMU, by their numbers.
pub(super) fn sensors(clouds: &ArrowFile, is_merged: bool) -> Result<BTreeMap<i64, Pose>, DataError> {
    let sensors: Vec<Sensor> = if is_merged {
        metadata::<BTreeMap<String, Sensor>>(clouds)?.into_values().collect()
    } else {
        vec![metadata(clouds)?]
    };
    if sensors.is_empty() {
        return Err(clouds.wrong("its metadata name no sensor"));
    }
    let most = i64::from(u16::MAX / RINGS);
    let pose = |sensor: Sensor| match sensor.lidar_to_imu_se3[..] {
        _ if !(0..most).contains(&sensor.lidar_id) => {
            Err(clouds.wrong(&format!("its metadata have the sensor {}, not 0 to {most}", sensor.lidar_id)))
        }
        [x, y, z, qw, qx, qy, qz] => {
            let pose = pose_from_quaternion([qw, qx, qy, qz], [x, y, z]);
            let pose = pose.ok().filter(|pose| pose.translation.vector.norm() < 100.0);
            pose.map(|pose| (sensor.lidar_id, pose))
                .ok_or_else(|| clouds.wrong(&format!("the pose of sensor {} is not one on a vehicle", sensor.lidar_id)))
        }
        _ => Err(clouds.wrong("lidar_to_imu_se3 of its metadata has not 7 values")),
    };
    sensors.into_iter().map(pose).collect()
}

/// What the metadata of a table say: MessagePack under the key `metadata`.
fn metadata<T: for<'a> Deserialize<'a>>(file: &ArrowFile) -> Result<T, DataError> {
    let bytes = file.metadata().get("metadata");
    let bytes = bytes.ok_or_else(|| file.wrong("has no metadata: it was not written by py123d 0.1 or later"))?;
    rmp_serde::from_slice(bytes).map_err(|e| file.wrong(&format!("its metadata cannot be read: {e}")))
}

/// The poses of the IMU in the world, by row.
pub(super) fn read_poses(path: &Path) -> Result<Vec<Pose>, DataError> {
    let table = ArrowFile::open(path)?.table()?;
    if table.rows() == 0 {
        return Ok(Vec::new());
    }
    let pose = |(row, values): (usize, Option<Vec<f64>>)| {
        let values = values.as_deref().unwrap_or_default();
        let [x, y, z, qw, qx, qy, qz] = values[..] else {
            return Err(table.wrong(row, &format!("imu_se3 has {} values, not 7", values.len())));
        };
        pose_from_quaternion([qw, qx, qy, qz], [x, y, z]).map_err(|message| table.wrong(row, &message))
    };
    table.real_lists("ego_state_se3.imu_se3")?.into_iter().enumerate().map(pose).collect()
}

/// The boxes of each row. Numbers of classes that are not known stay numbers.
pub(super) fn read_boxes(path: &Path) -> Result<Vec<Vec<WorldBox>>, DataError> {
    let file = ArrowFile::open(path)?;
    let table = file.table()?;
    if table.rows() == 0 {
        return Ok(Vec::new());
    }
    let names = classes::names(&metadata::<OfBoxes>(&file)?.box_detection_label_class);
    let column = |name: &str| format!("{}.{name}", stem(BOXES));
    let boxes = table.lists_of_rows::<10>(&column("bounding_box_se3"))?;
    let tracks = table.text_lists(&column("track_token"))?;
    let labels = table.integer_lists(&column("label"))?;
    let row = |row: usize| {
        let (boxes, tracks, labels) = (&boxes[row], &tracks[row], labels[row].as_deref().unwrap_or_default());
        if (boxes.len(), boxes.len()) != (tracks.len(), labels.len()) {
            let [b, t, l] = [boxes.len(), tracks.len(), labels.len()];
            return Err(table.wrong(row, &format!("it has {b} boxes, {t} tracks and {l} labels")));
        }
        at_most(path, "boxes of a frame", boxes.len() as u64, MOST_BOXES)?;
        let world_box = |i: usize| {
            let ([x, y, z, qw, qx, qy, qz, length, width, height], track) = (boxes[i], tracks[i].clone());
            let pose = pose_from_quaternion([qw, qx, qy, qz], [x, y, z]);
            let world_from_box = pose.map_err(|message| table.wrong(row, &format!("track {track:?}: {message}")))?;
            let name = usize::try_from(labels[i]).ok().and_then(|label| names.get(label));
            let class = name.map_or_else(|| labels[i].to_string(), |name| (*name).to_string());
            Ok(WorldBox { track, class, world_from_box, size: [length, width, height] })
        };
        (0..boxes.len()).map(world_box).collect()
    };
    (0..table.rows()).map(row).collect()
}
