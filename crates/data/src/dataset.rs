//! A data set on disk. Frames are read by id; their boxes are converted to the LiDAR frame.

use crate::Presence as _;
use crate::dataset_config::DatasetConfig;
use crate::frame_index::FrameIndex;
use crate::kitti_text::{KittiText, read_kitti_text};
use crate::layout::{Moment, PointDetails, Sequence, is_recording};
use crate::limits::{MOST_IDS, at_most, check_name, read_text};
use crate::{Calibration, Cloud, DataError, Detection, FilePart, Frame, LabelBox, LabelFrame, Object, PointColumns};
use rayon::prelude::*;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A data set on disk.
#[derive(Clone, Debug, PartialEq)]
pub struct Dataset {
    /// The contents of its TOML with all defaults filled in. `root` is absolute or relative to the working directory.
    pub config: DatasetConfig,
}

impl Dataset {
    /// Opens a data set by its folder or its TOML. Of a folder, `dataset.toml` is read; without that file the layout is
    /// recognised from its folders.
    ///
    /// Classes that the TOML does not give come from all labels, which are read again only if they were changed.
    pub fn open(path: &Path) -> Result<Self, DataError> {
        let mut dataset = Self::without_classes(path)?;
        if dataset.config.classes.is_empty() {
            dataset.config.classes = dataset.default_classes()?;
        }
        Ok(dataset)
    }

    /// As [`Dataset::open`], without reading labels for the classes: there are none if the TOML does not give them.
    ///
    /// # Errors
    /// As [`Dataset::open`].
    pub fn without_classes(path: &Path) -> Result<Self, DataError> {
        let inside = path.join("dataset.toml");
        let config = if path.may_be_file() && !is_recording(path) {
            DatasetConfig::read(path)?
        } else if inside.may_be_file() {
            DatasetConfig::read(&inside)?
        } else {
            DatasetConfig::of_folder(path)?
        };
        let mut dataset = Dataset { config };
        let DatasetConfig { layout, root, points, .. } = &dataset.config;
        layout.check_root(root)?;
        if *points == PointColumns::Xyzi && !layout.has_intensity(root)? {
            dataset.config.points = PointColumns::Xyz;
        }
        Ok(dataset)
    }

    /// The frame ids of a split, in its order. An error if the split is empty or a frame has no cloud.
    pub fn ids(&self, split: &str) -> Result<Vec<String>, DataError> {
        let path = self.split_path(split)?;
        let text = read_text(&path)?;
        let (lines, ids): (Vec<usize>, Vec<&str>) = parse_split(&text, &path)?.into_iter().unzip();
        if let Some(missing) = self.config.layout.first_without_cloud(&self.config.root, &ids) {
            let id = ids[missing];
            let message = format!("frame {id} has no cloud: {} does not exist", self.cloud_path(id).display());
            return Err(DataError::line(&path, lines[missing], message));
        }
        Ok(ids.into_iter().map(String::from).collect())
    }

    /// Path of the list of frames of a split. An error if the split is not known.
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

    /// Frame ids of a split; of all frames without one.
    ///
    /// # Errors
    /// As [`Dataset::ids`] and [`Dataset::all_ids`].
    pub fn ids_of(&self, split: Option<&str>) -> Result<Vec<String>, DataError> {
        split.map_or_else(|| self.all_ids(), |split| self.ids(split))
    }

    /// The ids of all frames that have a cloud, sorted.
    pub fn all_ids(&self) -> Result<Vec<String>, DataError> {
        self.config.layout.frame_ids(&self.config.root)
    }

    /// Path of a frame's cloud; if there is none, the path at which the layout writes it.
    pub fn cloud_path(&self, id: &str) -> PathBuf {
        self.config.layout.cloud_path(&self.config.root, id)
    }

    /// Path of a frame's labels, which need not exist.
    pub fn labels_path(&self, id: &str) -> PathBuf {
        match &self.config.labels {
            Some(folder) => text_path(&self.config.root.join(folder), id),
            None => self.config.layout.labels_path(&self.config.root, id),
        }
    }

