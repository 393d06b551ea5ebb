//! Checkpoints of the reference, damaged checkpoints, and checkpoints that ask to run code.

use lidarshift_models as models;
use models::checkpoint::{HostTensor, HostValues, NamedTensors, parse_checkpoint, read_checkpoint, read_safetensors};
use std::path::{Path, PathBuf};

fn case(name: &str) -> Option<PathBuf> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let own = root.join("../../tests/golden/synthetic").join(name);
    let shared = root.join("../../../shared/golden").join(name);
    let found = [own, shared].into_iter().find(|folder| folder.exists());
    if found.is_none() {
        eprintln!("skipped: there is no {name}");
    }
    found
}

fn parse(bytes: &[u8]) -> Result<NamedTensors, String> {
    parse_checkpoint(Path::new("some.pth"), bytes).map_err(|e| e.to_string())
}

#[track_caller]
fn assert_refused(bytes: &[u8], with: &str) {
    let message = parse(bytes).expect_err("should be refused");
    assert!(message.starts_with("some.pth: ") && message.contains(with), "{message}");
}

#[test]
fn all_three_formats_hold_the_same_weights() {
    for name in ["pointpillars_tiny", "pointrcnn_tiny"] {
        let Some(folder) = case(name) else { continue };
        let reference = read_safetensors(&folder.join("checkpoint.safetensors")).unwrap();
        assert!(reference.len() > 50);
        for file in ["checkpoint_legacy.pth", "checkpoint_zip.pth", "checkpoint.safetensors"] {
            let read = read_checkpoint(&folder.join(file)).unwrap();
            assert_eq!(read.len(), reference.len(), "{file}");
            for (tensor, ours) in &read {
                assert!(same_bits(ours, &reference[tensor]), "{file}: {tensor}");
            }
        }
    }
}

fn same_bits(a: &HostTensor, b: &HostTensor) -> bool {
    let values = match (&a.values, &b.values) {
        (HostValues::F32(a), HostValues::F32(b)) => a.iter().map(|v| v.to_bits()).eq(b.iter().map(|v| v.to_bits())),
        (a, b) => a == b,
    };
    a.shape == b.shape && values
}

#[test]
fn a_missing_file_is_named() {
    let message = read_checkpoint(Path::new("/nowhere/model.pth")).unwrap_err().to_string();
    assert!(message.contains("/nowhere/model.pth"), "{message}");
}

/// A small pickle, written opcode by opcode.
#[derive(Clone, Default)]
struct Script(Vec<u8>);

impl Script {
    fn raw(mut self, bytes: &[u8]) -> Self {
        self.0.extend_from_slice(bytes);
        self
    }
    fn text(self, text: &str) -> Self {
        self.raw(b"X").raw(&(text.len() as u32).to_le_bytes()).raw(text.as_bytes())
    }
    fn int(self, n: i32) -> Self {
        self.raw(b"J").raw(&n.to_le_bytes())
    }
    fn ints(self, numbers: &[i32]) -> Self {
        numbers.iter().fold(self.raw(b"("), |script, &n| script.int(n)).raw(b"t")
    }
    fn global(self, module: &str, name: &str) -> Self {
        self.raw(b"c").raw(module.as_bytes()).raw(b"\n").raw(name.as_bytes()).raw(b"\n")
    }
    fn storage(self, kind: &str, key: &str, location: &str, elements: i32) -> Self {
        let reference = self.raw(b"(").text("storage").global("torch", kind).text(key).text(location);
        reference.int(elements).raw(b"NtQ")
    }
    fn tensor(self, kind: &str, key: &str, elements: i32, offset: i32, shape: &[i32], strides: &[i32]) -> Self {
        let call = self.global("torch._utils", "_rebuild_tensor_v2").raw(b"(");
        let call = call.storage(kind, key, "cuda:0", elements).int(offset).ints(shape).ints(strides);
        call.raw(b"\x89").global("collections", "OrderedDict").raw(b")RtR")
    }
}

/// A file in torch's legacy format: `{"model_state": OrderedDict(state), ..}`.
fn legacy(state: Script, storages: &[(&str, &[u8], usize)]) -> Vec<u8> {
    let checkpoint = Script::default().raw(b"\x80\x02}(").text("epoch").int(3).text("model_state");
    let checkpoint = checkpoint.global("collections", "OrderedDict").raw(b")R(").raw(&state.0).raw(b"uu.");
    legacy_of(&checkpoint.0, storages)
}

