//! The segment that `tests/golden/waymo/make.py` wrote, and changes of it.

use super::*;
use crate::Dataset;
use arrow_array::{ArrayRef, Float64Array, Int8Array, RecordBatch};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde::Deserialize;
use std::fs::{self, File};
use std::sync::Arc;

const SEGMENT: &str = "made_up_0000_000_0020_000";
const COMPONENTS: [&str; 5] = ["lidar", "lidar_calibration", "lidar_pose", "vehicle_pose", "lidar_box"];

#[derive(Deserialize)]
struct Expected {
    stamp_us: i64,
    points: Vec<[f64; 5]>,
    boxes: Vec<(String, String, [f64; 7])>,
    place: [f64; 3],
    rotation: [[f64; 3]; 3],
}

fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/waymo")
}

fn expected() -> Vec<Expected> {
    serde_json::from_str(&fs::read_to_string(golden().join("expected.json")).unwrap()).unwrap()
}

/// A copy of the segment.
fn copy() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for name in COMPONENTS {
        fs::create_dir(folder.path().join(name)).unwrap();
        fs::copy(component(&golden(), name, SEGMENT), component(folder.path(), name, SEGMENT)).unwrap();
    }
    folder
}

/// Writes a component anew after a change of its rows.
fn rewrite(folder: &Path, name: &str, change: impl Fn(RecordBatch) -> RecordBatch) {
    let path = component(folder, name, SEGMENT);
    let builder = ParquetRecordBatchReaderBuilder::try_new(File::open(&path).unwrap()).unwrap();
    let mut reader = builder.with_batch_size(100).build().unwrap();
    let rows = change(reader.next().unwrap().unwrap());
    assert!(reader.next().is_none());
    let mut writer = ArrowWriter::try_new(File::create(&path).unwrap(), rows.schema(), None).unwrap();
    writer.write(&rows).unwrap();
    writer.close().unwrap();
}

/// A table with another column in the place of one.
fn with_column(rows: &RecordBatch, name: &str, column: ArrayRef) -> RecordBatch {
    let names: Vec<String> = rows.schema().fields().iter().map(|field| field.name().clone()).collect();
    let columns = names.into_iter().zip(rows.columns()).map(|(other, old)| {
        let column = if other == name { column.clone() } else { old.clone() };
        (other, column)
    });
    RecordBatch::try_from_iter_with_nullable(columns.map(|(name, column)| (name, column, true))).unwrap()
}

/// What is wrong with the first frame, or with the list of frames.
fn error(folder: &Path) -> String {
    let read = || {
        let dataset = Dataset::open(folder)?;
        let ids = dataset.all_ids()?;
        dataset.moments(&ids)?;
        ids.iter().try_for_each(|id| dataset.load(id).map(drop))
    };
    read().unwrap_err().to_string()
}

/// Compares a frame with what numpy computed, and gives its number of points.
fn check(dataset: &Dataset, id: &str, expected: &Expected) -> usize {
    let (frame, details) = (dataset.load(id).unwrap(), dataset.point_details(id).unwrap());
    let rings = details.ring.unwrap();
    assert_eq!((details.time_s, details.compensated), (None, Some(true)));
    let wanted = &expected.points[..frame.cloud.len()];
    for ((point, ring), want) in frame.cloud.points().zip(&rings).zip(wanted) {
        let off = (0..4).map(|i| (f64::from(point[i]) - want[i]).abs()).fold(0.0, f64::max);
        assert!(off < 1e-3 && f64::from(*ring) == want[4], "{point:?} {ring} is not {want:?}");
    }
    assert_eq!((rings.len(), frame.objects.len()), (wanted.len(), expected.boxes.len()));
    for (object, (_, class, bbox)) in frame.objects.iter().zip(&expected.boxes) {
        let off = object.bbox.to_array().iter().zip(bbox).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 1e-6 && object.class == *class, "{object:?} is not {class} {bbox:?}");
    }
    frame.cloud.len()
}

