//! Detections on many frames in one Parquet file: a row a detection, in the label frame of the data set.
//!
//! The book describes the columns in `reference/formats.md`.

use crate::kitti_text::check_detection;
use crate::layout::parquet_file::ParquetFile;
use crate::layout::table::Table;
use crate::limits::{MOST_BOXES, MOST_DETECTIONS, at_most};
use crate::output::write_atomic_with;
use crate::{DataError, LabelBox, Presence as _};
use arrow_array::{ArrayRef, Float64Array, RecordBatch, StringArray};
use parquet::arrow::ArrowWriter;
use parquet::basic::{Compression, ZstdLevel};
use parquet::file::properties::WriterProperties;
use std::collections::{BTreeSet, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Name of the file in a folder of detections.
pub const DETECTIONS_FILE: &str = "detections.parquet";

const FRAME: &str = "frame";
const CLASS: &str = "class";

/// The columns of numbers that every file has: [`required`].
const REQUIRED: [&str; 8] = ["score", "height_m", "width_m", "length_m", "x_m", "y_m", "z_m", "rotation_y_rad"];

/// The columns of numbers that a file may lack, and what their values are then: [`optional`].
const OPTIONAL: [(&str, f64); 7] = [
    ("truncation", -1.0),
    ("occlusion", -1.0),
    ("alpha_rad", -10.0),
    ("left_px", 0.0),
    ("top_px", 0.0),
    ("right_px", 50.0),
    ("bottom_px", 50.0),
];

/// Rows that are given to the library at once.
const BATCH_ROWS: usize = 4096;

/// Rows of a group, which is in memory while it is written.
const GROUP_ROWS: usize = 1 << 17;

fn required(detection: &LabelBox) -> [f64; 8] {
    let ([h, w, l], [x, y, z]) = (detection.size_hwl, detection.location);
    [detection.score.unwrap_or_default(), h, w, l, x, y, z, detection.rotation_y]
}

fn optional(detection: &LabelBox) -> [f64; 7] {
    let [left, top, right, bottom] = detection.image_box;
    [detection.truncation, detection.occlusion, detection.alpha, left, top, right, bottom]
}

fn detection(class: String, required: [f64; 8], optional: [f64; 7]) -> LabelBox {
    let [score, h, w, l, x, y, z, rotation_y] = required;
    let [truncation, occlusion, alpha, left, top, right, bottom] = optional;
    LabelBox {
        class,
        truncation,
        occlusion,
        alpha,
        image_box: [left, top, right, bottom],
        size_hwl: [h, w, l],
        location: [x, y, z],
        rotation_y,
        score: Some(score),
        track: None,
    }
}

/// The file of detections at a path: a file that ends in `.parquet`, or [`DETECTIONS_FILE`] in a folder.
pub fn detections_file(path: &Path) -> Option<PathBuf> {
    let inside = path.join(DETECTIONS_FILE);
    if inside.may_be_file() {
        return Some(inside);
    }
    let is_table = path.extension().is_some_and(|ending| ending == "parquet") && path.may_be_file();
    is_table.then(|| path.into())
}

/// Writes detections frame by frame.
pub struct DetectionsWriter<'a> {
    path: &'a Path,
    to: ArrowWriter<BufWriter<&'a mut File>>,
    /// Rows that the library does not have yet.
    rows: Vec<(String, Option<LabelBox>)>,
}

impl DetectionsWriter<'_> {
    /// Adds the detections on a frame, which may be none.
    ///
    /// # Errors
    /// A file that cannot be written.
    pub fn frame(&mut self, id: &str, detections: &[LabelBox]) -> Result<(), DataError> {
        self.rows.extend(detections.iter().map(|detection| (id.to_owned(), Some(detection.clone()))));
        if detections.is_empty() {
            self.rows.push((id.to_owned(), None));
        }
        if self.rows.len() >= BATCH_ROWS { self.give() } else { Ok(()) }
    }

    fn give(&mut self) -> Result<(), DataError> {
        let rows = std::mem::take(&mut self.rows);
        let wrong = |e: &dyn std::fmt::Display| DataError::file(self.path, format!("cannot be written: {e}"));
        let batch = batch(&rows).map_err(|e| wrong(&e))?;
        self.to.write(&batch).map_err(|e| wrong(&e))
    }
}

