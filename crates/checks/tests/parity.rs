//! `parity` on the reference values in the repository, unchanged and modified.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{golden, must, output_text, run};
use std::fs;

#[test]
fn equals_the_reference() {
    let dir = tempfile::tempdir().unwrap();
    for name in ["synthetic/pointpillars_tiny", "synthetic/centerpoint_tiny", "operators"] {
        must(dir.path(), &format!("parity {} --json rows.json", golden(name).display()));
        let rows: serde_json::Value = serde_json::from_slice(&fs::read(dir.path().join("rows.json")).unwrap()).unwrap();
        let rows = rows["rows"].as_array().unwrap();
        assert!(rows.len() > 50 && rows.iter().all(|row| row["pass"] == true));
    }
}

#[test]
fn a_wrong_value_and_an_unknown_tensor_fail() {
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("copy");
    fs::create_dir(&copy).unwrap();
    for entry in fs::read_dir(golden("synthetic/pointpillars_tiny")).unwrap() {
        let entry = entry.unwrap();
        fs::copy(entry.path(), copy.join(entry.file_name())).unwrap();
    }
    let path = copy.join("eval.safetensors");
    let sound = fs::read(&path).unwrap();
    let header = u64::from_le_bytes(sound[..8].try_into().unwrap()) as usize;
    let names: serde_json::Value = serde_json::from_slice(&sound[8..8 + header]).unwrap();
    let at = names["block0"]["data_offsets"][0].as_u64().or(names["block0.sample"]["data_offsets"][0].as_u64());
    let mut wrong = sound.clone();
    for byte in &mut wrong[8 + header + at.unwrap() as usize..][..400] {
        *byte ^= 0x41;
    }
    fs::write(&path, wrong).unwrap();
    let output = run(dir.path(), "parity copy");
    assert_eq!(output.status.code(), Some(1));
    assert!(
        output_text(&output).contains("FAIL") && output_text(&output).contains("block0"),
        "{}",
        output_text(&output)
    );

    let text = String::from_utf8_lossy(&sound[8..8 + header]).replacen("\"block1", "\"blockX", 1);
    let mut unknown = sound[..8].to_vec();
    unknown.extend(text.as_bytes());
    unknown.extend(&sound[8 + header..]);
    fs::write(&path, unknown).unwrap();
    let output = run(dir.path(), "parity copy");
    assert_eq!(output.status.code(), Some(1));
    assert!(output_text(&output).contains("blockX"), "{}", output_text(&output));
}
