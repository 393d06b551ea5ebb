//! A recorded drive in plain files: `velodyne/*.bin`, `poses.txt`, `labels.csv` and time stamps where they are known;
//! `ring/*.bin` and `time_s/*.bin` where rows and times of points are.

use super::file_names::{check_folder, ids_of_files};
use super::pose_text::{LineOfFrame, check_box, parse_poses};
use super::stamps::parse_stamps;
use super::{DataLayout, Moment, PointDetails, TrackedObject};
use crate::limits::{MOST_BOXES, MOST_CLOUD_BYTES, at_most, read_file, read_text};
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns, read_cloud};
use geometry::Box3;
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// The plain layout of a recorded drive. Read-only.
pub(super) struct Recording;

const CLOUDS: &str = "velodyne";
const POSES: &str = "poses.txt";
const LABELS: &str = "labels.csv";
/// A number a point, in the order of the points: its ring (u16), and its time relative to the stamp, s (f32).
const RINGS: &str = "ring";
const TIMES: &str = "time_s";
/// Files with time stamps: the first of them that exists is read. The last is the log of a GPS whose first column is
/// the time.
const STAMPS: [&str; 3] = ["times.txt", "timestamps.txt", "oxts_ts_lat_lon_alt_roll_pitch_yaw.txt"];

impl DataLayout for Recording {
    fn name(&self) -> &'static str {
        "recording"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["velodyne/ with poses.txt or labels.csv (a recording)"]
    }

    /// A folder `velodyne` with poses or labels beside it, and neither KITTI's calibration nor its labels.
    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let beside = [POSES, LABELS].iter().any(|name| folder.join(name).is_file());
        let kitti = folder.join("calib.txt").is_file() || folder.join("label_2").is_dir();
        let config = DatasetConfig { layout: Layout::Recording, root: folder.into(), ..DatasetConfig::default() };
        (folder.join(CLOUDS).is_dir() && beside && !kitti).then_some(config)
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        check_folder(&root.join(CLOUDS))
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        ids_of_files(&root.join(CLOUDS), ".bin")
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        root.join(CLOUDS).join(format!("{id}.bin"))
    }

    fn labels_path(&self, root: &Path, _id: &str) -> PathBuf {
        root.join(LABELS)
    }

    fn has_labels(&self, root: &Path) -> bool {
        root.join(LABELS).is_file()
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        read_cloud(&self.cloud_path(root, id), columns)
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let labels = read_labels_csv(&root.join(LABELS))?;
        Ok(labels.get(frame_key(id)).into_iter().flatten().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let all = self.frame_ids(root)?;
        let poses_path = root.join(POSES);
        let poses = if poses_path.is_file() { parse_poses(&read_text(&poses_path)?, &poses_path)? } else { Vec::new() };
        let stamps_path = STAMPS.iter().map(|name| root.join(name)).find(|path| path.is_file());
        let stamps = match &stamps_path {
            Some(path) => parse_stamps(&read_text(path)?, path)?,
            None => Vec::new(),
        };
        let labels = if self.has_labels(root) { read_labels_csv(&root.join(LABELS))? } else { BTreeMap::new() };
        let (pose_line, stamp_line) =
            (LineOfFrame::of(poses.len(), all.len()), LineOfFrame::of(stamps.len(), all.len()));
        let moment = |id: &String| {
            let mut moment = Moment::of(id);
            if !poses.is_empty() {
                moment.world_from_lidar = poses[pose_line.line(id, &all, &poses_path, poses.len())?];
            }
            if let Some(path) = &stamps_path {
                moment.stamp_s = Some(stamps[stamp_line.line(id, &all, path, stamps.len())?]);
            }
            moment.objects = labels.get(frame_key(id)).cloned().unwrap_or_default();
            Ok(moment)
        };
        ids.iter().map(moment).collect()
    }

    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let points = self.count_points(root, id, PointColumns::Xyzi)?;
        let ring = numbers(&root.join(RINGS).join(format!("{id}.bin")), points, u16::from_le_bytes)?;
        let time_s = numbers(&root.join(TIMES).join(format!("{id}.bin")), points, f32::from_le_bytes)?;
        if let Some(i) = time_s.iter().flatten().position(|t| !t.is_finite()) {
            let path = root.join(TIMES).join(format!("{id}.bin"));
            return Err(DataError::file(&path, format!("the time of point {i} is not finite")));
        }
        Ok(PointDetails { ring, time_s, ..PointDetails::default() })
    }
}

