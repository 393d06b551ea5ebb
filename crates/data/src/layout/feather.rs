//! Tables in Feather files: Arrow's IPC format, plain or compressed.

use crate::DataError;
use crate::limits::{MOST_CLOUD_BYTES, MOST_POINTS, at_most, read_file};
use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type,
};
use arrow_array::{Array, ArrayRef, ArrowPrimitiveType, RecordBatch};
use arrow_ipc::reader::FileReader;
use std::io::Cursor;
use std::path::{Path, PathBuf};

/// A table in memory.
pub(super) struct Feather {
    path: PathBuf,
    batches: Vec<RecordBatch>,
    rows: usize,
}

impl Feather {
    /// Reads a table.
    ///
    /// # Errors
    /// What is no Feather file of version 2, and more rows than a cloud may have points.
    pub(super) fn read(path: &Path) -> Result<Feather, DataError> {
        let wrong =
            |e: &dyn std::fmt::Display| DataError::file(path, format!("is not a Feather file (Arrow IPC): {e}"));
        let bytes = read_file(path, MOST_CLOUD_BYTES)?;
        let reader = FileReader::try_new(Cursor::new(bytes), None).map_err(|e| wrong(&e))?;
        let (mut batches, mut rows) = (Vec::new(), 0);
        for batch in reader {
            let batch = batch.map_err(|e| wrong(&e))?;
            rows += batch.num_rows();
            at_most(path, "rows", rows as u64, MOST_POINTS)?;
            batches.push(batch);
        }
        Ok(Feather { path: path.into(), batches, rows })
    }

    /// Number of rows.
    pub(super) fn rows(&self) -> usize {
        self.rows
    }

    /// An error of a row, from 0.
    pub(super) fn wrong(&self, row: usize, message: &str) -> DataError {
        DataError::file(&self.path, format!("row {row} (from 0): {message}"))
    }

    /// A column of real numbers, of any width.
    pub(super) fn reals(&self, name: &str) -> Result<Vec<f64>, DataError> {
        self.column(name, "real numbers", |column| {
            values::<Float64Type, f64>(column, |v| v)
                .or_else(|| values::<Float32Type, f64>(column, f64::from))
                .or_else(|| values::<Float16Type, f64>(column, f64::from))
        })
    }

    /// A column of whole numbers, of any width.
    pub(super) fn integers(&self, name: &str) -> Result<Vec<i64>, DataError> {
        self.column(name, "whole numbers", |column| {
            values::<Int64Type, i64>(column, |v| v)
                .or_else(|| values::<Int32Type, i64>(column, i64::from))
                .or_else(|| values::<Int16Type, i64>(column, i64::from))
                .or_else(|| values::<Int8Type, i64>(column, i64::from))
                .or_else(|| values::<UInt8Type, i64>(column, i64::from))
                .or_else(|| values::<UInt16Type, i64>(column, i64::from))
                .or_else(|| values::<UInt32Type, i64>(column, i64::from))
        })
    }

    /// A column of texts.
    pub(super) fn texts(&self, name: &str) -> Result<Vec<String>, DataError> {
        self.column(name, "texts", |column| {
            let short = column.as_string_opt::<i32>().map(|a| a.iter().map(|v| v.unwrap_or("").to_string()).collect());
            short.or_else(|| {
                let long = column.as_string_opt::<i64>()?;
                Some(long.iter().map(|v| v.unwrap_or("").to_string()).collect())
            })
        })
    }

    fn column<T>(
        &self,
        name: &str,
        what: &str,
        read: impl Fn(&ArrayRef) -> Option<Vec<T>>,
    ) -> Result<Vec<T>, DataError> {
        let mut all = Vec::with_capacity(self.rows);
        for batch in &self.batches {
            let missing = || DataError::file(&self.path, format!("has no column {name}"));
            let column = batch.column_by_name(name).ok_or_else(missing)?;
            let refuse = |why: String| DataError::file(&self.path, format!("column {name} {why}"));
            if column.null_count() > 0 {
                return Err(refuse("has missing values".into()));
            }
            all.extend(read(column).ok_or_else(|| refuse(format!("has {}, not {what}", column.data_type())))?);
        }
        if self.batches.is_empty() {
            return Err(DataError::file(&self.path, "has no rows"));
        }
        Ok(all)
    }
}

fn values<A: ArrowPrimitiveType, T>(column: &ArrayRef, convert: impl Fn(A::Native) -> T) -> Option<Vec<T>> {
    Some(column.as_primitive_opt::<A>()?.values().iter().map(|v| convert(*v)).collect())
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use arrow_array::{Float64Array, Int64Array, StringArray};
    use std::sync::Arc;

    /// Writes a table of columns.
    pub(crate) fn write(path: &Path, columns: Vec<(&str, ArrayRef)>) {
        let batch = RecordBatch::try_from_iter(columns).unwrap();
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        let mut writer =
            arrow_ipc::writer::FileWriter::try_new(std::fs::File::create(path).unwrap(), &batch.schema()).unwrap();
        writer.write(&batch).unwrap();
        writer.finish().unwrap();
    }

    #[test]
    fn columns_have_names_and_types() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.feather");
        write(
            &path,
            vec![
                ("real", Arc::new(Float64Array::from(vec![1.5, -2.0]))),
                ("whole", Arc::new(Int64Array::from(vec![7, i64::MAX]))),
                ("text", Arc::new(StringArray::from(vec!["a", "b"]))),
                ("gaps", Arc::new(Int64Array::from(vec![Some(7), None]))),
            ],
        );
        let table = Feather::read(&path).unwrap();
        assert_eq!((table.rows(), table.reals("real").unwrap()), (2, vec![1.5, -2.0]));
        assert_eq!(table.integers("whole").unwrap(), [7, i64::MAX]);
        assert_eq!(table.texts("text").unwrap(), ["a", "b"]);
        let errors = [
            (table.reals("other").unwrap_err(), "has no column other"),
            (table.reals("whole").unwrap_err(), "column whole has Int64, not real numbers"),
            (table.integers("gaps").unwrap_err(), "column gaps has missing values"),
        ];
        for (error, want) in errors {
            assert!(error.to_string().contains("a.feather") && error.to_string().contains(want), "{error}");
        }
        let bytes = std::fs::read(&path).unwrap();
        for bad in [&b"not a table"[..], &bytes[..bytes.len() - 9], b""] {
            std::fs::write(&path, bad).unwrap();
            let error = Feather::read(&path).err().unwrap().to_string();
            assert!(error.contains("a.feather: is not a Feather file"), "{error}");
        }
    }
}
