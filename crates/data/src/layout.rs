//! Layouts: how the frames of a data set are stored on disk. A new layout is a file in this folder and a line in
//! `layouts!`.

mod arrow_file;
mod arrow_metadata;
mod bag;
mod feather;
mod file_names;
mod file_per_frame;
mod nuscenes_tables;
mod oxts;
pub(crate) mod parquet_file;
mod pose_text;
mod recent;
mod stamps;
pub(crate) mod table;
mod tracklets;
mod without_panic;

pub use stamps::StampUnit;

use crate::Presence as _;
use crate::write::label_boxes;
use crate::{Calibration, Cloud, DataError, DatasetConfig, FilePart, Frame, LabelBox, LabelFrame, PointColumns};
use geometry::{Box3, Pose};
use rayon::prelude::*;
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
        $(pub(crate) mod $module;)+

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
    Recording = recording: "A recorded drive: `velodyne/*.bin` with `poses.txt`, `labels.csv` and time stamps where known.";
    KittiRaw = kitti_raw: "A drive of KITTI raw: `velodyne_points/data`, `oxts/data`, `tracklet_labels.xml`.";
    KittiTracking = kitti_tracking: "KITTI's tracking benchmark: `velodyne/SSSS/`, `label_02`, `calib`, `oxts`.";
    KittiOdometry = kitti_odometry: "A sequence of KITTI odometry or SemanticKITTI: `velodyne`, `calib.txt`, poses.";
    Argoverse2 = argoverse2: "A log of Argoverse 2: `sensors/lidar/*.feather` with annotations and poses.";
    Py123d = py123d: "Logs of 123D (py123d): a folder of logs, or one log with `sync.arrow`; read only.";
    Waymo = waymo: "The Waymo Open Dataset, version 2: `lidar/*.parquet` beside the other components; read only.";
    Nuscenes = nuscenes: "nuScenes: tables in `v1.0-*/`, clouds in `samples/LIDAR_TOP` and `sweeps/LIDAR_TOP`.";
    NuscenesScans = nuscenes_scans: "Scans of nuScenes alone: a folder of `*.pcd.bin`.";
    Kitti = kitti: "`velodyne/*.bin`, `label_2/*.txt` and, if there is a camera, `calib/*.txt`.";
    OpenPcdet = open_pcdet: "OpenPCDet's custom data: `points/*.npy` and `labels/*.txt` (`x y z dx dy dz heading name`).";
    Carla = carla: "`*.ply` that CARLA's LiDARs wrote, y negated, and `label/*.txt` in the LiDAR frame.";
    Mcap = mcap_file: "Clouds of a topic of an MCAP file (ROS 2): `root = \"drive.mcap#/topic\"`; read only.";
    Db3 = db3: "Clouds of a topic of a recording of rosbag2 in SQLite: `root = \"drive_0.db3#/topic\"`; read only.";
    S2rDad = s2r_dad: "`data/pcl/*.pcd` and `data/label/*.txt`, without calibration.";
    Shards = shards: "Frames in `shards/*.tar`, as `convert --to shards` writes them: members `ID.bin` or `ID.pcd`, `ID.txt`.";
}

/// Whether the name is that of a file that is itself a data set.
pub(crate) fn is_recording(path: &Path) -> bool {
    [&mcap_file::Mcap, &db3::Db3].iter().any(|bags| bags.names(path))
}

// The table has no mark for the default.
#[allow(clippy::derivable_impls)]
impl Default for Layout {
    fn default() -> Self {
        Layout::Kitti
    }
}

/// Finds, reads and writes the frames of one layout. `root` is the root folder of a data set, `id` the id of a frame.
///
/// Methods with a default are for optional data. The default is "not known" or "does not exist". A layout that names no
/// folders for writing is read-only: its methods that write return an error.
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

    /// Where the bytes of the cloud of a frame are. Layouts with several frames in a file override this.
    ///
    /// # Errors
    /// There is no such frame.
    fn cloud_part(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        Ok(self.cloud_path(root, id).into())
    }

    /// As [`Self::cloud_part`], of the labels, which need not exist.
    ///
    /// # Errors
    /// There is no such frame.
    fn labels_part(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        Ok(self.labels_path(root, id).into())
    }

    /// As [`Self::cloud_part`], without a look at the file. Layouts with an index override this.
    ///
    /// # Errors
    /// There is no such frame.
    fn cloud_place(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        self.cloud_part(root, id)
    }

    /// As [`Self::cloud_place`], of the labels.
    ///
    /// # Errors
    /// There is no such frame.
    fn labels_place(&self, root: &Path, id: &str) -> Result<FilePart, DataError> {
        self.labels_part(root, id)
    }

    /// Whether the frame has a cloud.
    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        self.cloud_path(root, id).may_be_file()
    }

    /// Index of the first of `ids` that has no cloud. The file system is asked in parallel.
    fn first_without_cloud(&self, root: &Path, ids: &[&str]) -> Option<usize> {
        ids.par_iter().position_first(|id| !self.has_cloud(root, id))
    }

    /// Whether the data set has labels. Without labels its frames have no objects.
    fn has_labels(&self, root: &Path) -> bool;

    /// Whether the clouds have an intensity; true if the files do not show it.
    fn has_intensity(&self, _root: &Path) -> Result<bool, DataError> {
        Ok(true)
    }

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

    /// The sequences of the data set: frames in a row that share a world. By default all frames are one.
    fn sequences(&self, root: &Path) -> Result<Vec<Sequence>, DataError> {
        Ok(vec![Sequence { name: String::new(), ids: self.frame_ids(root)? }])
    }

    /// Stamps, poses and tracked boxes of the frames `ids`, in their order. All frames belong to one sequence. A layout
    /// that knows nothing of them returns moments that hold the ids alone.
    fn moments(&self, _root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        Ok(ids.iter().map(|id| Moment::of(id)).collect())
    }

    /// Reads per-point data besides position and intensity.
    fn read_point_details(&self, _root: &Path, _id: &str) -> Result<PointDetails, DataError> {
        Ok(PointDetails::default())
    }

    /// The folders into which frames are written, relative to the root; empty if the layout is read-only.
    fn folders(&self) -> &'static [&'static str] {
        &[]
    }

    /// Writes the cloud of a frame.
    ///
    /// # Errors
    /// The layout is read-only, or the file cannot be written.
    fn write_cloud(&self, root: &Path, _id: &str, _cloud: &Cloud) -> Result<(), DataError> {
        Err(read_only(root, self.name()))
    }

    /// Writes the labels of a frame, in the label frame of the data set.
    ///
    /// # Errors
    /// The layout is read-only, or the file cannot be written.
    fn write_labels(&self, root: &Path, _id: &str, _labels: &[LabelBox]) -> Result<(), DataError> {
        Err(read_only(root, self.name()))
    }

    /// Writes cloud and labels of a frame. Labels are written in [`LabelFrame::Lidar`].
    fn write_frame(&self, root: &Path, frame: &Frame) -> Result<(), DataError> {
        self.write_cloud(root, &frame.id, &frame.cloud)?;
        self.write_labels(root, &frame.id, &label_boxes(frame))
    }
}