    /// Where the bytes of a frame's cloud are.
    ///
    /// # Errors
    /// There is no such frame.
    pub fn cloud_part(&self, id: &str) -> Result<FilePart, DataError> {
        self.config.layout.cloud_part(&self.config.root, id)
    }

    /// Where the bytes of a frame's labels are, which need not exist.
    ///
    /// # Errors
    /// There is no such frame.
    pub fn labels_part(&self, id: &str) -> Result<FilePart, DataError> {
        match &self.config.labels {
            Some(_) => Ok(self.labels_path(id).into()),
            None => self.config.layout.labels_part(&self.config.root, id),
        }
    }

    /// As [`Dataset::cloud_part`], from the index alone where there is one: the file is not looked at.
    ///
    /// # Errors
    /// There is no such frame.
    pub(crate) fn cloud_place(&self, id: &str) -> Result<FilePart, DataError> {
        self.config.layout.cloud_place(&self.config.root, id)
    }

    /// As [`Dataset::cloud_place`], of the labels.
    ///
    /// # Errors
    /// There is no such frame.
    pub(crate) fn labels_place(&self, id: &str) -> Result<FilePart, DataError> {
        match &self.config.labels {
            Some(_) => Ok(self.labels_path(id).into()),
            None => self.config.layout.labels_place(&self.config.root, id),
        }
    }

    /// Path of a frame's true boxes; `None` where the truth beside the labels is not known.
    pub fn true_labels_path(&self, id: &str) -> Option<PathBuf> {
        self.config.true_labels.as_ref().map(|folder| text_path(&self.config.root.join(folder), id))
    }

    /// Paths of a frame's repaired labels: the estimate, and both ends of the correction; `None` without any.
    pub fn repaired_labels_paths(&self, id: &str) -> Option<[PathBuf; 3]> {
        self.config.repaired_folders().map(|folders| folders.map(|folder| text_path(&folder, id)))
    }

    /// Path of a frame's calibration, which need not exist; `None` if the layout has no calibration.
    pub fn calibration_path(&self, id: &str) -> Option<PathBuf> {
        self.config.layout.calibration_path(&self.config.root, id)
    }

    /// Whether there are labels. Frames of a data set without labels (such as KITTI's `testing`) have no objects.
    pub fn has_labels(&self) -> bool {
        self.config.labels.is_some() || self.config.layout.has_labels(&self.config.root)
    }

    /// The sequences of the data set: frames in a row that share a world.
    pub fn sequences(&self) -> Result<Vec<Sequence>, DataError> {
        self.config.layout.sequences(&self.config.root)
    }

    /// Stamps, poses and tracked boxes of the frames `ids`, in their order. All frames belong to one sequence.
    pub fn moments(&self, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        self.config.layout.moments(&self.config.root, ids)
    }

    /// Per-point data besides position and intensity, for all points of a frame (not cropped to the image).
    pub fn point_details(&self, id: &str) -> Result<PointDetails, DataError> {
        self.config.layout.read_point_details(&self.config.root, id)
    }

    /// Number of points of a frame (not cropped to the image).
    pub fn count_points(&self, id: &str) -> Result<usize, DataError> {
        self.config.layout.count_points(&self.config.root, id, self.config.points)
    }

    /// Reads cloud and objects of a frame. DontCare and objects without a 3D box are left out.
    pub fn load(&self, id: &str) -> Result<Frame, DataError> {
        let cloud = self.load_cloud(id)?;
        let lines = if self.has_labels() { self.labels(id)? } else { Vec::new() };
        Ok(Frame { id: id.into(), cloud, objects: self.objects(id, &lines)? })
    }

    /// Reads the cloud of a frame. With `fov_crop` it is cropped to the camera's image.
    pub fn load_cloud(&self, id: &str) -> Result<Cloud, DataError> {
        let mut cloud = self.load_whole_cloud(id)?;
        if self.config.fov_crop {
            let calibration = self.calibration(id)?;
            cloud.retain(|_, p| calibration.sees([p[0].into(), p[1].into(), p[2].into()], self.config.image_size));
            if cloud.is_empty() {
                return Err(DataError::file(&self.cloud_path(id), "no point is inside the camera's image (fov_crop)"));
            }
        }
        Ok(cloud)
    }

