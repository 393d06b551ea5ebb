//! MCAP files that the crate `mcap` writes, with messages encoded here.

use super::*;
use crate::layout::mcap_file::Mcap;
use ::mcap::records::MessageHeader;
use ::mcap::{Compression, WriteOptions, Writer};
use std::collections::BTreeMap;
use std::fs::File;

/// A CDR message that is written value by value.
struct Out {
    bytes: Vec<u8>,
    big_endian: bool,
}

impl Out {
    fn new(big_endian: bool) -> Out {
        Out { bytes: vec![], big_endian }
    }

    fn push<const N: usize>(&mut self, mut little: [u8; N]) -> &mut Self {
        self.bytes.resize(self.bytes.len().next_multiple_of(N), 0);
        if self.big_endian {
            little.reverse();
        }
        self.bytes.extend(little);
        self
    }

    fn u32(&mut self, v: u32) -> &mut Self {
        self.push(v.to_le_bytes())
    }

    fn text(&mut self, text: &str) -> &mut Self {
        self.u32(text.len() as u32 + 1);
        self.bytes.extend(text.as_bytes());
        self.bytes.push(0);
        self
    }

    fn header(&mut self, stamp_ns: u64, frame: &str) -> &mut Self {
        self.u32((stamp_ns / 1_000_000_000) as u32).u32((stamp_ns % 1_000_000_000) as u32).text(frame)
    }

    fn pose(&mut self, position: [f64; 3], yaw_rad: f64) -> &mut Self {
        let [x, y, z] = position;
        for v in [x, y, z, 0.0, 0.0, (yaw_rad / 2.0).sin(), (yaw_rad / 2.0).cos()] {
            self.push(v.to_le_bytes());
        }
        self
    }

    fn message(&self) -> Vec<u8> {
        [&[0, u8::from(!self.big_endian), 0, 0][..], &self.bytes].concat()
    }
}

/// Field of a point: name, type of `PointField`, and the value of each point.
type Field<'a> = (&'a str, u8, &'a [f64]);

/// A cloud with padding between fields, points and rows.
fn cloud(stamp_ns: u64, fields: &[Field], height: usize, big_endian: bool) -> Vec<u8> {
    let points = fields[0].2.len();
    let (width, point_step) = (points / height, 8 * fields.len() + 3);
    let row_step = width * point_step + 5;
    let mut data = vec![0xAA; height * row_step];
    for (i, (_, kind, values)) in fields.iter().enumerate() {
        for (p, v) in values.iter().enumerate() {
            let mut bytes = match kind {
                4 => (*v as u16).to_le_bytes().to_vec(),
                6 => (*v as u32).to_le_bytes().to_vec(),
                7 => (*v as f32).to_le_bytes().to_vec(),
                _ => v.to_le_bytes().to_vec(),
            };
            if big_endian {
                bytes.reverse();
            }
            let at = (p / width) * row_step + (p % width) * point_step + 8 * i + 1;
            data[at..at + bytes.len()].copy_from_slice(&bytes);
        }
    }
    let mut out = Out::new(big_endian);
    out.header(stamp_ns, "lidar").u32(height as u32).u32(width as u32).u32(fields.len() as u32);
    for (i, (name, kind, _)) in fields.iter().enumerate() {
        out.text(name).u32(8 * i as u32 + 1).push([*kind]).u32(1);
    }
    out.push([u8::from(big_endian)]).u32(point_step as u32).u32(row_step as u32).u32(data.len() as u32);
    out.bytes.extend(data);
    out.push([1]);
    out.message()
}

const NAN: f64 = f64::NAN;

/// Four points, the third of them without a return.
fn velodyne(stamp_ns: u64, first_x: f64) -> Vec<u8> {
    let fields: [Field; 6] = [
        ("x", 7, &[first_x, 2.0, NAN, 4.0]),
        ("y", 7, &[1.5, 2.5, NAN, 4.5]),
        ("z", 7, &[0.5, 0.25, NAN, -1.0]),
        ("intensity", 7, &[10.0, 20.0, 30.0, 255.0]),
        ("ring", 4, &[0.0, 1.0, 2.0, 63.0]),
        ("time", 7, &[-0.05, 0.0, 0.01, 0.05]),
    ];
    cloud(stamp_ns, &fields, 2, false)
}