fn read_only(root: &Path, layout: &str) -> DataError {
    let writable: Vec<&str> = Layout::ALL.iter().filter(|l| !l.folders().is_empty()).map(|l| l.name()).collect();
    let message = format!("the layout {layout} is read-only; data sets are written in {}", writable.join(" or "));
    DataError::file(root, message)
}

/// Frames in a row that share a world and a clock.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Sequence {
    /// Name of the sequence; empty if the data set has only one.
    pub name: String,
    /// Ids of its frames in the order of time.
    pub ids: Vec<String>,
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

impl TrackedObject {
    /// The label in [`LabelFrame::Lidar`]. A track that is a number stays one.
    pub(crate) fn label_box(&self) -> LabelBox {
        let mut label = LabelBox::from_box(&self.class, &self.bbox, None);
        label.track = self.track.parse().ok();
        label
    }
}

/// Optional data of each point of a cloud, in the order of its points; `None` if not known.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PointDetails {
    /// Ring (laser channel), from 0.
    pub ring: Option<Vec<u16>>,
    /// Time of the point relative to the time stamp of the frame, s.
    pub time_s: Option<Vec<f32>>,
    /// Whether the point is labelled as part of something that moves.
    pub moving: Option<Vec<bool>>,
    /// Whether the motion of the sensor within the scan has been taken out of the points.
    pub compensated: Option<bool>,
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

    /// Layouts recognise their own folders and no empty one; those without folders for writing say that they have none.
    #[test]
    fn read_only_layouts_say_so() {
        let folder = tempfile::tempdir().unwrap();
        let (root, frame) = (folder.path(), frame());
        let writable = |layout: &&Layout| !layout.folders().is_empty();
        let written: Vec<&str> = Layout::ALL.iter().filter(writable).map(|layout| layout.name()).collect();
        assert_eq!(written, ["kitti", "open_pcdet", "carla", "s2r_dad"]);
        for layout in Layout::ALL {
            assert!(layout.check_root(root).is_err() && layout.recognise(root).is_none() && !layout.has_labels(root));
            assert!(layout.frame_ids(root).is_err() && !layout.has_cloud(root, "000007"));
            if writable(&layout) {
                continue;
            }
            let errors = [
                layout.write_cloud(root, "000007", &frame.cloud),
                layout.write_labels(root, "000007", &[]),
                layout.write_frame(root, &frame),
            ];
            for error in errors {
                let (error, name) = (error.unwrap_err().to_string(), layout.name());
                let written = written.join(" or ");
                let want = format!("the layout {name} is read-only; data sets are written in {written}");
                assert!(error.contains(&want), "{error}");
            }
        }
        assert_eq!(std::fs::read_dir(root).unwrap().count(), 0);
    }

    fn frame() -> Frame {
        let object = Object {
            class: "Car".into(),
            bbox: Box3::from_array([10.5, -2.25, -0.9, 4.1, 1.7, 1.5, 0.3]),
            truncation: None,
            occlusion: None,
            image_box: None,
        };
        Frame {
            id: "000007".into(),
            cloud: Cloud { values: vec![1.0, 2.0, 3.0, 0.5, -4.0, 5.0, 6.0, 0.25], channels: 4 },
            objects: vec![object],
        }
    }

    /// The contract of all layouts that are written.
    #[test]
    fn every_layout_reads_what_it_writes() {
        let frame = frame();
        for layout in Layout::ALL.iter().filter(|layout| !layout.folders().is_empty()) {
            let folder = tempfile::tempdir().unwrap();
            let root = folder.path();
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
