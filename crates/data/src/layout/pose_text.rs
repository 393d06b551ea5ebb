//! Poses as text: a line a frame with the 12 values of a 3x4 matrix, row by row, or the 16 of a 4x4 matrix.

use crate::limits::{MOST_IDS, at_most};
use crate::{DataError, FARTHEST_M};
use geometry::Pose;
use nalgebra::{Matrix3, Rotation3, Translation3, UnitQuaternion};
use std::path::Path;

/// How far the columns of a rotation may be from orthonormal. Files have from 6 significant digits.
const MOST_SKEW: f64 = 1e-3;

/// Parses poses. Blank lines at the end are skipped. `path` is used in error messages.
///
/// A line of which all values are `nan` is a pose that is not known, such as in a gap of the GPS: `None`.
///
/// # Errors
/// Another number of values, single values that are not finite, and what is no rotation. A mirrored matrix is named.
pub(super) fn parse_poses(text: &str, path: &Path) -> Result<Vec<Option<Pose>>, DataError> {
    let mut poses = Vec::new();
    let text = text.trim_end();
    for (i, line) in text.lines().enumerate() {
        at_most(path, "poses", i as u64 + 1, MOST_IDS)?;
        poses.push(parse_pose(line).map_err(|message| DataError::line(path, i + 1, message))?);
    }
    if poses.is_empty() { Err(DataError::file(path, "has no pose")) } else { Ok(poses) }
}

fn parse_pose(line: &str) -> Result<Option<Pose>, String> {
    let mut values = [0.0; 16];
    let mut count = 0;
    for word in line.split(|c: char| c.is_ascii_whitespace() || c == ',').filter(|word| !word.is_empty()) {
        let value = word.parse::<f64>().map_err(|_| format!("{word:?} is not a number"))?;
        if let Some(place) = values.get_mut(count) {
            *place = value;
        }
        count += 1;
    }
    if count != 12 && count != 16 {
        return Err(format!("a pose has 12 values (3x4, row by row) or 16 (4x4); this line has {count}"));
    }
    if values[..count].iter().all(|v| v.is_nan()) {
        return Ok(None);
    }
    if count == 16 && values[12..] != [0.0, 0.0, 0.0, 1.0] {
        return Err(format!("the last row of a 4x4 pose is 0 0 0 1, not {:?}", &values[12..]));
    }
    pose_from_rows(&values[..12]).map(Some)
}

/// The pose of a 3x4 matrix, row by row.
///
/// # Errors
/// Values that are not finite, and what is no rotation.
pub(super) fn pose_from_rows(rows: &[f64]) -> Result<Pose, String> {
    if let Some(i) = rows.iter().position(|v| !v.is_finite()) {
        return Err(format!("value {} is {}; a pose that is not known has nan in all values", i + 1, rows[i]));
    }
    let rotation = Matrix3::from_fn(|row, column| rows[row * 4 + column]);
    if rotation.determinant() < 0.0 {
        return Err("the matrix mirrors: its frames have unlike handedness; turn one axis of the poses".into());
    }
    let skew = (rotation.transpose() * rotation - Matrix3::identity()).abs().max();
    if skew > MOST_SKEW {
        return Err(format!("the left 3x3 values are not a rotation: they are {skew:.3} from orthonormal"));
    }
    let quaternion = UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(rotation));
    let quaternion = UnitQuaternion::new_normalize(quaternion.into_inner());
    Ok(Pose::from_parts(Translation3::new(rows[3], rows[7], rows[11]), quaternion))
}

/// Where the line of each id is in a table with a line a frame.
///
/// A table with as many lines as there are frames has them in the order of the sorted ids. Any other table has a line
/// for each number of a frame, from 0: the table of a whole drive, of which some frames are there.
#[derive(Debug)]
pub(super) enum LineOfFrame {
    /// The position of the id among all ids.
    Position,
    /// The number that the id is.
    Number,
}

impl LineOfFrame {
    /// For a table of `lines` lines beside `frames` frames.
    pub(super) fn of(lines: usize, frames: usize) -> LineOfFrame {
        if lines == frames { LineOfFrame::Position } else { LineOfFrame::Number }
    }