    pub(crate) fn load_whole_cloud(&self, id: &str) -> Result<Cloud, DataError> {
        check_frame_id(id).map_err(|message| DataError::file(&self.config.root, message))?;
        let cloud = self.config.layout.read_cloud(&self.config.root, id, self.config.points)?;
        if cloud.channels != self.config.points.channels() {
            return Err(DataError::file(
                &self.cloud_path(id),
                "has no intensity, but other clouds of this data set have one",
            ));
        }
        Ok(cloud)
    }

    /// Reads the labels of a frame in the label frame, DontCare included.
    pub fn labels(&self, id: &str) -> Result<Vec<LabelBox>, DataError> {
        match &self.config.labels {
            Some(_) => read_kitti_text(&self.labels_path(id), KittiText::Labels),
            None => self.config.layout.read_labels(&self.config.root, id),
        }
    }

    /// Reads the true boxes of a frame in the label frame; `None` where the truth beside the labels is not known.
    pub fn true_labels(&self, id: &str) -> Result<Option<Vec<LabelBox>>, DataError> {
        self.true_labels_path(id).map(|path| read_kitti_text(&path, KittiText::Labels)).transpose()
    }

    /// Reads the repaired labels of a frame in the label frame: the estimate, and both ends of the correction; `None`
    /// without any.
    pub fn repaired_labels(&self, id: &str) -> Result<Option<[Vec<LabelBox>; 3]>, DataError> {
        let Some(paths) = self.repaired_labels_paths(id) else { return Ok(None) };
        if let Some(missing) = paths.iter().find(|path| !path.may_be_file()) {
            let message = "does not exist: the diagnosis that repaired the labels did not see this frame; diagnose all \
                           frames, or test on those that it saw";
            return Err(DataError::missing(missing, message));
        }
        let [estimate, low, high] = paths.map(|path| read_kitti_text(&path, KittiText::Labels));
        Ok(Some([estimate?, low?, high?]))
    }

    /// Reads the calibration of a frame.
    pub fn calibration(&self, id: &str) -> Result<Calibration, DataError> {
        self.config.layout.read_calibration(&self.config.root, id)
    }

    /// Converts labels of a frame to objects in the LiDAR frame. DontCare and labels without a 3D box are left out.
    pub fn objects(&self, id: &str, lines: &[LabelBox]) -> Result<Vec<Object>, DataError> {
        let mut lines = lines.iter().filter(|line| !line.is_dont_care() && line.has_box()).peekable();
        if lines.peek().is_none() {
            return Ok(Vec::new());
        }
        let calibration = match self.config.label_frame {
            LabelFrame::Camera => Some(self.calibration(id)?),
            LabelFrame::Lidar => None,
        };
        let object = |line: &LabelBox| Object {
            class: line.class.clone(),
            bbox: calibration.as_ref().map_or_else(|| line.lidar_box(), |c| c.lidar_box(line)).with_wrapped_yaw(),
            truncation: Some(line.truncation).filter(|v| *v >= 0.0),
            occlusion: Some(line.occlusion as i32).filter(|v| *v >= 0),
            image_box: calibration.is_some().then_some(line.image_box),
        };
        Ok(lines.map(object).collect())
    }

    /// Converts a frame's objects to labels in this data set's label frame, in their order.
    pub fn label_boxes(&self, frame: &Frame) -> Result<Vec<LabelBox>, DataError> {
        if self.config.label_frame == LabelFrame::Lidar {
            return Ok(crate::write::label_boxes(frame));
        }
        let (calibration, size) = (self.calibration(&frame.id)?, self.config.image_size);
        let label = |object: &Object| {
            let mut label = calibration.camera_from_lidar_box(&object.class, &object.bbox, None, size);
            label.truncation = object.truncation.unwrap_or(-1.0);
            label.occlusion = object.occlusion.map_or(-1.0, f64::from);
            label
        };
        Ok(frame.objects.iter().map(label).collect())
    }

