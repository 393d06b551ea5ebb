//! Recordings of ROS 2: topics with `sensor_msgs/msg/PointCloud2` in CDR. Read only.
//!
//! What holds the messages is a layout of its own: MCAP ([`super::mcap_file`]) or SQLite ([`super::db3`]). The root of
//! the data set is a file, or a folder of rosbag2, and behind a `#` the topic: `drive.mcap#/front/points`. The topic
//! may be left out if there is one with clouds. Frames are numbered in the order of their log times. Poses come from
//! `/tf` and `/tf_static` or from odometry.

mod cdr;
mod files;
mod point_cloud2;
mod transforms;

use super::{DataLayout, Moment, PointDetails};
use crate::cloud_file::check_cloud;
use crate::limits::MOST_CLOUD_BYTES;
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use std::borrow::Cow;
use std::collections::{BTreeSet, HashMap};
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::SystemTime;
use transforms::Transforms;

/// Names of the types in ROS 2 and in bags that were converted from ROS 1.
pub(super) const CLOUD: &str = "sensor_msgs/msg/PointCloud2";
pub(super) const TF: &str = "tf2_msgs/msg/TFMessage";
pub(super) const ODOMETRY: &str = "nav_msgs/msg/Odometry";

/// What a frame of Zstandard begins with. CDR begins with a zero byte.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xB5, 0x2F, 0xFD];

/// A layout whose files hold messages of ROS 2.
pub(super) struct Bags {
    pub layout: Layout,
    pub name: &'static str,
    /// Of the files, without the full stop.
    pub extension: &'static str,
    pub markers: &'static [&'static str],
    /// Refuses a file before each use, also one that is open.
    pub check: fn(&Path) -> Result<(), DataError>,
    /// Opens a file.
    pub open: fn(&Path) -> Result<Box<dyn BagFile>, DataError>,
}

/// A file with messages.
pub(super) trait BagFile: Send + Sync {
    /// All topics that a reader of clouds and poses needs, in any order.
    fn topics(&self) -> Vec<Topic>;

    /// Places of all messages of a channel.
    fn places(&self, channel: i64) -> Result<Vec<Place>, DataError>;

    /// The data of a message.
    fn message(&self, channel: i64, place: Place) -> Result<Vec<u8>, DataError>;

    /// Calls `visit` with the channel and the data of all messages of some channels.
    fn all(&self, channels: &[i64], visit: &mut Visit) -> Result<(), DataError>;
}

/// Called with channel and data of a message; returns what is wrong with it.
pub(super) type Visit<'a> = dyn FnMut(i64, &[u8]) -> Result<(), String> + 'a;

/// A channel of a file: its number, topic, type and encoding. A topic may have several.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Topic {
    pub channel: i64,
    pub name: String,
    pub kind: String,
    pub encoding: String,
}

/// Place of a message in its file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    /// ns since 1970.
    pub log_time: i64,
    /// The chunk of an MCAP file, else 0.
    pub chunk: usize,
    /// Which of the chunk's messages of its channel it is; the id of a row of SQLite.
    pub number: i64,
}

/// The clouds of one topic.
struct Clouds {
    files: Vec<(PathBuf, Box<dyn BagFile>)>,
    /// File, channel and place of each message.
    places: Vec<(usize, i64, Place)>,
}

/// Recordings that stay open.
const MOST_OPEN: usize = 64;

/// Recordings that are open, with the state of their files.
static OPEN: Mutex<Option<HashMap<PathBuf, Opened>>> = Mutex::new(None);

/// Path, length and time of change of each file.
type State = Vec<(PathBuf, u64, Option<SystemTime>)>;
type Opened = (State, Arc<Clouds>);

