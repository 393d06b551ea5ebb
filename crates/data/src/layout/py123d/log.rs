//! A log: its tables, and what of them stays in memory.

use super::super::TrackedObject;
use super::super::arrow_file::{ArrowFile, is_stream, read_stream};
use super::super::pose_text::check_box;
use super::super::recent::{Recent, State, state};
use super::super::table::Table;
use super::tables::{RINGS, WorldBox, read_boxes, read_poses, sensors, stem};
use crate::DataError;
use geometry::{Box3, Pose, yaw_rad};
use nalgebra::Translation3;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The table of moments: for each the rows of the other tables.
pub(super) const SYNC: &str = "sync.arrow";
/// The table of labels.
pub(super) const BOXES: &str = "box_detections_se3.arrow";
/// The table of poses.
const POSES: &str = "ego_state_se3.arrow";
/// The table of the points of all LiDARs.
const MERGED: &str = "lidar.lidar_merged";

/// Names of the sensors by the number that points have.
const SENSORS: [&str; 8] = [
    "lidar_unknown",
    "lidar_merged",
    "lidar_top",
    "lidar_front",
    "lidar_side_left",
    "lidar_side_right",
    "lidar_back",
    "lidar_down",
];
/// The number of the upper LiDAR.
const TOP: i64 = 2;

/// What to do about a table that is missing.
const MISSING: &str = "does not exist: add this table of the log";

/// The rows of a moment in the other tables.
struct Rows {
    cloud: usize,
    pose: Option<usize>,
    boxes: Option<usize>,
}

/// The points of a frame.
pub(super) struct Scan {
    /// x, y, z (m, LiDAR frame) of each point, and its intensity, 0 to 1, if it is known.
    pub values: Vec<f32>,
    /// 3 or 4.
    pub channels: usize,
    /// Row of each point.
    pub rings: Option<Vec<u16>>,
    /// Time of each point, s since the stamp.
    pub times_s: Option<Vec<f32>>,
}

/// A log with what all of its frames need.
pub(super) struct Log {
    folder: PathBuf,
    /// Name of the table of points, without its ending.
    table: String,
    clouds: ArrowFile,
    /// The sensor that is read alone.
    alone: Option<i64>,
    /// Numbers of the sensors of the table, ascending.
    sensors: Vec<i64>,
    /// The origin of the LiDAR frame in the frame of the IMU, m.
    origin: Translation3<f64>,
    moments: BTreeMap<i64, Rows>,
    /// By row; `None` without the table of poses.
    world_from_imu: Option<Vec<Pose>>,
    /// By row, in the world.
    boxes: Vec<Vec<WorldBox>>,
    state: State,
}

/// The name of the table that has the points of a sensor, or of all. Alone, a sensor may have a table of its own.
fn table_of(folder: &Path, sensor: Option<&str>) -> Result<String, DataError> {
    let is_there = |name: &str| folder.join(format!("{name}.arrow")).is_file();
    if let Some(own) = sensor.map(|sensor| format!("lidar.{sensor}")).filter(|own| is_there(own)) {
        return Ok(own);
    }
    if is_there(MERGED) {
        return Ok(MERGED.into());
    }
    let own: Vec<&str> = SENSORS.into_iter().filter(|sensor| is_there(&format!("lidar.{sensor}"))).collect();
    match (&own[..], sensor) {
        ([one], None) => Ok(format!("lidar.{one}")),
        ([], _) => Err(DataError::missing(folder, "has no table of a LiDAR (lidar.*.arrow)")),
        (_, Some(sensor)) => {
            let message = format!("has no table of the sensor {sensor}: choose one of {}", own.join(", "));
            Err(DataError::file(folder, message))
        }
        (several, None) => {
            let first = several[0];
            let message = format!(
                "has a table for each of {}: choose one behind the root of the data set, as in `LOGS#{first}`",
                several.join(", ")
            );
            Err(DataError::file(folder, message))
        }
    }
}

/// The time stamps of the moments with a cloud, us, ascending.
pub(super) fn stamps(folder: &Path, sensor: Option<&str>) -> Result<Vec<i64>, DataError> {
    Ok(moments(folder, &table_of(folder, sensor)?)?.into_keys().collect())
}

/// The moments with a row in the table of points, by their stamps.
fn moments(folder: &Path, table: &str) -> Result<BTreeMap<i64, Rows>, DataError> {
    let sync = ArrowFile::open(&folder.join(SYNC))?.table()?;
    let mut moments = BTreeMap::new();
    if sync.rows() == 0 {
        return Ok(moments);
    }
    let rows = |name: &str| if sync.has(name) { sync.optional_integers(name) } else { Ok(vec![None; sync.rows()]) };
    let [clouds, poses, boxes] = [rows(table)?, rows(stem(POSES))?, rows(stem(BOXES))?];
    for (i, stamp) in sync.integers("sync.timestamp_us")?.into_iter().enumerate() {
        let row = |value: Option<i64>| {
            let row = value.map(usize::try_from).transpose();
            row.map_err(|_| sync.wrong(i, "the number of a row is negative"))
        };
        let Some(cloud) = row(clouds[i])? else { continue };
        let rows = Rows { cloud, pose: row(poses[i])?, boxes: row(boxes[i])? };
        if moments.insert(stamp, rows).is_some() {
            return Err(sync.wrong(i, &format!("sync.timestamp_us {stamp} occurs twice")));
        }
    }
    Ok(moments)
}

