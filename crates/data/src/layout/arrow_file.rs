//! Files and streams of Arrow's IPC format. Their sizes are checked before the library reserves memory for them.

use super::arrow_metadata::{Metadata, take_metadata, u32_at};
use super::table::Table;
use super::without_panic::without_panic;
use crate::limits::{MOST_CLOUD_BYTES, MOST_POINTS, MOST_TEXT_BYTES, at_most, length_of_file};
use crate::source::Source;
use crate::{DataError, FilePart};
use arrow_array::cast::AsArray as _;
use arrow_array::types::{BinaryType, ByteArrayType as _, Utf8Type};
use arrow_array::{Array as _, RecordBatch};
use arrow_ipc::reader::{FileReader, FileReaderBuilder, StreamReader};
use arrow_ipc::{Block, RecordBatch as BatchHead, root_as_footer, root_as_message};
use std::io::{Cursor, Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// The length of the footer, and the mark of the format.
const TRAILER_BYTES: u64 = 10;

/// Bytes of a buffer that may come of any compression. A larger one may be so many times as large as in the file.
const BUFFER_BYTES: i64 = 16 << 20;
const MOST_COMPRESSION: i64 = 250;

/// A file with a footer, whose footer is in memory.
pub(super) struct ArrowFile {
    path: PathBuf,
    /// Where the footer begins.
    footer_at: u64,
    /// The footer, with blanks in the place of metadata that are no text, and what follows it.
    tail: Vec<u8>,
    metadata: Metadata,
    batches: Vec<Batch>,
    /// The batch that was decoded last, of those that are compressed.
    decoded: Mutex<Option<(usize, RecordBatch)>>,
}

/// A batch of rows.
struct Batch {
    /// Its first row, and the row behind its last one.
    rows: Range<usize>,
    /// Where its buffers are in the file.
    buffers: Vec<(u64, u64)>,
    is_compressed: bool,
}

impl ArrowFile {
    /// Reads the footer and the heads of all batches.
    ///
    /// # Errors
    /// What is no such file, batches that lie outside of it or claim to be much larger than they are, and more rows
    /// than a cloud may have points.
    pub(super) fn open(path: &Path) -> Result<ArrowFile, DataError> {
        let wrong = |e: &str| DataError::file(path, format!("is not a file of Arrow IPC, or is damaged: {e}"));
        let length = length_of_file(path, u64::MAX)?;
        let part = |start: u64, bytes: u64| FilePart { path: path.into(), range: Some((start, bytes)) };
        let trailer_at = length.checked_sub(TRAILER_BYTES).ok_or_else(|| wrong("it is too short"))?;
        let trailer = part(trailer_at, TRAILER_BYTES).read(TRAILER_BYTES)?;
        if !trailer.ends_with(b"ARROW1") {
            return Err(wrong("it does not end with ARROW1"));
        }
        let footer_bytes = u64::from(u32_at(&trailer, 0).unwrap_or(0));
        let footer_at = trailer_at.checked_sub(footer_bytes).filter(|_| footer_bytes <= MOST_TEXT_BYTES);
        let footer_at = footer_at.ok_or_else(|| wrong(&format!("its footer claims to have {footer_bytes} bytes")))?;
        let mut tail = part(footer_at, footer_bytes).read(MOST_TEXT_BYTES)?;
        let metadata = take_metadata(&mut tail);
        let batch = |(i, block): (usize, &Block)| {
            let named = |e: String| wrong(&format!("batch {i} (from 0): {e}"));
            let (head_at, head_bytes, body_bytes) = place(block, footer_at).map_err(named)?;
            let head = part(head_at, head_bytes).read(MOST_TEXT_BYTES)?;
            let body_at = head_at + head_bytes;
            let read = |start: u64, bytes: u64| part(body_at + start, bytes).read(bytes).map_err(|e| e.to_string());
            let batch = batch_of(&head, body_bytes, read).map_err(named)?.ok_or_else(|| named("has no rows".into()))?;
            let buffers = batch.buffers.iter().map(|(start, bytes)| (body_at + start, *bytes)).collect();
            Ok::<_, DataError>(Batch { buffers, ..batch })
        };
        let [dictionaries, blocks] = blocks(&tail).map_err(|e| wrong(&e))?;
        dictionaries.iter().enumerate().try_for_each(|dictionary| batch(dictionary).map(drop))?;
        let (mut batches, mut first) = (Vec::new(), 0);
        for block in blocks.iter().enumerate() {
            let batch = batch(block)?;
            let last = first + batch.rows.len();
            at_most(path, "rows", last as u64, MOST_POINTS)?;
            batches.push(Batch { rows: first..last, ..batch });
            first = last;
        }
        tail.extend(trailer);
        Ok(ArrowFile { path: path.into(), footer_at, tail, metadata, batches, decoded: Mutex::default() })
    }

    /// The metadata of its schema.
    pub(super) fn metadata(&self) -> &Metadata {
        &self.metadata
    }

    /// All rows of all columns.
    ///
    /// # Errors
    /// What the library cannot read, and files of more than [`MOST_CLOUD_BYTES`].
    pub(super) fn table(&self) -> Result<Table, DataError> {
        length_of_file(&self.path, MOST_CLOUD_BYTES)?;
        let mut reader = self.reader(None)?;
        let batches = std::iter::from_fn(|| without_panic("arrow", || reader.next().transpose()).transpose());
        Table::of_batches(&self.path, batches.map(|batch| batch.map_err(|e| self.damaged(&e))))
    }

    /// Whether a column has texts.
    ///
    /// # Errors
    /// What the library cannot read.
    pub(super) fn has_texts(&self, column: &str) -> Result<bool, DataError> {
        let schema = self.reader(None)?.schema();
        Ok(schema.field_with_name(column).is_ok_and(|field| *field.data_type() == Utf8Type::DATA_TYPE))
    }

    /// The bytes of a column in a row; `None` if they are missing. Only this row is read, unless its batch is
    /// compressed.
    ///
    /// # Errors
    /// A row or a column that is not there, a column of another type, and what cannot be read.
    pub(super) fn bytes(&self, column: &str, row: usize) -> Result<Option<Vec<u8>>, DataError> {
        let reader = self.reader(None)?;
        let schema = reader.schema();
        let index = schema.index_of(column).map_err(|_| self.wrong(&format!("has no column {column}")))?;
        let kind = schema.field(index).data_type();
        if *kind != BinaryType::DATA_TYPE {
            return Err(self.wrong(&format!("column {column} has {kind}, not bytes")));
        }
        let number = self.batches.iter().position(|batch| batch.rows.contains(&row));
        let number = number.ok_or_else(|| self.wrong(&format!("has no row {row} (from 0)")))?;
        let batch = &self.batches[number];
        let within = row - batch.rows.start;
        // Columns of numbers have two buffers, those of bytes and texts three: which are valid, offsets, values.
        let before = schema.fields()[..index].iter().map(|field| {
            let kind = field.data_type();
            let is_flat = *kind == BinaryType::DATA_TYPE || *kind == Utf8Type::DATA_TYPE;
            if kind.is_primitive() { Some(2) } else { is_flat.then_some(3) }
        });
        let flat = before.sum::<Option<usize>>().filter(|_| !batch.is_compressed);
        match flat.and_then(|first| batch.buffers.get(first..first + 3)) {
            Some(&[valid, offsets, values]) => self.bytes_in_place(within, [valid, offsets, values]),
            _ => self.decoded_bytes(number, index, within),
        }
    }

    /// The bytes of a row by the buffers of its column.
    fn bytes_in_place(
        &self,
        row: usize,
        [valid, offsets, values]: [(u64, u64); 3],
    ) -> Result<Option<Vec<u8>>, DataError> {
        let part = |(start, length): (u64, u64), from: u64, bytes: u64| {
            let inside = from.checked_add(bytes).is_some_and(|end| end <= length);
            let place = inside.then_some((start + from, bytes));
            let place = place.ok_or_else(|| self.damaged(&format!("row {row} of a batch lies outside of it")))?;
            FilePart { path: self.path.clone(), range: Some(place) }.read(MOST_CLOUD_BYTES)
        };
        if valid.1 > 0 && part(valid, row as u64 / 8, 1)?[0] >> (row % 8) & 1 == 0 {
            return Ok(None);
        }
        let ends = part(offsets, 4 * row as u64, 8)?;
        let [start, end] = [0, 4].map(|at| u64::from(u32_at(&ends, at).unwrap_or(u32::MAX)));
        let length = end.checked_sub(start).ok_or_else(|| self.damaged(&format!("row {row} of a batch ends early")))?;
        part(values, start, length).map(Some)
    }

    /// The bytes of a row of a batch that is decoded as a whole.
    fn decoded_bytes(&self, number: usize, column: usize, row: usize) -> Result<Option<Vec<u8>>, DataError> {
        let mut decoded = self.decoded.lock().unwrap_or_else(PoisonError::into_inner);
        let known = decoded.take().filter(|(known, _)| *known == number).map(|(_, batch)| batch);
        let batch = match known {
            Some(batch) => batch,
            None => {
                let mut reader = self.reader(Some(column))?;
                let read = || reader.set_index(number).and_then(|()| reader.next().transpose());
                let batch = without_panic("arrow", read).map_err(|e| self.damaged(&e))?;
                batch.ok_or_else(|| self.damaged(&format!("batch {number} (from 0) is missing")))?
            }
        };
        let values = batch.column(0).as_binary_opt::<i32>();
        let values = values.filter(|values| row < values.len()).ok_or_else(|| self.damaged(&"a batch is too short"))?;
        let found = values.is_valid(row).then(|| values.value(row).to_vec());
        *decoded = Some((number, batch));
        Ok(found)
    }

    /// The library's reader of all columns, or of one.
    fn reader(&self, column: Option<usize>) -> Result<FileReader<Seen<'_>>, DataError> {
        let length = self.footer_at + self.tail.len() as u64;
        let file = Source::open(&self.path, Some(length))?;
        let seen = Seen { file, footer_at: self.footer_at, tail: &self.tail, at: 0 };
        let builder = FileReaderBuilder::new();
        let builder = column.into_iter().fold(builder, |builder, column| builder.with_projection(vec![column]));
        without_panic("arrow", || builder.build(seen)).map_err(|e| self.damaged(&e))
    }

    fn damaged(&self, error: &dyn std::fmt::Display) -> DataError {
        self.wrong(&format!("is damaged: {error}"))
    }

    /// An error of the file.
    pub(super) fn wrong(&self, message: &str) -> DataError {
        DataError::file(&self.path, message)
    }
}

