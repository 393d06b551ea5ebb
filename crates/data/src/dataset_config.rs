//! The TOML of a data set and its defaults.

use crate::Presence as _;
use crate::layout::shards::list_shards;
use crate::limits::{MOST_IMAGE_SIDE_PX, MOST_NAME_BYTES, check_name, read_text};
use crate::source::is_url;
use crate::toml_text::{KeyError, parse_toml, wrong};
use crate::write::REPAIRED_ENDINGS;
use crate::{DataError, LabelFrame, Layout, PointColumns};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A data set: its files, label frame, classes and splits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DatasetConfig {
    /// Name for tables and messages. Default: the name of the folder.
    #[serde(default)]
    pub name: String,
    /// Folder of the data, relative to this file.
    #[serde(default = "this_folder")]
    pub root: PathBuf,
    /// Folders and files below the root.
    #[serde(default)]
    pub layout: Layout,
    /// Columns of a `.bin`. Those of a `.pcd` are in its header; `xyz` drops its intensity.
    #[serde(default)]
    pub points: PointColumns,
    /// Frame of the labels. Default: `camera` if the layout is KITTI's and there is a folder `calib`, else `lidar`.
    #[serde(default = "lidar")]
    pub label_frame: LabelFrame,
    /// Classes to train and to evaluate. Default: Car, Pedestrian, Cyclist if the labels are in the camera frame, else
    /// the classes found in the labels.
    #[serde(default)]
    pub classes: Vec<String>,
    /// Folder of the label files, relative to the root, in the place of the layout's: KITTI text, a file a frame.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub labels: Option<PathBuf>,
    /// Folder of label files with the true boxes, relative to the root, if the labels were made automatically and the
    /// truth is known (simulated data). Only the evaluation reads it: it scores detections against both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub true_labels: Option<PathBuf>,
    /// Folder of labels that `lidarshift diagnose` corrected, relative to the root: `label_2` of its results. Beside it
    /// are the folders with `_low` and `_high` at the end of their names, for the interval of the correction. Only the
    /// evaluation reads them: it scores detections against the labels and against these.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub repaired_labels: Option<PathBuf>,
    /// Name and file of each split; files are relative to the root. Default: those of train, val and test for which
    /// `ImageSets/NAME.txt` exists.
    #[serde(default)]
    pub splits: BTreeMap<String, PathBuf>,
    /// File with the LiDAR sensors (a rig as in `configs/sensors`), relative to this file. Without it, one sensor at
    /// the origin of the cloud is assumed.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<PathBuf>,
    /// Keep only points inside the camera's image (needs `calib`). Default: true if the labels are in the camera frame,
    /// because KITTI labels only objects in the image. OpenPCDet does the same in training and evaluation.
    #[serde(default)]
    pub fov_crop: bool,
    /// Width and height of the camera's image, px.
    #[serde(default = "kitti_image_size")]
    pub image_size: [u32; 2],
}

fn this_folder() -> PathBuf {
    ".".into()
}

fn lidar() -> LabelFrame {
    LabelFrame::Lidar
}

fn kitti_image_size() -> [u32; 2] {
    [1242, 375]
}

impl Default for DatasetConfig {
    fn default() -> Self {
        DatasetConfig {
            name: String::new(),
            root: this_folder(),
            layout: Layout::default(),
            points: PointColumns::default(),
            label_frame: lidar(),
            classes: Vec::new(),
            labels: None,
            true_labels: None,
            repaired_labels: None,
            splits: BTreeMap::new(),
            rig: None,
            fov_crop: false,
            image_size: kitti_image_size(),
        }
    }
}