impl DataLayout for Bags {
    fn name(&self) -> &'static str {
        self.name
    }

    fn markers(&self) -> &'static [&'static str] {
        self.markers
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        self.has_files(folder).ok().filter(|has| *has)?;
        Some(DatasetConfig { layout: self.layout, root: folder.into(), ..DatasetConfig::default() })
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        self.clouds(root).map(drop)
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        Ok((0..self.clouds(root)?.places.len()).map(|i| format!("{i:06}")).collect())
    }

    /// The file that has the frame; the first one if there is no such frame.
    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        self.clouds(root).map_or_else(|_| root.into(), |clouds| clouds.path(root, id).into())
    }

    fn labels_path(&self, root: &Path, id: &str) -> PathBuf {
        self.cloud_path(root, id).with_extension("labels").join(format!("{id}.txt"))
    }

    fn has_cloud(&self, root: &Path, id: &str) -> bool {
        self.clouds(root).is_ok_and(|clouds| clouds.place(root, id).is_ok())
    }

    fn has_labels(&self, _root: &Path) -> bool {
        false
    }

    /// From the first cloud.
    fn has_intensity(&self, root: &Path) -> Result<bool, DataError> {
        Ok(self.clouds(root)?.read(root, "000000")?.channels == 4)
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let message = self.clouds(root)?.read(root, id)?;
        let cloud = Cloud { values: message.values, channels: message.channels };
        check_cloud(&cloud, &frame_path(root, id))?;
        Ok(if cloud.channels > columns.channels() { cloud.with_channels(columns.channels()) } else { cloud })
    }

    fn read_labels(&self, _root: &Path, _id: &str) -> Result<Vec<LabelBox>, DataError> {
        Ok(Vec::new())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let clouds = self.clouds(root)?;
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
        let message = self.clouds(root)?.read(root, id)?;
        Ok(PointDetails { ring: message.ring, time_s: message.time_s, ..PointDetails::default() })
    }
}

impl Clouds {
    fn place(&self, root: &Path, id: &str) -> Result<(usize, i64, Place), DataError> {
        let number = id.parse::<usize>().ok().filter(|n| format!("{n:06}") == id);
        let place = number.and_then(|n| self.places.get(n)).copied();
        place.ok_or_else(|| {
            DataError::file(root, format!("has no frame {id:?}; there are {} from 000000", self.places.len()))
        })
    }

    fn path(&self, root: &Path, id: &str) -> &Path {
        let file = self.place(root, id).map_or(0, |(file, ..)| file);
        &self.files[file].0
    }

    /// What `parse` reads of the message of a frame.
    fn parsed<T>(&self, root: &Path, id: &str, parse: fn(&[u8]) -> Result<T, String>) -> Result<T, DataError> {
        let (file, channel, place) = self.place(root, id)?;
        let (path, bag) = &self.files[file];
        let message = bag.message(channel, place)?;
        let wrong = |e| DataError::file(path, format!("frame {id}: its PointCloud2 cannot be read: {e}"));
        decompressed(&message).and_then(|message| parse(&message)).map_err(wrong)
    }

    fn read(&self, root: &Path, id: &str) -> Result<point_cloud2::Message, DataError> {
        self.parsed(root, id, point_cloud2::parse)
    }

    fn header(&self, root: &Path, id: &str) -> Result<cdr::Header, DataError> {
        self.parsed(root, id, point_cloud2::header)
    }

    fn transforms(&self) -> Result<Transforms, DataError> {
        let mut transforms = Transforms::default();
        // What `/tf` says stands; odometry adds what it does not say.
        for kind in [TF, ODOMETRY] {
            for (_, bag) in &self.files {
                let topics: Vec<Topic> = bag.topics().into_iter().filter(|t| t.kind == kind).collect();
                let is_fixed = |t: &&Topic| t.name.ends_with("tf_static");
                let fixed: Vec<i64> = topics.iter().filter(is_fixed).map(|t| t.channel).collect();
                let channels: Vec<i64> = topics.iter().map(|t| t.channel).collect();
                bag.all(&channels, &mut |channel, data| {
                    let message = decompressed(data)?;
                    match kind {
                        TF => transforms.add_tf(&message, fixed.contains(&channel)),
                        _ => transforms.add_odometry(&message),
                    }
                })?;
            }
        }
        Ok(transforms)
    }
}

