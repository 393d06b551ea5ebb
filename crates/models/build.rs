//! Collects the TOML files of `configs/detectors`, so that a new one is built into the program without a line of code.

use std::path::Path;
use std::{env, fs};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = Path::new(&env::var("CARGO_MANIFEST_DIR")?).join("../../configs/detectors");
    println!("cargo::rerun-if-changed={}", folder.display());
    let mut names = Vec::new();
    for entry in fs::read_dir(&folder)? {
        let path = entry?.path();
        if path.extension().is_some_and(|extension| extension == "toml") {
            names.extend(path.file_stem().and_then(|name| name.to_str()).map(String::from));
        }
    }
    names.sort();
    let mut table = String::from("[\n");
    for name in names {
        let file = format!("\"/../../configs/detectors/{name}.toml\"");
        table += &format!("    ({name:?}, include_str!(concat!(env!(\"CARGO_MANIFEST_DIR\"), {file}))),\n");
    }
    table += "]\n";
    fs::write(Path::new(&env::var("OUT_DIR")?).join("detectors.rs"), table)?;
    Ok(())
}