/// Messages of a topic: its name, its type, and log time and data of each.
type Messages<'a> = (&'a str, &'a str, Vec<(u64, Vec<u8>)>);

fn write(path: &Path, topics: &[Messages], compression: Option<Compression>) {
    let options = WriteOptions::new().compression(compression).chunk_size(Some(300));
    let mut writer = Writer::with_options(File::create(path).unwrap(), options).unwrap();
    let mut all = Vec::new();
    for (topic, kind, messages) in topics {
        let schema = writer.add_schema(kind, "ros2msg", b"").unwrap();
        let channel = writer.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap();
        all.extend(messages.iter().map(|(time, data)| (*time, channel, data)));
    }
    all.sort_by_key(|(time, ..)| *time);
    for (i, (time, channel_id, data)) in all.into_iter().enumerate() {
        let header = MessageHeader { channel_id, sequence: i as u32, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, data).unwrap();
    }
    writer.finish().unwrap();
}

fn tf(stamp_ns: u64, parent: &str, child: &str, position: [f64; 3], yaw_rad: f64) -> Vec<u8> {
    let mut out = Out::new(false);
    out.u32(1).header(stamp_ns, parent).text(child).pose(position, yaw_rad);
    out.message()
}

const SECOND: u64 = 1_000_000_000;

#[test]
fn clouds_with_ring_time_and_pose() {
    for compression in [None, Some(Compression::Zstd), Some(Compression::Lz4)] {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("drive.mcap");
        let start = 1_700_000_000 * SECOND;
        let clouds = (0..3).map(|i| {
            let stamp = start + i * SECOND / 10;
            (stamp + 7, velodyne(stamp, 1.0 + i as f64))
        });
        // The car drives forward with 10 m/s and faces to the left of the map; the LiDAR is 2 m above it.
        let half = std::f64::consts::FRAC_PI_2;
        let moving = (0..2).map(|i| {
            let stamp = start + i * SECOND / 5;
            (stamp, tf(stamp, "map", "base_link", [0.0, 2.0 * i as f64, 0.0], half))
        });
        let fixed = vec![(start, tf(start, "base_link", "lidar", [1.0, 0.0, 2.0], 0.0))];
        let topics = [("/points", CLOUD, clouds.collect()), ("/tf", TF, moving.collect()), ("/tf_static", TF, fixed)];
        write(&path, &topics, compression);
        let dataset = crate::Dataset::open(&path).unwrap();
        assert_eq!((dataset.config.layout, dataset.config.points), (Layout::Mcap, PointColumns::Xyzi));
        let ids = dataset.all_ids().unwrap();
        assert_eq!(ids, ["000000", "000001", "000002"]);
        let cloud = dataset.load("000001").unwrap().cloud;
        assert_eq!(cloud.values, [2.0, 1.5, 0.5, 10.0, 2.0, 2.5, 0.25, 20.0, 4.0, 4.5, -1.0, 255.0]);
        let details = dataset.point_details("000001").unwrap();
        assert_eq!(details.ring.unwrap(), [0, 1, 63]);
        assert_eq!(details.time_s.unwrap(), [-0.05, 0.0, 0.05]);
        let moments = dataset.moments(&ids).unwrap();
        for (i, moment) in moments.iter().enumerate() {
            assert!((moment.stamp_s.unwrap() - 0.1 * i as f64).abs() < 1e-9);
            let pose = moment.world_from_lidar.unwrap();
            let want = [0.0, 1.0 + i as f64, 2.0];
            let at: [f64; 3] = pose.translation.vector.into();
            assert!(at.iter().zip(want).all(|(a, w)| (a - w).abs() < 1e-9), "{i}: {at:?}, not {want:?}");
            assert!((pose.rotation.angle() - half).abs() < 1e-9);
        }
        assert!(Mcap.has_cloud(&path, "000002") && !Mcap.has_cloud(&path, "000003") && !Mcap.has_cloud(&path, "2"));
    }
}

