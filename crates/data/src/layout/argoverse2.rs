//! A log of the Argoverse 2 sensor set: clouds, annotations and poses as Feather tables.
//!
//! Points and boxes of the files are in the frame of the car. The LiDAR frame has the axes of the car and its origin in
//! the upper LiDAR, so that ranges are what the sensor measured. Without the calibration of the log it is the frame of
//! the car.

use super::feather::read_feather;
use super::file_names::{check_folder, ids_of_files};
use super::pose_text::{check_box, pose_from_quaternion};
use super::table::Table;
use super::{DataLayout, Moment, PointDetails, TrackedObject};
use crate::cloud_file::check_cloud;
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use geometry::{Box3, Pose, yaw_rad};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The layout of a log of Argoverse 2. The id of a frame is its time stamp in ns. Read-only.
pub(super) struct Argoverse2;

const CLOUDS: &str = "sensors/lidar";
const ANNOTATIONS: &str = "annotations.feather";
const POSES: &str = "city_SE3_egovehicle.feather";
const CALIBRATION: &str = "calibration/egovehicle_SE3_sensor.feather";
const UPPER: &str = "up_lidar";

impl DataLayout for Argoverse2 {
    fn name(&self) -> &'static str {
        "argoverse2"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["sensors/lidar/ (a log of Argoverse 2)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let config = DatasetConfig { layout: Layout::Argoverse2, root: folder.into(), ..DatasetConfig::default() };
        folder.join(CLOUDS).is_dir().then_some(config)
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        check_folder(&root.join(CLOUDS))
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        ids_of_files(&root.join(CLOUDS), ".feather")
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(CLOUDS).join(format!("{id}.feather"))
    }

    fn labels_path(&self, root: &Path, _id: &str) -> PathBuf {
        root.join(ANNOTATIONS)
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(ANNOTATIONS).is_file()
    }

    /// The intensity of the files, 0 to 255, becomes 0 to 1.
    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        let path = self.cloud_path(root, id);
        let table = read_feather(&path)?;
        let origin = car_from_lidar(root)?;
        let [x, y, z] = [table.reals("x")?, table.reals("y")?, table.reals("z")?];
        let intensity = match columns {
            PointColumns::Xyz => Vec::new(),
            PointColumns::Xyzi => table.integers("intensity")?,
        };
        let channels = columns.channels();
        let mut values = Vec::with_capacity(table.rows() * channels);
        for i in 0..table.rows() {
            values.extend([x[i] - origin[0], y[i] - origin[1], z[i] - origin[2]].map(|v| v as f32));
            values.extend(intensity.get(i).map(|v| *v as f32 / 255.0));
        }
        let cloud = Cloud { values, channels };
        check_cloud(&cloud, &path)?;
        Ok(cloud)
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let objects = read_annotations(root)?.remove(&stamp_ns(root, id)?);
        Ok(objects.iter().flatten().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let start_ns = stamp_ns(root, &self.frame_ids(root)?[0])?;
        let poses = read_poses(root)?;
        let annotations = if self.has_labels(root) { read_annotations(root)? } else { BTreeMap::new() };
        let car_from_lidar = Pose::translation(0.0, 0.0, 0.0) * nalgebra::Translation3::from(car_from_lidar(root)?);
        let moment = |id: &String| {
            let at_ns = stamp_ns(root, id)?;
            Ok(Moment {
                stamp_s: Some(at_ns.wrapping_sub(start_ns) as f64 * 1e-9),
                world_from_lidar: pose_at(&poses, at_ns).map(|city_from_car| city_from_car * car_from_lidar),
                objects: annotations.get(&at_ns).cloned().unwrap_or_default(),
                ..Moment::of(id)
            })
        };
        ids.iter().map(moment).collect()
    }

    /// The number of the laser (two heads of 32) and the time. The points are freed of the motion of the car.
    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let table = read_feather(&self.cloud_path(root, id))?;
        let lasers = table.integers("laser_number")?;
        let ring = |(row, laser): (usize, &i64)| {
            u16::try_from(*laser).map_err(|_| table.wrong(row, &format!("laser_number {laser} is not from 0 to 65535")))
        };
        let times = table.integers("offset_ns")?;
        Ok(PointDetails {
            ring: Some(lasers.iter().enumerate().map(ring).collect::<Result<_, _>>()?),
            time_s: Some(times.iter().map(|ns| (*ns as f64 * 1e-9) as f32).collect()),
            compensated: Some(true),
            ..PointDetails::default()
        })
    }
}

fn stamp_ns(root: &Path, id: &str) -> Result<i64, DataError> {
    id.parse().map_err(|_| {
        DataError::file(&root.join(CLOUDS), format!("frame {id}: the names of Argoverse 2 are time stamps in ns"))
    })
}

