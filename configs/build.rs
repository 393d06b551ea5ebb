//! Collects the TOML files of the folders, so that a new one is built into the program without a line of code.

use std::path::Path;
use std::{env, fs};

/// The folders whose files are built in.
const FOLDERS: [&str; 4] = ["detectors", "sensors", "simulate", "studies"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let root = env::var("CARGO_MANIFEST_DIR")?;
    let mut paths = Vec::new();
    for folder in FOLDERS {
        let full = Path::new(&root).join(folder);
        println!("cargo::rerun-if-changed={}", full.display());
        for entry in fs::read_dir(&full)? {
            let path = entry?.path();
            if path.extension().is_some_and(|extension| extension == "toml") {
                let name = path.file_name().and_then(|name| name.to_str()).ok_or("a name is not UTF-8")?;
                paths.push(format!("{folder}/{name}"));
            }
        }
    }
    paths.sort();
    let mut table = String::from("[\n");
    for path in paths {
        table += &format!("    ({path:?}, include_str!(concat!(env!(\"CARGO_MANIFEST_DIR\"), \"/{path}\"))),\n");
    }
    table += "]\n";
    fs::write(Path::new(&env::var("OUT_DIR")?).join("files.rs"), table)?;
    Ok(())
}
