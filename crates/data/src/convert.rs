//! Data sets in other formats. What is written is a data set again: its `dataset.toml` stands beside it.

mod cdr;
mod mcap_file;
mod shards;

use crate::checksum::hex;
use crate::layout::shards::FOLDER;
use crate::limits::{MOST_TEXT_BYTES, read_file};
use crate::write::write_kitti_text;
use crate::{Cloud, DataError, Dataset, DatasetConfig, LabelBox, LabelFrame, Layout, NewDataset};
use crate::{Presence as _, to_kitti_text, write_atomic};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// Schema version of the manifest.
pub const CONVERT_MANIFEST_SCHEMA: &str = "lidarshift/converted-dataset/1";

/// Folder of the labels beside an MCAP file.
const MCAP_LABELS: &str = "labels";

/// The formats that are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// KITTI's folders: `velodyne/*.bin`, `label_2/*.txt`.
    Kitti,
    /// S2R-DAD's folders: `data/pcl/*.pcd`, `data/label/*.txt`.
    Pcd,
    /// OpenPCDet's custom data: `points/*.npy`, `labels/*.txt`.
    OpenPcdet,
    /// CARLA's PLY.
    Carla,
    /// One MCAP file of ROS 2: clouds, poses and boxes.
    Mcap,
    /// Tar files of many frames each: `shards/*.tar`.
    Shards,
}

impl Format {
    /// The layout of the new data set.
    pub fn layout(self) -> Layout {
        match self {
            Format::Kitti => Layout::Kitti,
            Format::Pcd => Layout::S2rDad,
            Format::OpenPcdet => Layout::OpenPcdet,
            Format::Carla => Layout::Carla,
            Format::Mcap => Layout::Mcap,
            Format::Shards => Layout::Shards,
        }
    }
}

/// Content of the `manifest.json` of a converted data set.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ConvertManifest {
    /// [`CONVERT_MANIFEST_SCHEMA`].
    pub schema: String,
    /// Whether all frames exist. An interrupted run leaves `false` and can be resumed.
    pub complete: bool,
    /// Name of the source data set.
    pub source: String,
    /// The format.
    pub to: Format,
    /// SHA-256 of format, description of the source, and program version.
    pub config_sha256: String,
    /// Number of frames.
    pub frames: usize,
    /// Points of all frames.
    pub points: usize,
    /// Labels of all frames.
    pub labels: usize,
    /// SHA-256 of `frames.jsonl`, which has those of the files of each frame and of what the frame was made from.
    #[serde(default)]
    pub frames_sha256: String,
    /// Builds of the program that wrote the frames; several if one of them was interrupted.
    #[serde(default)]
    pub builds: Vec<String>,
}

crate::manifest!(ConvertManifest, "from another data set, in another format or by another version");

/// A frame as it is written.
struct Content {
    cloud: Cloud,
    labels: Vec<LabelBox>,
}

impl Content {
    /// SHA-256 of points and labels.
    fn sha256(&self) -> String {
        let mut hash = Sha256::new();
        hash.update(self.cloud.channels.to_le_bytes());
        for value in &self.cloud.values {
            hash.update(value.to_le_bytes());
        }
        hash.update(to_kitti_text(&self.labels));
        hex(&hash.finalize())
    }
}

/// A data set, and the format in which it is written.
pub struct Conversion<'a> {
    /// The data set.
    pub dataset: &'a Dataset,
    /// The format.
    pub to: Format,
    /// Frames of a shard, for that format. At least one.
    pub shard_frames: usize,
}

/// Usual number of frames of a shard.
pub const SHARD_FRAMES: usize = 500;