impl Log {
    /// A log, of which a sensor is read alone or all. It is read again if one of its tables has changed.
    ///
    /// # Errors
    /// Tables that are missing, damaged or have other columns, and a sensor that is not there.
    pub(super) fn open(folder: &Path, sensor: Option<&str>) -> Result<Arc<Log>, DataError> {
        static LOGS: Recent<(PathBuf, State), Log> = Recent::new();
        let table = table_of(folder, sensor)?;
        let path = folder.join(format!("{table}.arrow"));
        let others = [SYNC, POSES, BOXES].map(|name| folder.join(name));
        let mut paths: Vec<&Path> = vec![&path, &others[0]];
        paths.extend(others[1..].iter().filter(|other| other.is_file()).map(PathBuf::as_path));
        let state = state(&paths, MISSING)?;
        let key = PathBuf::from(format!("{}{}", path.display(), sensor.unwrap_or_default()));
        LOGS.get((key, state.clone()), || Log::read(folder, table, &path, sensor, state))
    }

    fn read(folder: &Path, table: String, path: &Path, sensor: Option<&str>, state: State) -> Result<Log, DataError> {
        let clouds = ArrowFile::open(path)?;
        let sensors = sensors(&clouds, table == MERGED)?;
        let number = |name: &str| SENSORS.iter().position(|known| *known == name).map(|i| i as i64);
        let alone = sensor.and_then(number);
        if sensor.is_some() && !alone.is_some_and(|alone| sensors.contains_key(&alone)) {
            let name = |id: &i64| usize::try_from(*id).ok().and_then(|id| SENSORS.get(id)).copied();
            let known: Vec<&str> = sensors.keys().filter_map(name).collect();
            let sensor = sensor.unwrap_or_default();
            return Err(clouds.wrong(&format!("has no sensor {sensor}: choose one of {}", known.join(", "))));
        }
        let first = alone.or(sensors.contains_key(&TOP).then_some(TOP)).or(sensors.keys().next().copied());
        let origin = first.and_then(|id| sensors.get(&id)).map_or(Translation3::identity(), |pose| pose.translation);
        let poses = folder.join(POSES);
        let boxes = folder.join(BOXES);
        Ok(Log {
            moments: moments(folder, &table)?,
            world_from_imu: if poses.is_file() { Some(read_poses(&poses)?) } else { None },
            boxes: if boxes.is_file() { read_boxes(&boxes)? } else { Vec::new() },
            folder: folder.into(),
            sensors: sensors.into_keys().collect(),
            table,
            clouds,
            alone,
            origin,
            state,
        })
    }

    /// The table of points.
    pub(super) fn cloud_path(&self) -> PathBuf {
        self.folder.join(format!("{}.arrow", self.table))
    }

    /// The table of labels.
    pub(super) fn labels_path(&self) -> PathBuf {
        self.folder.join(BOXES)
    }

    /// The table of points with the frame, for error messages.
    pub(super) fn frame_path(&self, stamp_us: i64) -> PathBuf {
        PathBuf::from(format!("{} frame {stamp_us}", self.cloud_path().display()))
    }

    /// The stamp of the first frame, us.
    pub(super) fn start_us(&self) -> i64 {
        self.moments.first_key_value().map_or(0, |(stamp, _)| *stamp)
    }

    /// Whether there is such a frame.
    pub(super) fn has(&self, stamp_us: i64) -> bool {
        self.moments.contains_key(&stamp_us)
    }

    fn rows(&self, stamp_us: i64) -> Result<&Rows, DataError> {
        let missing = || {
            let message = format!("has no row with sync.timestamp_us {stamp_us} and a cloud of {}", self.table);
            DataError::file(&self.folder.join(SYNC), message)
        };
        self.moments.get(&stamp_us).ok_or_else(missing)
    }

    /// The pose of the LiDAR frame in the world; `None` if the moment has no pose.
    ///
    /// # Errors
    /// There is no such frame, or the table of poses is too short.
    pub(super) fn world_from_lidar(&self, stamp_us: i64) -> Result<Option<Pose>, DataError> {
        let (Some(row), Some(poses)) = (self.rows(stamp_us)?.pose, &self.world_from_imu) else { return Ok(None) };
        let missing = || DataError::file(&self.folder.join(POSES), format!("has no row {row} (from 0)"));
        let pose = poses.get(row).ok_or_else(missing)?;
        Ok(Some(pose * self.origin))
    }

