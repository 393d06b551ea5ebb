//! Safetensors with OpenPCDet's names.

use super::{HostTensor, HostValues, NamedTensors, NumberType, file_error};
use crate::ModelError;
use crate::limits::{MOST_CHECKPOINT_BYTES, MOST_HEADER_BYTES};
use safetensors::{Dtype, SafeTensors};
use serde_json::{Map, Value, json};
use std::collections::BTreeMap;
use std::path::Path;

/// All tensors of a safetensors file.
///
/// # Errors
/// A file that cannot be read, is damaged or truncated, or holds tensors of other types than F32, F64 and I64.
pub fn read_safetensors(path: &Path) -> Result<NamedTensors, ModelError> {
    let bytes = data::limits::read_file(path, MOST_CHECKPOINT_BYTES)?;
    parse(&bytes).map_err(|message| file_error(path, message))
}

/// The metadata of a safetensors file.
///
/// # Errors
/// A file that cannot be read, or whose header is damaged.
pub fn read_metadata(path: &Path) -> Result<BTreeMap<String, String>, ModelError> {
    let bytes = data::limits::read_file(path, MOST_CHECKPOINT_BYTES)?;
    check_header(&bytes).map_err(|message| file_error(path, message))?;
    let (_, header) = SafeTensors::read_metadata(&bytes).map_err(|e| file_error(path, not_safetensors(&e)))?;
    Ok(header.metadata().iter().flatten().map(|(key, text)| (key.clone(), text.clone())).collect())
}

/// Writes tensors and metadata atomically. The same content gives the same bytes.
///
/// # Errors
/// A file that cannot be written; a tensor whose values do not fill its shape.
pub fn write_safetensors(
    path: &Path,
    tensors: &NamedTensors,
    metadata: &BTreeMap<String, String>,
) -> Result<(), ModelError> {
    let bytes = serialize(tensors, metadata).map_err(|message| file_error(path, message))?;
    Ok(data::write_atomic(path, &bytes)?)
}

pub(super) fn parse(bytes: &[u8]) -> Result<NamedTensors, String> {
    check_header(bytes)?;
    let file = SafeTensors::deserialize(bytes).map_err(|e| not_safetensors(&e))?;
    let mut tensors = NamedTensors::new();
    for (name, view) in file.iter() {
        let numbers = match view.dtype() {
            Dtype::F32 => NumberType::F32,
            Dtype::F64 => NumberType::F64,
            Dtype::I64 => NumberType::I64,
            other => return Err(format!("tensor {name} holds {other:?}; only F32, F64 and I64 are supported")),
        };
        let values = numbers.values(view.data());
        tensors.insert(name.into(), HostTensor { shape: view.shape().to_vec(), values });
    }
    Ok(tensors)
}

/// Refuses a header with more text than networks have names, before it is parsed.
fn check_header(bytes: &[u8]) -> Result<(), String> {
    match bytes.first_chunk::<8>().map(|length| u64::from_le_bytes(*length)) {
        Some(length) if length > bytes.len() as u64 => {
            Err(format!("says that its header has {length} bytes, but the file has {}", bytes.len()))
        }
        Some(length) if length > MOST_HEADER_BYTES => {
            Err(format!("has a header of {length} bytes with names of tensors; at most {MOST_HEADER_BYTES} are read"))
        }
        _ => Ok(()),
    }
}

fn not_safetensors(error: &safetensors::SafeTensorError) -> String {
    format!("is not a safetensors file, or is damaged or truncated: {error}")
}