impl Conversion<'_> {
    /// Writes all frames of the data set to the folder `out`.
    ///
    /// Labels are written in the LiDAR frame. KITTI's camera frame is kept, with the calibrations, from KITTI's layout
    /// to itself. Of a data set whose clouds are cropped to the image, other formats have the points in the image.
    ///
    /// `progress(done, total)` is called with the number of frames, from several threads. Frames that an earlier run
    /// with the same arguments finished are kept if neither they nor their sources have changed.
    ///
    /// # Errors
    /// A source that cannot be read, and a folder with other content.
    pub fn make(&self, out: &Path, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<ConvertManifest, DataError> {
        let source = &self.dataset.config;
        let ids = self.dataset.all_ids()?;
        let mut manifest = ConvertManifest {
            schema: CONVERT_MANIFEST_SCHEMA.into(),
            complete: false,
            source: source.name.clone(),
            to: self.to,
            config_sha256: self.fingerprint(),
            frames: ids.len(),
            points: 0,
            labels: 0,
            frames_sha256: String::new(),
            builds: Vec::new(),
        };
        // What cannot be read is found before anything is written.
        for name in source.splits.keys() {
            self.dataset.ids(name)?;
        }
        let new = NewDataset::begin(out, self.to.layout(), &["calib", MCAP_LABELS, FOLDER, ""], &mut manifest)?;
        let written = if self.to == Format::Mcap {
            mcap_file::write(self, &new, progress, &mut manifest)?
        } else if self.to == Format::Shards {
            shards::write(self, &new, &ids, progress, &mut manifest)?
        } else {
            let counts = new.make_frames(&ids, progress, |_, id| self.write_frame(&new, id))?;
            for [points, labels] in counts {
                manifest.points += points;
                manifest.labels += labels;
            }
            self.describe(&new, &|id| id.to_owned())?;
            ids
        };
        new.finish(&mut manifest, &written)?;
        Ok(manifest)
    }

    /// Whether labels stay in KITTI's camera frame.
    fn keeps_camera(&self) -> bool {
        let source = &self.dataset.config;
        self.to == Format::Kitti && source.layout == Layout::Kitti && source.label_frame == LabelFrame::Camera
    }

    fn content(&self, id: &str) -> Result<Content, DataError> {
        let dataset = self.dataset;
        let lines = if dataset.has_labels() { dataset.labels(id)? } else { Vec::new() };
        if self.keeps_camera() {
            return Ok(Content { cloud: dataset.load_whole_cloud(id)?, labels: lines });
        }
        let cloud = dataset.load_cloud(id)?;
        if dataset.config.label_frame == LabelFrame::Lidar {
            return Ok(Content { cloud, labels: lines });
        }
        let solid: Vec<LabelBox> = lines.into_iter().filter(|l| !l.is_dont_care() && l.has_box()).collect();
        let labels = dataset.objects(id, &solid)?.into_iter().zip(solid).map(|(object, line)| {
            let lidar = LabelBox::from_box(&object.class, &object.bbox, None);
            LabelBox {
                class: lidar.class,
                size_hwl: lidar.size_hwl,
                location: lidar.location,
                rotation_y: lidar.rotation_y,
                ..line
            }
        });
        Ok(Content { labels: labels.collect(), cloud })
    }

    /// Writes a frame unless it is there; returns its numbers of points and labels.
    fn write_frame(&self, new: &NewDataset, id: &str) -> Result<[usize; 2], DataError> {
        let (layout, root) = (new.layout(), new.root());
        let content = self.content(id)?;
        let labelled = self.dataset.has_labels();
        let from = self.dataset.calibration_path(id).filter(|path| self.keeps_camera() && path.may_be_file());
        let calibrations = from.zip(layout.calibration_path(root, id));
        let files = || {
            let labels = labelled.then(|| layout.labels_path(root, id));
            let calibration = calibrations.as_ref().map(|(_, to)| to.clone());
            [Some(layout.cloud_path(root, id)), labels, calibration].into_iter().flatten().collect()
        };
        new.frame(id, Some(&content.sha256()), files, || {
            if labelled {
                layout.write_labels(root, id, &content.labels)?;
            }
            if let Some((from, to)) = &calibrations {
                write_atomic(to, &read_file(from, MOST_TEXT_BYTES)?)?;
            }
            layout.write_cloud(root, id, &content.cloud)
        })?;
        Ok([content.cloud.len(), content.labels.len()])
    }

    /// Writes splits, `dataset.toml` and the rig. `renamed` gives the new id of a frame.
    fn describe(&self, new: &NewDataset, renamed: &dyn Fn(&str) -> String) -> Result<(), DataError> {
        let source = &self.dataset.config;
        let rig = source.rig.as_ref().map(|path| read_file(path, MOST_TEXT_BYTES)).transpose()?;
        if let Some(text) = &rig {
            write_atomic(&new.root().join("rig.toml"), text)?;
        }
        let camera = self.keeps_camera();
        let labels = (self.to == Format::Mcap && self.dataset.has_labels()).then(|| PathBuf::from(MCAP_LABELS));
        let config = DatasetConfig {
            rig: rig.map(|_| "rig.toml".into()),
            label_frame: if camera { LabelFrame::Camera } else { LabelFrame::Lidar },
            fov_crop: camera && source.fov_crop,
            labels,
            true_labels: None,
            repaired_labels: None,
            ..source.clone()
        };
        let splits = source.splits.keys().map(|name| {
            let ids = self.dataset.ids(name)?;
            Ok((name, ids.iter().map(|id| renamed(id)).collect()))
        });
        new.describe(config, splits.collect::<Result<Vec<(&String, Vec<String>)>, DataError>>()?)
    }

    fn fingerprint(&self) -> String {
        let source = DatasetConfig { root: PathBuf::new(), rig: None, ..self.dataset.config.clone() };
        let text = serde_json::to_string(&(env!("CARGO_PKG_VERSION"), self.to, source));
        let mut text = text.expect("a configuration is plain data");
        if self.to == Format::Shards {
            text += &format!(" {} frames a shard", self.shard_frames);
        }
        hex(&Sha256::digest(text))
    }
}

fn write_labels_beside(root: &Path, id: &str, labels: &[LabelBox]) -> Result<PathBuf, DataError> {
    let path = root.join(MCAP_LABELS).join(format!("{id}.txt"));
    write_kitti_text(&path, labels)?;
    Ok(path)
}

#[cfg(test)]
mod tests;
