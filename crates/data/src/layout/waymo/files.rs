//! The files of a segment, and what of them stays in memory.

use super::super::TrackedObject;
use super::super::parquet_file::{ParquetFile, Rows};
use super::super::pose_text::check_box;
use super::super::recent::{Recent, State, state};
use super::range_image::{Columns, Inclinations, Laser, Scan, pose_from_matrix};
use crate::DataError;
use crate::limits::{MOST_BOXES, at_most};
use geometry::{Box3, Pose};
use nalgebra::Translation3;
use std::collections::{BTreeMap, HashMap};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

/// The sensor on the roof, whose place is the origin of the LiDAR frame.
pub(super) const TOP: i64 = 1;

/// Sensors: top, front, left, right, rear.
const LASERS: std::ops::RangeInclusive<i64> = TOP..=5;

/// Folder of the range images.
pub(super) const LIDAR: &str = "lidar";
/// Folder of the labels.
pub(super) const BOXES: &str = "lidar_box";

const STAMP: &str = "key.frame_timestamp_micros";
const LASER: &str = "key.laser_name";
const IMAGE: Columns = ["[LiDARComponent].range_image_return1.values", "[LiDARComponent].range_image_return1.shape"];
const POSES: Columns =
    ["[LiDARPoseComponent].range_image_return1.values", "[LiDARPoseComponent].range_image_return1.shape"];
const EXTRINSIC: &str = "[LiDARCalibrationComponent].extrinsic.transform";
const LEAST: &str = "[LiDARCalibrationComponent].beam_inclination.min";
const MOST: &str = "[LiDARCalibrationComponent].beam_inclination.max";
const EACH: &str = "[LiDARCalibrationComponent].beam_inclination.values";
const VEHICLE: &str = "[VehiclePoseComponent].world_from_vehicle.transform";
const TRACK: &str = "key.laser_object_id";
const TYPE: &str = "[LiDARBoxComponent].type";
const BOX: [&str; 7] = [
    "[LiDARBoxComponent].box.center.x",
    "[LiDARBoxComponent].box.center.y",
    "[LiDARBoxComponent].box.center.z",
    "[LiDARBoxComponent].box.size.x",
    "[LiDARBoxComponent].box.size.y",
    "[LiDARBoxComponent].box.size.z",
    "[LiDARBoxComponent].box.heading",
];

/// Names of the types of objects, from 0.
const TYPES: [&str; 5] = ["unknown", "Vehicle", "Pedestrian", "Sign", "Cyclist"];

/// What to do about a file that is missing.
const MISSING: &str = "does not exist: add this component of the segment";

/// Segments whose frames stay in memory. The largest split has 798.
const MOST_INDICES: usize = 4096;

/// The rows of the sensors by the stamps of the frames, us. Sensors are in their order.
pub(super) type Index = BTreeMap<i64, BTreeMap<i64, usize>>;

/// Path of the file of a segment.
pub(super) fn component(folder: &Path, name: &str, segment: &str) -> PathBuf {
    folder.join(name).join(format!("{segment}.parquet"))
}

/// The frames of a segment. They are read again if the file has changed.
pub(super) fn index(folder: &Path, segment: &str) -> Result<Arc<Index>, DataError> {
    type Known = HashMap<PathBuf, (State, Arc<Index>)>;
    static INDICES: Mutex<Option<Known>> = Mutex::new(None);
    let path = component(folder, LIDAR, segment);
    let state = state(&[&path], MISSING)?;
    let find = |known: &Known| known.get(&path).filter(|(of, _)| *of == state).map(|(_, index)| index.clone());
    let known = INDICES.lock().unwrap_or_else(PoisonError::into_inner).as_ref().and_then(find);
    if let Some(index) = known {
        return Ok(index);
    }
    let index = Arc::new(rows_of_sensors(&ParquetFile::open(&path)?)?);
    let mut known = INDICES.lock().unwrap_or_else(PoisonError::into_inner);
    let known = known.get_or_insert_with(Known::new);
    if known.len() == MOST_INDICES {
        known.clear();
    }
    known.insert(path, (state, index.clone()));
    Ok(index)
}

fn rows_of_sensors(file: &ParquetFile) -> Result<Index, DataError> {
    let table = file.table(&[STAMP, LASER])?;
    let mut index = Index::new();
    for (row, (stamp, laser)) in table.integers(STAMP)?.into_iter().zip(table.integers(LASER)?).enumerate() {
        if !LASERS.contains(&laser) {
            return Err(table.wrong(row, &format!("{LASER} {laser} is not from 1 to 5")));
        }
        if index.entry(stamp).or_default().insert(laser, row).is_some() {
            return Err(table.wrong(row, &format!("{STAMP} {stamp} and {LASER} {laser} occur twice")));
        }
    }
    Ok(index)
}

