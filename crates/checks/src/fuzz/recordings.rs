//! The readers of recordings: SQLite and MCAP of ROS 2, what rosbag2 says of its files, Parquet, and Arrow IPC.

use super::targets::Target;
use anyhow::Result;
use data::{Cloud, Dataset};
use std::cell::Cell;
use std::path::Path;

/// A file below the folder of a recording, and its content.
type File = (&'static str, &'static [u8]);

const DRIVE: &[u8] = include_bytes!("../../../../tests/golden/recordings/drive_0.db3");
const COMPRESSED: &[u8] = include_bytes!("../../../../tests/golden/recordings/compressed.db3");
const PLAIN: &[u8] = include_bytes!("../../../../tests/golden/recordings/plain.mcap");
const ZSTD: &[u8] = include_bytes!("../../../../tests/golden/recordings/zstd.mcap");
const METADATA: &str = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  \
                        relative_file_paths:\n    - drive.db3\n  compression_format: \"\"\n";

/// A component of a segment of Waymo.
macro_rules! waymo {
    ($name:literal) => {
        (
            concat!($name, "/a.parquet"),
            include_bytes!(concat!("../../../../tests/golden/waymo/", $name, "/made_up_0000_000_0020_000.parquet")),
        )
    };
}

/// The components of a segment of Waymo, which are damaged one by one.
const WAYMO: [File; 5] =
    [waymo!("lidar"), waymo!("lidar_pose"), waymo!("lidar_calibration"), waymo!("vehicle_pose"), waymo!("lidar_box")];

/// A table of a log of 123D.
macro_rules! py123d {
    ($log:literal, $name:literal) => {
        (
            concat!($name, ".arrow"),
            include_bytes!(concat!("../../../../tests/golden/py123d/made_up_val/", $log, "/", $name, ".arrow")),
        )
    };
}

/// The tables of two logs of 123D: compressed within the points, and as a whole.
const CURVE: [File; 4] = [
    py123d!("curve", "lidar.lidar_merged"),
    py123d!("curve", "sync"),
    py123d!("curve", "ego_state_se3"),
    py123d!("curve", "box_detections_se3"),
];
const STILL: [File; 2] = [py123d!("still", "lidar.lidar_merged"), py123d!("still", "sync")];

/// A recording of each kind, and the list of its files, each damaged separately.
pub(super) fn targets(folder: &Path) -> Result<Vec<Target>> {
    let [lidar, poses, calibration, vehicle, boxes] = WAYMO;
    let kinds: [(&'static str, &'static [File], &'static str, File); 15] = [
        ("db3", &[], "drive.db3", ("drive.db3", DRIVE)),
        ("db3 compressed", &[], "drive.db3", ("drive.db3", COMPRESSED)),
        ("rosbag2 metadata", &[("drive.db3", DRIVE)], "", ("metadata.yaml", METADATA.as_bytes())),
        ("mcap", &[], "drive.mcap", ("drive.mcap", PLAIN)),
        ("mcap compressed", &[], "drive.mcap", ("drive.mcap", ZSTD)),
        ("waymo lidar", &WAYMO, "", lidar),
        ("waymo poses", &WAYMO, "", poses),
        ("waymo calibration", &WAYMO, "", calibration),
        ("waymo vehicle", &WAYMO, "", vehicle),
        ("waymo boxes", &WAYMO, "", boxes),
        ("py123d points", &CURVE, "", CURVE[0]),
        ("py123d points lz4", &STILL, "", STILL[0]),
        ("py123d moments", &CURVE, "", CURVE[1]),
        ("py123d poses", &CURVE, "", CURVE[2]),
        ("py123d boxes", &CURVE, "", CURVE[3]),
    ];
    let target = |(name, files, root, damaged)| target(name, files, root, damaged, &folder.join(name));
    kinds.into_iter().map(target).collect()
}

/// Damages a file of a recording that is opened at `root` in `folder` and has other `files`.
fn target(
    name: &'static str,
    files: &'static [File],
    root: &'static str,
    (file, valid): File,
    folder: &Path,
) -> Result<Target> {
    let (folder, number) = (folder.to_path_buf(), Cell::new(0));
    let read = move |bytes: &[u8]| {
        // A file of another name is opened anew, even if its size and its time are those of the one before.
        fs_err::remove_dir_all(folder.join(number.get().to_string())).ok();
        number.set(number.get() + 1);
        let folder = folder.join(number.get().to_string());
        let write = |name: &str, bytes: &[u8]| {
            let path = folder.join(name);
            fs_err::create_dir_all(path.parent().unwrap_or(&folder)).and_then(|()| fs_err::write(path, bytes))
        };
        files
            .iter()
            .try_for_each(|(name, bytes)| write(name, bytes))
            .and_then(|()| write(file, bytes))
            .map_err(|e| e.to_string())?;
        let Ok(set) = Dataset::open(&folder.join(root)) else { return Ok(false) };
        let ids = set.all_ids().map_err(|e| format!("a recording without frames: {e}"))?;
        set.moments(&ids).ok();
        let mut read = ids.iter().filter_map(|id| set.load_cloud(id).ok());
        let finite = |cloud: Cloud| cloud.values.iter().all(|v| v.is_finite()) && !cloud.is_empty();
        if read.all(finite) { Ok(true) } else { Err("a cloud that is not valid".into()) }
    };
    Ok(Target { name, valid: valid.to_vec(), read: Box::new(read) })
}
