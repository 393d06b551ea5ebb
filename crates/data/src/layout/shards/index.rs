//! Where the members of shards are: from the headers of the tar files, or from `index.jsonl` beside them.
//!
//! A line of `index.jsonl` is taken for a shard of the same size. It spares the headers of the shard, and is no more
//! than a hint: each read of a member compares the header before it.

use crate::limits::{MOST_CLOUD_BYTES, MOST_IDS, at_most, check_name, length_of_file};
use crate::source::{Facts, Source, list};
use crate::{DataError, FilePart, Presence as _};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::HashMap;
use std::io::{BufRead as _, BufReader, Read as _, Seek as _, SeekFrom};
use std::path::{Path, PathBuf};

/// Name of the file with the index.
pub(super) const INDEX: &str = "index.jsonl";

/// Bytes of a header.
const HEADER: u64 = 512;

/// The index of a folder of shards.
pub(super) struct ShardIndex {
    folder: PathBuf,
    shards: Vec<ShardFile>,
    /// Sorted by id.
    frames: Vec<Entry>,
}

/// A shard as it was when its index was made.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct ShardFile {
    pub path: PathBuf,
    pub facts: Facts,
}

/// A frame of a shard.
#[derive(Clone, Debug)]
struct Entry {
    id: Box<str>,
    shard: u32,
    is_pcd: bool,
    cloud: Place,
    labels: Option<Place>,
}

/// First byte and length.
type Place = (u64, u32);

/// A line of `index.jsonl`: the frames of a shard with a `.bin` each.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Line {
    /// Name of the file.
    shard: String,
    /// Its size.
    bytes: u64,
    /// Id, place of the cloud, place of the labels.
    frames: Vec<(Box<str>, Place, Option<Place>)>,
}

/// A member of a shard.
pub(super) struct Member<'a> {
    shard: &'a Path,
    id: &'a str,
    pub ending: &'static str,
    pub at: u64,
    pub length: u32,
}

/// The shards in a folder, sorted by name.
pub(super) fn shards_in(folder: &Path) -> Result<Vec<ShardFile>, DataError> {
    let found = list(folder, "tar", INDEX)?;
    let mut shards: Vec<ShardFile> = found.into_iter().map(|(path, facts)| ShardFile { path, facts }).collect();
    shards.sort_by(|a, b| a.path.cmp(&b.path));
    Ok(shards)
}

impl ShardIndex {
    /// Reads the index of a folder from `index.jsonl` and, for shards that it does not have, from their headers.
    pub(super) fn open(folder: &Path) -> Result<ShardIndex, DataError> {
        Self::read(folder, known_lines(folder))
    }

    /// Reads all headers.
    pub(super) fn scan(folder: &Path) -> Result<ShardIndex, DataError> {
        Self::read(folder, HashMap::new())
    }

    fn read(folder: &Path, lines: HashMap<String, Line>) -> Result<ShardIndex, DataError> {
        if !folder.may_be_folder() {
            return Err(DataError::file(folder, "does not exist: check `root` and `layout` of the data set"));
        }
        let shards = shards_in(folder)?;
        let of_shard = |(number, shard): (usize, &ShardFile)| {
            let name = shard.path.file_name().and_then(|name| name.to_str());
            match name.and_then(|name| lines.get(name)).filter(|line| line.bytes == shard.facts.bytes) {
                Some(line) => Ok(line.entries(number)),
                None => headers_of(shard, number),
            }
        };
        let found: Vec<Result<Vec<Entry>, DataError>> = shards.par_iter().enumerate().map(of_shard).collect();
        let mut frames = Vec::new();
        for entries in found {
            frames.extend(entries?);
            at_most(folder, "frames", frames.len() as u64, MOST_IDS)?;
        }
        frames.par_sort_by(|a, b| (&a.id, a.shard).cmp(&(&b.id, b.shard)));
        if let Some(pair) = frames.windows(2).find(|pair| pair[0].id == pair[1].id) {
            let other = shards[pair[1].shard as usize].path.display();
            let message =
                format!("has the frame {}, which {other} has as well; give each frame its own name", pair[0].id);
            return Err(DataError::file(&shards[pair[0].shard as usize].path, message));
        }
        if frames.is_empty() {
            let message =
                "has no .tar file with members that end in .bin or .pcd: check `root` and `layout` of the data set";
            return Err(DataError::file(folder, message));
        }
        Ok(ShardIndex { folder: folder.into(), shards, frames })
    }

    /// Whether the shards have the same names, sizes and times of change as when the index was read.
    pub(super) fn is_current(&self) -> bool {
        shards_in(&self.folder).is_ok_and(|shards| shards == self.shards)
    }

    /// The ids of all frames, sorted.
    pub(super) fn ids(&self) -> impl Iterator<Item = &str> {
        self.frames.iter().map(|frame| &*frame.id)
    }

    /// Whether any frame has labels.
    pub(super) fn has_labels(&self) -> bool {
        self.frames.iter().any(|frame| frame.labels.is_some())
    }

