//! Tables in Parquet files. Columns are read by name, rows in ranges, so that the size of a file does not matter.

use super::table::Table;
use super::without_panic::without_panic;
use crate::DataError;
use crate::limits::{MOST_POINTS, at_most, length_of_file};
use arrow_array::RecordBatch;
use bytes::Bytes;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReader, ParquetRecordBatchReaderBuilder,
};
use parquet::errors::ParquetError;
use parquet::file::metadata::ColumnChunkMetaData;
use parquet::file::reader::{ChunkReader, Length};
use std::fmt::Display;
use std::fs::File;
use std::io::{BufReader, Read as _};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Rows that are decoded at once of a whole table.
const BATCH_ROWS: usize = 4096;

/// Places of a file that stay open, for as many threads that read rows one after the other.
const MOST_PLACES: usize = 4;

/// A Parquet file whose metadata is in memory.
pub(crate) struct ParquetFile {
    path: PathBuf,
    metadata: ArrowReaderMetadata,
    /// The first row of each group of rows, and the number of all rows.
    starts: Vec<usize>,
}

impl ParquetFile {
    /// Reads the metadata of a file.
    ///
    /// # Errors
    /// What is no Parquet file, and more rows than a cloud may have points.
    pub(crate) fn open(path: &Path) -> Result<ParquetFile, DataError> {
        Self::open_within(path, MOST_POINTS)
    }

    /// As [`ParquetFile::open`], with at most `most` rows.
    ///
    /// # Errors
    /// What is no Parquet file, and more rows.
    pub(crate) fn open_within(path: &Path, most: usize) -> Result<ParquetFile, DataError> {
        let length = length_of_file(path, u64::MAX)?;
        let file = fs_err::File::open(path)?.into_file();
        // The types are those of the columns themselves, not those of a schema that Arrow wrote beside them.
        let options = ArrowReaderOptions::new().with_skip_arrow_metadata(true);
        let wrong = |e: String| DataError::file(path, format!("is not a Parquet file, or is damaged: {e}"));
        let metadata = without_panic("parquet", || ArrowReaderMetadata::load(&file, options)).map_err(wrong)?;
        let mut starts = vec![0];
        for group in metadata.metadata().row_groups() {
            if !group.columns().iter().all(|column| lies_inside(column, length)) {
                return Err(wrong("a column lies outside of the file".into()));
            }
            let rows = starts[starts.len() - 1] as u64 + u64::try_from(group.num_rows()).unwrap_or(u64::MAX / 2);
            at_most(path, "rows", rows, most)?;
            starts.push(rows as usize);
        }
        Ok(ParquetFile { path: path.into(), metadata, starts })
    }

    /// All rows of some columns.
    ///
    /// # Errors
    /// A column that is not there, or that cannot be read.
    pub(crate) fn table(&self, columns: &[&str]) -> Result<Table, DataError> {
        let mut reader = self.reader(columns, BATCH_ROWS, 0)?;
        let batches = std::iter::from_fn(|| self.next(&mut reader, columns).transpose());
        let table = Table::of_batches(&self.path, batches)?;
        let rows = self.starts[self.starts.len() - 1];
        if table.rows() != rows {
            return Err(self.damaged(columns, &format!("has {} rows, not {rows}", table.rows())));
        }
        Ok(table)
    }

    /// Whether there is a column with this name.
    pub(crate) fn has_column(&self, name: &str) -> bool {
        self.metadata.parquet_schema().root_schema().get_fields().iter().any(|field| field.name() == name)
    }