/// A segment with what all of its frames need.
pub(super) struct Segment {
    path: PathBuf,
    index: Arc<Index>,
    images: Rows,
    poses: Rows,
    rows_of_poses: Index,
    lasers: BTreeMap<i64, Laser>,
    vehicles: BTreeMap<i64, Pose>,
    /// By stamp, in the frame of the vehicle.
    boxes: BTreeMap<i64, Vec<TrackedObject>>,
    state: State,
}

/// A segment. It is read again if one of its files has changed.
pub(super) fn segment(folder: &Path, name: &str) -> Result<Arc<Segment>, DataError> {
    static SEGMENTS: Recent<(PathBuf, State), Segment> = Recent::new();
    let names = [LIDAR, "lidar_calibration", "lidar_pose", "vehicle_pose"];
    let [lidar, calibration, poses, vehicle] = names.map(|part| component(folder, part, name));
    let mut paths = vec![&*lidar, &*calibration, &*poses, &*vehicle];
    let boxes = Some(component(folder, BOXES, name)).filter(|_| folder.join(BOXES).is_dir());
    paths.extend(boxes.as_deref());
    let state = state(&paths, MISSING)?;
    SEGMENTS.get((lidar.clone(), state.clone()), || {
        let index = index(folder, name)?;
        let of_poses = ParquetFile::open(&poses)?;
        Ok(Segment {
            index,
            images: Rows::new(ParquetFile::open(&lidar)?, &IMAGE),
            rows_of_poses: rows_of_sensors(&of_poses)?,
            poses: Rows::new(of_poses, &POSES),
            lasers: read_lasers(&calibration)?,
            vehicles: read_vehicles(&vehicle)?,
            boxes: boxes.map_or(Ok(BTreeMap::new()), |path| read_boxes(&path))?,
            path: lidar.clone(),
            state,
        })
    })
}

impl Segment {
    /// Where the upper LiDAR is on the vehicle, m.
    fn origin(&self) -> Result<Translation3<f64>, DataError> {
        Ok(self.laser(TOP)?.vehicle_from_sensor.translation)
    }

    fn laser(&self, laser: i64) -> Result<&Laser, DataError> {
        let missing = || self.wrong(&format!("the calibration of the segment has no {LASER} {laser}"));
        self.lasers.get(&laser).ok_or_else(missing)
    }

    fn wrong(&self, message: &str) -> DataError {
        DataError::file(&self.path, message)
    }

    /// The stamp of the first frame, us.
    pub(super) fn start_us(&self) -> i64 {
        self.index.first_key_value().map_or(0, |(stamp, _)| *stamp)
    }

    /// The pose of the LiDAR frame in the world: the axes of the vehicle, the place of the upper LiDAR.
    pub(super) fn world_from_lidar(&self, stamp_us: i64) -> Result<Pose, DataError> {
        Ok(self.vehicle(stamp_us)? * self.origin()?)
    }

    fn vehicle(&self, stamp_us: i64) -> Result<Pose, DataError> {
        let missing = || self.wrong(&format!("frame {stamp_us} has no row in vehicle_pose"));
        self.vehicles.get(&stamp_us).copied().ok_or_else(missing)
    }

    /// The labelled objects of a frame, in the LiDAR frame.
    pub(super) fn objects(&self, stamp_us: i64) -> Result<Vec<TrackedObject>, DataError> {
        let Some(objects) = self.boxes.get(&stamp_us) else { return Ok(Vec::new()) };
        let origin = self.origin()?.vector;
        let moved = |object: &TrackedObject| {
            let center = [0, 1, 2].map(|axis| object.bbox.center[axis] - origin[axis]);
            TrackedObject { bbox: Box3 { center, ..object.bbox }, ..object.clone() }
        };
        Ok(objects.iter().map(moved).collect())
    }

    /// The points of a frame, of all sensors or of the upper one alone.
    pub(super) fn scan(&self, stamp_us: i64, top_alone: bool) -> Result<Arc<Scan>, DataError> {
        type Key = (PathBuf, State, i64, bool);
        static SCANS: Recent<Key, Scan> = Recent::new();
        let key = (self.path.clone(), self.state.clone(), stamp_us, top_alone);
        SCANS.get(key, || self.read_scan(stamp_us, top_alone))
    }