    /// Converts a detection to this data set's label frame.
    pub fn detection_box(&self, id: &str, detection: &Detection) -> Result<LabelBox, DataError> {
        Ok(self.detection_boxes(id, std::slice::from_ref(detection))?.remove(0))
    }

    /// Converts the detections of a frame to this data set's label frame, in their order.
    pub fn detection_boxes(&self, id: &str, detections: &[Detection]) -> Result<Vec<LabelBox>, DataError> {
        let line: Box<dyn Fn(&Detection) -> LabelBox> = match self.config.label_frame {
            LabelFrame::Lidar => Box::new(|d| LabelBox::from_box(&d.class, &d.bbox, Some(d.score))),
            LabelFrame::Camera => {
                let (calibration, size) = (self.calibration(id)?, self.config.image_size);
                Box::new(move |d| calibration.camera_from_lidar_box(&d.class, &d.bbox, Some(d.score), size))
            }
        };
        Ok(detections.iter().map(line).collect())
    }

    fn default_classes(&self) -> Result<Vec<String>, DataError> {
        let kitti = ["Car", "Pedestrian", "Cyclist"].map(String::from).to_vec();
        if self.config.label_frame == LabelFrame::Camera || !self.has_labels() {
            return Ok(kitti);
        }
        let ids = self.all_ids()?;
        let index = FrameIndex::of(self, ids.len());
        let of_frame = |mut found: BTreeSet<String>, id: &String| {
            index.add_classes(id, &mut found);
            found
        };
        let all = |a: BTreeSet<String>, b: BTreeSet<String>| a.into_iter().chain(b).collect();
        let found = ids.par_iter().fold(BTreeSet::new, of_frame).reduce(BTreeSet::new, all);
        index.finish(true);
        Ok(if found.is_empty() { kitti } else { found.into_iter().collect() })
    }
}

fn text_path(folder: &Path, id: &str) -> PathBuf {
    folder.join(format!("{id}.txt"))
}

/// Parses a split: one frame id a line, returned with its line number (from 1). Blank lines are skipped. An error if
/// there is no id. `path` is used in error messages.
pub fn parse_split<'a>(text: &'a str, path: &Path) -> Result<Vec<(usize, &'a str)>, DataError> {
    let mut ids = Vec::new();
    for (i, line) in text.lines().enumerate() {
        let id = line.trim();
        if !id.is_empty() {
            check_frame_id(id).map_err(|message| DataError::line(path, i + 1, message))?;
            at_most(path, "frames", ids.len() as u64 + 1, MOST_IDS)?;
            ids.push((i + 1, id));
        }
    }
    if ids.is_empty() { Err(DataError::file(path, "the split is empty")) } else { Ok(ids) }
}