/// What the library sees of a file: the tail that is in memory in the place of its own.
struct Seen<'a> {
    file: Source,
    footer_at: u64,
    tail: &'a [u8],
    at: u64,
}

impl Read for Seen<'_> {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        let count = if self.at < self.footer_at {
            let most = buffer.len().min(usize::try_from(self.footer_at - self.at).unwrap_or(usize::MAX));
            self.file.seek(SeekFrom::Start(self.at))?;
            self.file.read(&mut buffer[..most])?
        } else {
            let from = usize::try_from(self.at - self.footer_at).unwrap_or(usize::MAX).min(self.tail.len());
            (&self.tail[from..]).read(buffer)?
        };
        self.at += count as u64;
        Ok(count)
    }
}

impl Seek for Seen<'_> {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        let end = self.footer_at + self.tail.len() as u64;
        let place = match to {
            SeekFrom::Start(place) => Some(place),
            SeekFrom::End(by) => end.checked_add_signed(by),
            SeekFrom::Current(by) => self.at.checked_add_signed(by),
        };
        self.at = place.ok_or(std::io::ErrorKind::InvalidInput)?;
        Ok(self.at)
    }
}

/// The table of a stream that is in memory. `path` is used in error messages.
///
/// # Errors
/// As [`ArrowFile::open`], and what the library cannot read.
pub(super) fn read_stream(bytes: &[u8], path: &Path) -> Result<Table, DataError> {
    let wrong = |e: &dyn std::fmt::Display| DataError::file(path, format!("its stream of Arrow IPC is damaged: {e}"));
    check_stream(bytes).map_err(|e| wrong(&e))?;
    let reader = without_panic("arrow", || StreamReader::try_new(Cursor::new(bytes), None)).map_err(|e| wrong(&e))?;
    let mut reader = reader;
    let batches = std::iter::from_fn(|| without_panic("arrow", || reader.next().transpose()).transpose());
    Table::of_batches(path, batches.map(|batch| batch.map_err(|e| wrong(&e))))
}