    /// The line of an id, from 0. `all` are all ids of the folder, sorted. `path` and `lines` are of the table.
    ///
    /// # Errors
    /// The table has no such line.
    pub(super) fn line(&self, id: &str, all: &[String], path: &Path, lines: usize) -> Result<usize, DataError> {
        let found = match self {
            LineOfFrame::Position => all.binary_search_by(|known| known.as_str().cmp(id)).ok(),
            LineOfFrame::Number => id.parse().ok(),
        };
        found.filter(|line| *line < lines).ok_or_else(|| {
            let frames = all.len();
            let message = format!(
                "has {lines} lines and none for frame {id}: it needs a line for each of the {frames} clouds, or clouds \
                 whose names are the numbers of its lines, from 0"
            );
            DataError::file(path, message)
        })
    }
}

/// An error unless the box has finite values, positive sizes and lies within 10 km.
pub(super) fn check_box(bbox: &geometry::Box3) -> Result<(), String> {
    if !bbox.size.iter().all(|v| v.is_finite() && *v > 0.0) {
        return Err(format!("the sizes of a box must be positive, not {:?}", bbox.size));
    }
    if !bbox.center.iter().all(|v| v.abs() <= f64::from(FARTHEST_M)) {
        return Err(format!("the centre of the box {:?} is not finite or farther than 10 km", bbox.center));
    }
    if !bbox.yaw_rad.is_finite() {
        return Err(format!("the yaw of a box must be finite, not {}", bbox.yaw_rad));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A line of 12 values.
    fn line(pose: &Pose) -> String {
        let m = pose.to_homogeneous();
        let row = |r: usize| (0..4).map(move |c| m[(r, c)].to_string());
        (0..3).flat_map(row).collect::<Vec<_>>().join(" ")
    }

    fn parse(text: &str) -> Result<Vec<Option<Pose>>, String> {
        parse_poses(text, Path::new("poses.txt")).map_err(|e| e.to_string())
    }

    proptest! {
        #[test]
        fn poses_round_trip(t in prop::array::uniform3(-1e4..1e4), r in prop::array::uniform3(-1.8..1.8)) {
            let pose = Pose::new(t.into(), r.into());
            let text = line(&pose);
            let again = parse(&format!("{text}\n{text} 0 0 0 1\n\n")).unwrap();
            for found in &again {
                let found = found.unwrap();
                prop_assert!((found.translation.vector - pose.translation.vector).norm() < 1e-9);
                prop_assert!(found.rotation.angle_to(&pose.rotation) < 1e-7);
            }
            prop_assert_eq!(again.len(), 2);
        }

        #[test]
        fn arbitrary_text_does_not_panic(text in "[-0-9a-z. \n,]{0,200}") {
            let _ = parse(&text);
        }
    }

    #[test]
    fn bad_poses_are_refused_by_line() {
        let fine = "1 0 0 5 0 1 0 6 0 0 1 7";
        let cases = [
            ("1 0 0 5", "12 values (3x4, row by row) or 16 (4x4); this line has 4"),
            ("1 0 0 5 0 1 0 6 0 0 1 seven", "\"seven\" is not a number"),
            ("1 0 0 5 0 1 0 nan 0 0 1 7", "value 8 is NaN"),
            ("1 0 0 5 0 1 0 inf 0 0 1 7", "value 8 is inf"),
            ("1 0 0 5 0 -1 0 6 0 0 1 7", "the matrix mirrors"),
            ("2 0 0 5 0 2 0 6 0 0 2 7", "3.000 from orthonormal"),
            ("", "this line has 0"),
            ("1 0 0 5 0 1 0 6 0 0 1 7 0 0 1 1", "the last row of a 4x4 pose is 0 0 0 1"),
        ];
        for (line, want) in cases {
            let error = parse(&format!("{fine}\n{line}\n{fine}\n")).unwrap_err();
            assert!(error.starts_with("poses.txt:2: ") && error.contains(want), "{error}");
        }
        assert_eq!(parse("").unwrap_err(), "poses.txt: has no pose");
        let nan = ["nan"; 12].join(" ");
        let poses = parse(&format!("{fine}\n{nan}\n")).unwrap();
        assert!(poses[0].is_some() && poses[1].is_none());
    }

    #[test]
    fn lines_of_frames() {
        let ids = ["000010", "000011"].map(String::from);
        let line = |id: &str, lines| LineOfFrame::of(lines, 2).line(id, &ids, Path::new("poses.txt"), lines);
        assert_eq!(line("000011", 2).unwrap(), 1);
        assert_eq!(line("000011", 20).unwrap(), 11);
        let error = line("000011", 11).unwrap_err().to_string();
        assert!(error.contains("poses.txt: has 11 lines and none for frame 000011"), "{error}");
        assert!(line("000012", 2).is_err());
    }
}
