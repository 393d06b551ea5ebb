//! OpenPCDet's checkpoints, `{epoch, it, model_state, optimizer_state, version}`, as `torch.save` writes them.
//!
//! **Zip format**: an uncompressed archive of `NAME/data.pkl` and a file `NAME/data/KEY` for each storage, with
//! checksums. **Legacy format** (`_use_new_zipfile_serialization=False`, as OpenPCDet writes): one file of five pickles
//! (magic number, version, properties of the machine, checkpoint, list of storage keys), then for each key the number
//! of elements (i64) and the elements.
//!
//! Only `model_state` is read. The device of a storage (`cuda:0`) is ignored.

use super::pickle::{Contents, Id, Pickle, Value, storage_width};
use super::{HostTensor, NamedTensors, NumberType};
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::io::{Cursor, Read as _};

/// 0x1950a86a20f9469cfc6c.
const MAGIC: [u8; 10] = [0x6c, 0xfc, 0x9c, 0x46, 0xf9, 0x20, 0x6a, 0xa8, 0x50, 0x19];
const VERSION: i64 = 1001;
const MAX_DIMENSIONS: usize = 8;

/// A storage as the checkpoint's pickle refers to it.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Storage<'a> {
    /// `FloatStorage` and so on.
    kind: &'a str,
    key: &'a str,
    elements: usize,
    /// `elements` times the element size.
    bytes: usize,
}

/// Reads the zip format.
pub fn parse_zip(bytes: &[u8]) -> Result<NamedTensors, String> {
    // torch writes no archive comment, so the file ends with the end record.
    let end = bytes.len().checked_sub(22).map_or(&[][..], |from| &bytes[from..]);
    if !end.starts_with(b"PK\x05\x06") || !end.ends_with(&[0, 0]) {
        return Err(
            "is a damaged or truncated zip archive, or bytes follow it: its end record is not at its end".into()
        );
    }
    let damaged = |e: &dyn std::fmt::Display| format!("is a damaged zip archive: {e}");
    // The archive begins at the start of the file.
    let config = zip::read::Config { archive_offset: zip::read::ArchiveOffset::Known(0) };
    let mut archive = zip::ZipArchive::with_config(config, Cursor::new(bytes)).map_err(|e| damaged(&e))?;
    if archive.has_duplicate_names() {
        return Err("is a damaged zip archive: it has a duplicate name".into());
    }
    let mut roots = Vec::new();
    for name in archive.file_names() {
        if let Some(root) = name.map_err(|e| damaged(&e))?.strip_suffix("/data.pkl") {
            roots.push(root.to_string());
        }
    }
    let [root] = roots.as_slice() else {
        return Err("is a zip archive without exactly one data.pkl, so not of torch".into());
    };
    let mut entry = |name: &str, expected: Option<usize>| -> Result<Vec<u8>, String> {
        let name = format!("{root}/{name}");
        let file = archive.by_name(&name).map_err(|e| format!("{name} of the archive: {e}"))?;
        let size = file.size();
        if file.compression() != zip::CompressionMethod::Stored || size > bytes.len() as u64 {
            return Err(format!("{name} of the archive is compressed or damaged; torch stores files uncompressed"));
        }
        if expected.is_some_and(|expected| expected as u64 != size) {
            return Err(format!("{name} of the archive has {size} bytes, its tensor needs {}", expected.unwrap_or(0)));
        }
        let mut content = Vec::with_capacity(size as usize);
        file.take(bytes.len() as u64).read_to_end(&mut content).map_err(|e| format!("{name} of the archive: {e}"))?;
        if content.len() as u64 != size {
            return Err(format!("{name} of the archive has {} bytes instead of {size}", content.len()));
        }
        Ok(content)
    };
    if entry("byteorder", None).is_ok_and(|order| order != b"little") {
        return Err("was written on a big-endian machine, which is not supported".into());
    }
    let content = entry("data.pkl", None)?;
    let pickle = Pickle::parse(&content, Contents::Checkpoint)?;
    if pickle.length != content.len() {
        return Err(format!("{} bytes follow the pickle in data.pkl", content.len() - pickle.length));
    }
    let mut content = |storage: &Storage| entry(&format!("data/{}", storage.key), Some(storage.bytes)).map(Cow::Owned);
    model_state(&pickle, bytes.len(), &mut content)
}

