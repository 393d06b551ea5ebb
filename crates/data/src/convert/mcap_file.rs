//! A data set as an MCAP file of ROS 2: clouds on `/points`, poses on `/tf`, boxes as markers on `/boxes`, in CDR.

use super::cdr::Out;
use super::{Content, Conversion, ConvertManifest, write_labels_beside};
use crate::checksum::hex;
use crate::output::write_atomic_with;
use crate::{DataError, LabelBox, Moment, NewDataset, PointDetails, write_atomic};
use geometry::{Pose, upright_pose};
use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::{BTreeMap, HashMap};
use std::fmt::Write as _;
use std::io::{BufWriter, Write as _};
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Name of the file.
const FILE: &str = "data.mcap";

/// Table of the frames: id, id and sequence in the source, stamp.
const TABLE: &str = "frames.csv";

/// The record of the file and of the labels beside it in `frames.jsonl`.
const WHOLE: &str = "recording";

const SECOND_NS: u64 = 1_000_000_000;

/// Stamp of the first frame. Some programs take a stamp of 0 for none.
const FIRST_NS: u64 = SECOND_NS;

/// Time between frames without stamps.
const STEP_NS: u64 = SECOND_NS / 10;

/// Time between two sequences. Readers do not interpolate poses over it.
const BETWEEN_SEQUENCES_NS: u64 = 10 * SECOND_NS;

const WORLD: &str = "map";
const LIDAR: &str = "lidar";

/// Frames that are read at a time.
const BATCH: usize = 16;

/// A frame of the file.
struct Entry {
    id: String,
    sequence: String,
    stamp_ns: u64,
    moment: Moment,
}

/// Writes the file unless it is there; returns the ids of the records of the data set.
pub(super) fn write(
    conversion: &Conversion,
    new: &NewDataset,
    progress: &(dyn Fn(usize, usize) + Sync),
    manifest: &mut ConvertManifest,
) -> Result<Vec<String>, DataError> {
    let (dataset, root) = (conversion.dataset, new.root());
    let entries = entries(conversion)?;
    let total = entries.len();
    let read = AtomicUsize::new(0);
    progress(0, total);
    // Of all frames, because a file of gigabytes is not made anew if nothing changed.
    let hashes: Vec<(String, usize, usize)> = entries
        .par_iter()
        .map(|entry| {
            let content = conversion.content(&entry.moment.id)?;
            progress(read.fetch_add(1, Ordering::Relaxed) / 2, total);
            Ok((content.sha256(), content.cloud.len(), content.labels.len()))
        })
        .collect::<Result<_, DataError>>()?;
    let mut hash = Sha256::new();
    for (entry, (content, points, labels)) in entries.iter().zip(&hashes) {
        let pose = entry.moment.world_from_lidar.map(|pose| pose.to_homogeneous());
        hash.update(format!("{} {} {content} {pose:?}", entry.moment.id, entry.stamp_ns));
        manifest.points += points;
        manifest.labels += labels;
    }
    let labelled = dataset.has_labels();
    let files = || {
        let labels =
            entries.iter().filter(|_| labelled).map(|e| root.join(super::MCAP_LABELS).join(format!("{}.txt", e.id)));
        [root.join(FILE), root.join(TABLE)].into_iter().chain(labels).collect()
    };
    new.frame(WHOLE, Some(&hex(&hash.finalize())), files, || {
        write_atomic(&root.join(TABLE), table(&entries).as_bytes())?;
        write_atomic_with(&root.join(FILE), |file| {
            let path = root.join(FILE);
            let mut recorder = Recorder::new(file, &path)?;
            for (batch, some) in entries.chunks(BATCH).enumerate() {
                let messages: Vec<Messages> = some
                    .par_iter()
                    .map(|entry| {
                        let content = conversion.content(&entry.moment.id)?;
                        if labelled {
                            write_labels_beside(root, &entry.id, &content.labels)?;
                        }
                        let details = dataset.point_details(&entry.moment.id)?;
                        Ok(Messages::of(entry, &content, &details, labelled))
                    })
                    .collect::<Result<_, DataError>>()?;
                for messages in &messages {
                    recorder.add(messages)?;
                }
                progress((total + (batch + 1) * BATCH).min(2 * total) / 2, total);
            }
            recorder.finish()
        })
    })?;
    progress(total, total);
    let renamed: HashMap<&str, &str> = entries.iter().map(|e| (e.moment.id.as_str(), e.id.as_str())).collect();
    conversion.describe(new, &|id| renamed.get(id).copied().unwrap_or(id).to_owned())?;
    Ok(vec![WHOLE.into()])
}

