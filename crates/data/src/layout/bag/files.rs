//! The files of a recording: one, or those that `metadata.yaml` of rosbag2 lists.

use super::super::recent::{Recent, State, state};
use super::Bags;
use crate::DataError;
use crate::limits::read_text;
use saphyr_parser::{Event, Parser};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// What rosbag2 writes beside the files of a recording.
const METADATA: &str = "metadata.yaml";

/// The one key of its outermost mapping.
const INFORMATION: &str = "rosbag2_bagfile_information";

/// Deepest nesting of lists and mappings in it.
const MOST_LEVELS: usize = 32;

/// What is read of `metadata.yaml`.
#[derive(Default)]
struct Metadata {
    relative_file_paths: Vec<String>,
    /// Empty without compression.
    compression_format: String,
}

/// A list, or a mapping with the key whose value comes next.
enum Level {
    List,
    Mapping(Option<String>),
}

impl Metadata {
    /// Reads a file. It stays in memory, and is read again if it has changed: every frame asks for it.
    fn read(path: &Path) -> Result<Arc<Metadata>, DataError> {
        static KNOWN: Recent<(PathBuf, State), Metadata> = Recent::new();
        let state = state(&[path], "does not exist: check `root` of the data set")?;
        KNOWN.get((path.into(), state), || {
            Metadata::parse(&read_text(path)?).map_err(|message| DataError::file(path, message))
        })
    }

    /// Walks through the text once. Anchors are not followed.
    fn parse(text: &str) -> Result<Metadata, String> {
        let mut metadata = Metadata::default();
        let mut levels: Vec<Level> = Vec::new();
        for event in Parser::new_from_str(text) {
            let value = match event.map_err(|e| format!("is no YAML: {e}"))?.0 {
                Event::MappingStart(..) | Event::SequenceStart(..)
                    if matches!(levels.last(), Some(Level::Mapping(None))) =>
                {
                    return Err("is no metadata of rosbag2: a key of it is not a text".into());
                }
                Event::MappingStart(..) | Event::SequenceStart(..) if levels.len() == MOST_LEVELS => {
                    return Err(format!("is no metadata of rosbag2: it nests in more than {MOST_LEVELS} levels"));
                }
                Event::MappingStart(..) => {
                    levels.push(Level::Mapping(None));
                    continue;
                }
                Event::SequenceStart(..) => {
                    levels.push(Level::List);
                    continue;
                }
                Event::MappingEnd | Event::SequenceEnd => {
                    levels.pop();
                    String::new()
                }
                Event::Scalar(text, ..) => text.into_owned(),
                Event::Alias(_) => String::new(),
                _ => continue,
            };
            match &levels[..] {
                [Level::Mapping(Some(a)), Level::Mapping(Some(b)), Level::List]
                    if a == INFORMATION && b == "relative_file_paths" =>
                {
                    metadata.relative_file_paths.push(value.clone());
                }
                [Level::Mapping(Some(a)), Level::Mapping(Some(b))] if a == INFORMATION && b == "compression_format" => {
                    metadata.compression_format = value.clone();
                }
                _ => {}
            }
            if let Some(Level::Mapping(key)) = levels.last_mut() {
                *key = if key.is_none() { Some(value) } else { None };
            }
        }
        Ok(metadata)
    }
}

/// A root without its topic, and the topic if there is one.
pub(super) fn split(root: &Path) -> (&Path, Option<&str>) {
    match root.to_str().and_then(|text| text.split_once('#')) {
        Some((place, topic)) if !root.exists() => (Path::new(place), Some(topic)),
        _ => (root, None),
    }
}

impl Bags {
    /// Whether a root is or has a file of this layout, compressed or not.
    pub(super) fn has_files(&self, root: &Path) -> Result<bool, DataError> {
        let place = split(root).0;
        if place.is_dir() {
            return Ok(self.files_in(place, "")?.len() + self.files_in(place, ".zstd")?.len() > 0);
        }
        Ok(place.is_file() && self.names(place))
    }

    /// Whether the name is that of a file of this layout, compressed or not.
    pub(in crate::layout) fn names(&self, path: &Path) -> bool {
        self.is_file(path, "") || self.is_file(path, ".zstd")
    }