#[test]
fn a_pose_is_unknown_outside_of_its_samples_and_in_gaps() {
    let mut transforms = Transforms::default();
    let second = SECOND as i64;
    for at in [0, 1, 4, 20] {
        let stamp = (at * second / 10) as u64;
        transforms.add_tf(&tf(stamp, "odom", "lidar", [at as f64, 0.0, 0.0], 0.0), false).unwrap();
    }
    let x = |at: i64| transforms.world_from("lidar", at * second / 100).map(|p| p.translation.x);
    assert_eq!([x(0), x(5), x(25)].map(Option::unwrap), [0.0, 0.5, 2.5]);
    assert_eq!([x(-1), x(201), x(100)], [None; 3]);
    assert_eq!(transforms.world_from("camera", 0), None);
}

#[test]
fn odometry_gives_poses_without_tf() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("o.mcap");
    let mut odometry = Out::new(false);
    odometry.header(SECOND, "odom").text("lidar").pose([5.0, 6.0, 7.0], 0.0);
    let topics =
        [("/points", CLOUD, vec![(5, velodyne(SECOND, 1.0))]), ("/odom", ODOMETRY, vec![(5, odometry.message())])];
    write(&path, &topics, None);
    let pose = Mcap.moments(&path, &["000000".into()]).unwrap()[0].world_from_lidar.unwrap();
    assert_eq!(pose.translation.vector.as_slice(), [5.0, 6.0, 7.0]);
}

#[test]
fn fields_of_ouster_and_hesai_in_both_byte_orders() {
    let stamp_s = 1_700_000_000.25;
    let stamp_ns = (stamp_s * 1e9) as u64;
    let xyz: [Field; 3] = [("x", 7, &[1.0, 2.0]), ("y", 7, &[3.0, 4.0]), ("z", 7, &[5.0, 6.0])];
    let ouster: [Field; 3] = [("t", 6, &[0.0, 5e7]), ("reflectivity", 4, &[7.0, 300.0]), ("ring", 4, &[3.0, 127.0])];
    let hesai: [Field; 3] =
        [("timestamp", 8, &[stamp_s, stamp_s + 0.05]), ("intensity", 7, &[7.0, 300.0]), ("ring", 4, &[3.0, 127.0])];
    for extra in [ouster, hesai] {
        for big_endian in [false, true] {
            let fields: Vec<Field> = xyz.iter().chain(&extra).copied().collect();
            let message = point_cloud2::parse(&cloud(stamp_ns, &fields, 1, big_endian)).unwrap();
            assert_eq!(message.values, [1.0, 3.0, 5.0, 7.0, 2.0, 4.0, 6.0, 300.0]);
            assert_eq!(message.ring.unwrap(), [3, 127]);
            let time = message.time_s.unwrap();
            assert!(time[0].abs() < 1e-6 && (time[1] - 0.05).abs() < 1e-6, "{time:?}");
        }
    }
}

#[test]
fn several_topics_are_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("three.mcap");
    let topic = |name| (name, CLOUD, vec![(5, velodyne(SECOND, if name == "/left" { 9.0 } else { 1.0 }))]);
    write(&path, &[topic("/left"), topic("/front"), topic("/right")], None);
    let error = crate::Dataset::open(&path).unwrap_err().to_string();
    for name in ["/front", "/left", "/right"] {
        assert!(error.contains(&format!("three.mcap#{name}")), "{error}");
    }
    let chosen = PathBuf::from(format!("{}#/left", path.display()));
    assert_eq!(crate::Dataset::open(&chosen).unwrap().load("000000").unwrap().cloud.values[0], 9.0);
    // A folder of rosbag2 has one file.
    let chosen = PathBuf::from(format!("{}#/front", folder.path().display()));
    assert_eq!(crate::Dataset::open(&chosen).unwrap().load("000000").unwrap().cloud.values[0], 1.0);
    let error = Mcap.check_root(&PathBuf::from(format!("{}#/back", path.display()))).unwrap_err().to_string();
    assert!(error.contains("no topic \"/back\""), "{error}");
}

