//! Training curves as TensorBoard event files.
//!
//! An event file is a sequence of TFRecords (length and content, each followed by its masked CRC-32C), each with a
//! protocol buffer of type `Event`:
//! <https://github.com/tensorflow/tensorboard/blob/master/tensorboard/compat/proto/event.proto>.

use crate::ReportError;
use crate::pages::study::metrics_lines;
use data::{DataError, write_atomic};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::time::UNIX_EPOCH;

/// The metrics file that training writes into a run folder.
const METRICS: &str = "metrics.jsonl";
/// TensorBoard reads files with `tfevents` in their name.
const EVENT_FILE: &str = "events.out.tfevents.0.lidarshift";

/// Writes an event file into `out` for every `metrics.jsonl` below `runs`, in a folder with the same relative path,
/// which TensorBoard shows as the run name. Returns the files in the order of their names.
///
/// Every number of a line becomes a scalar: `train/NAME` for a step, `epoch/NAME` for an epoch, `validation/NAME` for
/// its validation. The lines hold no times; all events have the modification time of their file, so that the same file
/// gives the same bytes.
///
/// # Errors
/// No `metrics.jsonl` below `runs`, a damaged one, or files that cannot be written.
pub fn write_event_files(runs: &Path, out: &Path) -> Result<Vec<PathBuf>, ReportError> {
    let mut found = Vec::new();
    find_metrics(runs, &mut found)?;
    if found.is_empty() {
        let message = format!("no {METRICS} below it: nothing has been trained here");
        return Err(DataError::file(runs, message).into());
    }
    let mut written = Vec::new();
    for metrics in found {
        let changed = fs_err::metadata(&metrics).and_then(|m| m.modified()).map_err(DataError::from)?;
        let wall_time_s = changed.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_secs());
        let run = metrics.parent().and_then(|folder| folder.strip_prefix(runs).ok()).unwrap_or(Path::new(""));
        let path = out.join(run).join(EVENT_FILE);
        write_atomic(&path, &event_file(&metrics, wall_time_s as f64)?)?;
        written.push(path);
    }
    Ok(written)
}

/// All `metrics.jsonl` below a folder, sorted.
fn find_metrics(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), ReportError> {
    let entries = fs_err::read_dir(folder).map_err(DataError::from)?;
    let mut paths = Vec::new();
    for entry in entries {
        let entry = entry.map_err(DataError::from)?;
        let kind = entry.file_type().map_err(DataError::from)?;
        if kind.is_dir() || entry.file_name() == METRICS {
            paths.push((entry.path(), kind.is_dir()));
        }
    }
    paths.sort();
    for (path, is_folder) in paths {
        if is_folder { find_metrics(&path, found)? } else { found.push(path) }
    }
    Ok(())
}

/// The event file of one `metrics.jsonl`.
fn event_file(metrics: &Path, wall_time_s: f64) -> Result<Vec<u8>, ReportError> {
    let mut file = Vec::new();
    let event = |step: u64, content: Vec<u8>| [f64_field(1, wall_time_s), int_field(2, step), content].concat();
    record(&mut file, &event(0, bytes_field(3, b"brain.Event:2")));
    for line in metrics_lines(metrics)? {
        let Some(step) = line["step"].as_u64() else { continue };
        let mut scalars = Vec::new();
        match line["kind"].as_str() {
            Some("step") => collect("train", &line, &mut scalars),
            Some("epoch") => {
                collect("validation", &line["validation"], &mut scalars);
                collect("epoch", &line, &mut scalars);
            }
            _ => {}
        }
        let summary: Vec<u8> = scalars
            .iter()
            .flat_map(|(tag, v)| bytes_field(1, &[bytes_field(1, tag.as_bytes()), f32_field(2, *v)].concat()))
            .collect();
        if !summary.is_empty() {
            record(&mut file, &event(step, bytes_field(5, &summary)));
        }
    }
    Ok(file)
}

