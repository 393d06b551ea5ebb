//! PCD files with arbitrary columns: per-point data that are stored beside a cloud.

use crate::pcd_header::{PcdEncoding, parse_pcd_header};
use crate::{DataError, write_atomic};
use std::path::Path;

/// A column with one number per point.
#[derive(Clone, Debug, PartialEq)]
pub enum PcdColumn {
    /// TYPE F, SIZE 4.
    F32(Vec<f32>),
    /// TYPE U, SIZE 1.
    U8(Vec<u8>),
    /// TYPE U, SIZE 2.
    U16(Vec<u16>),
}

impl PcdColumn {
    /// SIZE and TYPE of the PCD header.
    fn kind(&self) -> (usize, char) {
        match self {
            PcdColumn::F32(_) => (4, 'F'),
            PcdColumn::U8(_) => (1, 'U'),
            PcdColumn::U16(_) => (2, 'U'),
        }
    }

    fn len(&self) -> usize {
        match self {
            PcdColumn::F32(v) => v.len(),
            PcdColumn::U8(v) => v.len(),
            PcdColumn::U16(v) => v.len(),
        }
    }

    fn push(&self, row: usize, out: &mut Vec<u8>) {
        match self {
            PcdColumn::F32(v) => out.extend(v[row].to_le_bytes()),
            PcdColumn::U8(v) => out.push(v[row]),
            PcdColumn::U16(v) => out.extend(v[row].to_le_bytes()),
        }
    }
}

/// Encodes columns as PCD v0.7 with `DATA binary`. Panics if the columns differ in length.
pub fn encode_pcd_columns(columns: &[(&str, PcdColumn)]) -> Vec<u8> {
    let rows = columns.first().map_or(0, |(_, column)| column.len());
    assert!(columns.iter().all(|(_, column)| column.len() == rows), "all columns of a file have the same length");
    let entry = |value: &dyn Fn(&(&str, PcdColumn)) -> String| columns.iter().map(value).collect::<Vec<_>>().join(" ");
    let mut out = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {rows}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {rows}\nDATA binary\n",
        entry(&|(name, _)| name.to_string()),
        entry(&|(_, column)| column.kind().0.to_string()),
        entry(&|(_, column)| column.kind().1.to_string()),
        entry(&|_| "1".into()),
    )
    .into_bytes();
    for row in 0..rows {
        columns.iter().for_each(|(_, column)| column.push(row, &mut out));
    }
    out
}

/// Writes columns to a PCD file, see [`encode_pcd_columns`].
pub fn write_pcd_columns(path: &Path, columns: &[(&str, PcdColumn)]) -> Result<(), DataError> {
    write_atomic(path, &encode_pcd_columns(columns))
}

/// Parses the columns `names` of a PCD with `DATA binary`, converted to f32. A missing column is an error.
pub fn parse_pcd_columns(bytes: &[u8], path: &Path, names: &[&str]) -> Result<Vec<Vec<f32>>, DataError> {
    let header = parse_pcd_header(bytes, path)?;
    if header.encoding != PcdEncoding::Binary {
        return Err(DataError::file(path, "is not a PCD with DATA binary"));
    }
    let body = &bytes[header.body_start..];
    let wanted = header.body_bytes(path)?;
    if body.len() as u64 != wanted {
        return Err(DataError::file(path, format!("has {} bytes of points, but its header says {wanted}", body.len())));
    }
    let column = |name: &&str| {
        let field = header.fields.iter().find(|f| f.name == *name);
        let field = field.ok_or_else(|| DataError::file(path, format!("has no field {name}")))?;
        let mut values = vec![0.0; header.points as usize];
        let cells = body.chunks_exact(header.point_bytes as usize).map(|point| &point[field.offset..]);
        field.number.read_all(cells, values.iter_mut());
        Ok(values)
    };
    names.iter().map(column).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn bytes() -> Vec<u8> {
        let columns = [
            ("x", PcdColumn::F32(vec![1.5, -2.0, 3.0])),
            ("y", PcdColumn::F32(vec![0.0; 3])),
            ("z", PcdColumn::F32(vec![0.5; 3])),
            ("row", PcdColumn::U16(vec![7, 65_535, 0])),
            ("sensor", PcdColumn::U8(vec![0, 1, 255])),
        ];
        encode_pcd_columns(&columns)
    }

    #[test]
    fn columns_are_read_by_name() {
        let read = parse_pcd_columns(&bytes(), Path::new("a.pcd"), &["sensor", "row", "x"]).unwrap();
        assert_eq!(read, [vec![0.0, 1.0, 255.0], vec![7.0, 65_535.0, 0.0], vec![1.5, -2.0, 3.0]]);
        assert_eq!(crate::parse_pcd(&bytes(), Path::new("a.pcd")).unwrap().len(), 3);
    }

    #[test]
    fn missing_columns_and_points_are_reported() {
        let error = parse_pcd_columns(&bytes(), Path::new("a.pcd"), &["ring"]).unwrap_err().to_string();
        assert_eq!(error, "a.pcd: has no field ring");
        let mut short = bytes();
        short.pop();
        assert!(parse_pcd_columns(&short, Path::new("a.pcd"), &["x"]).unwrap_err().to_string().contains("header says"));
    }
}
