//! MCAP files of ROS 2. They are read by ranges, so that their size does not matter.

mod lengths;

use super::bag::{BagFile, Bags, Place, Topic, Visit};
use crate::limits::{MOST_CLOUD_BYTES, MOST_TEXT_BYTES};
use crate::{DataError, Layout};
use ::mcap::records::{ChunkIndex, Record, op};
use ::mcap::sans_io::{
    LinearReadEvent, LinearReader, LinearReaderOptions, SummaryReadEvent, SummaryReader, SummaryReaderOptions,
};
use ::mcap::{McapError, Summary};
use fs_err::File;
use std::io::{Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

/// Clouds in MCAP files.
#[allow(non_upper_case_globals, reason = "a line of `layouts!`")]
pub(super) const Mcap: Bags = Bags {
    layout: Layout::Mcap,
    name: "mcap",
    extension: "mcap",
    markers: &["*.mcap (ROS 2)"],
    check: |_| Ok(()),
    open: |path| Ok(Box::new(Recording::open(path)?)),
};

/// Bytes before the records of a chunk without compression.
const CHUNK_HEADER: u64 = 40;

/// An open file with its summary.
struct Recording {
    path: PathBuf,
    length: u64,
    summary: Summary,
}

impl Recording {
    /// # Errors
    /// A file that is no MCAP, has no summary (as after a crash of the recorder), or whose index points outside.
    fn open(path: &Path) -> Result<Recording, DataError> {
        let wrong = |e: &dyn std::fmt::Display| {
            let advice = "if its recorder crashed, `mcap recover` writes a complete file";
            DataError::file(path, format!("is no complete MCAP file: {e}; {advice}"))
        };
        let length = fs_err::metadata(path)?.len();
        let mut file = File::open(path)?;
        let section = summary_section(&mut file, length)?.ok_or_else(|| wrong(&"its summary is too large"))?;
        lengths::check_summary(&section).map_err(|e| wrong(&e))?;
        drop(section);
        let options = SummaryReaderOptions::default().with_file_size(length);
        let mut reader = SummaryReader::new_with_options(options);
        while let Some(event) = reader.next_event() {
            match event.map_err(|e| wrong(&e))? {
                SummaryReadEvent::ReadRequest(n) => {
                    let read = file.read(reader.insert(n.min(1 << 24)))?;
                    reader.notify_read(read);
                }
                SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to)?),
            }
        }
        let summary = reader.finish().ok_or_else(|| wrong(&"it has no summary"))?;
        for chunk in &summary.chunk_indexes {
            let end = chunk.chunk_start_offset.checked_add(chunk.chunk_length);
            let inside = end.is_some_and(|end| end <= length) && chunk.chunk_length >= 9;
            if !inside || chunk.chunk_length > MOST_CLOUD_BYTES || chunk.uncompressed_size > MOST_CLOUD_BYTES {
                return Err(wrong(&"its index names a chunk that lies outside or is too large"));
            }
        }
        Ok(Recording { path: path.into(), length, summary })
    }

    fn wrong(&self, message: impl std::fmt::Display) -> DataError {
        DataError::file(&self.path, message.to_string())
    }

    fn range(&self, start: u64, length: u64) -> Result<Vec<u8>, DataError> {
        if start.checked_add(length).is_none_or(|end| end > self.length) || length > MOST_CLOUD_BYTES {
            return Err(self.wrong("its index points outside of the file"));
        }
        let mut file = File::open(&self.path)?;
        file.seek(SeekFrom::Start(start))?;
        let mut bytes = vec![0; length as usize];
        file.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// Log times and offsets of a message index record.
    fn message_index(&self, offset: u64, channel: u16) -> Result<Vec<(u64, u64)>, DataError> {
        let head = self.range(offset, 9)?;
        let length = head[1..9].iter().rev().fold(0u64, |n, b| n << 8 | u64::from(*b));
        if head[0] != op::MESSAGE_INDEX {
            return Err(self.wrong("its index points to no index of messages"));
        }
        let body = self.range(offset + 9, length)?;
        match ::mcap::parse_record(op::MESSAGE_INDEX, &body).map_err(|e| self.wrong(e))? {
            Record::MessageIndex(index) if index.channel_id == channel => {
                Ok(index.records.iter().map(|r| (r.log_time, r.offset)).collect())
            }
            _ => Err(self.wrong("its index points to the messages of another topic")),
        }
    }

    fn looked_through(&self, chunk: &ChunkIndex, channel: u16) -> Result<Vec<(u64, u64)>, DataError> {
        let mut found = Vec::new();
        self.each(chunk, |id, log_time, _| {
            if id == channel {
                found.push((log_time, found.len() as u64));
            }
        })?;
        Ok(found)
    }

    /// Calls `visit` with channel, log time and data of the messages of a chunk. It is read to its end, where its
    /// checksum is compared.
    fn each(&self, chunk: &ChunkIndex, mut visit: impl FnMut(u16, u64, &[u8])) -> Result<(), DataError> {
        let wrong = |e: McapError| self.wrong(format!("a chunk of it cannot be read: {e}"));
        let bytes = self.range(chunk.chunk_start_offset, chunk.chunk_length)?;
        let (head, body) = bytes.split_at(9);
        if head[0] != op::CHUNK || head[1..] != (body.len() as u64).to_le_bytes() {
            return Err(self.wrong("its index points to no chunk"));
        }
        if !lengths::fit(op::CHUNK, body) {
            return Err(self.wrong("a chunk of it is damaged"));
        }
        let Record::Chunk { header, .. } = ::mcap::parse_record(op::CHUNK, body).map_err(wrong)? else {
            return Err(self.wrong("its index points to no chunk"));
        };
        // Behind the records of a chunk without compression the library expects nothing.
        if header.compression.is_empty() && header.compressed_size.checked_add(CHUNK_HEADER) != Some(body.len() as u64)
        {
            return Err(self.wrong("a chunk of it is damaged: its records do not fill it"));
        }
        if header.uncompressed_size > MOST_CLOUD_BYTES {
            return Err(self.wrong("a chunk of it is larger than 2 GiB"));
        }
        let options = LinearReaderOptions::default()
            .with_skip_start_magic(true)
            .with_skip_end_magic(true)
            .with_validate_chunk_crcs(true)
            .with_record_length_limit((header.uncompressed_size as usize).max(bytes.len()));
        let (mut reader, mut rest) = (LinearReader::new_with_options(options), &bytes[..]);
        while let Some(event) = reader.next_event() {
            match event.map_err(wrong)? {
                LinearReadEvent::ReadRequest(wanted) => {
                    let (next, behind) = rest.split_at(wanted.min(rest.len()));
                    reader.insert(next.len()).copy_from_slice(next);
                    reader.notify_read(next.len());
                    rest = behind;
                }
                LinearReadEvent::Record { opcode: op::MESSAGE, data } => {
                    if let Record::Message { header, data } = ::mcap::parse_record(op::MESSAGE, data).map_err(wrong)? {
                        visit(header.channel_id, header.log_time, &data);
                    }
                }
                LinearReadEvent::Record { .. } => {}
            }
        }
        Ok(())
    }
}

