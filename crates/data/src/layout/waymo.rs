//! The Waymo Open Dataset, version 2: a Parquet file for each segment and component.
//!
//! Points of the files are range images, boxes are in the frame of the vehicle. The LiDAR frame has the axes of the
//! vehicle and its origin in the upper LiDAR, so that ranges are what this sensor measured.

mod files;
mod range_image;

use super::file_names::{check_folder, ids_of_files};
use super::{DataLayout, Moment, PointDetails, Sequence, TrackedObject};
use crate::cloud_file::check_cloud;
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use files::{BOXES, LIDAR, component, index, segment};
use rayon::prelude::*;
use std::path::{Path, PathBuf};

/// The layout of the Waymo Open Dataset. The root is the folder of the components. Behind it, `#top` leaves out all
/// sensors but the upper one. The id of a frame is `SEGMENT_STAMP` with the time stamp in us. Read-only.
pub(super) struct Waymo;

const ENDING: &str = ".parquet";

/// Chooses the upper LiDAR alone.
const TOP_ALONE: &str = "#top";

/// The folder of a root, and whether the upper LiDAR alone is read.
fn split(root: &Path) -> (&Path, bool) {
    let folder = root.to_str().and_then(|root| root.strip_suffix(TOP_ALONE));
    folder.map_or((root, false), |folder| (Path::new(folder), true))
}

/// The segment and the time stamp of a frame, us.
fn parts<'a>(root: &Path, id: &'a str) -> Result<(&'a str, i64), DataError> {
    let parts = id.rsplit_once('_').and_then(|(segment, stamp)| Some((segment, stamp.parse().ok()?)));
    parts.ok_or_else(|| DataError::file(root, format!("frame {id}: the frames of Waymo are SEGMENT_STAMP")))
}

fn segments(root: &Path) -> Result<Vec<String>, DataError> {
    let folder = split(root).0.join(LIDAR);
    check_folder(&folder)?;
    ids_of_files(&folder, ENDING)
}

fn objects(root: &Path, id: &str) -> Result<Vec<TrackedObject>, DataError> {
    let (name, stamp_us) = parts(root, id)?;
    segment(split(root).0, name)?.objects(stamp_us)
}

impl DataLayout for Waymo {
    fn name(&self) -> &'static str {
        "waymo"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["lidar/*.parquet (Waymo)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        segments(folder).ok()?;
        Some(DatasetConfig { layout: Layout::Waymo, root: folder.into(), ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        check_folder(&split(root).0.join(LIDAR))
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        Ok(self.sequences(root)?.into_iter().flat_map(|sequence| sequence.ids).collect())
    }

    fn sequences(&self, root: &Path) -> Result<Vec<Sequence>, DataError> {
        let sequence = |name: String| {
            let ids = index(split(root).0, &name)?.keys().map(|stamp| format!("{name}_{stamp}")).collect();
            Ok(Sequence { name, ids })
        };
        segments(root)?.into_par_iter().map(sequence).collect()
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        let name = parts(root, id).map_or(id, |(name, _)| name);
        component(split(root).0, LIDAR, name)
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        let name = parts(root, id).map_or(id, |(name, _)| name);
        component(split(root).0, BOXES, name)
    }

    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        let frames = |(name, stamp_us)| Ok((index(split(root).0, name)?, stamp_us));
        parts(root, id).and_then(frames).is_ok_and(|(frames, stamp_us)| frames.contains_key(&stamp_us))
    }

    fn has_labels(&self, root: &Path) -> bool {
        split(root).0.join(BOXES).is_dir()
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let (folder, top_alone) = split(root);
        let (name, stamp_us) = parts(root, id)?;
        let scan = segment(folder, name)?.scan(stamp_us, top_alone)?;
        let cloud = Cloud { values: scan.values.clone(), channels: 4 };
        check_cloud(&cloud, &PathBuf::from(format!("{} frame {stamp_us}", self.cloud_path(root, id).display())))?;
        Ok(cloud.with_channels(columns.channels()))
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        Ok(objects(root, id)?.iter().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let moment = |id: &String| {
            let (name, stamp_us) = parts(root, id)?;
            if parts(root, &ids[0])?.0 != name {
                let first = &ids[0];
                let message =
                    format!("frame {id} is of another segment than {first}: list the frames of one segment in a split");
                return Err(DataError::file(root, message));
            }
            let segment = segment(split(root).0, name)?;
            Ok(Moment {
                stamp_s: Some(stamp_us.wrapping_sub(segment.start_us()) as f64 * 1e-6),
                world_from_lidar: Some(segment.world_from_lidar(stamp_us)?),
                objects: segment.objects(stamp_us)?,
                ..Moment::of(id)
            })
        };
        ids.iter().map(moment).collect()
    }

    /// Rows of the upper LiDAR, then those of the others. The motion of the vehicle is out of the points.
    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let (folder, top_alone) = split(root);
        let (name, stamp_us) = parts(root, id)?;
        let scan = segment(folder, name)?.scan(stamp_us, top_alone)?;
        Ok(PointDetails { ring: Some(scan.rings.clone()), compensated: Some(true), ..PointDetails::default() })
    }
}

#[cfg(test)]
mod tests;
