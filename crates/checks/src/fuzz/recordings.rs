//! The readers of recordings of ROS 2: SQLite, and what rosbag2 says of its files. MCAP is not among them: its library
//! allocates the length that a damaged text claims, up to 4 GiB.

use super::targets::Target;
use anyhow::Result;
use data::{Cloud, Dataset};
use std::cell::Cell;
use std::path::Path;

const DRIVE: &[u8] = include_bytes!("../../../../tests/golden/recordings/drive_0.db3");
const COMPRESSED: &[u8] = include_bytes!("../../../../tests/golden/recordings/compressed.db3");
const METADATA: &str = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  \
                        relative_file_paths:\n    - drive.db3\n  compression_format: \"\"\n";

/// A recording of each kind, and the list of its files, each damaged separately.
pub(super) fn targets(folder: &Path) -> Result<Vec<Target>> {
    [
        ("db3", "drive.db3", "drive.db3", DRIVE.to_vec()),
        ("db3 compressed", "drive.db3", "drive.db3", COMPRESSED.to_vec()),
        ("rosbag2 metadata", "metadata.yaml", "", METADATA.into()),
    ]
    .into_iter()
    .map(|(name, file, root, valid)| target(name, file, root, valid, &folder.join(name)))
    .collect()
}

/// Damages `file` of a recording that is opened at `root`, both in `folder`.
fn target(name: &'static str, file: &'static str, root: &'static str, valid: Vec<u8>, folder: &Path) -> Result<Target> {
    let (folder, number) = (folder.to_path_buf(), Cell::new(0));
    let read = move |bytes: &[u8]| {
        // A file of another name is opened anew, even if its size and its time are those of the one before.
        fs_err::remove_dir_all(folder.join(number.get().to_string())).ok();
        number.set(number.get() + 1);
        let folder = folder.join(number.get().to_string());
        let write = |name: &str, bytes: &[u8]| fs_err::write(folder.join(name), bytes);
        fs_err::create_dir_all(&folder)
            .and_then(|()| write("drive.db3", DRIVE))
            .and_then(|()| write(file, bytes))
            .map_err(|e| e.to_string())?;
        let Ok(set) = Dataset::open(&folder.join(root)) else { return Ok(false) };
        let ids = set.all_ids().map_err(|e| format!("a recording without frames: {e}"))?;
        set.moments(&ids).ok();
        let mut read = ids.iter().filter_map(|id| set.load_cloud(id).ok());
        let finite = |cloud: Cloud| cloud.values.iter().all(|v| v.is_finite()) && !cloud.is_empty();
        if read.all(finite) { Ok(true) } else { Err("a cloud that is not valid".into()) }
    };
    Ok(Target { name, valid, read: Box::new(read) })
}
