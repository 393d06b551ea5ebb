//! Recordings that `tests/golden/recordings/make.py` wrote, and changes of them.

use super::*;
use crate::layout::DataLayout as _;
use crate::layout::bag::tests::each_damaged;
use crate::{Dataset, PointColumns};
use std::fs;

const DRIVE: [&[u8]; 2] = [
    include_bytes!("../../../../../tests/golden/recordings/drive_0.db3"),
    include_bytes!("../../../../../tests/golden/recordings/drive_1.db3"),
];
const COMPRESSED: &[u8] = include_bytes!("../../../../../tests/golden/recordings/compressed.db3");

const METADATA: &str = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  \
                        relative_file_paths:\n    - drive_0.db3\n    - drive_1.db3\n  compression_format: \"\"\n  \
                        compression_mode: \"\"\n  topics_with_message_count:\n    - topic_metadata:\n        \
                        offered_qos_profiles: \"- history: 3\\n  depth: 0\"\n      message_count: 3\n";

/// The folder of a recording in two files.
fn drive() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (i, bytes) in DRIVE.iter().enumerate() {
        fs::write(folder.path().join(format!("drive_{i}.db3")), bytes).unwrap();
    }
    fs::write(folder.path().join("metadata.yaml"), METADATA).unwrap();
    folder
}

/// The message of the error with which a data set is refused.
fn refusal(path: &Path) -> String {
    Dataset::open(path).unwrap_err().to_string()
}

/// Checks the three clouds of the recording, with rings, times, stamps and poses.
fn check_drive(dataset: &Dataset, layout: Layout) {
    assert_eq!((dataset.config.layout, dataset.config.points), (layout, PointColumns::Xyzi));
    let ids = dataset.all_ids().unwrap();
    assert_eq!(ids, ["000000", "000001", "000002"]);
    let moments = dataset.moments(&ids).unwrap();
    for (i, id) in ids.iter().enumerate() {
        let cloud = dataset.load(id).unwrap().cloud;
        assert_eq!(cloud.values, [1.0 + i as f32, 1.5, 0.5, 10.0, 2.0, 2.5, 0.25, 20.0, 4.0, 4.5, -1.0, 255.0]);
        let details = dataset.point_details(id).unwrap();
        assert_eq!((details.ring.unwrap(), details.time_s.unwrap()), (vec![0, 1, 63], vec![-0.05, 0.0, 0.05]));
        assert!((moments[i].stamp_s.unwrap() - 0.1 * i as f64).abs() < 1e-9);
        let place = moments[i].world_from_lidar.unwrap().translation.vector;
        assert!((place - nalgebra::Vector3::new(i as f64, 0.0, 2.0)).norm() < 1e-9, "{id}: {place}");
    }
}

#[test]
fn a_folder_of_several_files_is_one_recording() {
    let folder = drive();
    check_drive(&Dataset::open(folder.path()).unwrap(), Layout::Db3);
    // The frame names the file that has it.
    let dataset = Dataset::open(&folder.path().join(".#/points")).unwrap();
    let name = |id: &str| dataset.cloud_path(id).file_name().unwrap().to_owned();
    assert_eq!((name("000001"), name("000002")), ("drive_0.db3".into(), "drive_1.db3".into()));
    // A file is a recording, too.
    assert_eq!(Dataset::open(&folder.path().join("drive_0.db3")).unwrap().all_ids().unwrap().len(), 2);
    // Nothing was written beside the files.
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
    // Early versions of rosbag2 wrote the folder as well.
    fs::write(folder.path().join("metadata.yaml"), METADATA.replace("- drive", "- bag/drive")).unwrap();
    assert_eq!(Dataset::open(folder.path()).unwrap().all_ids().unwrap().len(), 3);
}

/// The same recording in MCAP files of another program.
#[test]
fn recordings_in_mcap_are_those_in_sqlite() {
    for name in ["plain", "zstd"] {
        let path = format!("{}/../../tests/golden/recordings/{name}.mcap", env!("CARGO_MANIFEST_DIR"));
        check_drive(&Dataset::open(Path::new(&path)).unwrap(), Layout::Mcap);
    }
}

