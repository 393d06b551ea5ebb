//! Layouts: how the frames of a data set are stored on disk. A new layout is a file in this folder and a line in
//! `layouts!`.

mod file_per_frame;

use crate::Presence as _;
use crate::write::label_boxes;
use crate::{Calibration, Cloud, DataError, DatasetConfig, Frame, LabelBox, LabelFrame, PointColumns};
use geometry::{Box3, Pose};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Deref;
use std::path::{Path, PathBuf};

/// Declares the modules and the enum [`Layout`]. Each line is `Type = module: "documentation";`.
///
/// The module has a unit type of this name that implements [`DataLayout`]. A data set's TOML has the name in snake
/// case. The documentation is shown in the reference of the configuration.
macro_rules! layouts {
    ($($name:ident = $module:ident: $doc:tt;)+) => {
        $(mod $module;)+

        /// Folders and files below the root of a data set.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
        #[serde(rename_all = "snake_case")]
        pub enum Layout {
            $(#[doc = $doc] $name,)+
        }

        impl Layout {
            /// All layouts, in the order in which they are tried on a folder without a TOML.
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
    Kitti = kitti: "`velodyne/*.bin`, `label_2/*.txt` and, if there is a camera, `calib/*.txt`.";
    S2rDad = s2r_dad: "`data/pcl/*.pcd` and `data/label/*.txt`, without calibration.";
}

impl Default for Layout {
    fn default() -> Self {
        Layout::ALL[0]
    }
}

/// Finds, reads and writes the frames of one layout. `root` is the root folder of a data set, `id` the id of a frame.
///
/// Methods with a default are for optional data. The default is "not known" or "does not exist".
pub trait DataLayout: Send + Sync {
    /// The name of the layout in a data set's TOML.
    fn name(&self) -> &'static str;

    /// Folders by which the layout is recognised without a TOML, for error messages.
    fn markers(&self) -> &'static [&'static str];

    /// The configuration of a folder without a TOML; `None` if the folder has another layout. Sets `root`; sets `name`
    /// and `splits` only if they differ from the defaults.
    fn recognise(&self, folder: &Path) -> Option<DatasetConfig>;

    /// An error that names the missing folder if `root` has no data of this layout.
    fn check_root(&self, root: &Path) -> Result<(), DataError>;

    /// The ids of all frames, sorted. An error if there is none.
    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError>;

    /// Path of the cloud of a frame, which need not exist.
    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf;

    /// Path of the labels of a frame, which need not exist.
    fn labels_path(&self, root: &Path, id: &str) -> PathBuf;

    /// Whether the frame has a cloud.
    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        self.cloud_path(root, id).may_be_file()
    }

    /// Whether the data set has labels. Without labels its frames have no objects.
    fn has_labels(&self, root: &Path) -> bool;

    /// Whether the clouds have an intensity; true if the files do not show it.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError>;

    /// Reads the cloud of a frame, with the checks of [`crate::read_cloud`].
    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError>;

    /// Number of points of a frame. Layouts override this if they need not read the points.
    fn count_points(&self, root: &Path, id: &str, columns: PointColumns) -> Result<usize, DataError> {
        Ok(self.read_cloud(root, id, columns)?.len())
    }

    /// Reads the labels of a frame in the label frame, DontCare included.
    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError>;

    /// Whether the layout supports a camera calibration.
    fn supports_calibration(&self) -> bool {
        false
    }

    /// The label frame if the TOML does not give one.
    fn default_label_frame(&self, _root: &Path) -> LabelFrame {
        LabelFrame::Lidar
    }

    /// Path of the calibration of a frame, which need not exist; `None` if the layout has no calibration.
    fn calibration_path(&self, _root: &Path, _id: &str) -> Option<PathBuf> {
        None
    }

    /// Reads the calibration of a frame.
    fn read_calibration(&self, root: &Path, _id: &str) -> Result<Calibration, DataError> {
        Err(DataError::file(root, format!("the layout {} has no calibration", self.name())))
    }

    /// Stamps, poses and tracked boxes of the frames `ids`, in their order. A layout that knows nothing of them returns
    /// moments that hold the ids alone.
    fn moments(&self, _root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        Ok(ids.iter().map(|id| Moment::of(id)).collect())
    }

    /// Reads per-point data besides position and intensity.
    fn read_point_details(&self, _root: &Path, _id: &str) -> Result<PointDetails, DataError> {
        Ok(PointDetails::default())
    }

    /// The folders into which frames are written, relative to the root.
    fn folders(&self) -> &'static [&'static str];

    /// Writes the cloud of a frame.
    fn write_cloud(&self, root: &Path, id: &str, cloud: &Cloud) -> Result<(), DataError>;

    /// Writes the labels of a frame, in the label frame of the data set.
    fn write_labels(&self, root: &Path, id: &str, labels: &[LabelBox]) -> Result<(), DataError>;

    /// Writes cloud and labels of a frame. Labels are written in [`LabelFrame::Lidar`].
    fn write_frame(&self, root: &Path, frame: &Frame) -> Result<(), DataError> {
        self.write_cloud(root, &frame.id, &frame.cloud)?;
        self.write_labels(root, &frame.id, &label_boxes(frame))
    }
}

/// What a recording knows of the moment of a frame besides its points.
#[derive(Clone, Debug, PartialEq)]
pub struct Moment {
    /// Id of the frame.
    pub id: String,
    /// Time stamp, s since a start that all frames share; `None` if it is not known.
    pub stamp_s: Option<f64>,
    /// Pose of the LiDAR frame at the time stamp, in a world frame (z up) that all frames share; `None` if it is not
    /// known.
    pub world_from_lidar: Option<Pose>,
    /// Labelled boxes that carry a track, in the LiDAR frame at the time stamp.
    pub objects: Vec<TrackedObject>,
}

impl Moment {
    /// A moment of which nothing but the id of its frame is known.
    pub fn of(id: &str) -> Moment {
        Moment { id: id.into(), stamp_s: None, world_from_lidar: None, objects: Vec::new() }
    }
}

/// A labelled object that is known again in other frames.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackedObject {
    /// Name of the track, the same in all frames that show the object.
    pub track: String,
    /// Class as in the label file.
    pub class: String,
    /// Box in the LiDAR frame at the time stamp, m and rad.
    pub bbox: Box3,
}

/// Optional data of each point of a cloud, in the order of its points; `None` if not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointDetails {
    /// Ring (laser channel), from 0.
    pub ring: Option<Vec<u16>>,
    /// Time of the point relative to the time stamp of the frame, s.
    pub time_s: Option<Vec<f32>>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Object;

    #[test]
    fn layout_names_are_those_of_the_toml() {
        for layout in Layout::ALL {
            assert_eq!(serde_json::to_value(layout).unwrap(), layout.name());
        }
        assert_eq!(Layout::default(), Layout::Kitti);
    }

    /// The contract of all layouts.
    #[test]
    fn every_layout_reads_what_it_writes() {
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
            assert_eq!(layout.moments(root, &["000007".into()]).unwrap(), [Moment::of("000007")]);
            assert_eq!(layout.read_point_details(root, "000007").unwrap(), PointDetails::default());
        }
    }
}
