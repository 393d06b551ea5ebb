//! How the frames of a data set lie on disk. A layout is a file in this folder and a line in [`Layout`]'s list below.

mod file_per_frame;

use crate::write::label_boxes;
use crate::{Calibration, Cloud, DataError, DatasetConfig, Frame, LabelBox, LabelFrame, PointColumns};
use geometry::Pose;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Deref;
use std::path::{Path, PathBuf};

/// Declares the module of each layout and the enum that a data set's TOML spells in snake case. The module `m` of `Name = m` holds a
/// unit type `Name`, which is a [`DataLayout`]. The text is what the reference of the configuration says of it.
macro_rules! layouts {
    ($($name:ident = $module:ident: $says:tt;)+) => {
        $(mod $module;)+

        /// Where the files lie below the root.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        #[serde(rename_all = "snake_case")]
        pub enum Layout {
            $(#[doc = $says] $name,)+
        }

        impl Layout {
            /// All of them, in the order in which a folder without a TOML is compared with them.
            pub const ALL: &[Layout] = &[$(Layout::$name),+];
        }

        impl Deref for Layout {
            type Target = dyn DataLayout;

            fn deref(&self) -> &Self::Target {
                match self {
                    $(Layout::$name => &$module::$name,)+
                }
            }
        }
    };
}

layouts! {
    Kitti = kitti: "`velodyne/*.bin`, `label_2/*.txt` and, where there is a camera, `calib/*.txt`.";
    S2rDad = s2r_dad: "`data/pcl/*.pcd` and `data/label/*.txt`, without calibration.";
}

impl Default for Layout {
    fn default() -> Self {
        Layout::ALL[0]
    }
}

/// Finds, reads and writes the frames of one layout. `root` is the root of a data set, `id` a frame of it.
///
/// Methods with a body are what a format may not carry; their default says "not known" or "not there".
pub trait DataLayout: Send + Sync {
    /// The name as a data set's TOML spells it.
    fn name(&self) -> &'static str;

    /// What a folder without a TOML is known by, for messages.
    fn signs(&self) -> &'static [&'static str];

    /// The data set in a folder without a TOML, if it is of this layout: root, and name and splits unless they are the usual ones.
    fn recognise(&self, folder: &Path) -> Option<DatasetConfig>;

    /// An error that names what is missing, unless `root` holds data of this layout.
    fn check_root(&self, root: &Path) -> Result<(), DataError>;

    /// All frames, sorted; at least one.
    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError>;

    /// The file that holds the cloud of a frame, or would hold it.
    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf;

    /// The file that holds the labels of a frame, or would hold them.
    fn labels_path(&self, root: &Path, id: &str) -> PathBuf;

    /// Whether the frame has a cloud.
    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        self.cloud_path(root, id).is_file()
    }

    /// Whether the data set has labels at all; without, its frames have no objects.
    fn has_labels(&self, root: &Path) -> bool;

    /// Whether the clouds have an intensity, as far as the data say so.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError>;

    /// The cloud of a frame, checked as [`crate::read_cloud`] does.
    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError>;

    /// Number of points of a frame. A layout that knows it without reading the points says so.
    fn count_points(&self, root: &Path, id: &str, columns: PointColumns) -> Result<usize, DataError> {
        Ok(self.read_cloud(root, id, columns)?.len())
    }

    /// The labels of a frame in their label frame, DontCare included.
    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError>;

    /// Whether data of this layout can have a camera's calibration.
    fn knows_camera(&self) -> bool {
        false
    }

    /// The label frame of a data set that does not name one.
    fn usual_label_frame(&self, _root: &Path) -> LabelFrame {
        LabelFrame::Lidar
    }

    /// The file that holds the calibration of a frame, or would hold it.
    fn calibration_path(&self, _root: &Path, _id: &str) -> Option<PathBuf> {
        None
    }

    /// The calibration of a frame.
    fn read_calibration(&self, root: &Path, _id: &str) -> Result<Calibration, DataError> {
        Err(DataError::file(root, format!("the layout {} has no calibration", self.name())))
    }

    /// When the frame was taken, s from a start that all frames of the data set share.
    fn stamp_s(&self, _root: &Path, _id: &str) -> Result<Option<f64>, DataError> {
        Ok(None)
    }

    /// Pose of the LiDAR in a world that all frames of the data set share.
    fn world_from_lidar(&self, _root: &Path, _id: &str) -> Result<Option<Pose>, DataError> {
        Ok(None)
    }

    /// What is known of the points of a frame beside place and intensity.
    fn read_point_details(&self, _root: &Path, _id: &str) -> Result<PointDetails, DataError> {
        Ok(PointDetails::default())
    }

    /// The folders that writing puts files into, relative to the root.
    fn folders(&self) -> &'static [&'static str];

    /// Writes the cloud of a frame.
    fn write_cloud(&self, root: &Path, id: &str, cloud: &Cloud) -> Result<(), DataError>;

    /// Writes the labels of a frame, in the label frame of the data set.
    fn write_labels(&self, root: &Path, id: &str, labels: &[LabelBox]) -> Result<(), DataError>;

    /// Writes a frame, its labels in the label frame "lidar".
    fn write_frame(&self, root: &Path, frame: &Frame) -> Result<(), DataError> {
        self.write_cloud(root, &frame.id, &frame.cloud)?;
        self.write_labels(root, &frame.id, &label_boxes(frame))
    }
}