    /// The labelled objects of a frame, in the LiDAR frame. Boxes stand upright: roll and pitch are left out.
    ///
    /// # Errors
    /// There is no such frame, a table is too short, or a box is not valid.
    pub(super) fn objects(&self, stamp_us: i64) -> Result<Vec<TrackedObject>, DataError> {
        let Some(row) = self.rows(stamp_us)?.boxes else { return Ok(Vec::new()) };
        let wrong = |message: String| DataError::file(&self.labels_path(), format!("row {row} (from 0): {message}"));
        let boxes = self.boxes.get(row).ok_or_else(|| wrong("is missing".into()))?;
        if boxes.is_empty() {
            return Ok(Vec::new());
        }
        let pose = self.world_from_lidar(stamp_us)?;
        let pose =
            pose.ok_or_else(|| wrong(format!("its boxes are in the world, but {POSES} has no pose for them")))?;
        let lidar_from_world = pose.inverse();
        let object = |found: &WorldBox| {
            let lidar_from_box = lidar_from_world * found.world_from_box;
            let center = lidar_from_box.translation.vector.into();
            let bbox = Box3 { center, size: found.size, yaw_rad: yaw_rad(&lidar_from_box) };
            check_box(&bbox).map_err(|message| wrong(format!("track {:?}: {message}", found.track)))?;
            Ok(TrackedObject { track: found.track.clone(), class: found.class.clone(), bbox })
        };
        boxes.iter().map(object).collect()
    }

    /// The points of a frame.
    ///
    /// # Errors
    /// There is no such frame, its points are stored in a way that is not read, or they are damaged.
    pub(super) fn scan(&self, stamp_us: i64) -> Result<Arc<Scan>, DataError> {
        static SCANS: Recent<(PathBuf, State, Option<i64>), Scan> = Recent::new();
        let row = self.rows(stamp_us)?.cloud;
        let path = self.frame_path(stamp_us);
        SCANS.get((path.clone(), self.state.clone(), self.alone), || {
            let column = format!("{}.data", self.table);
            if self.clouds.has_texts(&column)? {
                let message = format!(
                    "column {column} has the paths of the original files: convert the log with \
                     lidar_store_option=binary lidar_codec=ipc_zstd (py123d), or read these files with their own layout"
                );
                return Err(self.clouds.wrong(&message));
            }
            let bytes = self.clouds.bytes(&column, row)?;
            let bytes = bytes.ok_or_else(|| DataError::file(&path, "its points are missing in the table"))?;
            self.read_scan(&read_points(&bytes, &path)?, &path, stamp_us)
        })
    }

    fn read_scan(&self, table: &Table, path: &Path, stamp_us: i64) -> Result<Scan, DataError> {
        let [x, y, z] = [table.reals("x")?, table.reals("y")?, table.reals("z")?];
        let some = |name: &str| table.has(name).then(|| table.integers(name)).transpose();
        let ids = some("ids")?;
        let kept: Vec<usize> = match (self.alone.filter(|_| self.sensors.len() > 1), &ids) {
            (None, _) => (0..x.len()).collect(),
            (Some(alone), Some(ids)) => (0..x.len()).filter(|i| ids[*i] == alone).collect(),
            (Some(_), None) => {
                return Err(DataError::file(path, "its points do not say of which sensor they are (column ids)"));
            }
        };
        let (intensity, channel, times) = (some("intensity")?, some("channel")?, some("timestamps")?);
        let origin = self.origin.vector;
        let mut values = Vec::with_capacity(kept.len() * 4);
        for &i in &kept {
            values.extend([x[i] - origin.x, y[i] - origin.y, z[i] - origin.z].map(|v| v as f32));
            values.extend(intensity.as_ref().map(|intensity| intensity[i] as f32 / 255.0));
        }
        // The place of a sensor among those of the table, as long as all are read.
        let place = |i: usize| {
            let id = ids.as_ref().filter(|_| self.alone.is_none())?;
            self.sensors.iter().position(|sensor| *sensor == id[i])
        };
        let ring = |channel: &[i64], i: usize| {
            let row = u16::try_from(channel[i]).ok().filter(|row| *row < RINGS);
            let row = row.ok_or_else(|| table.wrong(i, &format!("channel {} is not from 0 to 255", channel[i])))?;
            Ok(row + RINGS * place(i).unwrap_or(0) as u16)
        };
        let rings = channel.map(|channel| kept.iter().map(|i| ring(&channel, *i)).collect::<Result<_, DataError>>());
        let time = |stamp: i64| (stamp.wrapping_sub(stamp_us) as f64 * 1e-6) as f32;
        Ok(Scan {
            values,
            channels: if intensity.is_some() { 4 } else { 3 },
            rings: rings.transpose()?,
            times_s: times.map(|times| kept.iter().map(|i| time(times[*i])).collect()),
        })
    }
}

/// The table of the points of a frame.
fn read_points(bytes: &[u8], path: &Path) -> Result<Table, DataError> {
    if is_stream(bytes) {
        return read_stream(bytes, path);
    }
    let codec = [("LASF", "LAZ"), ("DRACO", "Draco")].into_iter().find(|(mark, _)| bytes.starts_with(mark.as_bytes()));
    let codec = codec.map_or("a way that is not known", |(_, name)| name);
    let message = format!("its points are stored in {codec}: convert the log with lidar_codec=ipc_zstd (py123d)");
    Err(DataError::file(path, message))
}
