//! OpenPCDet's `result.pkl`: the detections of `tools/test.py` on all frames of a split, a pickle of a list with one
//! dictionary for each frame.
//!
//! Read are `frame_id` (a text or a whole number), `name` (`[N]`, classes), `score` (`[N]`) and `boxes_lidar`
//! (`[N, 7]` or more columns: x, y, z of the geometric centre, length, width, height, m, and heading, rad, in the LiDAR
//! frame). Other keys are ignored. No code of the file is run: see [`crate::checkpoint`].

mod numpy;

use crate::ModelError;
use crate::checkpoint::pickle::{Contents, Id, Pickle, Value};
use data::Detection;
use geometry::Box3;
use numpy::{Array, text};
use std::collections::BTreeMap;
use std::path::Path;

/// Longest name of a class, bytes.
const LONGEST_NAME: usize = 200;
/// Largest absolute coordinate of a box, m.
const FARTHEST_M: f64 = 10_000.0;
/// Smallest number of bytes that a detection has in a file.
const BYTES_OF_DETECTION: usize = 8;

/// The detections of one frame.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameResult {
    /// Its id as in the file; a whole number in decimal.
    pub frame_id: String,
    /// Boxes in the LiDAR frame, in the order of the file.
    pub detections: Vec<Detection>,
}

/// Reads a `result.pkl`: the frames in the order of the file.
///
/// # Errors
/// A file that cannot be read, is not such a pickle, is damaged, or asks to run code; a frame that occurs twice, has
/// arrays of different lengths, or a box or score that is not finite.
pub fn read_results(path: &Path) -> Result<Vec<FrameResult>, ModelError> {
    parse_results(path, &data::limits::read_file(path, crate::limits::MOST_CHECKPOINT_BYTES)?)
}

/// The same for the content of a file; `path` is only for messages.
///
/// # Errors
/// As [`read_results`].
pub fn parse_results(path: &Path, bytes: &[u8]) -> Result<Vec<FrameResult>, ModelError> {
    parse(bytes).map_err(|message| ModelError::File { path: path.into(), message })
}

fn parse(bytes: &[u8]) -> Result<Vec<FrameResult>, String> {
    if bytes.is_empty() {
        return Err("is empty".into());
    }
    if !matches!(bytes, [0x80, 2..=5, ..]) {
        return Err("is not a pickle of protocol 2 or later; give OpenPCDet's result.pkl".into());
    }
    let pickle = Pickle::parse(bytes, Contents::Arrays)?;
    if pickle.length != bytes.len() {
        return Err(format!("{} bytes follow the pickle", bytes.len() - pickle.length));
    }
    let Value::List(frames) = pickle.root() else {
        return Err("is not a list of frames; give OpenPCDet's result.pkl".into());
    };
    // Frames may share arrays. The total is limited, so that a small file cannot use much memory.
    let mut budget = bytes.len() / BYTES_OF_DETECTION;
    let mut known: BTreeMap<String, usize> = BTreeMap::new();
    let mut out = Vec::new();
    for (i, &id) in frames.iter().enumerate() {
        let frame = frame(&pickle, id, &mut budget).map_err(|(frame, message)| match frame {
            Some(id) => format!("frame {id} (entry {i} of the list): {message}"),
            None => format!("entry {i} of the list: {message}"),
        })?;
        if let Some(before) = known.insert(frame.frame_id.clone(), i) {
            return Err(format!("frame {} occurs twice: entries {before} and {i} of the list", frame.frame_id));
        }
        out.push(frame);
    }
    Ok(out)
}

/// An error with the id of its frame, if it is known.
type Failed = (Option<String>, String);

fn frame(pickle: &Pickle, id: Id, budget: &mut usize) -> Result<FrameResult, Failed> {
    let Value::Dict(entries) = pickle.get(id) else { return Err((None, "is not a dictionary".into())) };
    let entry = |key: &str| {
        let found = entries.iter().rev().find(|(k, _)| *pickle.get(*k) == Value::Str(key));
        found.map(|(_, value)| *value).ok_or_else(|| format!("has no {key}; give OpenPCDet's result.pkl"))
    };
    let frame_id = entry("frame_id").and_then(|id| frame_name(pickle, id)).map_err(|message| (None, message))?;
    match detections(pickle, &entry, budget) {
        Ok(detections) => Ok(FrameResult { frame_id, detections }),
        Err(message) => Err((Some(frame_id), message)),
    }
}

