//! Logs of 123D (the library py123d): a folder with a table of Arrow IPC for each sensor and for each kind of label.
//!
//! Points of the files are in the frame of the IMU, boxes in the world. The LiDAR frame has the axes of the IMU (x
//! forward, y left, z up) and its origin in the upper LiDAR, so that ranges are what this sensor measured.

mod classes;
mod log;
mod tables;

use super::file_names::check_folder;
use super::{DataLayout, Moment, PointDetails, Sequence, TrackedObject};
use crate::cloud_file::check_cloud;
use crate::limits::{MOST_IDS, at_most};
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use log::{BOXES, Log, SYNC, stamps};
use rayon::prelude::*;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The layout of logs of 123D. The root is a folder of logs, such as a split, or one log. Behind it, `#lidar_top` or
/// another name of a sensor leaves out all other sensors. The id of a frame is `LOG_STAMP`, or `STAMP` in a single log,
/// with the time stamp in us. Read-only.
pub(super) struct Py123d;

/// How the choice of a sensor begins.
const SENSOR: &str = "#lidar_";

/// The folder of a root, and the sensor that is read alone: `lidar_top`.
fn split(root: &Path) -> (&Path, Option<&str>) {
    let parts = root.to_str().and_then(|text| text.rfind(SENSOR).map(|at| text.split_at(at)));
    parts.map_or((root, None), |(folder, sensor)| (Path::new(folder), Some(&sensor[1..])))
}

/// Names and folders of the logs below a folder, by name. A log that is itself the folder has no name.
fn logs(folder: &Path) -> Result<Vec<(String, PathBuf)>, DataError> {
    if folder.join(SYNC).is_file() {
        return Ok(vec![(String::new(), folder.into())]);
    }
    check_folder(folder)?;
    let mut logs = Vec::new();
    for entry in fs_err::read_dir(folder)? {
        let entry = entry?;
        let path = entry.path();
        if !entry.file_type()?.is_file() && path.join(SYNC).is_file() {
            let name = entry.file_name().into_string();
            logs.push((name.map_err(|_| DataError::file(&path, "its name is not UTF-8"))?, path));
            at_most(folder, "logs", logs.len() as u64, MOST_IDS)?;
        }
    }
    if logs.is_empty() {
        let message = format!("has neither a {SYNC} nor a folder with one: check `root` and `layout` of the data set");
        return Err(DataError::missing(folder, message));
    }
    logs.sort();
    Ok(logs)
}

/// The log of a frame, and its time stamp, us.
fn log_of(root: &Path, id: &str) -> Result<(Arc<Log>, i64), DataError> {
    let (folder, sensor) = split(root);
    let wrong = || DataError::file(folder, format!("frame {id}: the frames of 123D are LOG_STAMP, or STAMP in a log"));
    let (name, stamp) = if folder.join(SYNC).is_file() { ("", id) } else { id.rsplit_once('_').ok_or_else(wrong)? };
    let stamp_us = stamp.parse().map_err(|_| wrong())?;
    Ok((Log::open(&folder.join(name), sensor)?, stamp_us))
}

impl DataLayout for Py123d {
    fn name(&self) -> &'static str {
        "py123d"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["sync.arrow (a log of 123D)", "*/sync.arrow (logs of 123D)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        logs(split(folder).0).ok()?;
        Some(DatasetConfig { layout: Layout::Py123d, root: folder.into(), ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        logs(split(root).0).map(drop)
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        let mut ids: Vec<String> = self.sequences(root)?.into_iter().flat_map(|sequence| sequence.ids).collect();
        ids.par_sort_unstable();
        Ok(ids)
    }

    fn sequences(&self, root: &Path) -> Result<Vec<Sequence>, DataError> {
        let (folder, sensor) = split(root);
        let sequence = |(name, log): (String, PathBuf)| {
            let id = |stamp: i64| if name.is_empty() { stamp.to_string() } else { format!("{name}_{stamp}") };
            let ids: Vec<String> = stamps(&log, sensor)?.into_iter().map(id).collect();
            at_most(&log, "frames", ids.len() as u64, MOST_IDS)?;
            Ok(Sequence { name, ids })
        };
        let mut sequences = logs(folder)?.into_par_iter().map(sequence).collect::<Result<Vec<_>, DataError>>()?;
        sequences.retain(|sequence| !sequence.ids.is_empty());
        if sequences.is_empty() {
            return Err(DataError::file(folder, "its logs have no cloud"));
        }
        Ok(sequences)
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        log_of(root, id).map_or_else(|_| split(root).0.join(SYNC), |(log, _)| log.cloud_path())
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        log_of(root, id).map_or_else(|_| split(root).0.join(BOXES), |(log, _)| log.labels_path())
    }

    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        log_of(root, id).is_ok_and(|(log, stamp_us)| log.has(stamp_us))
    }

    fn has_labels(&self, root: &Path) -> bool {
        logs(split(root).0).is_ok_and(|logs| logs.iter().any(|(_, log)| log.join(BOXES).is_file()))
    }

    /// From the first cloud.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        let (log, stamp_us) = log_of(root, &self.frame_ids(root)?[0])?;
        Ok(log.scan(stamp_us)?.channels == 4)
    }

    /// The intensity of the files, 0 to 255, becomes 0 to 1.
    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let (log, stamp_us) = log_of(root, id)?;
        let scan = log.scan(stamp_us)?;
        let cloud = Cloud { values: scan.values.clone(), channels: scan.channels };
        check_cloud(&cloud, &log.frame_path(stamp_us))?;
        Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud })
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let (log, stamp_us) = log_of(root, id)?;
        Ok(log.objects(stamp_us)?.iter().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let Some(first) = ids.first() else { return Ok(Vec::new()) };
        let (first_log, _) = log_of(root, first)?;
        let moment = |id: &String| {
            let (log, stamp_us) = log_of(root, id)?;
            if log.cloud_path() != first_log.cloud_path() {
                let message =
                    format!("frame {id} is of another log than {first}: list the frames of one log in a split");
                return Err(DataError::file(root, message));
            }
            Ok(Moment {
                stamp_s: Some(stamp_us.wrapping_sub(log.start_us()) as f64 * 1e-6),
                world_from_lidar: log.world_from_lidar(stamp_us)?,
                objects: log.objects(stamp_us)?,
                ..Moment::of(id)
            })
        };
        ids.iter().map(moment).collect()
    }

    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let (log, stamp_us) = log_of(root, id)?;
        let scan = log.scan(stamp_us)?;
        Ok(PointDetails { ring: scan.rings.clone(), time_s: scan.times_s.clone(), ..PointDetails::default() })
    }
}
