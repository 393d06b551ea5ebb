//! Tables of Arrow's columns in memory.

use crate::DataError;
use crate::limits::{MOST_POINTS, at_most};
use arrow_array::cast::AsArray;
use arrow_array::types::{
    Float16Type, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type, UInt32Type,
};
use arrow_array::{Array, ArrayRef, ArrowPrimitiveType, RecordBatch};
use std::path::{Path, PathBuf};

/// A table in memory. Its errors name the file that it was read from, and the column or the row.
pub(crate) struct Table {
    path: PathBuf,
    batches: Vec<RecordBatch>,
    rows: usize,
}

impl Table {
    /// The table of batches with the same columns.
    ///
    /// # Errors
    /// A batch that cannot be read, and more rows than a cloud may have points.
    pub(crate) fn of_batches(
        path: &Path,
        batches: impl IntoIterator<Item = Result<RecordBatch, DataError>>,
    ) -> Result<Table, DataError> {
        let mut table = Table { path: path.into(), batches: Vec::new(), rows: 0 };
        for batch in batches {
            let batch = batch?;
            table.rows += batch.num_rows();
            at_most(path, "rows", table.rows as u64, MOST_POINTS)?;
            table.batches.push(batch);
        }
        Ok(table)
    }

    /// Number of rows.
    pub(crate) fn rows(&self) -> usize {
        self.rows
    }

    /// An error of a row, from 0.
    pub(crate) fn wrong(&self, row: usize, message: &str) -> DataError {
        DataError::file(&self.path, format!("row {row} (from 0): {message}"))
    }

    /// A column of real numbers, of any width.
    pub(crate) fn reals(&self, name: &str) -> Result<Vec<f64>, DataError> {
        self.column(name, "real numbers", reals)
    }

    /// A column of whole numbers, of any width.
    pub(crate) fn integers(&self, name: &str) -> Result<Vec<i64>, DataError> {
        self.column(name, "whole numbers", integers)
    }

    /// A column of lists of real numbers; `None` for a list that is missing or empty.
    pub(crate) fn real_lists(&self, name: &str) -> Result<Vec<Option<Vec<f64>>>, DataError> {
        self.lists(name, "lists of real numbers", reals)
    }

    /// A column of lists of whole numbers; `None` for a list that is missing or empty.
    pub(crate) fn integer_lists(&self, name: &str) -> Result<Vec<Option<Vec<i64>>>, DataError> {
        self.lists(name, "lists of whole numbers", integers)
    }

    /// Whether there is such a column.
    pub(super) fn has(&self, name: &str) -> bool {
        self.batches.iter().all(|batch| batch.column_by_name(name).is_some())
    }

    /// A column of whole numbers, of any width; `None` for one that is missing.
    pub(super) fn optional_integers(&self, name: &str) -> Result<Vec<Option<i64>>, DataError> {
        self.each(name, "whole numbers", |column| {
            let values = integers(column)?.into_iter().enumerate();
            Some(values.map(|(row, value)| column.is_valid(row).then_some(value)).collect())
        })
    }

    /// A column of lists of texts; an empty one for a list that is missing.
    pub(super) fn text_lists(&self, name: &str) -> Result<Vec<Vec<String>>, DataError> {
        let list = |values: Option<ArrayRef>| values.map_or(Some(Vec::new()), |values| texts(&values));
        self.each(name, "lists of texts", |column| column.as_list_opt::<i32>()?.iter().map(list).collect())
    }

    /// A column of lists of rows of `N` real numbers; an empty one for a list that is missing.
    pub(super) fn lists_of_rows<const N: usize>(&self, name: &str) -> Result<Vec<Vec<[f64; N]>>, DataError> {
        let rows = |values: Option<ArrayRef>| {
            let Some(values) = values else { return Some(Vec::new()) };
            let rows = values.as_fixed_size_list_opt()?;
            let numbers = rows.values();
            if rows.value_length() != N as i32 || rows.null_count() + numbers.null_count() > 0 {
                return None;
            }
            Some(reals(numbers)?.chunks_exact(N).map(|row| std::array::from_fn(|i| row[i])).collect())
        };
        let what = format!("lists of {N} real numbers each");
        self.each(name, &what, |column| column.as_list_opt::<i32>()?.iter().map(rows).collect())
    }

    /// A column of texts.
    pub(crate) fn texts(&self, name: &str) -> Result<Vec<String>, DataError> {
        self.column(name, "texts", texts)
    }