/// Reads the legacy format.
pub fn parse_legacy(bytes: &[u8]) -> Result<NamedTensors, String> {
    let mut at = 0;
    let mut next = || -> Result<Pickle, String> {
        let pickle = Pickle::parse(&bytes[at..], Contents::Checkpoint)
            .map_err(|e| format!("is damaged or truncated: from byte {at}: {e}"))?;
        at += pickle.length;
        Ok(pickle)
    };
    let (magic, version, machine) = (next()?, next()?, next()?);
    if *magic.root() != Value::Long(&MAGIC) || *version.root() != Value::Int(VERSION) {
        return Err("is a pickle, but not a checkpoint of torch".into());
    }
    let little_endian = lookup(&machine, machine.root(), "little_endian")?.map(|id| machine.get(id));
    if little_endian != Some(&Value::Bool(true)) {
        return Err("was written on a big-endian machine, which is not supported".into());
    }
    let (checkpoint, list) = (next()?, next()?);
    let Value::List(keys) = list.root() else {
        return Err("is damaged: its list of storages is not a list of strings".into());
    };
    // The optimiser's storages lie between those of the network, so all are read in order.
    let mut missing = storages(&checkpoint)?;
    let mut contents: BTreeMap<&str, &[u8]> = BTreeMap::new();
    let mut rest = &bytes[at..];
    for &key in keys {
        let Value::Str(key) = *list.get(key) else {
            return Err("is damaged: its list of storages is not a list of strings".into());
        };
        let storage =
            missing.remove(key).ok_or_else(|| format!("lists storage {key} twice, or a storage that is not used"))?;
        let truncated = || format!("is truncated inside storage {key}");
        let (elements, after) = rest.split_first_chunk::<8>().ok_or_else(truncated)?;
        if i64::from_le_bytes(*elements) != storage.elements as i64 {
            return Err(format!("is damaged: storage {key} does not have the expected {} elements", storage.elements));
        }
        let (content, after) = after.split_at_checked(storage.bytes).ok_or_else(truncated)?;
        contents.insert(key, content);
        rest = after;
    }
    if let Some(key) = missing.keys().next() {
        return Err(format!("is damaged: storage {key} is used, but not in the file"));
    }
    if !rest.is_empty() {
        return Err(format!("{} bytes follow the last storage", rest.len()));
    }
    let mut content = |storage: &Storage| {
        let content = contents.get(storage.key).ok_or_else(|| format!("storage {} is missing", storage.key))?;
        Ok(Cow::Borrowed(*content))
    };
    model_state(&checkpoint, bytes.len(), &mut content)
}

/// Every storage that a pickle refers to, by key.
fn storages<'p>(pickle: &'p Pickle) -> Result<BTreeMap<&'p str, Storage<'p>>, String> {
    let mut known = BTreeMap::new();
    for value in pickle.values() {
        if let Value::Persistent(id) = value {
            let storage = storage(pickle, *id)?;
            if known.insert(storage.key, storage).is_some_and(|before| before != storage) {
                return Err(format!("is damaged: storage {} is used with two types", storage.key));
            }
        }
    }
    Ok(known)
}

/// `("storage", kind, key, location, elements)`; the legacy format adds a view, which is always empty.
fn storage<'p>(pickle: &'p Pickle, id: Id) -> Result<Storage<'p>, String> {
    let damaged = || String::from("is damaged: a reference to a storage is not as torch writes it");
    let Value::Tuple(parts) = pickle.get(id) else { return Err(damaged()) };
    let parts: Vec<&Value> = parts.iter().map(|&part| pickle.get(part)).collect();
    let (Value::Str("storage"), Value::Global("torch", kind), Value::Str(key), Value::Str(_), Value::Int(elements)) =
        (match parts[..] {
            [tag, kind, key, location, elements] | [tag, kind, key, location, elements, Value::None] => {
                (tag, kind, key, location, elements)
            }
            _ => return Err(damaged()),
        })
    else {
        return Err(damaged());
    };
    let width = storage_width(kind).ok_or_else(damaged)?;
    let elements = usize::try_from(*elements).map_err(|_| damaged())?;
    let bytes = elements.checked_mul(width).filter(|&bytes| bytes <= isize::MAX as usize).ok_or_else(damaged)?;
    Ok(Storage { kind, key, elements, bytes })
}

/// The entry of a dictionary with a string as its key.
fn lookup(pickle: &Pickle, dict: &Value, key: &str) -> Result<Option<Id>, String> {
    let Value::Dict(entries) = dict else { return Err(format!("is damaged: {key} is not in a dictionary")) };
    let mut found = entries.iter().filter(|(k, _)| *pickle.get(*k) == Value::Str(key)).map(|(_, value)| *value);
    match (found.next(), found.next()) {
        (first, None) => Ok(first),
        _ => Err(format!("is damaged: {key} occurs twice")),
    }
}

/// Returns the bytes of a storage.
type Content<'c, 'b> = dyn FnMut(&Storage) -> Result<Cow<'b, [u8]>, String> + 'c;

fn model_state(pickle: &Pickle, file_length: usize, content: &mut Content) -> Result<NamedTensors, String> {
    let Some(state) = lookup(pickle, pickle.root(), "model_state")? else {
        return Err("has no entry model_state; only checkpoints of OpenPCDet are supported".into());
    };
    let Value::Dict(entries) = pickle.get(state) else {
        return Err("has a model_state that is not a dictionary".into());
    };
    let mut tensors = NamedTensors::new();
    // Tensors may share a storage. The total size is limited, so that a small file cannot use much memory or time.
    let mut budget = file_length.saturating_mul(4);
    for &(name, value) in entries {
        let Value::Str(name) = *pickle.get(name) else {
            return Err("is damaged: the name of a tensor is not a string".into());
        };
        let named = |message: String| format!("tensor {name} {message}");
        let view = View::of(pickle, value).map_err(named)?;
        budget = budget
            .checked_sub(view.storage.bytes)
            .ok_or_else(|| named("needs more bytes, with those before it, than the file can hold".into()))?;
        let tensor = view.read(&content(&view.storage).map_err(named)?).map_err(named)?;
        if tensors.insert(name.into(), tensor).is_some() {
            return Err(format!("is damaged: tensor {name} occurs twice"));
        }
    }
    Ok(tensors)
}