fn legacy_of(checkpoint: &[u8], storages: &[(&str, &[u8], usize)]) -> Vec<u8> {
    let start = Script::default().raw(b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.\x80\x02}");
    let mut file = start.text("little_endian").raw(b"\x88s.").raw(checkpoint).raw(b"\x80\x02](");
    file = storages.iter().fold(file, |file, (key, ..)| file.text(key)).raw(b"e.");
    for (_, content, elements) in storages {
        file = file.raw(&(*elements as i64).to_le_bytes()).raw(content);
    }
    file.0
}

fn bytes_of(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

#[test]
fn views_parameters_and_inert_numbers() {
    let values: Vec<f32> = (0..6).map(|v| v as f32).collect();
    let state = Script::default().text("plain").tensor("FloatStorage", "7", 6, 0, &[2, 3], &[3, 1]);
    let state = state.text("turned").tensor("FloatStorage", "7", 6, 0, &[3, 2], &[1, 3]);
    let state = state.text("part").tensor("FloatStorage", "7", 6, 3, &[2], &[2]);
    let state = state.text("empty").tensor("FloatStorage", "7", 6, 0, &[0, 2], &[2, 1]);
    let state = state.text("parameter").global("torch._utils", "_rebuild_parameter").raw(b"(");
    let state = state.tensor("FloatStorage", "7", 6, 5, &[], &[]).raw(b"\x88}tR");
    // A numpy scalar, like the learning rate in the optimiser's state, is ignored.
    let checkpoint =
        Script::default().raw(b"\x80\x02}(").text("optimizer_state").global("numpy.core.multiarray", "scalar");
    let checkpoint =
        checkpoint.raw(b"(").global("numpy", "dtype").text("f8").raw(b"\x89\x88\x87R(").int(3).text("<").raw(b"NNNtb");
    let checkpoint = checkpoint.global("_codecs", "encode").text("x").text("latin1").raw(b"\x86RtR");
    let checkpoint = checkpoint.text("model_state").raw(b"}(").raw(&state.0).raw(b"uu.");
    let tensors = parse(&legacy_of(&checkpoint.0, &[("7", &bytes_of(&values), 6)])).unwrap();
    let of = |name: &str| match &tensors[name] {
        HostTensor { shape, values: HostValues::F32(values) } => (shape.clone(), values.clone()),
        other => panic!("{other:?}"),
    };
    assert_eq!(of("plain"), (vec![2, 3], values));
    assert_eq!(of("turned"), (vec![3, 2], vec![0.0, 3.0, 1.0, 4.0, 2.0, 5.0]));
    assert_eq!(of("part"), (vec![2], vec![3.0, 5.0]));
    assert_eq!(of("empty"), (vec![0, 2], vec![]));
    assert_eq!(of("parameter"), (vec![], vec![5.0]));
}

#[test]
fn sizes_that_the_file_does_not_have() {
    let content = bytes_of(&[1.0, 2.0, 3.0, 4.0]);
    let with = |elements, offset, shape: &[i32], strides: &[i32], stored| {
        let state = Script::default().text("w").tensor("FloatStorage", "0", elements, offset, shape, strides);
        legacy(state, &[("0", &content, stored)])
    };
    assert!(parse(&with(4, 0, &[2, 2], &[2, 1], 4)).is_ok());
    assert_refused(&with(i32::MAX, 0, &[4], &[1], i32::MAX as usize), "truncated inside storage 0");
    assert_refused(&with(4, 0, &[4], &[1], 5), "does not have the expected 4 elements");
    assert_refused(&with(-4, 0, &[4], &[1], 4), "reference to a storage");
    assert_refused(&with(3, 0, &[3], &[1], 3), "4 bytes follow the last storage");
    assert_refused(&with(4, 0, &[5], &[1], 4), "does not fit its storage");
    assert_refused(&with(4, 1, &[4], &[1], 4), "does not fit its storage");
    assert_refused(&with(4, 0, &[2, 2], &[1, 1], 4), "does not fit its storage");
    assert_refused(&with(4, 0, &[1 << 30, 1 << 30, 1 << 30], &[0, 0, 0], 4), "does not fit its storage");
    assert_refused(
        &with(4, 0, &[i32::MAX, i32::MAX, i32::MAX], &[1, i32::MAX, i32::MAX], 4),
        "does not fit its storage",
    );
    assert_refused(&with(4, 0, &[4], &[1, 1], 4), "not as torch writes it");
    assert_refused(&with(4, 0, &[-1], &[1], 4), "not as torch writes it");
}

#[test]
fn files_without_weights_are_refused() {
    let tensor = |kind| Script::default().text("w").tensor(kind, "0", 2, 0, &[2], &[1]);
    assert!(parse(&legacy(tensor("FloatStorage"), &[("0", &[0; 8], 2)])).is_ok());
    assert_refused(&legacy(tensor("HalfStorage"), &[("0", &[0; 4], 2)]), "tensor w lies in a HalfStorage");
    assert_refused(&legacy(tensor("FloatStorage"), &[]), "storage 0 is used, but not in the file");
    assert_refused(&legacy(tensor("FloatStorage"), &[("1", &[0; 8], 2)]), "lists storage 1");
    let twice = tensor("FloatStorage").raw(&tensor("FloatStorage").0);
    assert_refused(&legacy(twice, &[("0", &[0; 8], 2)]), "tensor w occurs twice");
    assert_refused(&legacy(Script::default().text("w").int(1), &[]), "tensor w is no tensor");
    assert_refused(&legacy_of(b"\x80\x02}.", &[]), "no entry model_state");
    let code = Script::default().text("w").global("os", "system").text("true").raw(b"\x85R");
    assert_refused(&legacy(code, &[]), "asks for os.system");
    assert_refused(b"", "is empty");
    assert_refused(b"hello, this is not a checkpoint", "neither torch's (.pth) nor safetensors");
    assert_refused(b"PK\x03\x04 no archive at all, but long enough", "zip archive");
}

#[test]
fn a_small_file_cannot_fill_a_large_memory() {
    let content = vec![0; 40_000];
    let state = (0..100).fold(Script::default(), |state, i| {
        state.text(&format!("w{i}")).tensor("FloatStorage", "0", 10_000, 0, &[10_000], &[1])
    });
    assert_refused(&legacy(state, &[("0", &content, 10_000)]), "than the file can hold");
}

/// Deterministic random numbers for the damage.
struct Chance(u64);

impl Chance {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) % end.max(1) as u64) as usize
    }
}