/// The bytes from the start of the summary to the end of the file: none if there is no summary, `None` if there are
/// more than [`MOST_TEXT_BYTES`]. The footer says 28 bytes before the end where it starts.
fn summary_section(file: &mut File, length: u64) -> Result<Option<Vec<u8>>, DataError> {
    let mut start = [0; 8];
    if let Some(at) = length.checked_sub(28) {
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut start)?;
    }
    let start = u64::from_le_bytes(start);
    let mut bytes = Vec::new();
    if (1..length).contains(&start) {
        if length - start > MOST_TEXT_BYTES {
            return Ok(None);
        }
        file.seek(SeekFrom::Start(start))?;
        file.take(length - start).read_to_end(&mut bytes)?;
    }
    Ok(Some(bytes))
}

impl BagFile for Recording {
    fn topics(&self) -> Vec<Topic> {
        let topic = |(number, channel): (&u16, &std::sync::Arc<::mcap::Channel<'static>>)| Topic {
            channel: i64::from(*number),
            name: channel.topic.clone(),
            kind: channel.schema.as_ref().map(|s| s.name.clone()).unwrap_or_default(),
            encoding: channel.message_encoding.clone(),
        };
        self.summary.channels.iter().map(topic).collect()
    }

    fn places(&self, channel: i64) -> Result<Vec<Place>, DataError> {
        let channel = number(channel);
        let mut places = Vec::new();
        for (chunk, index) in self.summary.chunk_indexes.iter().enumerate() {
            let mut entries = match index.message_index_offsets.get(&channel) {
                Some(offset) => self.message_index(*offset, channel)?,
                // A chunk without an index has to be looked through.
                None if index.message_index_offsets.is_empty() => self.looked_through(index, channel)?,
                None => continue,
            };
            entries.sort_by_key(|(_, offset)| *offset);
            let time = |log_time: u64| i64::try_from(log_time).unwrap_or(i64::MAX);
            places.extend((0..).zip(entries).map(|(number, (at, _))| Place { log_time: time(at), chunk, number }));
        }
        Ok(places)
    }

    fn message(&self, channel: i64, place: Place) -> Result<Vec<u8>, DataError> {
        let channel = number(channel);
        let (mut number, mut found) = (0, None);
        self.each(&self.summary.chunk_indexes[place.chunk], |id, _, data| {
            if id == channel {
                if number == place.number {
                    found = Some(data.to_vec());
                }
                number += 1;
            }
        })?;
        found.ok_or_else(|| self.wrong("a message of its index does not exist"))
    }

    fn all(&self, channels: &[i64], visit: &mut Visit) -> Result<(), DataError> {
        let channels: Vec<u16> = channels.iter().map(|channel| number(*channel)).collect();
        for chunk in &self.summary.chunk_indexes {
            let offsets = &chunk.message_index_offsets;
            if !offsets.is_empty() && channels.iter().all(|c| !offsets.contains_key(c)) {
                continue;
            }
            let mut result = Ok(());
            self.each(chunk, |id, _, data| {
                if channels.contains(&id) && result.is_ok() {
                    result = visit(i64::from(id), data);
                }
            })?;
            result.map_err(|e| self.wrong(format!("a message of it cannot be read: {e}")))?;
        }
        Ok(())
    }
}

/// The number of a channel that [`Recording::topics`] returned.
fn number(channel: i64) -> u16 {
    u16::try_from(channel).expect("a channel of this file")
}