/// The numbers of a file, one a point; `None` if it does not exist.
fn numbers<const N: usize, T>(
    path: &Path,
    points: usize,
    number: fn([u8; N]) -> T,
) -> Result<Option<Vec<T>>, DataError> {
    if !path.is_file() {
        return Ok(None);
    }
    let bytes = read_file(path, MOST_CLOUD_BYTES)?;
    if bytes.len() != N * points {
        let message = format!("has {} bytes, not {N} for each of the {points} points of the cloud", bytes.len());
        return Err(DataError::file(path, message));
    }
    Ok(Some(bytes.as_chunks().0.iter().map(|bytes| number(*bytes)).collect()))
}

/// One line of `labels.csv`: the box in the LiDAR frame, m and rad.
#[derive(Deserialize)]
struct Line {
    frame: String,
    track: String,
    class: String,
    cx: f64,
    cy: f64,
    cz: f64,
    l: f64,
    w: f64,
    h: f64,
    yaw: f64,
}

/// The frame of a line as it is compared: without leading zeros.
fn frame_key(id: &str) -> &str {
    let trimmed = id.trim_start_matches('0');
    if trimmed.is_empty() && !id.is_empty() { "0" } else { trimmed }
}

/// Reads the tracked boxes of each frame. The header names the columns, in any order.
fn read_labels_csv(path: &Path) -> Result<BTreeMap<String, Vec<TrackedObject>>, DataError> {
    let text = read_text(path)?;
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(text.as_bytes());
    let mut frames: BTreeMap<String, Vec<TrackedObject>> = BTreeMap::new();
    let headers = reader.headers().map_err(|e| DataError::line(path, 1, e.to_string()))?.clone();
    for record in reader.records() {
        let wrong = |e: csv::Error, line: Option<u64>| {
            let line = e.position().map(|p| p.line()).or(line).unwrap_or(1);
            DataError::line(path, line as usize, format!("{e}; columns: frame,track,class,cx,cy,cz,l,w,h,yaw"))
        };
        let record = record.map_err(|e| wrong(e, None))?;
        let number = record.position().map(|p| p.line());
        let line: Line = record.deserialize(Some(&headers)).map_err(|e| wrong(e, number))?;
        let bbox = Box3::from_array([line.cx, line.cy, line.cz, line.l, line.w, line.h, line.yaw]);
        check_box(&bbox).map_err(|message| DataError::line(path, number.unwrap_or(1) as usize, message))?;
        let objects = frames.entry(frame_key(&line.frame).to_string()).or_default();
        at_most(path, "boxes of a frame", objects.len() as u64 + 1, MOST_BOXES)?;
        objects.push(TrackedObject { track: line.track, class: line.class, bbox: bbox.with_wrapped_yaw() });
    }
    Ok(frames)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Dataset;
    use crate::write::write_bin;

    const HEADER: &str = "frame,track,class,cx,cy,cz,l,w,h,yaw\n";

    fn recording(frames: &[&str]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for id in frames {
            let cloud = Cloud { values: vec![1.0, 2.0, 3.0, 0.5], channels: 4 };
            write_bin(&folder.path().join(format!("velodyne/{id}.bin")), &cloud).unwrap();
        }
        folder
    }

    fn write(folder: &tempfile::TempDir, name: &str, text: &str) {
        std::fs::write(folder.path().join(name), text).unwrap();
    }

    #[test]
    fn a_recording_has_stamps_poses_and_tracks() {
        let folder = recording(&["000001", "000002"]);
        assert_eq!(Dataset::open(folder.path()).unwrap().config.layout, Layout::Kitti);
        write(&folder, "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 3 0 1 0 4 0 0 1 5\n0 -1 0 6 1 0 0 7 0 0 1 8\n");
        write(&folder, "times.txt", "0.5\n0.6\n");
        write(
            &folder,
            "labels.csv",
            &format!("{HEADER}2,7,Car,10,1,-0.5,4,1.8,1.5,-3.2\n000002,x,Van,9,1,0,5,2,2,0\n"),
        );
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(
            (dataset.config.layout, &dataset.config.classes[..]),
            (Layout::Recording, &["Car", "Van"].map(String::from)[..])
        );
        let moments = dataset.moments(&dataset.all_ids().unwrap()).unwrap();
        // Three poses beside two clouds: a line for each number. Two stamps: a line for each cloud.
        let at = |i: usize| moments[i].world_from_lidar.unwrap();
        assert_eq!(at(0).translation.vector.as_slice(), [3.0, 4.0, 5.0]);
        assert!((geometry::yaw_rad(&at(1)) - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        assert_eq!((moments[0].stamp_s, moments[1].id.as_str()), (Some(0.0), "000002"));
        assert!((moments[1].stamp_s.unwrap() - 0.1).abs() < 1e-12);
        assert!(moments[0].objects.is_empty());
        let tracks: Vec<&str> = moments[1].objects.iter().map(|o| o.track.as_str()).collect();
        assert_eq!(tracks, ["7", "x"]);
        assert!((moments[1].objects[0].bbox.yaw_rad - (std::f64::consts::TAU - 3.2)).abs() < 1e-12);
        let frame = dataset.load("000002").unwrap();
        assert_eq!((frame.objects.len(), frame.objects[0].bbox), (2, moments[1].objects[0].bbox));
        assert_eq!(dataset.labels("000002").unwrap().iter().map(|l| l.track).collect::<Vec<_>>(), [Some(7), None]);
        assert!(dataset.load("000001").unwrap().objects.is_empty());
    }

    #[test]
    fn rings_and_times_of_points_are_read_where_they_are() {
        let folder = recording(&["000001"]);
        write(&folder, "labels.csv", HEADER);
        let details = || Dataset::open(folder.path()).unwrap().point_details("000001");
        assert_eq!(details().unwrap(), PointDetails::default());
        for name in ["ring", "time_s"] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        std::fs::write(folder.path().join("ring/000001.bin"), 7u16.to_le_bytes()).unwrap();
        std::fs::write(folder.path().join("time_s/000001.bin"), 0.02f32.to_le_bytes()).unwrap();
        let found = details().unwrap();
        assert_eq!((found.ring, found.time_s, found.compensated), (Some(vec![7]), Some(vec![0.02]), None));
        std::fs::write(folder.path().join("time_s/000001.bin"), f32::NAN.to_le_bytes()).unwrap();
        let error = details().unwrap_err().to_string();
        assert!(error.contains("time_s/000001.bin: the time of point 0 is not finite"), "{error}");
        std::fs::write(folder.path().join("ring/000001.bin"), [0; 3]).unwrap();
        let error = details().unwrap_err().to_string();
        assert!(error.contains("ring/000001.bin: has 3 bytes, not 2 for each of the 1 points"), "{error}");
    }

    #[test]
    fn bad_tables_are_refused_by_file_and_line() {
        let folder = recording(&["000000", "000004"]);
        let moments = || Recording.moments(folder.path(), &["000004".into()]).unwrap_err().to_string();
        write(&folder, "poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n");
        assert!(moments().contains("poses.txt: has 1 lines and none for frame 000004"), "{}", moments());
        std::fs::remove_file(folder.path().join("poses.txt")).unwrap();
        for (line, want) in [
            ("0,1,Car,10,1,0,4,1.8,1.5", "labels.csv:2: "),
            ("0,1,Car,far,1,0,4,1.8,1.5,0", "labels.csv:2: "),
            ("0,1,Car,10,1,0,4,-1.8,1.5,0", "labels.csv:2: the sizes of a box must be positive"),
            ("0,1,Car,10,nan,0,4,1.8,1.5,0", "labels.csv:2: the centre of the box"),
            ("0,1,Car,10,1,0,4,1.8,1.5,inf", "labels.csv:2: the yaw of a box must be finite"),
        ] {
            write(&folder, "labels.csv", &format!("{HEADER}{line}\n"));
            assert!(moments().contains(want), "{} not {want}", moments());
        }
        write(&folder, "labels.csv", "frame,track\n0,1\n");
        assert!(moments().contains("missing field `class`"), "{}", moments());
    }

    #[test]
    fn a_real_drive_is_read() {
        let root = Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared/data/kitti_raw_0001"));
        if !root.exists() {
            return eprintln!("skipped: {} is not there", root.display());
        }
        let dataset = Dataset::open(root).unwrap();
        assert_eq!(dataset.config.layout, Layout::Recording);
        let ids = dataset.all_ids().unwrap();
        let moments = dataset.moments(&ids).unwrap();
        assert_eq!((ids.len(), moments.len()), (36, 36));
        let end = moments[35].world_from_lidar.unwrap().translation.vector;
        assert!((40.0..60.0).contains(&end.norm()), "{end}");
        let seconds = moments[35].stamp_s.unwrap();
        assert!((3.5..3.7).contains(&seconds), "{seconds}");
        // The first car is parked: it stays where it is in the world.
        let track = |m: &Moment| {
            let object = m.objects.iter().find(|o| o.track == "0")?;
            Some(geometry::move_box(&m.world_from_lidar?, &object.bbox).center)
        };
        let places: Vec<[f64; 3]> = moments.iter().filter_map(track).collect();
        let off = places.iter().map(|p| (p[0] - places[0][0]).hypot(p[1] - places[0][1])).fold(0.0, f64::max);
        assert!(places.len() > 10 && off < 0.5, "{off} m of {} places", places.len());
        let frame = dataset.load("000000").unwrap();
        assert!(frame.cloud.len() > 100_000 && !frame.objects.is_empty());
    }
}