    /// The files of a root, and the topic if it names one.
    pub(super) fn files_and_topic(&self, root: &Path) -> Result<(Vec<PathBuf>, Option<String>), DataError> {
        let (place, topic) = split(root);
        let files = if place.is_dir() { self.files_of_folder(place)? } else { vec![self.checked(place.into())?] };
        Ok((files, topic.map(String::from)))
    }

    fn files_of_folder(&self, folder: &Path) -> Result<Vec<PathBuf>, DataError> {
        if folder.join(METADATA).is_file() {
            return self.listed_files(folder);
        }
        let Bags { extension, .. } = self;
        let plain = self.files_in(folder, "")?;
        let files = if plain.is_empty() { self.files_in(folder, ".zstd")? } else { plain };
        match &files[..] {
            [file] => Ok(vec![self.checked(file.clone())?]),
            [] => Err(DataError::file(
                folder,
                format!("has no .{extension} file: check `root` and `layout` of the data set"),
            )),
            several => {
                let names: Vec<String> = several.iter().map(|f| f.display().to_string()).collect();
                let message = format!(
                    "has several .{extension} files and no {METADATA} that says that they are one recording; name one \
                     as `root`, or write the {METADATA} with `ros2 bag reindex`: {}",
                    names.join(", ")
                );
                Err(DataError::file(folder, message))
            }
        }
    }

    /// The files that `metadata.yaml` lists. All lie beside it; early versions of rosbag2 wrote folders before the
    /// names.
    fn listed_files(&self, folder: &Path) -> Result<Vec<PathBuf>, DataError> {
        let path = folder.join(METADATA);
        let wrong = |message: String| DataError::file(&path, message);
        let metadata = Metadata::read(&path)?;
        let format = &metadata.compression_format;
        if !["", "none", "zstd"].contains(&format.as_str()) {
            let message =
                format!("compression_format is {format:?}; zstd is read: write it anew with `ros2 bag convert`");
            return Err(wrong(message));
        }
        let mut files = Vec::new();
        for item in &metadata.relative_file_paths {
            let name = Path::new(item).file_name();
            let name = name.ok_or_else(|| wrong("relative_file_paths has an item that is no name of a file".into()))?;
            let file = self.checked(folder.join(name)).map_err(|e| match e {
                DataError::File { message, .. } => wrong(format!("its file {} {message}", name.display())),
                other => other,
            })?;
            files.push(file);
        }
        if files.is_empty() {
            return Err(wrong(
                "lists no file under rosbag2_bagfile_information.relative_file_paths; write it anew with \
                 `ros2 bag reindex`"
                    .into(),
            ));
        }
        Ok(files)
    }

    /// A file of this layout that exists.
    fn checked(&self, path: PathBuf) -> Result<PathBuf, DataError> {
        let Bags { extension, .. } = self;
        let message = if self.is_file(&path, ".zstd") {
            format!("is compressed as a whole; decompress it with `zstd -d` and name the .{extension} file as `root`")
        } else if !self.is_file(&path, "") {
            format!("is no .{extension} file: check `root` and `layout` of the data set")
        } else if !path.is_file() {
            let message = "does not exist: check `root`; if a recording was copied without all of its files, name one \
                           of them as `root`";
            return Err(DataError::missing(&path, message));
        } else {
            return Ok(path);
        };
        Err(DataError::file(&path, message))
    }

    /// Whether the name is that of a file of this layout with `ending` behind its extension.
    fn is_file(&self, path: &Path, ending: &str) -> bool {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let stem = name.strip_suffix(ending).and_then(|name| name.strip_suffix(self.extension));
        stem.is_some_and(|stem| stem.len() > 1 && stem.ends_with('.'))
    }

    /// The files of a folder by name.
    fn files_in(&self, folder: &Path, ending: &str) -> Result<Vec<PathBuf>, DataError> {
        let mut files = Vec::new();
        for entry in fs_err::read_dir(folder)? {
            files.push(entry?.path());
        }
        files.retain(|path| self.is_file(path, ending) && path.is_file());
        files.sort();
        Ok(files)
    }
}
