//! MCAP files of ROS 2 with `sensor_msgs/msg/PointCloud2` in CDR. Read only.
//!
//! The root of the data set is the file, or a folder with one file (rosbag2), and behind a `#` the topic:
//! `drive.mcap#/front/points`. The topic may be left out if there is one with clouds. Frames are numbered in the order
//! of their log times. Poses come from `/tf` and `/tf_static` or from odometry.

mod cdr;
mod index;
mod point_cloud2;
mod transforms;

use super::{DataLayout, Moment, PointDetails};
use crate::cloud_file::check_cloud;
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use index::{Place, Recording};
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;
use transforms::Transforms;

/// Clouds in MCAP files.
pub(super) struct Mcap;

/// Names of the types in ROS 2 and in bags that were converted from ROS 1.
const CLOUD: &str = "sensor_msgs/msg/PointCloud2";
const TF: &str = "tf2_msgs/msg/TFMessage";
const ODOMETRY: &str = "nav_msgs/msg/Odometry";

/// The clouds of one topic.
struct Clouds {
    recording: Recording,
    channel: u16,
    places: Vec<Place>,
}

/// Files that are open, with what their index said, and when and how large they were.
static OPEN: Mutex<Option<HashMap<PathBuf, Opened>>> = Mutex::new(None);

/// Length, time of change and content.
type Opened = (u64, Option<SystemTime>, Arc<Clouds>);

impl DataLayout for Mcap {
    fn name(&self) -> &'static str {
        "mcap"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["*.mcap (ROS 2)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        file_and_topic(folder).ok()?;
        Some(DatasetConfig { layout: Layout::Mcap, root: folder.into(), ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        clouds(root).map(drop)
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        Ok((0..clouds(root)?.places.len()).map(|i| format!("{i:06}")).collect())
    }

    fn cloud_path(&self, root: &Path, _id: &str) -> PathBuf {
        file_and_topic(root).map_or_else(|_| root.into(), |(file, _)| file)
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        self.cloud_path(root, id).with_extension("labels").join(format!("{id}.txt"))
    }

    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        clouds(root).is_ok_and(|clouds| clouds.place(root, id).is_ok())
    }

    fn has_labels(&self, _root: &Path) -> bool {
        false
    }

    /// From the first cloud.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        Ok(clouds(root)?.read(root, "000000")?.channels == 4)
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let message = clouds(root)?.read(root, id)?;
        let cloud = Cloud { values: message.values, channels: message.channels };
        check_cloud(&cloud, &frame_path(root, id))?;
        Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud })
    }

    fn read_labels(&self, _root: &Path, _id: &str) -> Result<Vec<LabelBox>, DataError> {
        Ok(Vec::new())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let clouds = clouds(root)?;
        let transforms = clouds.transforms()?;
        let mut moments = Vec::new();
        let start_ns = clouds.header(root, "000000")?.stamp_ns;
        for id in ids {
            let header = clouds.header(root, id)?;
            moments.push(Moment {
                stamp_s: Some((header.stamp_ns - start_ns) as f64 * 1e-9),
                world_from_lidar: transforms.world_from(&header.frame, header.stamp_ns),
                ..Moment::of(id)
            });
        }
        Ok(moments)
    }

    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let message = clouds(root)?.read(root, id)?;
        Ok(PointDetails { ring: message.ring, time_s: message.time_s, ..PointDetails::default() })
    }
}

impl Clouds {
    fn place(&self, root: &Path, id: &str) -> Result<Place, DataError> {
        let number = id.parse::<usize>().ok().filter(|n| format!("{n:06}") == id);
        let place = number.and_then(|n| self.places.get(n)).copied();
        place.ok_or_else(|| {
            DataError::file(root, format!("has no frame {id:?}; there are {} from 000000", self.places.len()))
        })
    }

    fn bytes(&self, root: &Path, id: &str) -> Result<Vec<u8>, DataError> {
        self.recording.message(self.channel, self.place(root, id)?)
    }

    fn read(&self, root: &Path, id: &str) -> Result<point_cloud2::Message, DataError> {
        let wrong = |e| DataError::file(root, format!("frame {id}: its PointCloud2 cannot be read: {e}"));
        point_cloud2::parse(&self.bytes(root, id)?).map_err(wrong)
    }