impl DatasetConfig {
    /// Reads a data set's TOML. `root` and `rig` become relative to the working directory. All defaults except the
    /// classes are filled in.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        Self::parse(&read_text(path)?, path)
    }

    /// Parses a data set's TOML. `root` and `rig` are resolved against the folder of `path`.
    pub fn parse(text: &str, path: &Path) -> Result<Self, DataError> {
        let mut config: DatasetConfig = parse_toml(text, path, DatasetConfig::check_values)?;
        let folder = path.parent().unwrap_or(Path::new(""));
        config.root = folder.join(&config.root);
        config.rig = config.rig.map(|rig| folder.join(rig));
        let written: toml::Table = toml::from_str(text).expect("it was parsed above");
        config.fill_in(!written.contains_key("label_frame"), !written.contains_key("fov_crop"));
        config.check(path)?;
        Ok(config)
    }

    /// The configuration of a folder without a TOML, from the first layout that recognises it.
    pub fn of_folder(folder: &Path) -> Result<Self, DataError> {
        // Only shards are read from stores. The error of a store says more than "maybe".
        let layouts = if is_url(folder) { &[Layout::Shards][..] } else { Layout::ALL };
        let Some(mut config) = layouts.iter().find_map(|layout| layout.recognise(folder)) else {
            if is_url(folder) {
                list_shards(folder)?;
            }
            if !folder.may_be_folder() {
                return Err(DataError::missing(folder, "does not exist; give the folder or the TOML of a data set"));
            }
            let markers: Vec<&str> = Layout::ALL.iter().flat_map(|layout| layout.markers()).copied().collect();
            let markers = match &markers[..] {
                [others @ .., last] if !others.is_empty() => format!("{} or {last}", others.join(", ")),
                markers => markers.concat(),
            };
            return Err(DataError::file(
                folder,
                format!("is not a data set: it has neither dataset.toml nor {markers}"),
            ));
        };
        config.fill_in(true, true);
        Ok(config)
    }

    fn fill_in(&mut self, default_label_frame: bool, default_fov_crop: bool) {
        if self.name.is_empty() {
            self.name = folder_name(&self.root);
        }
        if default_label_frame {
            self.label_frame = self.layout.default_label_frame(&self.root);
        }
        if default_fov_crop {
            self.fov_crop = self.label_frame == LabelFrame::Camera;
        }
        if self.splits.is_empty() {
            for name in ["train", "val", "test"] {
                let list = PathBuf::from(format!("ImageSets/{name}.txt"));
                if self.root.join(&list).may_be_file() {
                    self.splits.insert(name.into(), list);
                }
            }
        }
    }

    /// Folders of the repaired labels: the estimate, and both ends of the correction.
    pub(crate) fn repaired_folders(&self) -> Option<[PathBuf; 3]> {
        let folder = self.root.join(self.repaired_labels.as_ref()?);
        Some(REPAIRED_ENDINGS.map(|ending| {
            let mut name = folder.file_name().unwrap_or_default().to_os_string();
            name.push(ending);
            folder.with_file_name(name)
        }))
    }

    /// What needs no look at the files. The name may be missing.
    fn check_values(&self) -> Result<(), KeyError> {
        if !self.name.is_empty() {
            check_name(&self.name).map_err(|message| wrong("name", message))?;
        }
        for split in self.splits.keys() {
            check_name(split).map_err(|message| wrong("splits", message))?;
        }
        if self.image_size.iter().any(|side| !(1..=MOST_IMAGE_SIDE_PX).contains(side)) {
            let message = format!("{:?}: both sides must be from 1 to {MOST_IMAGE_SIDE_PX} px", self.image_size);
            return Err(wrong("image_size", message));
        }
        Ok(())
    }

    fn check(&self, path: &Path) -> Result<(), DataError> {
        let wrong = |message: String| Err(DataError::file(path, message));
        let repaired = self.repaired_folders();
        let repaired = repaired.iter().flatten().map(|folder| ("repaired_labels", folder.clone()));
        let others = [("labels", &self.labels), ("true_labels", &self.true_labels)];
        let others = others.into_iter().filter_map(|(key, folder)| Some((key, self.root.join(folder.as_ref()?))));
        if let Some((key, missing)) = others.chain(repaired).find(|(_, folder)| !folder.may_be_folder()) {
            return wrong(format!("{key}: {} is not a folder", missing.display()));
        }
        if !self.layout.supports_calibration() {
            let reason = format!("needs a calibration, which the layout {} does not have", self.layout.name());
            if self.label_frame == LabelFrame::Camera {
                return wrong(format!("label_frame = \"camera\" {reason}"));
            }
            if self.fov_crop {
                return wrong(format!("fov_crop {reason}"));
            }
        }
        for (i, class) in self.classes.iter().enumerate() {
            if class.is_empty()
                || class.contains(|c: char| c.is_whitespace() || c.is_control())
                || class == "DontCare"
                || self.classes[..i].contains(class)
            {
                return wrong(format!("classes: {class:?} is empty, contains a space, occurs twice or is DontCare"));
            }
        }
        Ok(())
    }
}

pub(crate) fn folder_name(folder: &Path) -> String {
    let name = |p: &Path| p.file_name().map(|n| usable(&n.to_string_lossy()));
    name(folder).or_else(|| name(&folder.canonicalize().ok()?)).unwrap_or_else(|| "data set".into())
}

/// A name that [`check_name`] accepts.
fn usable(name: &str) -> String {
    let mut usable = String::new();
    for c in name.trim_start_matches('.').chars().map(|c| if c.is_control() || c == '\\' { '_' } else { c }) {
        if usable.len() + c.len_utf8() > MOST_NAME_BYTES {
            break;
        }
        usable.push(c);
    }
    if usable.is_empty() { "data set".into() } else { usable }
}
