//! Where the messages of an MCAP file are. The file is read by ranges, so that its size does not matter.

use crate::DataError;
use crate::limits::MOST_CLOUD_BYTES;
use ::mcap::records::{ChunkIndex, Record, op};
use ::mcap::sans_io::{SummaryReadEvent, SummaryReader, SummaryReaderOptions};
use ::mcap::{McapError, Summary};
use fs_err::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// An open file with its summary.
pub(super) struct Recording {
    path: PathBuf,
    length: u64,
    summary: Summary,
}

/// A channel: its number, topic, type and encoding.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Topic {
    pub channel: u16,
    pub name: String,
    pub kind: String,
    pub encoding: String,
}

/// Place of a message: the chunk, and which of the chunk's messages of its channel it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Place {
    pub chunk: usize,
    pub number: usize,
    pub log_time: u64,
}

impl Recording {
    /// # Errors
    /// A file that is no MCAP, has no summary (as after a crash of the recorder), or whose index points outside.
    pub fn open(path: &Path) -> Result<Recording, DataError> {
        let wrong = |e: &dyn std::fmt::Display| {
            let advice = "if its recorder crashed, `mcap recover` writes a complete file";
            DataError::file(path, format!("is no complete MCAP file: {e}; {advice}"))
        };
        let length = fs_err::metadata(path)?.len();
        let mut file = File::open(path)?;
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

    /// Topics with messages of a type, by name.
    pub fn topics(&self, kind: &str) -> Vec<Topic> {
        let topic = |(number, channel): (&u16, &std::sync::Arc<::mcap::Channel<'static>>)| {
            let found = channel.schema.as_ref().map(|s| s.name.clone()).unwrap_or_default();
            Topic {
                channel: *number,
                name: channel.topic.clone(),
                kind: found,
                encoding: channel.message_encoding.clone(),
            }
        };
        let mut topics: Vec<Topic> = self.summary.channels.iter().map(topic).filter(|t| t.kind == kind).collect();
        topics.sort_by(|a, b| (&a.name, a.channel).cmp(&(&b.name, b.channel)));
        topics
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

    /// Places of all messages of a channel, by time.
    pub fn places(&self, channel: u16) -> Result<Vec<Place>, DataError> {
        let mut places = Vec::new();
        for (number, chunk) in self.summary.chunk_indexes.iter().enumerate() {
            let mut entries = match chunk.message_index_offsets.get(&channel) {
                Some(offset) => self.message_index(*offset, channel)?,
                // A chunk without an index has to be looked through.
                None if chunk.message_index_offsets.is_empty() => self.looked_through(chunk, channel)?,
                None => continue,
            };
            entries.sort_by_key(|(_, offset)| *offset);
            let place = |(i, (log_time, _)): (usize, (u64, u64))| Place { chunk: number, number: i, log_time };
            places.extend(entries.into_iter().enumerate().map(place));
        }
        places.sort_by_key(|p| (p.log_time, p.chunk, p.number));
        Ok(places)
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
        let bytes = self.range(chunk.chunk_start_offset + 9, chunk.chunk_length - 9)?;
        let Record::Chunk { header, data } = ::mcap::parse_record(op::CHUNK, &bytes).map_err(wrong)? else {
            return Err(self.wrong("its index points to no chunk"));
        };
        if header.uncompressed_size > MOST_CLOUD_BYTES {
            return Err(self.wrong("a chunk of it is larger than 2 GiB"));
        }
        for record in ::mcap::read::ChunkReader::new(header, &data).map_err(wrong)? {
            if let Record::Message { header, data } = record.map_err(wrong)? {
                visit(header.channel_id, header.log_time, &data);
            }
        }
        Ok(())
    }

    /// The data of a message.
    pub fn message(&self, channel: u16, place: Place) -> Result<Vec<u8>, DataError> {
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

    /// Calls `visit` with the channel and the data of all messages of some channels.
    pub fn all(
        &self,
        channels: &[u16],
        mut visit: impl FnMut(u16, &[u8]) -> Result<(), String>,
    ) -> Result<(), DataError> {
        for chunk in &self.summary.chunk_indexes {
            let offsets = &chunk.message_index_offsets;
            if !offsets.is_empty() && channels.iter().all(|c| !offsets.contains_key(c)) {
                continue;
            }
            let mut result = Ok(());
            self.each(chunk, |id, _, data| {
                if channels.contains(&id) && result.is_ok() {
                    result = visit(id, data);
                }
            })?;
            result.map_err(|e| self.wrong(format!("a message of it cannot be read: {e}")))?;
        }
        Ok(())
    }
}