fn frame_name(pickle: &Pickle, id: Id) -> Result<String, String> {
    let of = |message: String| format!("frame_id {message}");
    let name = match pickle.get(id) {
        Value::Int(n) => n.to_string(),
        _ => match text(pickle, id).map_err(of)? {
            Some(name) => name,
            None => {
                let number = Array::of(pickle, id).map_err(of)?.filter(|one| one.shape.is_empty());
                let numbers = number.map_or(Ok(Vec::new()), |one| one.numbers()).map_err(of)?;
                match numbers[..] {
                    [n] if n.fract() == 0.0 && n.abs() < 9e15 => format!("{n:.0}"),
                    _ => return Err("frame_id is neither a text nor a whole number".into()),
                }
            }
        },
    };
    if name.is_empty() || name.len() > LONGEST_NAME {
        return Err(format!("frame_id has {} bytes; 1 to {LONGEST_NAME} are allowed", name.len()));
    }
    Ok(name)
}

fn detections(
    pickle: &Pickle,
    entry: &impl Fn(&str) -> Result<Id, String>,
    budget: &mut usize,
) -> Result<Vec<Detection>, String> {
    let array = |key: &str| -> Result<Array, String> {
        let found = Array::of(pickle, entry(key)?).map_err(|message| format!("{key} {message}"))?;
        found.ok_or_else(|| format!("{key} is not an array"))
    };
    let of = |key: &str, shape: &[usize]| format!("{key} has the shape {shape:?}");
    let (boxes, scores, names) = (array("boxes_lidar")?, array("score")?, array("name")?);
    let (rows, columns) = match boxes.shape[..] {
        [0, ..] if scores.shape[..] == [0] => return Ok(Vec::new()),
        [rows, columns] if columns >= 7 => (rows, columns),
        _ => return Err(format!("{}, but boxes are [N, 7]", of("boxes_lidar", &boxes.shape))),
    };
    for (key, shape) in [("score", &scores.shape), ("name", &names.shape)] {
        if shape[..] != [rows] {
            return Err(format!("{}, but boxes_lidar has {rows} rows", of(key, shape)));
        }
    }
    *budget = budget.checked_sub(rows).ok_or("has more detections, with those before it, than the file can hold")?;
    let boxes = boxes.numbers().map_err(|message| format!("boxes_lidar {message}"))?;
    let scores = scores.numbers().map_err(|message| format!("score {message}"))?;
    let names = names.texts().map_err(|message| format!("name {message}"))?;
    let mut out = Vec::with_capacity(rows);
    for (k, (row, (score, class))) in boxes.chunks_exact(columns).zip(scores.into_iter().zip(names)).enumerate() {
        let wrong = |message: String| Err(format!("detection {k}: {message}"));
        let score = score as f32;
        if let Some(v) = row[..7].iter().copied().chain([score.into()]).find(|v| !v.is_finite()) {
            return wrong(format!("{v} in its box or score is not a finite number"));
        }
        if let Some(v) = row[..3].iter().find(|v| v.abs() > FARTHEST_M) {
            return wrong(format!("its centre is at {v} m, farther than 10 km"));
        }
        if let Some(v) = row[3..6].iter().find(|v| **v < 0.0) {
            return wrong(format!("its size is {v} m; a size cannot be negative"));
        }
        if class.is_empty() || class.len() > LONGEST_NAME {
            return wrong(format!("the name of its class has {} bytes; 1 to {LONGEST_NAME} are allowed", class.len()));
        }
        let bbox = Box3::from_array(std::array::from_fn(|i| row[i]));
        out.push(Detection { class, bbox, score });
    }
    Ok(out)
}

#[cfg(test)]
mod tests;