    /// A column of texts; `None` where a value is missing.
    pub(crate) fn optional_texts(&self, name: &str) -> Result<Vec<Option<String>>, DataError> {
        self.each(name, "texts", |column| {
            let short = column.as_string_opt::<i32>().map(|a| a.iter().map(|v| v.map(String::from)).collect());
            short.or_else(|| Some(column.as_string_opt::<i64>()?.iter().map(|v| v.map(String::from)).collect()))
        })
    }

    /// A column of real or whole numbers, of any width; `None` where a value is missing.
    pub(crate) fn optional_numbers(&self, name: &str) -> Result<Vec<Option<f64>>, DataError> {
        self.each(name, "numbers", |column| {
            let whole = || Some(integers(column)?.into_iter().map(|v| v as f64).collect());
            let values: Vec<f64> = reals(column).or_else(whole)?;
            Some(values.into_iter().enumerate().map(|(i, value)| column.is_valid(i).then_some(value)).collect())
        })
    }

    fn lists<T>(
        &self,
        name: &str,
        what: &str,
        read: impl Fn(&ArrayRef) -> Option<Vec<T>>,
    ) -> Result<Vec<Option<Vec<T>>>, DataError> {
        let list = |values: Option<ArrayRef>| match values.filter(|values| !values.is_empty()) {
            Some(values) if values.null_count() == 0 => read(&values).map(Some),
            Some(_) => None,
            None => Some(None),
        };
        self.each(name, what, |column| match column.as_fixed_size_list_opt() {
            Some(rows) => rows.iter().map(list).collect(),
            None => column.as_list_opt::<i32>()?.iter().map(list).collect(),
        })
    }

    fn column<T>(
        &self,
        name: &str,
        what: &str,
        read: impl Fn(&ArrayRef) -> Option<Vec<T>>,
    ) -> Result<Vec<T>, DataError> {
        let missing = |batch: &RecordBatch| batch.column_by_name(name).is_some_and(|column| column.null_count() > 0);
        if self.batches.iter().any(missing) {
            return Err(self.refused(name, "has missing values"));
        }
        self.each(name, what, read)
    }

    fn each<T>(&self, name: &str, what: &str, read: impl Fn(&ArrayRef) -> Option<Vec<T>>) -> Result<Vec<T>, DataError> {
        let mut all = Vec::with_capacity(self.rows);
        for batch in &self.batches {
            let missing = || DataError::file(&self.path, format!("has no column {name}"));
            let column = batch.column_by_name(name).ok_or_else(missing)?;
            let refuse = || self.refused(name, &format!("has {}, not {what}", column.data_type()));
            all.extend(read(column).ok_or_else(refuse)?);
        }
        if self.batches.is_empty() {
            return Err(DataError::file(&self.path, "has no rows"));
        }
        Ok(all)
    }

    fn refused(&self, name: &str, why: &str) -> DataError {
        DataError::file(&self.path, format!("column {name} {why}"))
    }
}

fn texts(column: &ArrayRef) -> Option<Vec<String>> {
    let short = column.as_string_opt::<i32>().map(|a| a.iter().map(|v| v.unwrap_or("").to_string()).collect());
    short.or_else(|| {
        let long = column.as_string_opt::<i64>()?;
        Some(long.iter().map(|v| v.unwrap_or("").to_string()).collect())
    })
}

fn reals(column: &ArrayRef) -> Option<Vec<f64>> {
    values::<Float64Type, f64>(column, |v| v)
        .or_else(|| values::<Float32Type, f64>(column, f64::from))
        .or_else(|| values::<Float16Type, f64>(column, f64::from))
}

fn integers(column: &ArrayRef) -> Option<Vec<i64>> {
    values::<Int64Type, i64>(column, |v| v)
        .or_else(|| values::<Int32Type, i64>(column, i64::from))
        .or_else(|| values::<Int16Type, i64>(column, i64::from))
        .or_else(|| values::<Int8Type, i64>(column, i64::from))
        .or_else(|| values::<UInt8Type, i64>(column, i64::from))
        .or_else(|| values::<UInt16Type, i64>(column, i64::from))
        .or_else(|| values::<UInt32Type, i64>(column, i64::from))
}

fn values<A: ArrowPrimitiveType, T>(column: &ArrayRef, convert: impl Fn(A::Native) -> T) -> Option<Vec<T>> {
    Some(column.as_primitive_opt::<A>()?.values().iter().map(|v| convert(*v)).collect())
}