    /// The cloud of a frame.
    pub(super) fn cloud(&self, id: &str) -> Result<Member<'_>, DataError> {
        let frame = self.frame(id)?;
        Ok(self.member(frame, if frame.is_pcd { "pcd" } else { "bin" }, frame.cloud))
    }

    /// The labels of a frame.
    pub(super) fn labels(&self, id: &str) -> Result<Member<'_>, DataError> {
        let frame = self.frame(id)?;
        let labels = frame.labels.ok_or_else(|| {
            let message = format!("has no member {id}.txt with the labels of the frame {id}");
            DataError::file(&self.shards[frame.shard as usize].path, message)
        })?;
        Ok(self.member(frame, "txt", labels))
    }

    fn frame(&self, id: &str) -> Result<&Entry, DataError> {
        match self.frames.binary_search_by(|frame| (*frame.id).cmp(id)) {
            Ok(found) => Ok(&self.frames[found]),
            Err(_) => Err(DataError::file(&self.folder, format!("has no frame {id:?} in its .tar files"))),
        }
    }

    fn member<'a>(&'a self, frame: &'a Entry, ending: &'static str, (at, length): Place) -> Member<'a> {
        Member { shard: &self.shards[frame.shard as usize].path, id: &frame.id, ending, at, length }
    }

    /// The content of `index.jsonl`. A shard with another cloud than `.bin` has no line.
    pub(super) fn to_lines(&self) -> String {
        let mut lines: Vec<Line> = Vec::new();
        for shard in &self.shards {
            let name = shard.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            lines.push(Line { shard: name, bytes: shard.facts.bytes, frames: Vec::new() });
        }
        let mut whole = vec![true; lines.len()];
        for frame in &self.frames {
            whole[frame.shard as usize] &= !frame.is_pcd;
            lines[frame.shard as usize].frames.push((frame.id.clone(), frame.cloud, frame.labels));
        }
        let lines = lines.iter().zip(whole).filter(|(_, whole)| *whole);
        lines.map(|(line, _)| format!("{}\n", serde_json::to_string(line).expect("a line is plain data"))).collect()
    }
}

impl Line {
    fn entries(&self, number: usize) -> Vec<Entry> {
        let entry = |(id, cloud, labels): &(Box<str>, Place, Option<Place>)| Entry {
            id: id.clone(),
            shard: number as u32,
            is_pcd: false,
            cloud: *cloud,
            labels: *labels,
        };
        self.frames.iter().map(entry).collect()
    }

    /// Whether all names are names and all places are inside the shard.
    fn is_sound(&self) -> bool {
        let inside = |(at, length): &Place| *at >= HEADER && at.saturating_add((*length).into()) <= self.bytes;
        self.frames
            .iter()
            .all(|(id, cloud, labels)| check_name(id).is_ok() && inside(cloud) && labels.as_ref().is_none_or(inside))
    }
}

/// The lines of `index.jsonl` by shard; none without the file. A line that cannot be read is left out.
fn known_lines(folder: &Path) -> HashMap<String, Line> {
    let path = folder.join(INDEX);
    if length_of_file(&path, MOST_CLOUD_BYTES).is_err() {
        return HashMap::new();
    }
    let Ok(file) = Source::open(&path, None) else { return HashMap::new() };
    let texts: Vec<Vec<u8>> = BufReader::new(file).split(b'\n').map_while(Result::ok).collect();
    let line = |text: &Vec<u8>| serde_json::from_slice::<Line>(text).ok().filter(Line::is_sound);
    texts.par_iter().filter_map(line).map(|line| (line.shard.clone(), line)).collect()
}

