//! What a data set's TOML may say, and what holds where it says nothing.

use crate::toml_text::{parse_toml, read_text};
use crate::{DataError, LabelFrame, Layout, PointColumns};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// A data set: files, frame of the labels, classes, splits.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DatasetConfig {
    /// A name for tables and messages. Default: the name of the folder.
    #[serde(default)]
    pub name: String,
    /// Folder of the data, relative to this file.
    #[serde(default = "here")]
    pub root: PathBuf,
    /// Where the files lie below the root.
    #[serde(default)]
    pub layout: Layout,
    /// Columns of a `.bin`. A `.pcd` says so itself; `xyz` here then drops its intensity.
    #[serde(default)]
    pub points: PointColumns,
    /// Frame of the labels. Default: `camera` where the KITTI layout has a folder `calib`, else `lidar`.
    #[serde(default = "lidar")]
    pub label_frame: LabelFrame,
    /// Classes to learn and to evaluate. Default: those found in the labels (of KITTI itself: Car, Pedestrian, Cyclist).
    #[serde(default)]
    pub classes: Vec<String>,
    /// Name and file of each split, relative to the root. Default: those of train, val and test for which `ImageSets/NAME.txt` exists.
    #[serde(default)]
    pub splits: BTreeMap<String, PathBuf>,
    /// The sensors, relative to this file: a rig as those in `configs/sensors`. Without one, one sensor at the cloud's origin is assumed
    /// wherever it matters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rig: Option<PathBuf>,
    /// Keep only the points that the camera sees (needs `calib`). Default: where the labels are in the camera's frame, for only what the
    /// camera sees is labelled there; the reference does so with KITTI in training and in test.
    #[serde(default)]
    pub fov_crop: bool,
    /// Width and height of the camera's image, px.
    #[serde(default = "kitti_image_size")]
    pub image_size: [u32; 2],
}

fn here() -> PathBuf {
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
            root: here(),
            layout: Layout::default(),
            points: PointColumns::default(),
            label_frame: lidar(),
            classes: Vec::new(),
            splits: BTreeMap::new(),
            rig: None,
            fov_crop: false,
            image_size: kitti_image_size(),
        }
    }
}

impl DatasetConfig {
    /// Reads a data set's TOML; `root` and `rig` are then relative to the working folder and every default is filled in but the classes.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        Self::parse(&read_text(path)?, path)
    }

    /// A data set's TOML in memory; `path` is where it lies, for messages, `root` and `rig`.
    pub fn parse(text: &str, path: &Path) -> Result<Self, DataError> {
        let mut config: DatasetConfig = parse_toml(text, path, |_| Ok(()))?;
        let folder = path.parent().unwrap_or(Path::new(""));
        config.root = folder.join(&config.root);
        config.rig = config.rig.map(|rig| folder.join(rig));
        let written: toml::Table = toml::from_str(text).expect("it was read above");
        config.fill_in(!written.contains_key("label_frame"), !written.contains_key("fov_crop"));
        config.check(path)?;
        Ok(config)
    }

    /// What a folder without a TOML is: the first layout that knows it.
    pub fn of_folder(folder: &Path) -> Result<Self, DataError> {
        let Some(mut config) = Layout::ALL.iter().find_map(|layout| layout.recognise(folder)) else {
            if !folder.is_dir() {
                return Err(DataError::file(folder, "does not exist; a data set is a folder or its TOML"));
            }
            let signs: Vec<&str> = Layout::ALL.iter().flat_map(|layout| layout.signs()).copied().collect();
            let signs = match &signs[..] {
                [others @ .., last] if !others.is_empty() => format!("{} or {last}", others.join(", ")),
                signs => signs.concat(),
            };
            return Err(DataError::file(folder, format!("is no data set: it has neither dataset.toml nor {signs}")));
        };
        config.fill_in(true, true);
        Ok(config)
    }

    fn fill_in(&mut self, label_frame_unsaid: bool, fov_crop_unsaid: bool) {
        if self.name.is_empty() {
            self.name = folder_name(&self.root);
        }
        if label_frame_unsaid {
            self.label_frame = self.layout.usual_label_frame(&self.root);
        }
        if fov_crop_unsaid {
            self.fov_crop = self.label_frame == LabelFrame::Camera;
        }
        if self.splits.is_empty() {
            for name in ["train", "val", "test"] {
                let list = PathBuf::from(format!("ImageSets/{name}.txt"));
                if self.root.join(&list).is_file() {
                    self.splits.insert(name.into(), list);
                }
            }
        }
    }

    fn check(&self, path: &Path) -> Result<(), DataError> {
        let wrong = |message: String| Err(DataError::file(path, message));
        if self.image_size.contains(&0) {
            return wrong(format!("image_size {:?} px has no pixel", self.image_size));
        }
        if !self.layout.knows_camera() {
            let without = format!("needs a calibration, which the layout {} does not have", self.layout.name());
            if self.label_frame == LabelFrame::Camera {
                return wrong(format!("label_frame = \"camera\" {without}"));
            }
            if self.fov_crop {
                return wrong(format!("fov_crop {without}"));
            }
        }
        for (i, class) in self.classes.iter().enumerate() {
            if class.is_empty()
                || class.contains(char::is_whitespace)
                || class == "DontCare"
                || self.classes[..i].contains(class)
            {
                return wrong(format!("classes: {class:?} is empty, has a space, is there twice or is DontCare"));
            }
        }
        Ok(())
    }
}

pub(crate) fn folder_name(folder: &Path) -> String {
    let name = |p: &Path| p.file_name().map(|n| n.to_string_lossy().into_owned());
    name(folder).or_else(|| name(&folder.canonicalize().ok()?)).unwrap_or_else(|| "data set".into())
}