/// The position of the upper LiDAR in the frame of the car, m; the origin without a calibration.
fn car_from_lidar(root: &Path) -> Result<[f64; 3], DataError> {
    let path = root.join(CALIBRATION);
    if !path.is_file() {
        return Ok([0.0; 3]);
    }
    let table = read_feather(&path)?;
    let row = table.texts("sensor_name")?.iter().position(|name| name == UPPER);
    let row = row.ok_or_else(|| DataError::file(&path, format!("has no sensor {UPPER}")))?;
    let place = [table.reals("tx_m")?[row], table.reals("ty_m")?[row], table.reals("tz_m")?[row]];
    if !place.iter().all(|v| v.abs() < 100.0) {
        return Err(table.wrong(row, &format!("the sensor is at {place:?} m, not on a car")));
    }
    Ok(place)
}

/// The poses of all rows of a table, m.
fn poses_of(table: &Table) -> Result<Vec<Pose>, DataError> {
    let reals = |name: &str| table.reals(name);
    let q = [reals("qw")?, reals("qx")?, reals("qy")?, reals("qz")?];
    let t = [reals("tx_m")?, reals("ty_m")?, reals("tz_m")?];
    let pose = |row: usize| {
        let pose =
            pose_from_quaternion([q[0][row], q[1][row], q[2][row], q[3][row]], [t[0][row], t[1][row], t[2][row]]);
        pose.map_err(|message| table.wrong(row, &message))
    };
    (0..table.rows()).map(pose).collect()
}

/// The poses of the car in the city by their stamps, ns; none without a table.
fn read_poses(root: &Path) -> Result<BTreeMap<i64, Pose>, DataError> {
    let path = root.join(POSES);
    if !path.is_file() {
        return Ok(BTreeMap::new());
    }
    let table = read_feather(&path)?;
    Ok(table.integers("timestamp_ns")?.into_iter().zip(poses_of(&table)?).collect())
}

/// The pose at a stamp, between the poses before and after it; `None` outside of them.
fn pose_at(poses: &BTreeMap<i64, Pose>, at_ns: i64) -> Option<Pose> {
    let (before_ns, before) = poses.range(..=at_ns).next_back()?;
    let (after_ns, after) = poses.range(at_ns..).next()?;
    let span_ns = after_ns.wrapping_sub(*before_ns);
    let share = if span_ns == 0 { 0.0 } else { at_ns.wrapping_sub(*before_ns) as f64 / span_ns as f64 };
    before.try_lerp_slerp(after, share, 1e-9).or(Some(*before))
}