#[test]
fn points_poses_and_boxes_are_those_of_numpy() {
    let (dataset, expected) = (Dataset::open(&golden()).unwrap(), expected());
    assert_eq!((dataset.config.layout, dataset.config.points), (Layout::Waymo, PointColumns::Xyzi));
    assert_eq!(dataset.config.classes, ["Cyclist", "Pedestrian", "Vehicle"]);
    let ids = dataset.all_ids().unwrap();
    assert_eq!(ids, expected.iter().map(|e| format!("{SEGMENT}_{}", e.stamp_us)).collect::<Vec<_>>());
    // Also in another order than that of the file.
    for i in [0, 1, 2, 1, 0, 2] {
        assert_eq!(check(&dataset, &ids[i], &expected[i]), expected[i].points.len());
    }
    let sequences = dataset.sequences().unwrap();
    assert_eq!((sequences.len(), sequences[0].name.as_str(), &sequences[0].ids), (1, SEGMENT, &ids));
    for (moment, expected) in dataset.moments(&ids).unwrap().iter().zip(&expected) {
        let seconds = (expected.stamp_us - 1_550_083_467_346_370) as f64 * 1e-6;
        assert!((moment.stamp_s.unwrap() - seconds).abs() < 1e-9);
        let pose = moment.world_from_lidar.unwrap();
        let rotation = pose.rotation.to_rotation_matrix();
        for row in 0..3 {
            assert!((pose.translation.vector[row] - expected.place[row]).abs() < 1e-5);
            assert!((0..3).all(|column| (rotation[(row, column)] - expected.rotation[row][column]).abs() < 1e-9));
        }
        let tracks: Vec<&str> = moment.objects.iter().map(|o| o.track.as_str()).collect();
        assert_eq!(tracks, expected.boxes.iter().map(|b| b.0.as_str()).collect::<Vec<_>>());
    }
}

#[test]
fn the_upper_lidar_can_be_read_alone() {
    let root = PathBuf::from(format!("{}#top", golden().display()));
    let (dataset, expected) = (Dataset::open(&root).unwrap(), expected());
    for (id, expected) in dataset.all_ids().unwrap().iter().zip(&expected) {
        let top = expected.points.iter().filter(|point| point[4] < 8.0).count();
        assert!((150..256).contains(&top));
        assert_eq!(check(&dataset, id, expected), top);
    }
}

#[test]
fn missing_components_and_columns_are_named() {
    for (name, columns) in [
        ("lidar", &["key.frame_timestamp_micros", "key.laser_name", "[LiDARComponent].range_image_return1.values"][..]),
        ("lidar_calibration", &["key.laser_name", "[LiDARCalibrationComponent].extrinsic.transform"]),
        ("lidar_pose", &["key.laser_name", "[LiDARPoseComponent].range_image_return1.shape"]),
        ("vehicle_pose", &["[VehiclePoseComponent].world_from_vehicle.transform"]),
        ("lidar_box", &["key.laser_object_id", "[LiDARBoxComponent].box.heading", "[LiDARBoxComponent].type"]),
    ] {
        for column in columns {
            let folder = copy();
            rewrite(folder.path(), name, |mut rows| {
                rows.remove_column(rows.schema().index_of(column).unwrap());
                rows
            });
            let error = error(folder.path());
            let place = format!("{name}/{SEGMENT}.parquet: ");
            assert!(error.contains(&place) && error.ends_with(&format!(": has no column {column}")), "{error}");
        }
        if name != "lidar" {
            let folder = copy();
            fs::remove_file(component(folder.path(), name, SEGMENT)).unwrap();
            let error = error(folder.path());
            assert!(error.contains(&format!("{name}/{SEGMENT}.parquet: does not exist: add this")), "{error}");
        }
    }
    // A segment in which nothing is labelled.
    let folder = copy();
    rewrite(folder.path(), "lidar_box", |rows| rows.slice(0, 0));
    let dataset = Dataset::open(folder.path()).unwrap();
    assert!(dataset.has_labels() && dataset.load(&dataset.all_ids().unwrap()[0]).unwrap().objects.is_empty());
    let folder = copy();
    fs::remove_dir_all(folder.path().join("lidar_box")).unwrap();
    let dataset = Dataset::open(folder.path()).unwrap();
    let ids = dataset.all_ids().unwrap();
    assert!(!dataset.has_labels() && dataset.load(&ids[0]).unwrap().objects.is_empty());
    assert!(dataset.moments(&ids).unwrap()[2].objects.is_empty());
}