    /// All rows of some columns, some rows at a time, in their order.
    ///
    /// # Errors
    /// A column that is not there. The iterator gives an error for rows that cannot be read.
    pub(crate) fn tables<'a>(
        &'a self,
        columns: &'a [&'a str],
    ) -> Result<impl Iterator<Item = Result<Table, DataError>> + 'a, DataError> {
        let mut reader = self.reader(columns, BATCH_ROWS, 0)?;
        let batches = std::iter::from_fn(move || self.next(&mut reader, columns).transpose());
        Ok(batches.map(|batch| Table::of_batches(&self.path, [Ok(batch?)])))
    }

    /// Reads rows of some columns from the beginning of a group of rows on, `batch_rows` at once.
    fn reader(&self, columns: &[&str], batch_rows: usize, group: usize) -> Result<ParquetRecordBatchReader, DataError> {
        let schema = self.metadata.parquet_schema();
        let fields = schema.root_schema().get_fields();
        let index = |name: &&str| {
            let found = fields.iter().position(|field| field.name() == *name);
            found.ok_or_else(|| DataError::file(&self.path, format!("has no column {name}")))
        };
        let indices: Vec<usize> = columns.iter().map(index).collect::<Result<_, _>>()?;
        // A file of its own for each reader, because readers move its position.
        let file = Pages(fs_err::File::open(&self.path)?.into_file());
        let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file, self.metadata.clone())
            .with_projection(ProjectionMask::roots(schema, indices))
            .with_row_groups((group..self.starts.len() - 1).collect())
            .with_batch_size(batch_rows);
        without_panic("parquet", || builder.build()).map_err(|e| self.damaged(columns, &e))
    }

    /// The next rows; `None` behind the last one.
    fn next(&self, reader: &mut ParquetRecordBatchReader, columns: &[&str]) -> Result<Option<RecordBatch>, DataError> {
        without_panic("parquet", || reader.next().transpose()).map_err(|e| self.damaged(columns, &e))
    }

    fn damaged(&self, columns: &[&str], error: &dyn Display) -> DataError {
        let names = columns.join(", ");
        DataError::file(&self.path, format!("is damaged: the columns {names} cannot be read: {error}"))
    }
}

/// A file of which pages are read. The library reserves the size that the head of a page claims to have decompressed.
struct Pages(File);

/// Bytes of a page that may come of any compression. A larger page may be so many times as large as in the file.
const PAGE_BYTES: i64 = 16 << 20;
const MOST_COMPRESSION: i64 = 250;

impl Length for Pages {
    fn len(&self) -> u64 {
        self.0.len()
    }
}

impl ChunkReader for Pages {
    type T = BufReader<File>;

    /// Pages are read from their heads on.
    fn get_read(&self, start: u64) -> Result<BufReader<File>, ParquetError> {
        let mut head = Vec::new();
        self.0.get_read(start)?.take(32).read_to_end(&mut head)?;
        if let Some((whole, compressed)) = sizes_of_page(&head)
            && whole > PAGE_BYTES.max(compressed.saturating_mul(MOST_COMPRESSION))
        {
            return Err(ParquetError::General(format!("a page of {compressed} bytes claims to have {whole}")));
        }
        self.0.get_read(start)
    }

    fn get_bytes(&self, start: u64, length: usize) -> Result<Bytes, ParquetError> {
        self.0.get_bytes(start, length)
    }
}

/// The sizes without and with compression in the head of a page: a struct of Thrift's compact protocol, whose first
/// three fields are the kind and the sizes, i32.
fn sizes_of_page(head: &[u8]) -> Option<(i64, i64)> {
    const NEXT_FIELD_I32: u8 = 0x15;
    let mut bytes = head.iter();
    let mut field = || {
        if *bytes.next()? != NEXT_FIELD_I32 {
            return None;
        }
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = *bytes.next()?;
            value |= u64::from(byte & 0x7f) << shift;
            if byte & 0x80 == 0 {
                // Zigzag: 0, -1, 1, -2, ...
                return Some((value >> 1) as i64 ^ -((value & 1) as i64));
            }
        }
        None
    };
    field()?;
    Some((field()?, field()?))
}

/// Whether the pages of a column lie in a file of this length.
fn lies_inside(column: &ColumnChunkMetaData, length: u64) -> bool {
    let start = column.dictionary_page_offset().unwrap_or(column.data_page_offset());
    let end = u64::try_from(start).ok().zip(u64::try_from(column.compressed_size()).ok());
    end.and_then(|(start, bytes)| start.checked_add(bytes)).is_some_and(|end| end <= length)
}