/// The annotated boxes of each stamp, in the LiDAR frame. Boxes stand upright: roll and pitch are left out.
fn read_annotations(root: &Path) -> Result<BTreeMap<i64, Vec<TrackedObject>>, DataError> {
    let table = read_feather(&root.join(ANNOTATIONS))?;
    let origin = car_from_lidar(root)?;
    let stamps = table.integers("timestamp_ns")?;
    let (tracks, classes) = (table.texts("track_uuid")?, table.texts("category")?);
    let sizes = [table.reals("length_m")?, table.reals("width_m")?, table.reals("height_m")?];
    let mut frames: BTreeMap<i64, Vec<TrackedObject>> = BTreeMap::new();
    for (row, pose) in poses_of(&table)?.iter().enumerate() {
        let center = [0, 1, 2].map(|axis| pose.translation.vector[axis] - origin[axis]);
        let bbox = Box3 { center, size: [sizes[0][row], sizes[1][row], sizes[2][row]], yaw_rad: yaw_rad(pose) };
        check_box(&bbox).map_err(|message| table.wrong(row, &message))?;
        let (track, class) = (tracks[row].clone(), classes[row].clone());
        frames.entry(stamps[row]).or_default().push(TrackedObject { track, class, bbox });
    }
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::super::feather::tests::write;
    use super::*;
    use crate::Dataset;
    use arrow_array::{ArrayRef, Float32Array, Float64Array, Int32Array, Int64Array, StringArray, UInt8Array};
    use std::sync::Arc;

    fn reals(values: &[f64]) -> ArrayRef {
        Arc::new(Float64Array::from(values.to_vec()))
    }

    fn log() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let singles = |values: [f32; 2]| Arc::new(Float32Array::from(values.to_vec())) as ArrayRef;
        for id in ["1000000000", "1100000000"] {
            let columns: Vec<(&str, ArrayRef)> = vec![
                ("x", singles([11.5, -3.0])),
                ("y", singles([2.0, 1.0])),
                ("z", singles([1.5, 0.0])),
                ("intensity", Arc::new(UInt8Array::from(vec![255, 51]))),
                ("laser_number", Arc::new(UInt8Array::from(vec![63, 0]))),
                ("offset_ns", Arc::new(Int32Array::from(vec![0, 99_000_000]))),
            ];
            write(&folder.path().join(format!("{CLOUDS}/{id}.feather")), columns);
        }
        let q =
            |n: usize| vec![("qw", reals(&vec![1.0; n])), ("qx", reals(&vec![0.0; n])), ("qy", reals(&vec![0.0; n]))];
        let t = |x: &[f64]| {
            let zero = vec![0.0; x.len()];
            vec![("qz", reals(&zero)), ("tx_m", reals(x)), ("ty_m", reals(&zero)), ("tz_m", reals(&zero))]
        };
        let stamps = |values: &[i64]| ("timestamp_ns", Arc::new(Int64Array::from(values.to_vec())) as ArrayRef);
        let texts = |values: &[&str]| Arc::new(StringArray::from(values.to_vec())) as ArrayRef;
        let names = ("sensor_name", texts(&["down_lidar", "up_lidar"]));
        write(&folder.path().join(CALIBRATION), [vec![names], q(2), t(&[0.0, 1.5])].concat());
        let poses = [vec![stamps(&[1_000_000_000, 1_050_000_000, 1_150_000_000])], q(3), t(&[0.0, 1.0, 3.0])].concat();
        write(&folder.path().join(POSES), poses);
        let sizes = vec![("length_m", reals(&[4.0])), ("width_m", reals(&[2.0])), ("height_m", reals(&[1.5]))];
        let who = vec![("track_uuid", texts(&["a-b"])), ("category", texts(&["REGULAR_VEHICLE"]))];
        let boxes = [vec![stamps(&[1_100_000_000])], who, sizes, q(1), t(&[21.5])].concat();
        write(&folder.path().join(ANNOTATIONS), boxes);
        folder
    }

    #[test]
    fn a_log_is_moved_to_the_upper_lidar() {
        let folder = log();
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(dataset.config.layout, Layout::Argoverse2);
        let frame = dataset.load("1100000000").unwrap();
        assert_eq!(frame.cloud.values, [10.0, 2.0, 1.5, 1.0, -4.5, 1.0, 0.0, 0.2]);
        assert_eq!(frame.objects[0].bbox.center, [20.0, 0.0, 0.0]);
        let details = dataset.point_details("1100000000").unwrap();
        assert_eq!((details.ring, details.time_s), (Some(vec![63, 0]), Some(vec![0.0, 0.099])));
        let moments = dataset.moments(&dataset.all_ids().unwrap()).unwrap();
        assert_eq!(moments[1].stamp_s, Some(0.1));
        // Half way between 1 m and 3 m, and 1.5 m from the car to the sensor.
        let at = moments[1].world_from_lidar.unwrap().translation.vector;
        assert!((at - nalgebra::Vector3::new(3.5, 0.0, 0.0)).norm() < 1e-9, "{at}");
        assert_eq!((moments[0].objects.len(), moments[1].objects[0].track.as_str()), (0, "a-b"));
    }

    #[test]
    fn real_sweeps_are_read() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/argoverse2"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        let dataset = Dataset::open(&root.join("7fab2350-7eaf-3b7e-a39d-6937a4c1bede")).unwrap();
        let ids = dataset.all_ids().unwrap();
        let moments = dataset.moments(&ids).unwrap();
        assert_eq!((ids.len(), (moments[1].stamp_s.unwrap() * 1e3).round()), (2, 100.0));
        let (frame, details) = (dataset.load(&ids[0]).unwrap(), dataset.point_details(&ids[0]).unwrap());
        assert_eq!((frame.cloud.len(), frame.objects.len()), (99_229, moments[0].objects.len()));
        assert!(frame.cloud.points().all(|p| (0.0..=1.0).contains(&p[3])));
        assert_eq!(details.ring.unwrap().iter().max(), Some(&63));
        // The roof, and the ground about 1.6 m below the sensor.
        let mut heights: Vec<f32> = frame.cloud.points().filter(|p| p[0].hypot(p[1]) < 15.0).map(|p| p[2]).collect();
        heights.sort_by(f32::total_cmp);
        assert!((-2.2..-1.2).contains(&heights[heights.len() / 4]), "{}", heights[heights.len() / 4]);
        // What both sweeps show lies at one place in the city: parked cars.
        let place = |m: &Moment, track: &str| {
            let object = m.objects.iter().find(|o| o.track == track)?;
            Some(geometry::move_box(&m.world_from_lidar?, &object.bbox).center)
        };
        let moved = |object: &TrackedObject| {
            let (a, b) = (place(&moments[0], &object.track)?, place(&moments[1], &object.track)?);
            Some((a[0] - b[0]).hypot(a[1] - b[1]))
        };
        let steps: Vec<f64> = moments[0].objects.iter().filter_map(moved).collect();
        let still = steps.iter().filter(|step| **step < 0.05).count();
        assert!(steps.len() > 40 && still > steps.len() / 3, "{still} of {}", steps.len());
        let other = Dataset::open(&root.join("adcf7d18-0510-35b0-a2fa-b4cea13a6d76")).unwrap();
        assert!(!other.load(&other.all_ids().unwrap()[0]).unwrap().objects.is_empty());
    }
}
