//! A data set on disk: frames by id, in the LiDAR frame whatever the labels are written in.

use crate::dataset_config::DatasetConfig;
use crate::kitti_text::{KittiText, read_kitti_text};
use crate::{Calibration, Cloud, DataError, Detection, Frame, KittiLine, LabelFrame, Object, PointColumns};
use crate::{parse_pcd_header, read_cloud};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A data set on disk.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// Everything its TOML says, defaults filled in; `root` is relative to the working folder or absolute.
    pub config: DatasetConfig,
}

impl Dataset {
    /// Opens a data set by its folder or its TOML. A folder is read by its `dataset.toml`, or without one by its layout.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let inside = path.join("dataset.toml");
        let config = if path.is_file() {
            DatasetConfig::read(path)?
        } else if inside.is_file() {
            DatasetConfig::read(&inside)?
        } else {
            DatasetConfig::of_folder(path)?
        };
        let mut dataset = Dataset { config };
        let clouds = dataset.config.root.join(dataset.config.layout.cloud_folder());
        if !clouds.is_dir() {
            return Err(DataError::file(&clouds, "does not exist: check root and layout of the data set"));
        }
        if dataset.config.points == PointColumns::Xyzi && !dataset.has_intensity()? {
            dataset.config.points = PointColumns::Xyz;
        }
        if dataset.config.classes.is_empty() {
            dataset.config.classes = dataset.default_classes()?;
        }
        Ok(dataset)
    }

    /// The frame ids of a split, in its order. Every one has a cloud, and there is at least one.
    pub fn ids(&self, split: &str) -> Result<Vec<String>, DataError> {
        let path = self.split_path(split)?;
        let bytes = fs_err::read(&path)?;
        let text = std::str::from_utf8(&bytes).map_err(|_| DataError::file(&path, "is not text"))?;
        let mut ids = Vec::new();
        for (i, line) in text.lines().enumerate() {
            let id = line.trim();
            if id.is_empty() {
                continue;
            }
            check_frame_id(id).map_err(|message| DataError::line(&path, i + 1, message))?;
            let cloud = self.cloud_path(id);
            if !cloud.is_file() {
                let message = format!("frame {id} has no cloud: {} does not exist", cloud.display());
                return Err(DataError::line(&path, i + 1, message));
            }
            ids.push(id.to_string());
        }
        if ids.is_empty() {
            return Err(DataError::file(&path, format!("the split {split:?} has no frame")));
        }
        Ok(ids)
    }

    /// The file of a split.
    pub fn split_path(&self, split: &str) -> Result<PathBuf, DataError> {
        match self.config.splits.get(split) {
            Some(list) => Ok(self.config.root.join(list)),
            None => {
                let names: Vec<_> = self.config.splits.keys().map(String::as_str).collect();
                let known = if names.is_empty() { "none".into() } else { names.join(", ") };
                Err(DataError::file(
                    &self.config.root,
                    format!(
                        "has no split {split:?} (it has: {known}); add ImageSets/{split}.txt, or name its file under [splits]"
                    ),
                ))
            }
        }
    }

    /// The ids of all clouds of the folder, sorted.
    pub fn all_ids(&self) -> Result<Vec<String>, DataError> {
        let folder = self.config.root.join(self.config.layout.cloud_folder());
        let mut ids = BTreeSet::new();
        for entry in fs_err::read_dir(&folder)? {
            let path = entry?.path();
            let ending = path.extension().and_then(|e| e.to_str());
            let (Some("bin" | "pcd"), Some(id)) = (ending, path.file_stem()) else { continue };
            let id = id.to_str().ok_or_else(|| DataError::file(&path, "its name is not UTF-8"))?;
            ids.insert(id.to_string());
        }
        if ids.is_empty() {
            return Err(DataError::file(&folder, "has no .bin and no .pcd"));
        }
        Ok(ids.into_iter().collect())
    }

    /// The file of a cloud; where there is none, the one that the layout would have.
    pub fn cloud_path(&self, id: &str) -> PathBuf {
        let folder = self.config.root.join(self.config.layout.cloud_folder());
        let [usual, other] = self.config.layout.endings().map(|ending| folder.join(format!("{id}.{ending}")));
        if !usual.is_file() && other.is_file() { other } else { usual }
    }

    /// The file of a frame's labels.
    pub fn labels_path(&self, id: &str) -> PathBuf {
        self.config.root.join(self.config.layout.label_folder()).join(format!("{id}.txt"))
    }

    /// The file of a frame's calibration.
    pub fn calibration_path(&self, id: &str) -> PathBuf {
        self.config.root.join("calib").join(format!("{id}.txt"))
    }

    /// The folder of labels exists. A data set without one (the testing part of KITTI) has frames without objects.
    pub fn has_labels(&self) -> bool {
        self.config.root.join(self.config.layout.label_folder()).is_dir()
    }

    /// Cloud and objects of a frame. DontCare and objects without a 3D box are left out.
    pub fn load(&self, id: &str) -> Result<Frame, DataError> {
        let cloud = self.load_cloud(id)?;
        let lines = if self.has_labels() { self.labels(id)? } else { Vec::new() };
        Ok(Frame { id: id.into(), cloud, objects: self.objects(id, &lines)? })
    }

    /// The cloud of a frame alone, cropped to the camera's image where the data set says so.
    pub fn load_cloud(&self, id: &str) -> Result<Cloud, DataError> {
        let mut cloud = self.load_whole_cloud(id)?;
        if self.config.fov_crop {
            let calibration = self.calibration(id)?;
            cloud.retain(|_, p| calibration.sees([p[0].into(), p[1].into(), p[2].into()], self.config.image_size));
            if cloud.is_empty() {
                return Err(DataError::file(&self.cloud_path(id), "the camera sees none of its points (fov_crop)"));
            }
        }
        Ok(cloud)
    }

    pub(crate) fn load_whole_cloud(&self, id: &str) -> Result<Cloud, DataError> {
        check_frame_id(id).map_err(|message| DataError::file(&self.config.root, message))?;
        let path = self.cloud_path(id);
        let cloud = read_cloud(&path, self.config.points)?;
        if cloud.channels != self.config.points.channels() {
            return Err(DataError::file(&path, "has no intensity, though other clouds of this data set do"));
        }
        Ok(cloud)
    }

    /// The label lines of a frame as they are written, DontCare included.
    pub fn labels(&self, id: &str) -> Result<Vec<KittiLine>, DataError> {
        read_kitti_text(&self.labels_path(id), KittiText::Labels)
    }

    /// The calibration of a frame.
    pub fn calibration(&self, id: &str) -> Result<Calibration, DataError> {
        Calibration::read(&self.calibration_path(id))
    }

    /// Label lines of a frame as objects of the LiDAR frame.
    pub fn objects(&self, id: &str, lines: &[KittiLine]) -> Result<Vec<Object>, DataError> {
        let mut lines = lines.iter().filter(|line| !line.is_dont_care() && line.has_box()).peekable();
        if lines.peek().is_none() {
            return Ok(Vec::new());
        }
        let calibration = match self.config.label_frame {
            LabelFrame::Camera => Some(self.calibration(id)?),
            LabelFrame::Lidar => None,
        };
        let object = |line: &KittiLine| Object {
            class: line.class.clone(),
            bbox: calibration.as_ref().map_or_else(|| line.lidar_box(), |c| c.lidar_box(line)).with_wrapped_yaw(),
            truncation: Some(line.truncation).filter(|v| *v >= 0.0),
            occlusion: Some(line.occlusion as i32).filter(|v| *v >= 0),
            image_box: calibration.is_some().then_some(line.image_box),
        };
        Ok(lines.map(object).collect())
    }

    /// A detection as a line of KITTI text in the frame of this data set's labels.
    pub fn detection_line(&self, id: &str, detection: &Detection) -> Result<KittiLine, DataError> {
        Ok(self.detection_lines(id, std::slice::from_ref(detection))?.remove(0))
    }

    /// The detections of a frame as lines of KITTI text in the frame of this data set's labels, in their order.
    pub fn detection_lines(&self, id: &str, detections: &[Detection]) -> Result<Vec<KittiLine>, DataError> {
        let line: Box<dyn Fn(&Detection) -> KittiLine> = match self.config.label_frame {
            LabelFrame::Lidar => Box::new(|d| KittiLine::from_box(&d.class, &d.bbox, Some(d.score))),
            LabelFrame::Camera => {
                let (calibration, size) = (self.calibration(id)?, self.config.image_size);
                Box::new(move |d| calibration.camera_from_lidar_box(&d.class, &d.bbox, Some(d.score), size))
            }
        };
        Ok(detections.iter().map(line).collect())
    }

    /// What the first cloud says, for a `.pcd`; a `.bin` says nothing and is believed.
    fn has_intensity(&self) -> Result<bool, DataError> {
        let path = self.cloud_path(&self.all_ids()?[0]);
        if path.extension().is_some_and(|e| e == "bin") {
            return Ok(true);
        }
        Ok(parse_pcd_header(&fs_err::read(&path)?, &path)?.has_intensity())
    }

    fn default_classes(&self) -> Result<Vec<String>, DataError> {
        let kitti = ["Car", "Pedestrian", "Cyclist"].map(String::from).to_vec();
        if self.config.label_frame == LabelFrame::Camera || !self.has_labels() {
            return Ok(kitti);
        }
        let mut found = BTreeSet::new();
        for id in self.all_ids()? {
            // A missing or bad file is an error of the frame it belongs to, when that is loaded.
            let lines = self.labels(&id).unwrap_or_default();
            found.extend(lines.into_iter().filter(|line| !line.is_dont_care()).map(|line| line.class));
        }
        Ok(if found.is_empty() { kitti } else { found.into_iter().collect() })
    }
}

/// A frame id is a file name without ending: it names no folder.
fn check_frame_id(id: &str) -> Result<(), String> {
    if id.is_empty() || id == "." || id == ".." || id.contains(['/', '\\', '\0']) {
        return Err(format!("frame id {id:?} is no file name: it must not contain a path separator"));
    }
    Ok(())
}