/// Damages the bytes at a random position between `from` and `to`.
fn damage(bytes: &mut Vec<u8>, from: usize, to: usize, chance: &mut Chance) {
    let at = from + chance.below(to - from);
    let length = 1 + chance.below(12).min(bytes.len() - at - 1);
    match chance.below(7) {
        0 => bytes[at] ^= 1 << chance.below(8),
        1 => bytes[at] = chance.below(256) as u8,
        2 => bytes[at..at + length].fill([0, 0xff, 0x7f, b'('][chance.below(4)]),
        3 => drop(bytes.drain(at..at + length)),
        4 => drop(bytes.splice(at..at, (0..length).map(|_| chance.below(256) as u8))),
        5 => bytes.truncate(at),
        _ => {
            let copy = bytes[at..at + length].to_vec();
            let to = from + chance.below(bytes.len() - from);
            drop(bytes.splice(to..to, copy));
        }
    }
}

#[test]
fn damaged_files_are_errors_or_harmless() {
    let Some(folder) = case("pointpillars_tiny") else { return };
    let reference = read_safetensors(&folder.join("checkpoint.safetensors")).unwrap();
    let mut chance = Chance(7);
    for (file, structure, rounds) in [
        ("checkpoint_legacy.pth", 27_000, 1500),
        ("checkpoint_zip.pth", 25_000, 1500),
        ("checkpoint.safetensors", 8_000, 1500),
    ] {
        let whole = std::fs::read(folder.join(file)).unwrap();
        let mut accepted = 0;
        for round in 0..rounds {
            let mut bytes = whole.clone();
            // Mostly in the header (for zip also at the end), sometimes anywhere.
            let (from, to) = match round % 4 {
                0 => (0, whole.len()),
                1 if file.contains("zip") => (whole.len() - 20_000, whole.len()),
                _ => (0, structure),
            };
            damage(&mut bytes, from, to, &mut chance);
            let Ok(read) = parse(&bytes) else { continue };
            accepted += usize::from(bytes != whole);
            assert!(bytes.len() >= whole.len() || !whole.starts_with(&bytes), "{file}: truncated and accepted");
            if file.contains("zip") {
                // With checksums, accepted content must be unchanged.
                assert!(read.iter().eq(&reference), "{file}: other weights accepted");
            }
        }
        eprintln!("{file}: {accepted} of {rounds} damaged files accepted");
    }
}