/// The frames of a shard, from its headers.
fn headers_of(shard: &ShardFile, number: usize) -> Result<Vec<Entry>, DataError> {
    let wrong = |message: String| DataError::file(&shard.path, message);
    let unread = |e: std::io::Error| wrong(format!("is no tar file that can be read: {e}"));
    let mut archive = tar::Archive::new(Repeating(Source::open(&shard.path, None)?));
    let mut found: Vec<(String, &'static str, Place)> = Vec::new();
    for entry in archive.entries_with_seek().map_err(unread)? {
        let entry = entry.map_err(unread)?;
        let path = entry.path().map_err(unread)?;
        let Some((id, ending)) = path.file_name().and_then(|name| parts_of_name(name.to_str()?)) else { continue };
        if !entry.header().entry_type().is_file() {
            return Err(wrong(format!("its member {id}.{ending} is no regular file; only regular files are read")));
        }
        check_name(id).map_err(|problem| wrong(format!("frame id {problem}")))?;
        let (at, length) = (entry.raw_file_position(), entry.size());
        if length > MOST_CLOUD_BYTES {
            let message = format!("its member {id}.{ending} has {length} bytes; at most {MOST_CLOUD_BYTES} are read");
            return Err(wrong(message));
        }
        if at.saturating_add(length) > shard.facts.bytes {
            return Err(wrong(format!("ends within its member {id}.{ending}: it is truncated")));
        }
        at_most(&shard.path, "frames", found.len() as u64 / 2, MOST_IDS)?;
        found.push((id.into(), ending, (at, length as u32)));
    }
    found.sort();
    let mut entries: Vec<Entry> = Vec::new();
    for of_frame in found.chunk_by(|a, b| a.0 == b.0) {
        let id = &of_frame[0].0;
        if let Some(twice) = of_frame.windows(2).find(|pair| pair[0].1 == pair[1].1) {
            return Err(wrong(format!("has the member {id}.{} twice", twice[0].1)));
        }
        let place = |wanted: &str| of_frame.iter().find(|(_, ending, _)| *ending == wanted).map(|found| found.2);
        let (bin, pcd) = (place("bin"), place("pcd"));
        // Labels without a cloud are no frame.
        let Some(cloud) = bin.or(pcd) else { continue };
        let id = id.as_str().into();
        entries.push(Entry { id, shard: number as u32, is_pcd: bin.is_none(), cloud, labels: place("txt") });
    }
    Ok(entries)
}

/// Repeats reads that a signal interrupts, which the library for tar files gives up.
struct Repeating(Source);

impl std::io::Read for Repeating {
    fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
        loop {
            match self.0.read(buffer) {
                Err(e) if e.kind() == std::io::ErrorKind::Interrupted => {}
                done => return done,
            }
        }
    }
}

impl std::io::Seek for Repeating {
    fn seek(&mut self, to: SeekFrom) -> std::io::Result<u64> {
        self.0.seek(to)
    }
}

/// Id and ending of a member that belongs to a frame. Names that begin with a full stop are notes of systems.
fn parts_of_name(name: &str) -> Option<(&str, &'static str)> {
    let (id, ending) = name.rsplit_once('.')?;
    let ending = ["bin", "pcd", "txt"].into_iter().find(|known| *known == ending)?;
    (!name.starts_with('.')).then_some((id, ending))
}

impl Member<'_> {
    /// What error messages name: the member below its shard.
    pub(super) fn path(&self) -> PathBuf {
        self.shard.join(format!("{}.{}", self.id, self.ending))
    }

    /// Where its bytes are, after a look at its header.
    pub(super) fn part(&self) -> Result<FilePart, DataError> {
        let mut header = [0; HEADER as usize];
        self.open(0)?.read_exact(&mut header).map_err(|e| match e.kind() {
            std::io::ErrorKind::UnexpectedEof => self.moved(),
            _ => e.into(),
        })?;
        self.check(&header)?;
        Ok(self.place())
    }

    /// Where its bytes are, as the index says.
    pub(super) fn place(&self) -> FilePart {
        FilePart { path: self.shard.into(), range: Some((self.at, self.length.into())) }
    }

    /// Reads its bytes, of which there are at most `most`.
    pub(super) fn read(&self, most: u64) -> Result<Vec<u8>, DataError> {
        if u64::from(self.length) > most {
            let message = format!("has {} bytes; at most {most} are read from such a file", self.length);
            return Err(DataError::file(&self.path(), message));
        }
        let all = HEADER + u64::from(self.length);
        let mut bytes = Vec::with_capacity(all as usize);
        self.open(self.length.into())?.take(all).read_to_end(&mut bytes)?;
        if bytes.len() as u64 != all {
            return Err(self.moved());
        }
        self.check(&bytes)?;
        Ok(bytes.split_off(HEADER as usize))
    }

    /// The shard, at the header of this member, of which `wanted` bytes will be read.
    fn open(&self, wanted: u64) -> Result<Source, DataError> {
        let mut file = Source::open(self.shard, Some(self.at + wanted))?;
        file.seek(SeekFrom::Start(self.at - HEADER))?;
        Ok(file)
    }

    /// Compares the header with what the index says.
    fn check(&self, bytes: &[u8]) -> Result<(), DataError> {
        let header = tar::Header::from_byte_slice(&bytes[..HEADER as usize]);
        let mut summed = header.clone();
        summed.set_cksum();
        let name = format!("{}.{}", self.id, self.ending);
        let found = header.path_bytes();
        let found = found.rsplit(|byte| *byte == b'/').next().unwrap_or_default();
        // A name that is longer than the field of a header stands in another header before it.
        let is_named = found == name.as_bytes() || name.len() > 90 || header.path_bytes().len() > 90;
        let is_sound = summed.cksum().ok() == header.cksum().ok();
        if is_sound && is_named && header.entry_size().ok() == Some(self.length.into()) {
            return Ok(());
        }
        Err(self.moved())
    }

    fn moved(&self) -> DataError {
        let message = format!(
            "its member {}.{} is not where the index of the shards says: the file was changed; remove {INDEX} beside it, \
             and start the program again",
            self.id, self.ending
        );
        DataError::file(self.shard, message)
    }
}