fn batch(rows: &[(String, Option<LabelBox>)]) -> Result<RecordBatch, Box<dyn std::error::Error>> {
    let boxes = || rows.iter().map(|(_, detection)| detection.as_ref());
    let frames: StringArray = rows.iter().map(|(frame, _)| Some(frame.as_str())).collect();
    let classes: StringArray = boxes().map(|detection| Some(detection?.class.as_str())).collect();
    let numbers = |of: &dyn Fn(&LabelBox) -> f64| -> ArrayRef {
        Arc::new(boxes().map(|detection| detection.map(of)).collect::<Float64Array>())
    };
    let mut columns: Vec<(&str, ArrayRef, bool)> =
        vec![(FRAME, Arc::new(frames), false), (CLASS, Arc::new(classes), true)];
    columns.extend(REQUIRED.iter().enumerate().map(|(i, name)| (*name, numbers(&|d| required(d)[i]), true)));
    columns.extend(OPTIONAL.iter().enumerate().map(|(i, (name, _))| (*name, numbers(&|d| optional(d)[i]), true)));
    Ok(RecordBatch::try_from_iter_with_nullable(columns)?)
}

/// Writes a file of detections, which appears whole or not at all. `fill` gives the frames.
///
/// # Errors
/// Those of `fill`, and a file that cannot be written.
pub fn write_detections<E: From<DataError>>(
    path: &Path,
    fill: impl FnOnce(&mut DetectionsWriter<'_>) -> Result<(), E>,
) -> Result<(), E> {
    write_atomic_with(path, |file| {
        let wrong = |e: &dyn std::fmt::Display| DataError::file(path, format!("cannot be written: {e}"));
        let properties = WriterProperties::builder()
            .set_compression(Compression::ZSTD(ZstdLevel::default()))
            .set_max_row_group_row_count(Some(GROUP_ROWS))
            .build();
        let schema = batch(&[]).map_err(|e| wrong(&e))?.schema();
        let to = ArrowWriter::try_new(BufWriter::new(file), schema, Some(properties)).map_err(|e| wrong(&e))?;
        let mut writer = DetectionsWriter { path, to, rows: Vec::new() };
        fill(&mut writer)?;
        writer.give()?;
        let buffered = writer.to.into_inner().map_err(|e| wrong(&e))?;
        buffered.into_inner().map_err(|e| wrong(e.error()))?;
        Ok(())
    })
}

/// What a file has of some frames.
#[derive(Debug, PartialEq)]
pub struct FoundDetections {
    /// The detections on each frame, in the order of the file; `None` if no row names the frame.
    pub frames: Vec<Option<Vec<LabelBox>>>,
    /// Other frames that the file names.
    pub others: BTreeSet<String>,
}

/// Reads the detections on some frames. Rows may be in any order.
///
/// # Errors
/// A file that cannot be read, a column that is missing or has other values, a row with a value that is missing or not
/// finite, a negative size, a box farther than 10 km, too many boxes of a frame.
pub fn read_detections_file(path: &Path, frames: &[&str]) -> Result<FoundDetections, DataError> {
    let file = ParquetFile::open_within(path, MOST_DETECTIONS)?;
    let mut found = FoundDetections { frames: vec![None; frames.len()], others: BTreeSet::new() };
    let places: HashMap<&str, usize> = frames.iter().enumerate().map(|(i, frame)| (*frame, i)).collect();
    let optional: Vec<&str> = OPTIONAL.iter().map(|(name, _)| *name).filter(|name| file.has_column(name)).collect();
    let columns = [&[FRAME, CLASS][..], &REQUIRED, &optional].concat();
    let mut before = 0;
    for table in file.tables(&columns)? {
        let table = table?;
        let rows = Rows::of(&table, &optional)?;
        for (row, frame) in table.texts(FRAME)?.into_iter().enumerate() {
            let Some(place) = places.get(frame.as_str()) else {
                if !found.others.contains(&frame) {
                    found.others.insert(frame);
                }
                continue;
            };
            let boxes = found.frames[*place].get_or_insert_default();
            let wrong =
                |what: String| DataError::file(path, format!("row {} (from 0), frame {frame}: {what}", before + row));
            if let Some(detection) = rows.detection(row).map_err(wrong)? {
                boxes.push(detection);
                at_most(path, &format!("boxes of frame {frame}"), boxes.len() as u64, MOST_BOXES)?;
            }
        }
        before += table.rows();
    }
    Ok(found)
}

/// The frames that a file names.
///
/// # Errors
/// A file that cannot be read.
pub fn frames_of_detections(path: &Path) -> Result<BTreeSet<String>, DataError> {
    let file = ParquetFile::open_within(path, MOST_DETECTIONS)?;
    let mut frames = BTreeSet::new();
    for table in file.tables(&[FRAME])? {
        for frame in table?.texts(FRAME)? {
            if !frames.contains(&frame) {
                frames.insert(frame);
            }
        }
    }
    Ok(frames)
}

/// The values of some rows.
struct Rows {
    classes: Vec<Option<String>>,
    required: Vec<Vec<Option<f64>>>,
    optional: Vec<Option<Vec<Option<f64>>>>,
}

impl Rows {
    fn of(table: &Table, optional: &[&str]) -> Result<Rows, DataError> {
        let numbers = |name: &str| table.optional_numbers(name);
        let if_there = |(name, _): &(&str, f64)| optional.contains(name).then(|| numbers(name)).transpose();
        Ok(Rows {
            classes: table.optional_texts(CLASS)?,
            required: REQUIRED.iter().map(|name| numbers(name)).collect::<Result<_, _>>()?,
            optional: OPTIONAL.iter().map(if_there).collect::<Result<_, _>>()?,
        })
    }

    /// The detection of a row; `None` if no column but the frame has a value, or what is wrong.
    fn detection(&self, row: usize) -> Result<Option<LabelBox>, String> {
        let optional = || self.optional.iter().flatten();
        let empty = self.classes[row].is_none() && self.required.iter().chain(optional()).all(|all| all[row].is_none());
        if empty {
            return Ok(None);
        }
        let value = |name: &str, value: Option<f64>| match value {
            Some(value) if value.is_finite() => Ok(value),
            Some(value) => Err(format!("{name} is {value}, not a finite number")),
            None => Err(missing(name)),
        };
        let (mut of_box, mut beside) = ([0.0; 8], OPTIONAL.map(|(_, default)| default));
        for (i, name) in REQUIRED.iter().enumerate() {
            of_box[i] = value(name, self.required[i][row])?;
        }
        for (i, (name, _)) in OPTIONAL.iter().enumerate() {
            if let Some(column) = &self.optional[i] {
                beside[i] = value(name, column[row])?;
            }
        }
        let class = self.classes[row].clone().ok_or_else(|| missing(CLASS))?;
        let detection = detection(class, of_box, beside);
        check_detection(&detection)?;
        Ok(Some(detection))
    }
}

fn missing(name: &str) -> String {
    format!("{name} is missing; a frame without detections has one row, of which only {FRAME} has a value")
}

#[cfg(test)]
mod tests {
    use super::*;
    use geometry::Box3;

    fn found(x: f64, score: f32) -> LabelBox {
        LabelBox::from_box("Car", &Box3::from_array([x, -3.0, -0.7, 4.88, 1.9, 1.18, 0.1 + 0.2]), Some(score))
    }

    fn write(path: &Path, frames: &[(&str, Vec<LabelBox>)]) {
        let fill = |to: &mut DetectionsWriter<'_>| frames.iter().try_for_each(|(id, boxes)| to.frame(id, boxes));
        write_detections::<DataError>(path, fill).unwrap();
    }

    #[test]
    fn frames_round_trip_to_the_bit() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/detections.parquet");
        let camera = LabelBox {
            truncation: 0.25,
            occlusion: 2.0,
            alpha: 0.1,
            image_box: [1.5, 2.0, 3.0, 4.0],
            ..found(1.0 / 3.0, 0.1)
        };
        // More rows than are written at once.
        let many: Vec<LabelBox> = (0..BATCH_ROWS + 5).map(|i| found(i as f64 / 7.0, 0.5)).collect();
        let frames = [("b", vec![camera, found(2.0, 0.9)]), ("empty", vec![]), ("a", many.clone()), ("c", many)];
        write(&path, &frames);
        let read = read_detections_file(&path, &["a", "none", "empty", "b"]).unwrap();
        let wanted = vec![Some(frames[2].1.clone()), None, Some(vec![]), Some(frames[0].1.clone())];
        assert_eq!(read, FoundDetections { frames: wanted, others: ["c".into()].into() });
        assert!(frames_of_detections(&path).unwrap().iter().eq(["a", "b", "c", "empty"]));

        // The same detections are the same bytes.
        let again = folder.path().join("again.parquet");
        write(&again, &frames);
        assert_eq!(std::fs::read(&path).unwrap(), std::fs::read(&again).unwrap());
        assert_eq!(detections_file(path.parent().unwrap()), Some(path));
        assert_eq!(detections_file(&again), Some(again));
        assert_eq!(detections_file(folder.path()), None);
        write(&folder.path().join("none.parquet"), &[]);
        let read = read_detections_file(&folder.path().join("none.parquet"), &["a"]).unwrap();
        assert_eq!(read, FoundDetections { frames: vec![None], others: BTreeSet::new() });
    }

    #[test]
    #[ignore = "takes minutes: prints files, bytes and times of a cell of 20,000 frames"]
    #[expect(clippy::print_stdout, reason = "a measurement")]
    fn a_cell_as_text_and_as_one_file() {
        use crate::write::write_kitti_text;
        use crate::{KittiText, read_kitti_text, stream};
        use rand::RngExt as _;
        use rayon::prelude::*;
        let folder = tempfile::tempdir().unwrap();
        let mut random = stream(1, "cell", 0, 0);
        let ids: Vec<String> = (0..20_000).map(|i| format!("{i:06}")).collect();
        let boxes: Vec<Vec<LabelBox>> = ids
            .iter()
            .map(|_| {
                let number = random.random_range(0..40);
                let mut near = |value: f32| f64::from(value + random.random_range(-1.0f32..1.0));
                let mut one = || {
                    let values = [30.0 * near(0.0), 30.0 * near(0.0), near(-1.0), near(4.0), near(2.0), near(1.6)];
                    let bbox =
                        Box3::from_array([values[0], values[1], values[2], values[3], values[4], values[5], near(0.0)]);
                    LabelBox::from_box("Car", &bbox, Some(near(1.0) as f32 / 2.0))
                };
                (0..number).map(|_| one()).collect()
            })
            .collect();
        let time = |what: &str, work: &dyn Fn()| {
            let start = std::time::Instant::now();
            work();
            println!("{what}: {:.2} s", start.elapsed().as_secs_f64());
        };
        let (text, path) = (folder.path().join("text"), folder.path().join("cell/detections.parquet"));
        let file = |id: &String| text.join(format!("{id}.txt"));
        time("write text", &|| {
            ids.iter().zip(&boxes).for_each(|(id, boxes)| write_kitti_text(&file(id), boxes).unwrap());
        });
        let frames: Vec<(&str, Vec<LabelBox>)> = ids.iter().map(String::as_str).zip(boxes.clone()).collect();
        time("write file", &|| write(&path, &frames));
        time("read text, two threads", &|| {
            let read: Vec<_> =
                ids.par_iter().map(|id| read_kitti_text(&file(id), KittiText::Detections).unwrap()).collect();
            assert!(read == boxes);
        });
        let names: Vec<&str> = ids.iter().map(String::as_str).collect();
        time("read file", &|| {
            let read = read_detections_file(&path, &names).unwrap();
            assert!(read.frames.into_iter().map(Option::unwrap).eq(boxes.iter().cloned()));
        });
        time("state of text", &|| assert!(ids.iter().all(|id| file(id).may_be_file())));
        time("state of file", &|| assert!(path.may_be_file()));
        time("checksum of file", &|| drop(crate::checksum::file_sha256(&path).unwrap()));
        let lengths = ids.iter().map(|id| file(id).metadata().unwrap().len());
        let blocks: u64 = lengths.clone().map(|length| length.div_ceil(4096) * 4096).sum();
        let (bytes, of_file) = (lengths.sum::<u64>(), path.metadata().unwrap().len());
        let detections: usize = boxes.iter().map(Vec::len).sum();
        println!("{detections} detections; text {bytes} bytes, {blocks} in blocks of 4 KiB; file {of_file} bytes");
    }

    /// Writes a file with these columns; `None` of a number is a value that is missing.
    fn other(path: &Path, changed: &[(&str, &[Option<f32>])], left_out: &str) {
        let rows = changed[0].1.len();
        let frames: StringArray = vec![Some("a"); rows].into_iter().collect();
        let classes: StringArray = changed[0].1.iter().map(|v| v.map(|_| "Car")).collect();
        let mut columns: Vec<(&str, ArrayRef)> = vec![(FRAME, Arc::new(frames)), (CLASS, Arc::new(classes))];
        for name in REQUIRED.iter().filter(|name| **name != left_out) {
            let known = changed.iter().find(|(other, _)| other == name);
            let values = known.map_or_else(|| vec![Some(1.5f32); rows], |(_, values)| values.to_vec());
            columns.push((name, Arc::new(arrow_array::Float32Array::from(values))));
        }
        let batch = RecordBatch::try_from_iter(columns).unwrap();
        let mut to = ArrowWriter::try_new(File::create(path).unwrap(), batch.schema(), None).unwrap();
        to.write(&batch).unwrap();
        to.close().unwrap();
    }

    #[test]
    fn files_of_other_programs_and_bad_rows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("found.parquet");
        let read = || read_detections_file(&path, &["a"]);
        other(&path, &[("score", &[Some(0.25), Some(0.5)])], "");
        let boxes = read().unwrap().frames[0].clone().unwrap();
        assert_eq!(boxes.len(), 2);
        assert_eq!((boxes[1].score, boxes[1].size_hwl, boxes[1].location), (Some(0.5), [1.5; 3], [1.5; 3]));
        let beside = LabelBox::from_box("Car", &boxes[1].lidar_box(), Some(0.5));
        assert_eq!(boxes[1], beside, "columns that may be missing");
        for (changed, message) in [
            (("score", Some(f32::NAN)), "row 1 (from 0), frame a: score is NaN, not a finite number"),
            (("width_m", Some(-2.0)), "row 1 (from 0), frame a: width is -2; a size cannot be negative"),
            (("x_m", Some(20_000.0)), "frame a: location x is 20000 m, farther than 10 km"),
            (("z_m", None), "frame a: z_m is missing; a frame without detections has one row"),
        ] {
            let scores: [Option<f32>; 2] = [Some(0.5), if changed.0 == "score" { changed.1 } else { Some(0.5) }];
            other(&path, &[("score", &scores), (changed.0, &[Some(1.0), changed.1])], "");
            let error = read().unwrap_err().to_string();
            assert!(error.contains("found.parquet: ") && error.contains(message), "{error}");
        }
        other(&path, &[("score", &[Some(0.25)])], "y_m");
        let error = read().unwrap_err().to_string();
        assert!(error.contains("found.parquet: has no column y_m"), "{error}");
        std::fs::write(&path, "a text").unwrap();
        assert!(read().unwrap_err().to_string().contains("is not a Parquet file, or is damaged"));
        write(&path, &[("a", vec![found(1.0, 0.5); 3])]);
        let error = ParquetFile::open_within(&path, 2).map(drop).unwrap_err().to_string();
        assert!(error.contains("has 3 rows; at most 2 are supported"), "{error}");
    }
}