/// What a recording may know of each point of a cloud, in the order of its points; `None`: not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointDetails {
    /// Number of the laser.
    pub ring: Option<Vec<u16>>,
    /// Time of the shot after the frame's stamp, s.
    pub time_s: Option<Vec<f32>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Object;
    use geometry::Box3;

    #[test]
    fn layouts_are_named_as_a_toml_spells_them() {
        for layout in Layout::ALL {
            assert_eq!(serde_json::to_value(layout).unwrap(), layout.name());
        }
        assert_eq!(Layout::default(), Layout::Kitti);
    }

    /// Every layout has to pass this.
    #[test]
    fn what_a_layout_writes_it_finds_and_reads() {
        let object = Object {
            class: "Car".into(),
            bbox: Box3::from_array([10.5, -2.25, -0.9, 4.1, 1.7, 1.5, 0.3]),
            truncation: None,
            occlusion: None,
            image_box: None,
        };
        let frame = Frame {
            id: "000007".into(),
            cloud: Cloud { values: vec![1.0, 2.0, 3.0, 0.5, -4.0, 5.0, 6.0, 0.25], channels: 4 },
            objects: vec![object],
        };
        for layout in Layout::ALL {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path();
            assert!(layout.check_root(root).is_err() && layout.recognise(root).is_none() && !layout.has_labels(root));
            layout.write_frame(root, &frame).unwrap();
            layout.check_root(root).unwrap();
            let found = layout.recognise(root).unwrap();
            assert_eq!((found.layout, found.root.as_path()), (*layout, root));
            assert_eq!(layout.frame_ids(root).unwrap(), ["000007"]);
            assert!(layout.has_cloud(root, "000007") && !layout.has_cloud(root, "000008"));
            assert!(layout.has_labels(root) && layout.has_intensity(root).unwrap());
            assert_eq!(layout.read_cloud(root, "000007", PointColumns::Xyzi).unwrap(), frame.cloud);
            assert_eq!(layout.count_points(root, "000007", PointColumns::Xyzi).unwrap(), 2);
            assert_eq!(layout.read_labels(root, "000007").unwrap(), label_boxes(&frame));
            for path in [layout.cloud_path(root, "000007"), layout.labels_path(root, "000007")] {
                assert!(layout.folders().iter().any(|inside| path.parent() == Some(&root.join(inside))));
            }
            assert_eq!(layout.stamp_s(root, "000007").unwrap(), None);
            assert_eq!(layout.world_from_lidar(root, "000007").unwrap(), None);
            assert_eq!(layout.read_point_details(root, "000007").unwrap(), PointDetails::default());
        }
    }
}