/// Collects every number below `value` with its tag, in file order.
fn collect(tag: &str, value: &Value, scalars: &mut Vec<(String, f32)>) {
    match value {
        Value::Number(number) => scalars.extend(number.as_f64().map(|v| (tag.to_string(), v as f32))),
        Value::Object(below) => {
            // Counters are not curves, and validation is a separate group.
            let kept = below.iter().filter(|(key, _)| !matches!(key.as_str(), "step" | "epoch" | "validation"));
            kept.for_each(|(key, value)| collect(&format!("{tag}/{key}"), value, scalars));
        }
        _ => {}
    }
}

/// A TFRecord.
fn record(file: &mut Vec<u8>, content: &[u8]) {
    let length = (content.len() as u64).to_le_bytes();
    for part in [&length[..], content] {
        file.extend_from_slice(part);
        let crc = crc32c::crc32c(part);
        file.extend(crc.rotate_right(15).wrapping_add(0xa282_ead8).to_le_bytes());
    }
}

// A protocol buffer field: field number and wire type, then the value. Zeros are omitted, as in proto3.

fn int_field(field: u8, value: u64) -> Vec<u8> {
    if value == 0 { Vec::new() } else { [vec![field << 3], varint(value)].concat() }
}

fn f64_field(field: u8, value: f64) -> Vec<u8> {
    if value == 0.0 { Vec::new() } else { [&[field << 3 | 1], &value.to_le_bytes()[..]].concat() }
}

/// Written even if zero: it is a oneof member and selects the kind of value.
fn f32_field(field: u8, value: f32) -> Vec<u8> {
    [&[field << 3 | 5], &value.to_le_bytes()[..]].concat()
}

fn bytes_field(field: u8, content: &[u8]) -> Vec<u8> {
    [&[field << 3 | 2], &varint(content.len() as u64)[..], content].concat()
}

/// Varint: seven bits per byte, lowest first; the highest bit marks continuation.
fn varint(mut value: u64) -> Vec<u8> {
    let mut bytes = Vec::new();
    while value > 0x7f {
        bytes.push(value as u8 | 0x80);
        value >>= 7;
    }
    bytes.push(value as u8);
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The golden file was written by TensorBoard's own writer and checked with its own reader, by `make_events.py`
    /// next to it.
    #[test]
    fn the_file_is_the_one_that_tensorboard_writes() {
        let golden = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/tensorboard");
        let ours = event_file(&golden.join(METRICS), 1_700_000_000.0).unwrap();
        assert!(ours == std::fs::read(golden.join("events.out.tfevents")).unwrap());
    }

    #[test]
    fn every_run_below_a_folder_has_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let (runs, out) = (folder.path().join("runs"), folder.path().join("out"));
        std::fs::create_dir_all(runs.join("empty")).unwrap();
        let error = write_event_files(&runs, &out).unwrap_err().to_string();
        assert!(error.contains("no metrics.jsonl below it"), "{error}");
        for run in ["b/seed-1", "a/seed-1"] {
            std::fs::create_dir_all(runs.join(run)).unwrap();
            // A run that is being written: its last line is incomplete.
            let text = "{\"kind\":\"step\",\"step\":1,\"loss\":3.5}\n{\"kind\":\"st";
            std::fs::write(runs.join(run).join(METRICS), text).unwrap();
        }
        let files = write_event_files(&runs, &out).unwrap();
        assert_eq!(files, ["a", "b"].map(|name| out.join(name).join("seed-1").join(EVENT_FILE)));
        let bytes: Vec<Vec<u8>> = files.iter().map(|file| std::fs::read(file).unwrap()).collect();
        assert!(bytes[0].windows(10).any(|w| w == b"train/loss"));
        std::fs::write(runs.join("a/seed-1").join(METRICS), "nonsense\n").unwrap();
        let error = write_event_files(&runs, &out).unwrap_err().to_string();
        assert!(error.contains("metrics.jsonl:1"), "{error}");
    }
}