/// A message that rosbag2 compressed by itself (`compression_mode: MESSAGE`); any other as it is.
fn decompressed(message: &[u8]) -> Result<Cow<'_, [u8]>, String> {
    if !message.starts_with(&ZSTD_MAGIC) {
        return Ok(message.into());
    }
    let mut bytes = Vec::new();
    let decoder = zstd::stream::read::Decoder::new(message).map_err(|e| e.to_string())?;
    let read = decoder.take(MOST_CLOUD_BYTES + 1).read_to_end(&mut bytes);
    read.map_err(|e| format!("it cannot be decompressed (Zstandard): {e}"))?;
    if bytes.len() as u64 > MOST_CLOUD_BYTES {
        return Err(format!("it is larger than {MOST_CLOUD_BYTES} bytes when decompressed"));
    }
    Ok(bytes.into())
}

/// What error messages name for a frame.
fn frame_path(root: &Path, id: &str) -> PathBuf {
    PathBuf::from(format!("{} frame {id}", root.display()))
}

impl Bags {
    /// The clouds of a root, from the recordings that are open.
    fn clouds(&self, root: &Path) -> Result<Arc<Clouds>, DataError> {
        let (files, topic) = self.files_and_topic(root)?;
        let mut state = State::new();
        for path in files {
            (self.check)(&path)?;
            let metadata = fs_err::metadata(&path)?;
            state.push((path, metadata.len(), metadata.modified().ok()));
        }
        let mut open = OPEN.lock().unwrap_or_else(PoisonError::into_inner);
        let open = open.get_or_insert_with(HashMap::new);
        if let Some((opened, clouds)) = open.get(root)
            && *opened == state
        {
            return Ok(clouds.clone());
        }
        let clouds = Arc::new(self.opened(root, &state, topic)?);
        if open.len() >= MOST_OPEN {
            open.clear();
        }
        open.insert(root.into(), (state, clouds.clone()));
        Ok(clouds)
    }

    fn opened(&self, root: &Path, state: &State, topic: Option<String>) -> Result<Clouds, DataError> {
        let open = |(path, ..): &(PathBuf, _, _)| Ok((path.clone(), (self.open)(path)?));
        let files: Vec<(PathBuf, Box<dyn BagFile>)> = state.iter().map(open).collect::<Result<_, DataError>>()?;
        // Errors name the folder of a recording in several files, but the file of one in a single file.
        let place = if let [(path, _)] = &files[..] { path.as_path() } else { files::split(root).0 };
        let wrong = |message: String| Err(DataError::file(place, message));
        let channels: Vec<(usize, Topic)> = files
            .iter()
            .enumerate()
            .flat_map(|(i, (_, bag))| bag.topics().into_iter().map(move |topic| (i, topic)))
            .filter(|(_, topic)| topic.kind == CLOUD)
            .collect();
        let names: BTreeSet<&str> = channels.iter().map(|(_, t)| t.name.as_str()).collect();
        let listed = || names.iter().map(|name| format!("{}#{name}", place.display())).collect::<Vec<_>>().join(", ");
        let chosen = match (topic.as_deref(), names.first(), names.len()) {
            (_, None, _) => return wrong(format!("has no topic with {CLOUD}")),
            (None, Some(one), 1) => *one,
            (None, ..) => return wrong(format!("has several topics with clouds; choose one of {}", listed())),
            (Some(name), ..) if names.contains(name) => name,
            (Some(name), ..) => return wrong(format!("has no topic {name:?} with clouds; it has {}", listed())),
        };
        let mut places = Vec::new();
        for (file, topic) in channels.iter().filter(|(_, topic)| topic.name == chosen) {
            if topic.encoding != "cdr" {
                return wrong(format!("its topic {chosen} has the encoding {:?}; cdr is read", topic.encoding));
            }
            let found = files[*file].1.places(topic.channel)?;
            places.extend(found.into_iter().map(|place| (*file, topic.channel, place)));
        }
        if places.is_empty() {
            return wrong(format!("its topic {chosen} has no message"));
        }
        places.sort_by_key(|(file, _, place)| (place.log_time, *file, place.chunk, place.number));
        Ok(Clouds { files, places })
    }
}

#[cfg(test)]
pub(super) mod tests;