/// An error unless the frame id is a file name.
fn check_frame_id(id: &str) -> Result<(), String> {
    check_name(id).map_err(|message| format!("frame id {message}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Layout;
    use crate::write::{write_dataset_toml, write_split};
    use geometry::Box3;

    fn frame(id: &str, channels: usize) -> Frame {
        let object = Object {
            class: "Car".into(),
            bbox: Box3::from_array([10.5, -2.25, -0.9, 4.1, 1.7, 1.5, 0.3]),
            truncation: Some(0.0),
            occlusion: Some(0),
            image_box: None,
        };
        let values = (0..channels * 5).map(|i| i as f32 * 0.5).collect();
        Frame { id: id.into(), cloud: Cloud { values, channels }, objects: vec![object] }
    }

    /// A folder with two frames and a TOML.
    fn synthetic(layout: Layout, channels: usize) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for id in ["000000", "000001"] {
            layout.write_frame(folder.path(), &frame(id, channels)).unwrap();
        }
        write_split(&folder.path().join("ImageSets/train.txt"), &["000001", "000000"]).unwrap();
        let points = if channels == 4 { PointColumns::Xyzi } else { PointColumns::Xyz };
        let config = DatasetConfig { name: "synthetic".into(), layout, points, ..DatasetConfig::default() };
        write_dataset_toml(&folder.path().join("dataset.toml"), &config).unwrap();
        folder
    }

    fn with_toml(folder: &Path, text: &str) -> Result<Dataset, String> {
        std::fs::write(folder.join("dataset.toml"), text).unwrap();
        Dataset::open(folder).map_err(|e| e.to_string())
    }

    #[test]
    fn data_sets_round_trip_in_all_layouts() {
        for layout in [Layout::Kitti, Layout::S2rDad] {
            for channels in [3, 4] {
                let folder = synthetic(layout, channels);
                let dataset = Dataset::open(folder.path()).unwrap();
                assert_eq!(dataset, Dataset::open(&folder.path().join("dataset.toml")).unwrap());
                assert_eq!(dataset.config.points.channels(), channels);
                assert_eq!(dataset.config.classes, ["Car"]);
                assert_eq!(dataset.ids("train").unwrap(), ["000001", "000000"]);
                assert_eq!(dataset.all_ids().unwrap(), ["000000", "000001"]);
                assert_eq!(dataset.load("000001").unwrap(), frame("000001", channels));
            }
        }
    }

    #[test]
    fn folders_without_a_toml_are_recognised_by_their_layout() {
        let folder = synthetic(Layout::Kitti, 4);
        std::fs::remove_file(folder.path().join("dataset.toml")).unwrap();
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!((dataset.config.label_frame, dataset.config.splits.len()), (LabelFrame::Lidar, 1));
        std::fs::create_dir(folder.path().join("calib")).unwrap();
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(dataset.config.label_frame, LabelFrame::Camera);
        let error = dataset.load("000000").unwrap_err().to_string();
        assert!(error.contains("calib/000000.txt"), "{error}");

        let above = tempfile::tempdir().unwrap();
        std::fs::rename(folder.path(), above.path().join("training")).unwrap();
        write_split(&above.path().join("ImageSets/val.txt"), &["000000"]).unwrap();
        assert_eq!(Dataset::open(above.path()).unwrap().ids("val").unwrap(), ["000000"]);
    }

    #[test]
    fn labels_of_another_folder_replace_those_of_the_layout() {
        let folder = synthetic(Layout::Kitti, 4);
        let other = folder.path().join("label_other");
        std::fs::create_dir(&other).unwrap();
        std::fs::write(other.join("000000.txt"), "").unwrap();
        let dataset = with_toml(folder.path(), "labels = \"label_other\"\ntrue_labels = \"label_2\"").unwrap();
        assert!(dataset.load("000000").unwrap().objects.is_empty());
        assert_eq!(dataset.true_labels("000000").unwrap().unwrap().len(), 1);
        assert!(dataset.labels("000001").unwrap_err().to_string().contains("label_other/000001.txt"));
        let plain = with_toml(folder.path(), "").unwrap();
        assert_eq!((plain.true_labels("000000").unwrap(), plain.labels("000000").unwrap().len()), (None, 1));
        let repaired = |toml: &str| with_toml(folder.path(), toml);
        let error = repaired("repaired_labels = \"label_2\"").unwrap_err();
        assert!(error.contains("repaired_labels: ") && error.contains("label_2_low is not a folder"), "{error}");
        for ending in ["low", "high"] {
            let end = folder.path().join(format!("label_2_{ending}"));
            std::fs::create_dir(&end).unwrap();
            std::fs::write(end.join("000000.txt"), "").unwrap();
        }
        let dataset = repaired("repaired_labels = \"label_2\"").unwrap();
        let counts = dataset.repaired_labels("000000").unwrap().unwrap().map(|boxes| boxes.len());
        assert_eq!((counts, plain.repaired_labels("000000").unwrap()), ([1, 0, 0], None));
        let error = dataset.repaired_labels("000001").unwrap_err().to_string();
        assert!(error.contains("label_2_low/000001.txt") && error.contains("did not see this frame"), "{error}");
        let error = with_toml(folder.path(), "true_labels = \"truth\"").unwrap_err();
        assert!(error.contains("dataset.toml: true_labels: ") && error.contains("truth is not a folder"), "{error}");
    }

    #[test]
    fn a_bad_toml_is_refused_by_line() {
        let folder = synthetic(Layout::Kitti, 4);
        let cases = [
            ("name = \"a\"\nroat = \".\"\n", "dataset.toml:2: unknown field `roat`"),
            ("name = \"a\"\nclasses = \"Car\"\n", "dataset.toml:2: classes: invalid type"),
            ("label_frame = \"world\"\n", "dataset.toml:1: label_frame: unknown variant `world`"),
            ("a = = 1", "dataset.toml:1: "),
            ("root = \"elsewhere\"", "elsewhere/velodyne: does not exist"),
            ("classes = [\"Car\", \"Car\"]", "occurs twice"),
            ("layout = \"s2r_dad\"\nlabel_frame = \"camera\"", "needs a calibration"),
            ("image_size = [0, 375]", "must be from 1 to 65536 px"),
        ];
        for (text, want) in cases {
            let error = with_toml(folder.path(), text).unwrap_err();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }

    #[test]
    fn bad_splits_are_refused_by_line() {
        let folder = synthetic(Layout::Kitti, 4);
        let dataset = Dataset::open(folder.path()).unwrap();
        let cases = [
            ("", "train.txt: the split is empty"),
            ("\n  \n", "is empty"),
            ("000000\n../000001\n", "train.txt:2: frame id \"../000001\""),
            ("a\\b\n", "path separator"),
            ("000000\n\n000009\n", "train.txt:3: frame 000009 has no cloud"),
        ];
        for (text, want) in cases {
            std::fs::write(folder.path().join("ImageSets/train.txt"), text).unwrap();
            let error = dataset.ids("train").unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
        // Many frames, whose folder is read once: a link to a cloud is one, a folder and what is absent are none.
        let ids: Vec<String> = (0..100).map(|i| format!("{i:06}")).collect();
        for id in &ids[2..] {
            std::fs::copy(folder.path().join("velodyne/000000.bin"), dataset.cloud_path(id)).unwrap();
        }
        write_split(&folder.path().join("ImageSets/train.txt"), &ids).unwrap();
        assert_eq!(dataset.ids("train").unwrap(), ids);
        #[cfg(unix)]
        {
            std::fs::remove_file(dataset.cloud_path("000050")).unwrap();
            std::os::unix::fs::symlink("000000.bin", dataset.cloud_path("000050")).unwrap();
            assert_eq!(dataset.ids("train").unwrap(), ids);
        }
        for (absent, line) in [("000090", 91), ("000070", 71)] {
            std::fs::remove_file(dataset.cloud_path(absent)).unwrap();
            std::fs::create_dir(folder.path().join(format!("velodyne/{absent}.bin"))).unwrap();
            let error = dataset.ids("train").unwrap_err().to_string();
            assert!(error.contains(&format!("train.txt:{line}: frame {absent} has no cloud")), "{error}");
        }
        let error = dataset.ids("val").unwrap_err().to_string();
        assert!(error.contains("no split \"val\" (it has: train)"), "{error}");
        assert!(dataset.load("../000000").unwrap_err().to_string().contains("path separator"));
    }

    #[test]
    fn fov_crop_keeps_points_inside_the_image() {
        let folder = synthetic(Layout::Kitti, 3);
        let cloud = Cloud { values: vec![10.0, 0.0, 0.0, -10.0, 0.0, 0.0, 10.0, 30.0, 0.0], channels: 3 };
        crate::write::write_bin(&folder.path().join("velodyne/000000.bin"), &cloud).unwrap();
        std::fs::create_dir(folder.path().join("calib")).unwrap();
        std::fs::write(folder.path().join("calib/000000.txt"), crate::calibration::tests::MADE_UP).unwrap();
        let text = "points = \"xyz\"\nlabel_frame = \"lidar\"\nfov_crop = true\n";
        let dataset = with_toml(folder.path(), text).unwrap();
        assert_eq!(dataset.load("000000").unwrap().cloud.values, [10.0, 0.0, 0.0]);
    }

    #[test]
    fn detections_are_written_in_the_frame_of_the_labels() {
        let folder = synthetic(Layout::Kitti, 4);
        std::fs::create_dir(folder.path().join("calib")).unwrap();
        std::fs::write(folder.path().join("calib/000000.txt"), crate::calibration::tests::MADE_UP).unwrap();
        let detection = Detection { class: "Car".into(), bbox: frame("", 3).objects[0].bbox, score: 0.75 };
        for label_frame in ["lidar", "camera"] {
            let dataset = with_toml(folder.path(), &format!("label_frame = \"{label_frame}\"")).unwrap();
            let line = dataset.detection_box("000000", &detection).unwrap();
            assert_eq!((line.score, line.truncation), (Some(0.75), -1.0));
            let back = dataset.objects("000000", &[line]).unwrap()[0].bbox.to_array();
            assert!(back.iter().zip(detection.bbox.to_array()).all(|(a, b)| (a - b).abs() < 1e-9), "{label_frame}");
        }
    }

    #[test]
    fn real_scans_load() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        let dataset = Dataset::open(root).unwrap();
        assert_eq!(dataset.config.classes, ["Car", "Pedestrian", "Cyclist"]);
        let ids = dataset.all_ids().unwrap();
        assert_eq!(ids.len(), 8);
        for id in ids {
            let frame = dataset.load(&id).unwrap();
            assert!(dataset.load_whole_cloud(&id).unwrap().len() > 100_000 && !frame.objects.is_empty());
            assert!(
                (10_000..30_000).contains(&frame.cloud.len()),
                "cropped to the camera's view: {}",
                frame.cloud.len()
            );
            let calibration = dataset.calibration(&id).unwrap();
            let lines = dataset.labels(&id).unwrap();
            for (line, object) in lines.iter().filter(|l| l.has_box()).zip(&frame.objects) {
                let back = calibration.camera_from_lidar_box(&line.class, &object.bbox, None, [1242, 375]);
                assert!((0..3).all(|i| (line.location[i] - back.location[i]).abs() < 1e-9));
                assert!((line.alpha - back.alpha).abs() < 0.05 || line.truncation > 0.0, "{line:?} {back:?}");
                let off = (0..4).map(|i| (line.image_box[i] - back.image_box[i]).abs()).fold(0.0, f64::max);
                assert!(off < 25.0 || line.truncation > 0.0, "{line:?} {back:?}");
            }
        }
    }

    #[test]
    fn fov_crop_matches_openpcdet() {
        let shared = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared"));
        let golden = shared.join("golden/pointpillars_kitti/eval.safetensors");
        if !golden.exists() {
            return eprintln!("skipped: {} is not there", golden.display());
        }
        let bytes = std::fs::read(golden).unwrap();
        let tensors = safetensors::SafeTensors::deserialize(&bytes).unwrap();
        let bits = |p: &[f32]| [0, 1, 2, 3].map(|i| p[i].to_bits());
        let values: Vec<f32> = tensors
            .tensor("in.points")
            .unwrap()
            .data()
            .chunks(4)
            .map(|b| f32::from_le_bytes(b.try_into().unwrap()))
            .collect();
        let mut want: Vec<_> = values.chunks(4).map(bits).collect();
        let mut dataset = Dataset::open(&shared.join("data/kitti")).unwrap();
        dataset.config.fov_crop = true;
        let cloud = dataset.load("000007").unwrap().cloud;
        let inside = |p: &&[f32]| (0.0..=69.12).contains(&p[0]) && (-39.68..=39.68).contains(&p[1]);
        let mut got: Vec<_> = cloud.points().filter(inside).map(bits).collect();
        want.sort();
        got.sort();
        assert_eq!(got.len(), want.len());
        assert!(got == want);
    }
}