/// A tensor as a view of a storage. Shape and strides have the same length.
struct View<'p> {
    storage: Storage<'p>,
    offset: usize,
    shape: Vec<usize>,
    /// Stride of each dimension, elements.
    strides: Vec<usize>,
}

impl<'p> View<'p> {
    /// `_rebuild_tensor_v2(storage, offset, shape, strides, ..)`, or a parameter of it.
    fn of(pickle: &'p Pickle, id: Id) -> Result<Self, String> {
        let call = |id: Id| match pickle.get(id) {
            Value::Call { callable, arguments, .. } => match (pickle.get(*callable), pickle.get(*arguments)) {
                (Value::Global("torch._utils", name), Value::Tuple(arguments)) => Some((*name, arguments.as_slice())),
                _ => None,
            },
            _ => None,
        };
        let made = match call(id) {
            Some(("_rebuild_parameter", [tensor, ..])) => call(*tensor),
            made => made,
        };
        let Some(("_rebuild_tensor_v2", &[source, offset, shape, strides, ..])) = made else {
            return Err("is no tensor".into());
        };
        let damaged = || String::from("is damaged: it is not as torch writes it");
        let Value::Persistent(source) = *pickle.get(source) else { return Err(damaged()) };
        let whole = |id: Id| match pickle.get(id) {
            Value::Int(n) => usize::try_from(*n).ok(),
            _ => None,
        };
        let list = |id: Id| match pickle.get(id) {
            Value::Tuple(items) if items.len() <= MAX_DIMENSIONS => items.iter().map(|&i| whole(i)).collect(),
            _ => None,
        };
        let (shape, strides): (Vec<usize>, Vec<usize>) = list(shape).zip(list(strides)).ok_or_else(damaged)?;
        let view =
            View { storage: storage(pickle, source)?, offset: whole(offset).ok_or_else(damaged)?, shape, strides };
        if view.shape.len() != view.strides.len() {
            return Err(damaged());
        }
        view.check()?;
        Ok(view)
    }

    /// Checks that all elements lie inside the storage and do not overlap. Their number is then at most that of the
    /// storage.
    fn check(&self) -> Result<(), String> {
        let message = || format!("of shape {:?} and strides {:?} does not fit its storage", self.shape, self.strides);
        if self.shape.contains(&0) {
            return Ok(());
        }
        let mut steps: Vec<(usize, usize)> = self.strides.iter().copied().zip(self.shape.iter().copied()).collect();
        steps.retain(|&(_, extent)| extent > 1);
        steps.sort_unstable();
        let mut span = 1usize; // elements from the first to the last over the dimensions so far
        for (stride, extent) in steps {
            if stride < span {
                return Err(message());
            }
            span = stride.checked_mul(extent - 1).and_then(|far| far.checked_add(span)).ok_or_else(message)?;
        }
        let end = self.offset.checked_add(span).ok_or_else(message)?;
        if end <= self.storage.elements { Ok(()) } else { Err(message()) }
    }

    /// The elements in row-major order.
    fn read(&self, content: &[u8]) -> Result<HostTensor, String> {
        let (numbers, width) = match self.storage.kind {
            "FloatStorage" => (NumberType::F32, 4),
            "DoubleStorage" => (NumberType::F64, 8),
            "LongStorage" => (NumberType::I64, 8),
            other => {
                return Err(format!(
                    "lies in a {other}; only float32, float64 and int64 are supported, convert it first"
                ));
            }
        };
        let shape = self.shape.clone();
        if self.shape.contains(&0) {
            return Ok(HostTensor { shape, values: numbers.values(&[]) });
        }
        let count: usize = self.shape.iter().product(); // no overflow: at most the size of the storage
        let first = self.offset * width;
        if self.is_row_major() {
            return Ok(HostTensor { shape, values: numbers.values(&content[first..first + count * width]) });
        }
        let mut gathered = Vec::with_capacity(count * width);
        let mut index = vec![0; self.shape.len()];
        for _ in 0..count {
            let steps: usize = index.iter().zip(&self.strides).map(|(i, stride)| i * stride).sum();
            let from = first + steps * width;
            gathered.extend_from_slice(&content[from..from + width]);
            for (i, extent) in index.iter_mut().zip(&self.shape).rev() {
                *i += 1;
                if *i < *extent {
                    break;
                }
                *i = 0;
            }
        }
        Ok(HostTensor { shape, values: numbers.values(&gathered) })
    }

    fn is_row_major(&self) -> bool {
        let mut expected = 1;
        self.shape.iter().zip(&self.strides).rev().all(|(&extent, &stride)| {
            let fits = extent == 1 || stride == expected;
            expected *= extent;
            fits
        })
    }
}