/// Whether bytes begin as a stream does.
pub(super) fn is_stream(bytes: &[u8]) -> bool {
    bytes.starts_with(&CONTINUATION)
}

/// Mark before the length of a head.
const CONTINUATION: [u8; 4] = [0xff; 4];

/// Checks the sizes of all messages of a stream.
fn check_stream(bytes: &[u8]) -> Result<(), String> {
    let mut rest = bytes;
    let mut rows = 0;
    while rest.starts_with(&CONTINUATION) {
        let head_bytes = 8 + u32_at(rest, 4).ok_or("it ends within a head")? as usize;
        if head_bytes == 8 {
            return Ok(());
        }
        let head = rest.get(..head_bytes).ok_or("it ends within a head")?;
        let body_bytes = message(head)?.bodyLength();
        let body = usize::try_from(body_bytes).ok().and_then(|bytes| rest[head_bytes..].get(..bytes));
        let body = body.ok_or_else(|| format!("a message claims to have {body_bytes} bytes"))?;
        let read = |start: u64, bytes: u64| Ok(body[start as usize..][..bytes as usize].to_vec());
        rows += batch_of(head, body.len() as u64, read)?.map_or(0, |batch| batch.rows.len());
        if rows > MOST_POINTS {
            return Err(format!("it has {rows} rows; at most {MOST_POINTS} are supported"));
        }
        rest = &rest[head_bytes + body.len()..];
    }
    // A stream may end without its mark.
    if rest.is_empty() { Ok(()) } else { Err("it goes on without the mark of a message".into()) }
}