/// Writes the header here, because the library writes metadata in the random order of a hash map: its length (u64),
/// JSON padded to 8 bytes, then the values, widest types first so that all are aligned.
fn serialize(tensors: &NamedTensors, metadata: &BTreeMap<String, String>) -> Result<Vec<u8>, String> {
    let mut ordered: Vec<(&str, &HostTensor)> = tensors.iter().map(|(name, tensor)| (name.as_str(), tensor)).collect();
    ordered.sort_by_key(|(_, tensor)| matches!(tensor.values, HostValues::F32(_)));
    let mut header = Map::new();
    if !metadata.is_empty() {
        let texts = metadata.iter().map(|(key, text)| (key.clone(), Value::from(text.as_str())));
        header.insert("__metadata__".into(), Value::Object(texts.collect()));
    }
    let mut values = Vec::new();
    for (name, tensor) in ordered {
        let from = values.len();
        let (dtype, count) = match &tensor.values {
            HostValues::F32(v) => ("F32", extend(&mut values, v, |v| v.to_le_bytes())),
            HostValues::F64(v) => ("F64", extend(&mut values, v, |v| v.to_le_bytes())),
            HostValues::I64(v) => ("I64", extend(&mut values, v, |v| v.to_le_bytes())),
        };
        if count != tensor.shape.iter().product::<usize>() {
            return Err(format!("tensor {name} has {count} values for the shape {:?}", tensor.shape));
        }
        let entry = json!({ "dtype": dtype, "shape": tensor.shape, "data_offsets": [from, values.len()] });
        header.insert(name.into(), entry);
    }
    let mut header = Value::Object(header).to_string().into_bytes();
    header.resize(header.len().next_multiple_of(8), b' ');
    let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
    bytes.append(&mut header);
    bytes.append(&mut values);
    Ok(bytes)
}

fn extend<T: Copy, const N: usize>(bytes: &mut Vec<u8>, values: &[T], to_bytes: impl Fn(T) -> [u8; N]) -> usize {
    bytes.extend(values.iter().flat_map(|&v| to_bytes(v)));
    values.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn some_tensors() -> NamedTensors {
        let of = |shape: Vec<usize>, values| HostTensor { shape, values };
        NamedTensors::from([
            ("a.weight".into(), of(vec![3], HostValues::F32(vec![1.0, f32::MIN_POSITIVE, -0.0]))),
            ("b.num_batches_tracked".into(), of(vec![], HostValues::I64(vec![7]))),
            ("c.empty".into(), of(vec![0, 4], HostValues::F32(vec![]))),
            ("d.loss".into(), of(vec![1, 2], HostValues::F64(vec![0.1, -1e300]))),
        ])
    }

    #[test]
    fn written_files_are_read_back() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("last.safetensors");
        let texts: BTreeMap<String, String> =
            (0..20).map(|i| (format!("key{i}"), format!("text \"{i}\"\n = 1"))).collect();
        write_safetensors(&path, &some_tensors(), &texts).unwrap();
        assert_eq!(read_safetensors(&path).unwrap(), some_tensors());
        assert_eq!(super::super::read_checkpoint(&path).unwrap(), some_tensors());
        assert_eq!(read_metadata(&path).unwrap(), texts);
        let first = std::fs::read(&path).unwrap();
        write_safetensors(&path, &some_tensors(), &texts).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), first, "the same content gives the same bytes");
        write_safetensors(&path, &some_tensors(), &BTreeMap::new()).unwrap();
        assert!(read_metadata(&path).unwrap().is_empty());
    }

    #[test]
    fn a_million_names_are_refused_before_they_are_parsed() {
        let names: Vec<String> = (0..1_000_000)
            .map(|i| format!(r#""t{i:06}":{{"dtype":"F32","shape":[0],"data_offsets":[0,0]}}"#))
            .collect();
        let header = format!("{{{}}}", names.join(","));
        let bytes = [&(header.len() as u64).to_le_bytes(), header.as_bytes()].concat();
        let error = parse(&bytes).unwrap_err();
        assert!(error.contains("names of tensors; at most 8388608 are read"), "{error}");
        let error = parse(&[&u64::MAX.to_le_bytes()[..], b"{}"].concat()).unwrap_err();
        assert!(error.contains("header has 18446744073709551615 bytes, but the file has 10"), "{error}");
    }

    #[test]
    fn a_shape_that_does_not_fit_is_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("x.safetensors");
        let wrong = HostTensor { shape: vec![2], values: HostValues::F32(vec![1.0]) };
        let error = write_safetensors(&path, &NamedTensors::from([("w".into(), wrong)]), &BTreeMap::new()).unwrap_err();
        assert!(error.to_string().contains("tensor w has 1 values for the shape [2]"), "{error}");
        assert!(!path.exists());
    }
}