    fn header(&self, root: &Path, id: &str) -> Result<cdr::Header, DataError> {
        let wrong = |e| DataError::file(root, format!("frame {id}: its PointCloud2 cannot be read: {e}"));
        point_cloud2::header(&self.bytes(root, id)?).map_err(wrong)
    }

    fn transforms(&self) -> Result<Transforms, DataError> {
        let of = |kind: &str| self.recording.topics(kind);
        let (tf, odometry) = (of(TF), of(ODOMETRY));
        let fixed: Vec<u16> = tf.iter().filter(|t| t.name.ends_with("tf_static")).map(|t| t.channel).collect();
        let moving: Vec<u16> = tf.iter().map(|t| t.channel).collect();
        let odometry: Vec<u16> = odometry.iter().map(|t| t.channel).collect();
        let mut transforms = Transforms::default();
        self.recording.all(&moving, |channel, data| transforms.add_tf(data, fixed.contains(&channel)))?;
        // What `/tf` says stands; odometry adds what it does not say.
        self.recording.all(&odometry, |_, data| transforms.add_odometry(data))?;
        Ok(transforms)
    }
}

/// What error messages name for a frame.
fn frame_path(root: &Path, id: &str) -> PathBuf {
    PathBuf::from(format!("{} frame {id}", root.display()))
}

/// The file of a root, and the topic if it names one.
fn file_and_topic(root: &Path) -> Result<(PathBuf, Option<String>), DataError> {
    let text = root.to_string_lossy();
    let (place, topic) = match text.split_once('#') {
        Some((place, topic)) if !root.exists() => (Path::new(place), Some(topic.to_string())),
        _ => (root, None),
    };
    let is_mcap = |path: &Path| path.extension().is_some_and(|e| e == "mcap") && path.is_file();
    if is_mcap(place) {
        return Ok((place.into(), topic));
    }
    let mut files = Vec::new();
    if place.is_dir() {
        for entry in fs_err::read_dir(place)? {
            files.push(entry?.path());
        }
    }
    files.retain(|path| is_mcap(path));
    files.sort();
    match &files[..] {
        [file] => Ok((file.clone(), topic)),
        [] => Err(DataError::file(place, "is no .mcap file and has none: check `root` and `layout` of the data set")),
        several => {
            let names: Vec<String> = several.iter().map(|f| f.display().to_string()).collect();
            Err(DataError::file(place, format!("has several .mcap files; name one as `root`: {}", names.join(", "))))
        }
    }
}

/// The clouds of a root, from the files that are open.
fn clouds(root: &Path) -> Result<Arc<Clouds>, DataError> {
    let (file, topic) = file_and_topic(root)?;
    let metadata = fs_err::metadata(&file)?;
    let (length, changed) = (metadata.len(), metadata.modified().ok());
    let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
    let open = open.get_or_insert_with(HashMap::new);
    if let Some((l, c, clouds)) = open.get(root)
        && (*l, *c) == (length, changed)
    {
        return Ok(clouds.clone());
    }
    let recording = Recording::open(&file)?;
    let topics = recording.topics(CLOUD);
    let listed = || topics.iter().map(|t| format!("{}#{}", file.display(), t.name)).collect::<Vec<_>>().join(", ");
    let chosen = match (&topic, &topics[..]) {
        (_, []) => return Err(DataError::file(&file, format!("has no topic with {CLOUD}"))),
        (None, [one]) => one,
        (None, _) => {
            let message = format!("has several topics with clouds; choose one of {}", listed());
            return Err(DataError::file(&file, message));
        }
        (Some(name), _) => topics
            .iter()
            .find(|t| t.name == *name)
            .ok_or_else(|| DataError::file(&file, format!("has no topic {name:?} with clouds; it has {}", listed())))?,
    };
    if chosen.encoding != "cdr" {
        let message = format!("its topic {} has the encoding {:?}; cdr is read", chosen.name, chosen.encoding);
        return Err(DataError::file(&file, message));
    }
    let places = recording.places(chosen.channel)?;
    if places.is_empty() {
        return Err(DataError::file(&file, format!("its topic {} has no message", chosen.name)));
    }
    let clouds = Arc::new(Clouds { channel: chosen.channel, places, recording });
    open.insert(root.into(), (length, changed, clouds.clone()));
    Ok(clouds)
}

#[cfg(test)]
mod tests;
