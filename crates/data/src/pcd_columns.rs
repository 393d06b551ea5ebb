//! PCD files with any columns: numbers beside a cloud, one row a point.

use crate::pcd_header::{PcdEncoding, parse_pcd_header};
use crate::{DataError, write_atomic};
use std::path::Path;

/// The numbers of a column.
#[derive(Clone, Debug, PartialEq)]
pub enum PcdColumn {
    /// 4 bytes a number.
    F32(Vec<f32>),
    /// 1 byte a number.
    U8(Vec<u8>),
    /// 2 bytes a number.
    U16(Vec<u16>),
}

impl PcdColumn {
    /// Size and type as a PCD's head names them.
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

/// A PCD v0.7 in its binary form with these columns, all of one length.
pub fn encode_pcd_columns(columns: &[(&str, PcdColumn)]) -> Vec<u8> {
    let rows = columns.first().map_or(0, |(_, column)| column.len());
    assert!(columns.iter().all(|(_, column)| column.len() == rows), "columns of one file have one length");
    let words = |word: &dyn Fn(&(&str, PcdColumn)) -> String| columns.iter().map(word).collect::<Vec<_>>().join(" ");
    let mut out = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {}\nSIZE {}\nTYPE {}\nCOUNT {}\nWIDTH {rows}\nHEIGHT 1\n\
         VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {rows}\nDATA binary\n",
        words(&|(name, _)| name.to_string()),
        words(&|(_, column)| column.kind().0.to_string()),
        words(&|(_, column)| column.kind().1.to_string()),
        words(&|_| "1".into()),
    )
    .into_bytes();
    for row in 0..rows {
        columns.iter().for_each(|(_, column)| column.push(row, &mut out));
    }
    out
}

/// Writes [`encode_pcd_columns`] to a file.
pub fn write_pcd_columns(path: &Path, columns: &[(&str, PcdColumn)]) -> Result<(), DataError> {
    write_atomic(path, &encode_pcd_columns(columns))
}

/// Columns of a PCD in its binary form by their names, as f32; a missing one is an error.
pub fn parse_pcd_columns(bytes: &[u8], path: &Path, names: &[&str]) -> Result<Vec<Vec<f32>>, DataError> {
    let header = parse_pcd_header(bytes, path)?;
    if header.encoding != PcdEncoding::Binary {
        return Err(DataError::file(path, "is not in PCD's binary form (DATA binary)"));
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
    fn columns_come_back_by_name() {
        let read = parse_pcd_columns(&bytes(), Path::new("a.pcd"), &["sensor", "row", "x"]).unwrap();
        assert_eq!(read, [vec![0.0, 1.0, 255.0], vec![7.0, 65_535.0, 0.0], vec![1.5, -2.0, 3.0]]);
        assert_eq!(crate::parse_pcd(&bytes(), Path::new("a.pcd")).unwrap().len(), 3);
    }

    #[test]
    fn what_is_missing_is_named() {
        let error = parse_pcd_columns(&bytes(), Path::new("a.pcd"), &["ring"]).unwrap_err().to_string();
        assert_eq!(error, "a.pcd: has no field ring");
        let mut short = bytes();
        short.pop();
        assert!(parse_pcd_columns(&short, Path::new("a.pcd"), &["x"]).unwrap_err().to_string().contains("header says"));
    }
}