#[test]
fn wrong_values_are_refused_by_file_and_column() {
    let reals = |values: &[f64]| Arc::new(Float64Array::from(values.to_vec())) as ArrayRef;
    let wholes = |values: &[i8]| Arc::new(Int8Array::from(values.to_vec())) as ArrayRef;
    let calibration = "[LiDARCalibrationComponent].beam_inclination.min";
    for (name, column, values, want) in [
        ("lidar", "key.laser_name", wholes(&[2, 6, 1, 2, 1]), "row 1 (from 0): key.laser_name 6 is not from 1 to 5"),
        ("lidar", "key.laser_name", wholes(&[2, 2, 1, 2, 1]), "and key.laser_name 2 occur twice"),
        ("lidar", "key.laser_name", reals(&[1.0; 5]), "column key.laser_name has Float64, not whole numbers"),
        ("lidar", "[LiDARComponent].range_image_return1.values", reals(&[1.0; 5]), "has Float64, not lists of real"),
        ("lidar", "[LiDARComponent].range_image_return1.shape", reals(&[1.0; 5]), "not lists of whole numbers"),
        ("lidar_pose", "key.laser_name", wholes(&[2; 3]), "the upper LiDAR has no row in lidar_pose"),
        ("lidar_calibration", "key.laser_name", wholes(&[3, 2]), "has no key.laser_name 1"),
        ("lidar_calibration", "key.laser_name", wholes(&[2, 1]), "2: its range image has 4 rows, but its"),
        ("lidar_calibration", calibration, reals(&[0.0, 9.0]), "row 1 (from 0): its inclinations are not ascending"),
        ("lidar_box", "[LiDARBoxComponent].type", wholes(&[1, 2, 9, 1, 1, 1, 1, 1]), "type 9 is not from 0 to 4"),
        ("lidar_box", "[LiDARBoxComponent].box.size.x", reals(&[-1.0; 8]), "row 0 (from 0): the sizes of a box"),
    ] {
        let folder = copy();
        rewrite(folder.path(), name, |rows| with_column(&rows, column, values.clone()));
        let error = error(folder.path());
        assert!(error.contains(&format!("/{SEGMENT}.parquet: ")) && error.contains(want), "{error}");
    }
    // Rows of another frame in the place of those of the first one.
    for (name, want) in [
        ("lidar", "key.laser_name 1: the poses are of 8 x 32 pixels, but the range image has 4 x 16"),
        ("vehicle_pose", "has no row in vehicle_pose"),
    ] {
        let folder = copy();
        rewrite(folder.path(), name, |rows| {
            let swapped = if name == "lidar" { rows.slice(0, 2) } else { rows.slice(1, 2) };
            let lasers = wholes(&[1, 2]);
            if name == "lidar" { with_column(&swapped, "key.laser_name", lasers) } else { swapped }
        });
        let error = error(folder.path());
        assert!(error.contains(want), "{error}");
    }
}

#[test]
fn damaged_files_are_refused_by_name() {
    for name in COMPONENTS {
        let whole = fs::read(component(&golden(), name, SEGMENT)).unwrap();
        for length in [0, 3, 8, whole.len() / 2, whole.len() - 1] {
            let folder = copy();
            fs::write(component(folder.path(), name, SEGMENT), &whole[..length]).unwrap();
            let error = error(folder.path());
            let want = format!("{name}/{SEGMENT}.parquet: is not a Parquet file, or is damaged: ");
            assert!(error.contains(&want), "{length} bytes: {error}");
        }
    }
    // The pages are damaged, but not the metadata at the end.
    let folder = copy();
    let path = component(folder.path(), "lidar", SEGMENT);
    let mut bytes = fs::read(&path).unwrap();
    bytes[1500..4000].fill(0xff);
    fs::write(&path, bytes).unwrap();
    let error = error(folder.path());
    assert!(error.contains("lidar/") && error.contains("is damaged: the columns [LiDARComponent]"), "{error}");
}

#[test]
fn frames_that_are_not_there_are_named() {
    let dataset = Dataset::open(&golden()).unwrap();
    for (id, want) in [
        ("000000".to_string(), "frame 000000: the frames of Waymo are SEGMENT_STAMP"),
        (format!("{SEGMENT}_7"), "lidar/made_up_0000_000_0020_000.parquet: has no frame"),
        ("other_7".to_string(), "lidar/other.parquet: does not exist"),
    ] {
        let error = dataset.load(&id).unwrap_err().to_string();
        assert!(error.contains(want), "{error}");
        assert!(!dataset.config.layout.has_cloud(&dataset.config.root, &id));
    }
    let folder = copy();
    fs::copy(component(&golden(), "lidar", SEGMENT), component(folder.path(), "lidar", "other")).unwrap();
    let dataset = Dataset::without_classes(folder.path()).unwrap();
    assert_eq!(dataset.sequences().unwrap().iter().map(|s| s.ids.len()).collect::<Vec<_>>(), [3, 3]);
    let error = dataset.moments(&dataset.all_ids().unwrap()).unwrap_err().to_string();
    assert!(error.contains("other_1550083467346370 is of another segment than made_up"), "{error}");
}

/// A segment that is written anew is read anew.
#[test]
fn changed_files_are_read_again() {
    let folder = copy();
    let dataset = Dataset::open(folder.path()).unwrap();
    let ids = dataset.all_ids().unwrap();
    dataset.load(&ids[2]).unwrap();
    rewrite(folder.path(), "lidar", |rows| rows.slice(0, 2));
    assert_eq!(dataset.all_ids().unwrap(), ids[..1]);
    assert!(dataset.load(&ids[2]).unwrap_err().to_string().contains("has no frame"));
    let points = dataset.load(&ids[0]).unwrap().cloud.len();
    assert_eq!(points, expected()[0].points.len());
}
