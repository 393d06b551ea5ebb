//! Tables in Feather files: Arrow's IPC format, plain or compressed.

use super::arrow_file::ArrowFile;
use super::table::Table;
use crate::DataError;
use std::path::Path;

/// Reads a table.
///
/// # Errors
/// What is no Feather file of version 2, and more rows than a cloud may have points.
pub(super) fn read_feather(path: &Path) -> Result<Table, DataError> {
    ArrowFile::open(path)?.table()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use arrow_array::{ArrayRef, Float64Array, Int64Array, RecordBatch, StringArray};
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
        let table = read_feather(&path).unwrap();
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
            let error = read_feather(&path).err().unwrap().to_string();
            assert!(error.contains("a.feather: is not a file of Arrow IPC"), "{error}");
        }
    }
}