#[test]
fn messages_that_are_compressed_one_by_one_are_read() {
    let folder = tempfile::tempdir().unwrap();
    // A name that is an address with other characters.
    let path = folder.path().join("50% #1?mode=rwc é.db3");
    fs::write(&path, COMPRESSED).unwrap();
    check_drive(&Dataset::open(&path).unwrap(), Layout::Db3);
    let mut damaged = COMPRESSED.to_vec();
    for at in 0..damaged.len() - 10 {
        if damaged[at..].starts_with(&[0x28, 0xB5, 0x2F, 0xFD]) {
            damaged[at + 5..at + 10].fill(0xFF);
        }
    }
    fs::write(&path, &damaged).unwrap();
    let dataset = Dataset::open(&path);
    let result = dataset.and_then(|d| d.all_ids()?.iter().try_for_each(|id| d.load(id).map(drop)));
    let error = result.unwrap_err().to_string();
    assert!(error.contains("frame 00000") && error.contains("decompressed"), "{error}");
}

#[test]
fn files_that_are_compressed_or_missing_are_named() {
    let folder = drive();
    let place = |name: &str| folder.path().join(name);
    fs::remove_file(place("drive_1.db3")).unwrap();
    let error = refusal(folder.path());
    assert!(error.contains("metadata.yaml: its file drive_1.db3 does not exist: check"), "{error}");
    fs::write(place("drive_1.db3.zstd"), b"zstd").unwrap();
    fs::write(place("metadata.yaml"), METADATA.replace("drive_1.db3", "drive_1.db3.zstd")).unwrap();
    let error = refusal(folder.path());
    assert!(error.contains("its file drive_1.db3.zstd is compressed as a whole; decompress it"), "{error}");
    let error = refusal(&place("drive_1.db3.zstd"));
    assert!(error.contains("drive_1.db3.zstd: is compressed as a whole; decompress it with `zstd -d`"), "{error}");
    fs::write(place("metadata.yaml"), METADATA.replace("_1.db3", "_1.mcap")).unwrap();
    assert!(refusal(folder.path()).contains("its file drive_1.mcap is no .db3 file: check `root` and `layout`"));
    fs::write(place("metadata.yaml"), METADATA.replace("format: \"\"", "format: lz4")).unwrap();
    assert!(
        refusal(folder.path()).contains("compression_format is \"lz4\"; zstd is read"),
        "{}",
        refusal(folder.path())
    );
    for (text, want) in [
        ("a: [", "is no YAML"),
        ("rosbag2_bagfile_information: 7", "lists no file"),
        ("rosbag2_bagfile_information:\n  relative_file_paths: [7]", "its file 7 is no .db3 file"),
        ("rosbag2_bagfile_information:\n  relative_file_paths: [[a.db3]]", "has an item that is no name of a file"),
        ("[a]: b", "a key of it is not a text"),
        ("rosbag2_bagfile_information:\n  relative_file_paths: [..]", "has an item that is no name of a file"),
    ] {
        fs::write(place("metadata.yaml"), text).unwrap();
        assert!(refusal(folder.path()).contains(want), "{}", refusal(folder.path()));
    }
    fs::remove_file(place("metadata.yaml")).unwrap();
    fs::write(place("drive_2.db3"), DRIVE[1]).unwrap();
    let error = refusal(folder.path());
    assert!(error.contains("has several .db3 files and no metadata.yaml") && error.contains("drive_2.db3"), "{error}");
}

/// A text that nests deeply or refers to itself again and again.
#[test]
fn a_hostile_list_of_files_is_refused() {
    let folder = drive();
    let mut laughs = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x]\n");
    for i in 1..12 {
        let before = format!("*a{}, ", i - 1).repeat(9);
        laughs += &format!("a{i}: &a{i} [{before}]\n");
    }
    for text in ["[".repeat(100_000), "- ".repeat(100_000), "{a: ".repeat(100_000), laughs] {
        fs::write(folder.path().join("metadata.yaml"), text).unwrap();
        let error = refusal(folder.path());
        assert!(error.contains("metadata.yaml: is ") || error.contains("metadata.yaml: lists no file"), "{error}");
    }
}