#[test]
fn wrong_files_are_errors() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.mcap");
    let error = || Mcap.check_root(&path).unwrap_err().to_string();
    write(&path, &[("/odom", ODOMETRY, vec![])], None);
    assert!(error().contains("has no topic with sensor_msgs/msg/PointCloud2"), "{}", error());
    write(&path, &[("/points", CLOUD, vec![])], None);
    assert!(error().contains("/points has no message"), "{}", error());
    std::fs::write(&path, b"not an mcap file at all, but long enough to have a footer").unwrap();
    assert!(error().contains("no complete MCAP file"), "{}", error());
    // A recorder that crashed leaves no summary.
    write(&path, &[("/points", CLOUD, vec![(5, velodyne(SECOND, 1.0))])], None);
    let whole = std::fs::read(&path).unwrap();
    std::fs::write(&path, &whole[..whole.len() - 40]).unwrap();
    assert!(error().contains("mcap recover"), "{}", error());
    // Damage of a chunk is found by its checksum.
    let mut damaged = whole.clone();
    let at = damaged.windows(5).position(|w| w == b"lidar").unwrap();
    damaged[at] = b'L';
    std::fs::write(&path, &damaged).unwrap();
    let error = Mcap.read_cloud(&path, "000000", PointColumns::Xyzi).unwrap_err().to_string();
    assert!(error.contains("a.mcap") && error.contains("chunk"), "{error}");
}

#[test]
fn wrong_clouds_are_errors() {
    let message = velodyne(SECOND, 1.0);
    for length in 0..message.len() - 1 {
        assert!(point_cloud2::parse(&message[..length]).is_err(), "{length}");
    }
    let fields: [Field; 2] = [("x", 7, &[1.0]), ("y", 7, &[1.0])];
    let error = |bytes: &[u8]| point_cloud2::parse(bytes).err().unwrap();
    assert!(error(&cloud(SECOND, &fields, 1, false)).contains("no field \"z\""));
    assert!(error(&cloud(SECOND, &[("x", 9, &[1.0])], 1, false)).contains("unknown type 9"));
    assert!(error(&[0, 7, 0, 0, 1]).contains("not plain CDR"));
}

#[test]
fn damaged_files_do_not_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("d.mcap");
    let topics = [
        ("/points", CLOUD, vec![(5, velodyne(SECOND, 1.0)), (6, velodyne(2 * SECOND, 1.0))]),
        ("/tf", TF, vec![(5, tf(SECOND, "map", "lidar", [0.0; 3], 0.0))]),
    ];
    write(&path, &topics, None);
    let whole = std::fs::read(&path).unwrap();
    each_damaged(&whole, "damage", "mcap", |path| {
        let _ = Mcap.moments(path, &["000000".into(), "000001".into()]);
        let _ = Mcap.read_cloud(path, "000001", PointColumns::Xyzi);
    });
}

/// Calls `read` with 600 files of an extension, in each of which one to three bytes differ from `whole`; each fifth is
/// cut off as well.
pub(in crate::layout) fn each_damaged(whole: &[u8], purpose: &str, extension: &str, read: impl Fn(&Path)) {
    use rand::RngExt;
    let folder = tempfile::tempdir().unwrap();
    let mut random = crate::stream(1, purpose, 0, 0);
    for round in 0..600 {
        let mut bytes = whole.to_vec();
        for _ in 0..1 + round % 3 {
            let at = random.random_range(0..bytes.len());
            bytes[at] = random.random();
        }
        if round % 5 == 0 {
            bytes.truncate(random.random_range(0..bytes.len()));
        }
        let path = folder.path().join(format!("{round}.{extension}"));
        std::fs::write(&path, &bytes).unwrap();
        read(&path);
        std::fs::remove_file(&path).unwrap();
    }
}