/// The message of a head, which begins with its length.
fn message(head: &[u8]) -> Result<arrow_ipc::Message<'_>, String> {
    let start = if head.starts_with(&CONTINUATION) { 8 } else { 4 };
    let bytes = head.get(start..).unwrap_or_default();
    root_as_message(bytes).map_err(|e| format!("its head cannot be read: {e}"))
}

/// The rows and buffers of a batch with a body of `body_bytes`, of which `read` gives a part; `None` for messages of
/// other kinds. Places of buffers count from the body.
fn batch_of(
    head: &[u8],
    body_bytes: u64,
    read: impl Fn(u64, u64) -> Result<Vec<u8>, String>,
) -> Result<Option<Batch>, String> {
    let message = message(head)?;
    let dictionary = message.header_as_dictionary_batch().and_then(|dictionary| dictionary.data());
    let Some(batch): Option<BatchHead<'_>> = dictionary.or_else(|| message.header_as_record_batch()) else {
        return Ok(None);
    };
    let is_compressed = batch.compression().is_some();
    let mut buffers = Vec::new();
    for buffer in batch.buffers().iter().flat_map(|buffers| buffers.iter()) {
        let place = u64::try_from(buffer.offset()).ok().zip(u64::try_from(buffer.length()).ok());
        let inside = |(start, bytes): &(u64, u64)| start.checked_add(*bytes).is_some_and(|end| end <= body_bytes);
        let (start, bytes) = place.filter(inside).ok_or("a buffer lies outside of its batch")?;
        if is_compressed && bytes > 0 {
            let claim = if bytes < 8 { Vec::new() } else { read(start, 8)? };
            let claim = <[u8; 8]>::try_from(claim).map(i64::from_le_bytes).map_err(|_| "a buffer has no size")?;
            let most = BUFFER_BYTES.max((bytes as i64).saturating_mul(MOST_COMPRESSION));
            if claim > most.min(MOST_CLOUD_BYTES as i64) {
                return Err(format!("a buffer of {bytes} bytes claims to have {claim}"));
            }
        }
        buffers.push((start, bytes));
    }
    let rows = usize::try_from(batch.length()).ok().filter(|rows| *rows <= MOST_POINTS);
    let rows = rows.ok_or_else(|| format!("it claims to have {} rows", batch.length()))?;
    Ok(Some(Batch { rows: 0..rows, buffers, is_compressed }))
}

/// The blocks of a footer: dictionaries and batches.
fn blocks(footer: &[u8]) -> Result<[Vec<Block>; 2], String> {
    let footer = root_as_footer(footer).map_err(|e| format!("its footer cannot be read: {e}"))?;
    let lists = [footer.dictionaries(), footer.recordBatches()];
    Ok(lists.map(|list| list.iter().flat_map(|blocks| blocks.iter()).copied().collect()))
}

/// Place and length of the head of a block, and length of its body, before the footer.
fn place(block: &Block, footer_at: u64) -> Result<(u64, u64, u64), String> {
    let parts = [block.offset(), i64::from(block.metaDataLength()), block.bodyLength()];
    let whole = parts.iter().try_fold(0, |sum: u64, part| sum.checked_add(u64::try_from(*part).ok()?));
    if whole.is_none_or(|end| end > footer_at) || parts[1] < 8 {
        return Err("it lies outside of the file".into());
    }
    let [start, head, body] = parts.map(|part| part as u64);
    Ok((start, head, body))
}