/// Single rows of a file. Rows that are asked for in their order are decoded once: a reader goes on where it stands.
pub(crate) struct Rows {
    file: ParquetFile,
    columns: &'static [&'static str],
    /// Readers and the rows that they read next.
    places: Mutex<Vec<(usize, ParquetRecordBatchReader)>>,
}

impl Rows {
    /// Single rows of some columns.
    pub(crate) fn new(file: ParquetFile, columns: &'static [&'static str]) -> Rows {
        Rows { file, columns, places: Mutex::default() }
    }

    /// A row as a table.
    ///
    /// # Errors
    /// A row or column that is not there, or that cannot be read.
    pub(crate) fn row(&self, row: usize) -> Result<Table, DataError> {
        let starts = &self.file.starts;
        let group = starts.partition_point(|start| *start <= row) - 1;
        if group + 1 >= starts.len() {
            return Err(DataError::file(&self.file.path, format!("has no row {row} (from 0)")));
        }
        let open = self.take_place(starts[group], row);
        let (mut next, mut reader) = match open {
            Some(place) => place,
            None => (starts[group], self.file.reader(self.columns, 1, group)?),
        };
        loop {
            let ended = || self.file.damaged(self.columns, &format!("they end before row {row}"));
            let batch = self.file.next(&mut reader, self.columns)?.ok_or_else(ended)?;
            next += 1;
            if next > row {
                self.keep_place(next, reader);
                return Table::of_batches(&self.file.path, [Ok(batch)]);
            }
        }
    }

    /// Takes the reader that is nearest before a row, but not before the beginning of its group of rows.
    fn take_place(&self, first: usize, row: usize) -> Option<(usize, ParquetRecordBatchReader)> {
        let mut places = self.places.lock().unwrap_or_else(PoisonError::into_inner);
        let before = (0..places.len()).filter(|i| (first..=row).contains(&places[*i].0));
        let nearest = before.max_by_key(|i| places[*i].0)?;
        Some(places.remove(nearest))
    }

    fn keep_place(&self, next: usize, reader: ParquetRecordBatchReader) {
        let mut places = self.places.lock().unwrap_or_else(PoisonError::into_inner);
        if places.len() == MOST_PLACES {
            places.remove(0);
        }
        places.push((next, reader));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pages_that_claim_more_than_they_hold_are_refused() {
        // Kind 0, 150 bytes without and 20 with compression; then other fields.
        assert_eq!(sizes_of_page(&[0x15, 0, 0x15, 0xac, 0x02, 0x15, 40, 0x2c]), Some((150, 20)));
        assert_eq!(sizes_of_page(&[0x15, 0, 0x15, 1, 0x15, 3]), Some((-1, -2)));
        assert_eq!(sizes_of_page(&[0x15, 0, 0x25, 2, 0x15, 2]), None);
        assert_eq!(sizes_of_page(&[0x15, 0, 0x15, 0x80]), None);
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("page");
        let field = |value: u32| {
            let bytes = (0..5).map(|i| ((2 * u64::from(value)) >> (7 * i)) as u8 & 0x7f | if i < 4 { 0x80 } else { 0 });
            std::iter::once(0x15).chain(bytes).collect::<Vec<u8>>()
        };
        let read = |whole: u32, compressed: u32| {
            std::fs::write(&path, [field(0), field(whole), field(compressed)].concat()).unwrap();
            Pages(File::open(&path).unwrap()).get_read(0).map(drop).map_err(|e| e.to_string())
        };
        assert_eq!([read(16 << 20, 1), read(1_000_000_000, 4_000_000)], [Ok(()), Ok(())]);
        let error = read(1_000_000_000, 3_999_999).unwrap_err();
        assert!(error.contains("a page of 3999999 bytes claims to have 1000000000"), "{error}");
        assert!(read((16 << 20) + 1, 1).is_err());
    }
}