    fn read_scan(&self, stamp_us: i64, top_alone: bool) -> Result<Scan, DataError> {
        let missing = || self.wrong(&format!("has no frame with the {STAMP} {stamp_us}"));
        let sensors = self.index.get(&stamp_us).ok_or_else(missing)?;
        let lidar_from_vehicle = self.origin()?.inverse();
        let mut scan = Scan::default();
        for (laser, row) in sensors.iter().filter(|(laser, _)| !top_alone || **laser == TOP) {
            let named = |e: DataError| self.in_frame(stamp_us, *laser, e);
            let image = self.images.row(*row).map_err(named)?;
            let of_poses = self.rows_of_poses.get(&stamp_us).and_then(|sensors| sensors.get(laser));
            let poses = of_poses.map(|row| self.poses.row(*row)).transpose().map_err(named)?;
            if poses.is_none() && *laser == TOP {
                return Err(self.wrong(&format!("frame {stamp_us}: the upper LiDAR has no row in lidar_pose")));
            }
            let poses = match &poses {
                Some(table) => Some((table, POSES, self.vehicle(stamp_us)?.inverse())),
                None => None,
            };
            scan.add(self.laser(*laser)?, (&image, IMAGE), poses, lidar_from_vehicle).map_err(named)?;
        }
        Ok(scan)
    }

    /// An error of a row that was read alone, with its frame and sensor.
    fn in_frame(&self, stamp_us: i64, laser: i64, error: DataError) -> DataError {
        let place = format!("frame {stamp_us}, {LASER} {laser}");
        match error {
            DataError::File { path, kind, message } => {
                let message = message.strip_prefix("row 0 (from 0): ").unwrap_or(&message);
                DataError::of_kind(kind, &path, format!("{place}: {message}"))
            }
            other => other,
        }
    }
}

fn read_lasers(path: &Path) -> Result<BTreeMap<i64, Laser>, DataError> {
    let table = ParquetFile::open(path)?.table(&[LASER, EXTRINSIC, LEAST, MOST, EACH])?;
    let (extrinsics, each) = (table.real_lists(EXTRINSIC)?, table.real_lists(EACH)?);
    let (least, most) = (table.reals(LEAST)?, table.reals(MOST)?);
    let mut lasers = BTreeMap::new();
    for (row, (laser, each)) in table.integers(LASER)?.into_iter().zip(each).enumerate() {
        let inclinations = each.map_or(Inclinations::Uniform(least[row], most[row]), Inclinations::Each);
        let read = Laser::new(extrinsics[row].as_deref().unwrap_or_default(), inclinations);
        lasers.insert(laser, read.map_err(|message| table.wrong(row, &message))?);
    }
    Ok(lasers)
}

fn read_vehicles(path: &Path) -> Result<BTreeMap<i64, Pose>, DataError> {
    let table = ParquetFile::open(path)?.table(&[STAMP, VEHICLE])?;
    let mut vehicles = BTreeMap::new();
    for (row, (stamp, matrix)) in table.integers(STAMP)?.into_iter().zip(table.real_lists(VEHICLE)?).enumerate() {
        let pose = pose_from_matrix(matrix.as_deref().unwrap_or_default());
        vehicles.insert(stamp, pose.map_err(|message| table.wrong(row, &format!("column {VEHICLE}: {message}")))?);
    }
    Ok(vehicles)
}

fn read_boxes(path: &Path) -> Result<BTreeMap<i64, Vec<TrackedObject>>, DataError> {
    let table = ParquetFile::open(path)?.table(&[&[STAMP, TRACK, TYPE][..], &BOX].concat())?;
    if table.rows() == 0 {
        return Ok(BTreeMap::new());
    }
    let (stamps, tracks, types) = (table.integers(STAMP)?, table.texts(TRACK)?, table.integers(TYPE)?);
    let columns: Vec<Vec<f64>> = BOX.iter().map(|name| table.reals(name)).collect::<Result<_, _>>()?;
    let mut frames: BTreeMap<i64, Vec<TrackedObject>> = BTreeMap::new();
    for (row, track) in tracks.into_iter().enumerate() {
        let bbox = Box3::from_array(std::array::from_fn(|i| columns[i][row])).with_wrapped_yaw();
        check_box(&bbox).map_err(|message| table.wrong(row, &message))?;
        let class = usize::try_from(types[row]).ok().and_then(|number| TYPES.get(number));
        let class = class.ok_or_else(|| table.wrong(row, &format!("{TYPE} {} is not from 0 to 4", types[row])))?;
        let objects = frames.entry(stamps[row]).or_default();
        at_most(path, "boxes of a frame", objects.len() as u64 + 1, MOST_BOXES)?;
        objects.push(TrackedObject { track, class: (*class).into(), bbox });
    }
    Ok(frames)
}