/// All frames with ids and stamps of the file. Sequences follow one another.
fn entries(conversion: &Conversion) -> Result<Vec<Entry>, DataError> {
    let dataset = conversion.dataset;
    let mut entries: Vec<Entry> = Vec::new();
    for sequence in dataset.sequences()? {
        let moments = dataset.moments(&sequence.ids)?;
        let start_ns = entries.last().map_or(FIRST_NS, |last| last.stamp_ns + BETWEEN_SEQUENCES_NS);
        let stamps: Option<Vec<f64>> = moments.iter().map(|m| m.stamp_s).collect();
        let first_s = stamps.as_ref().and_then(|s| s.first().copied()).unwrap_or(0.0);
        for (i, moment) in moments.into_iter().enumerate() {
            let since_ns = match &stamps {
                Some(stamps) => ((stamps[i] - first_s) * SECOND_NS as f64).round() as u64,
                None => i as u64 * STEP_NS,
            };
            let stamp_ns = start_ns + since_ns;
            if entries.last().is_some_and(|last| last.stamp_ns >= stamp_ns) {
                let message = format!("the stamp of frame {} is not behind that of the frame before it", moment.id);
                return Err(DataError::file(&dataset.config.root, message));
            }
            let id = format!("{:06}", entries.len());
            entries.push(Entry { id, sequence: sequence.name.clone(), stamp_ns, moment });
        }
    }
    Ok(entries)
}

fn table(entries: &[Entry]) -> String {
    let mut text = String::from("id,source_id,sequence,stamp_ns\n");
    for e in entries {
        let _ = writeln!(text, "{},{},{},{}", e.id, e.moment.id, e.sequence, e.stamp_ns);
    }
    text
}

/// The messages of a frame.
struct Messages {
    stamp_ns: u64,
    transform: Option<Vec<u8>>,
    cloud: Vec<u8>,
    boxes: Option<Vec<u8>>,
}

impl Messages {
    fn of(entry: &Entry, content: &Content, details: &PointDetails, labelled: bool) -> Messages {
        let stamp_ns = entry.stamp_ns;
        Messages {
            stamp_ns,
            transform: entry.moment.world_from_lidar.map(|pose| transform(stamp_ns, &pose)),
            cloud: cloud(stamp_ns, content, details),
            boxes: labelled.then(|| markers(stamp_ns, &content.labels)),
        }
    }
}

/// A `tf2_msgs/msg/TFMessage` with one transform.
fn transform(stamp_ns: u64, world_from_lidar: &Pose) -> Vec<u8> {
    Out::new().u32(1).header(stamp_ns, WORLD).text(LIDAR).pose(world_from_lidar).message()
}

/// Codes of `sensor_msgs/msg/PointField`.
const U16: u8 = 4;
const F32: u8 = 7;

/// A `sensor_msgs/msg/PointCloud2` with x, y, z and what is known of intensity, ring and time.
fn cloud(stamp_ns: u64, content: &Content, details: &PointDetails) -> Vec<u8> {
    let cloud = &content.cloud;
    // Of a cloud that was cropped to an image the details have more points.
    let fits = |length: Option<usize>| length == Some(cloud.len());
    let ring = details.ring.as_ref().filter(|r| fits(Some(r.len())));
    let time = details.time_s.as_ref().filter(|t| fits(Some(t.len())));
    let mut fields = vec![("x", F32), ("y", F32), ("z", F32)];
    fields.extend((cloud.channels > 3).then_some(("intensity", F32)));
    fields.extend(ring.map(|_| ("ring", U16)));
    fields.extend(time.map(|_| ("time", F32)));
    let size = |kind: u8| if kind == U16 { 2 } else { 4 };
    let step: u32 = fields.iter().map(|(_, kind)| size(*kind)).sum();
    let mut data = Vec::with_capacity(cloud.len() * step as usize);
    for (i, point) in cloud.points().enumerate() {
        data.extend(point.iter().flat_map(|v| v.to_le_bytes()));
        data.extend(ring.iter().flat_map(|r| r[i].to_le_bytes()));
        data.extend(time.iter().flat_map(|t| t[i].to_le_bytes()));
    }
    let mut out = Out::new();
    out.header(stamp_ns, LIDAR).u32(1).u32(cloud.len() as u32).u32(fields.len() as u32);
    let mut offset = 0;
    for (name, kind) in fields {
        out.text(name).u32(offset).u8(kind).u32(1);
        offset += size(kind);
    }
    out.u8(0).u32(step).u32(data.len() as u32).sequence(&data).u8(1).message()
}