/// The file after a change of its content.
fn changed(sql: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("drive.db3");
    fs::write(&path, DRIVE[0]).unwrap();
    Connection::open(&path).unwrap().execute_batch(sql).unwrap();
    (folder, path)
}

#[test]
fn what_is_wrong_is_named_with_table_and_row() {
    for (sql, want) in [
        ("DROP TABLE messages", "lacks the table topics or the table messages"),
        ("ALTER TABLE topics RENAME TO t; CREATE VIEW topics AS SELECT * FROM t", "lacks the table topics"),
        ("ALTER TABLE topics DROP COLUMN type", "its table topics cannot be read: no such column: type"),
        ("UPDATE topics SET name = x'00' WHERE id = 2", "its table topics cannot be read: row with the id 2: "),
        (
            "UPDATE messages SET timestamp = 'now' WHERE id = 3",
            "its table messages cannot be read: row with the id 3: ",
        ),
        ("UPDATE messages SET data = 'text' WHERE topic_id = 1", "its table messages cannot be read: row with the id "),
        ("UPDATE messages SET data = x'0001000005' WHERE topic_id = 1", "frame 000000: its PointCloud2 cannot be read"),
        ("DELETE FROM messages WHERE topic_id = 1", "its topic /points has no message"),
        ("UPDATE topics SET serialization_format = 'ros1'", "has the encoding \"ros1\"; cdr is read"),
        ("UPDATE topics SET type = 'sensor_msgs/msg/LaserScan'", "has no topic with sensor_msgs/msg/PointCloud2"),
        ("INSERT INTO topics VALUES (9, '/rear', 'sensor_msgs/msg/PointCloud2', 'cdr', '')", "drive.db3#/rear"),
    ] {
        let (_folder, path) = changed(sql);
        let error = refusal(&path);
        assert!(error.contains("drive.db3: ") && error.contains(want), "{sql}: {error}");
    }
    let (_folder, path) = changed("UPDATE messages SET data = x'0001000005' WHERE topic_id = 2");
    let error = Db3.moments(&path, &["000000".into()]).unwrap_err().to_string();
    assert!(error.contains("drive.db3: its table messages cannot be read: row with the id "), "{error}");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("text.db3");
    fs::write(&path, "no database at all, only a text that is long enough").unwrap();
    assert!(refusal(&path).contains("text.db3: is no rosbag2 recording in SQLite: file is not a database"));
    let error = Dataset::open(&folder.path().join("absent.db3")).unwrap_err().to_string();
    assert!(error.contains("absent.db3: does not exist"), "{error}");
}

/// A recorder that is running, or was killed, leaves messages in a file of their own.
#[test]
fn a_recording_that_was_not_closed_is_refused() {
    let (_folder, path) = changed("PRAGMA journal_mode = WAL");
    check_count(&path, 2);
    let recorder = Connection::open(&path).unwrap();
    recorder.execute_batch("DELETE FROM messages WHERE timestamp < 1700000000050000000").unwrap();
    let error = refusal(&path);
    assert!(error.contains("drive.db3: was not closed by its recorder") && error.contains("-wal has"), "{error}");
    // What the message says to do.
    recorder.execute_batch("PRAGMA journal_mode = DELETE").unwrap();
    drop(recorder);
    check_count(&path, 1);
}

fn check_count(path: &Path, frames: usize) {
    assert_eq!(Dataset::open(path).unwrap().all_ids().unwrap().len(), frames);
}

#[test]
fn damaged_files_do_not_panic() {
    each_damaged(DRIVE[0], "damage of db3", "db3", |path| {
        let _ = Db3.moments(path, &["000000".into(), "000001".into()]);
        if let Ok(cloud) = Db3.read_cloud(path, "000001", PointColumns::Xyzi) {
            assert!(cloud.values.iter().all(|v| v.is_finite()));
        }
    });
}