/// Types and actions of `visualization_msgs/msg/Marker`.
const CUBE: u32 = 1;
const ADD: u32 = 0;
const DELETE_ALL: u32 = 3;

/// A `visualization_msgs/msg/MarkerArray`: one that removes the boxes of the frame before, then a cube for each label.
/// The namespace of a cube is its class.
fn markers(stamp_ns: u64, labels: &[LabelBox]) -> Vec<u8> {
    let solid: Vec<&LabelBox> = labels.iter().filter(|l| !l.is_dont_care() && l.has_box()).collect();
    let mut out = Out::new();
    out.u32(solid.len() as u32 + 1);
    marker(&mut out, stamp_ns, "", 0, DELETE_ALL, &Pose::identity(), [0.0; 3]);
    for (i, label) in solid.iter().enumerate() {
        let bbox = label.lidar_box();
        let pose = upright_pose(bbox.center, bbox.yaw_rad);
        marker(&mut out, stamp_ns, &label.class, i as u32, ADD, &pose, bbox.size);
    }
    out.message()
}

fn marker(out: &mut Out, stamp_ns: u64, class: &str, id: u32, action: u32, pose: &Pose, size: [f64; 3]) {
    out.header(stamp_ns, LIDAR).text(class).u32(id).u32(CUBE).u32(action).pose(pose);
    for side in size {
        out.f64(side);
    }
    for channel in [0.1, 0.7, 1.0, 0.4] {
        out.f32(channel);
    }
    // Lifetime, frame_locked, points, colors.
    out.u32(0).u32(0).u8(1).u32(0).u32(0);
    // texture_resource, texture (header, format, data), uv_coordinates, text.
    out.text("").header(0, "").text("").u32(0).u32(0).text(class);
    // mesh_resource, mesh_file (name, data), mesh_use_embedded_materials.
    out.text("").text("").u32(0).u8(0);
}

/// A file that is being written.
struct Recorder<'a> {
    path: &'a Path,
    writer: Writer<BufWriter<&'a mut std::fs::File>>,
    /// Clouds, transforms, boxes.
    channels: [u16; 3],
    sequence: u32,
}

/// Topic, type and definition.
const TOPICS: [(&str, &str, &str); 3] = [
    ("/points", "sensor_msgs/msg/PointCloud2", include_str!("ros2/PointCloud2.msg")),
    ("/tf", "tf2_msgs/msg/TFMessage", include_str!("ros2/TFMessage.msg")),
    ("/boxes", "visualization_msgs/msg/MarkerArray", include_str!("ros2/MarkerArray.msg")),
];

fn failed(path: &Path, e: McapError) -> DataError {
    match e {
        McapError::Io(e) => DataError::io(path, "cannot be written", &e),
        e => DataError::file(path, format!("cannot be written: {e}")),
    }
}

impl<'a> Recorder<'a> {
    fn new(file: &'a mut std::fs::File, path: &'a Path) -> Result<Self, DataError> {
        let options = WriteOptions::new().profile("ros2").library(concat!("lidarshift ", env!("CARGO_PKG_VERSION")));
        let mut writer = Writer::with_options(BufWriter::new(file), options).map_err(|e| failed(path, e))?;
        let mut channels = [0; 3];
        for (channel, (topic, kind, definition)) in channels.iter_mut().zip(TOPICS) {
            let schema = writer.add_schema(kind, "ros2msg", definition.as_bytes()).map_err(|e| failed(path, e))?;
            let added = writer.add_channel(schema, topic, "cdr", &BTreeMap::new());
            *channel = added.map_err(|e| failed(path, e))?;
        }
        Ok(Recorder { path, writer, channels, sequence: 0 })
    }

    fn add(&mut self, messages: &Messages) -> Result<(), DataError> {
        let [points, tf, boxes] = self.channels;
        let all =
            [(tf, messages.transform.as_ref()), (points, Some(&messages.cloud)), (boxes, messages.boxes.as_ref())];
        for (channel_id, data) in all {
            let Some(data) = data else { continue };
            let time = messages.stamp_ns;
            let header = MessageHeader { channel_id, sequence: self.sequence, log_time: time, publish_time: time };
            self.writer.write_to_known_channel(&header, data).map_err(|e| failed(self.path, e))?;
        }
        self.sequence += 1;
        Ok(())
    }

    fn finish(mut self) -> Result<(), DataError> {
        self.writer.finish().map_err(|e| failed(self.path, e))?;
        let mut file = self.writer.into_inner();
        file.flush().map_err(|e| failed(self.path, e.into()))
    }
}
