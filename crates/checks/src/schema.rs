//! `cargo xtask schema`: writes the JSON schema of the configuration files and their Markdown reference.

use anyhow::Result;
use clap::Args;
use data::{DatasetConfig, JsonForm, write_atomic};
use models::config::DetectorConfig;
use schemars::{JsonSchema, Schema, schema_for};
use sensor::{EffectList, Rig};
use serde_json::{Map, Value, json};
use simulate::RoadConfig;
use simulate::race::RaceConfig;
use std::fmt::Write;
use std::path::PathBuf;
use study::StudyConfig;

/// Folder of the forms of JSON files.
const SCHEMAS: &str = "docs/src/reference/schemas";

/// Write configs/schema.json, docs/src/reference/configuration.md, docs/src/reference/schemas.md and the files that it
/// lists from the Rust types.
#[derive(Args, Debug)]
pub struct SchemaArgs {
    /// Folder of the repository
    #[arg(default_value = ".")]
    root: PathBuf,
    /// Only check that the files are up to date
    #[arg(long)]
    check: bool,
}

impl SchemaArgs {
    /// Writes the files, or compares them.
    pub fn run(self) -> Result<()> {
        let mut files = vec![
            ("configs/schema.json".to_owned(), schema_json()?),
            ("docs/src/reference/configuration.md".to_owned(), reference()),
        ];
        let forms = lidarshift::json_forms();
        files.push(("docs/src/reference/schemas.md".to_owned(), list_of_forms(&forms)));
        files.extend(forms.iter().map(|form| (format!("{SCHEMAS}/{}.schema.json", form.name), form.text())));
        for entry in fs_err::read_dir(self.root.join(SCHEMAS))? {
            let path = entry?.path();
            let known = files.iter().any(|(file, _)| path.ends_with(file));
            anyhow::ensure!(known, "{}: no JSON of the program has this form; remove the file", path.display());
        }
        for (path, text) in files {
            let path = self.root.join(path);
            if !self.check {
                write_atomic(&path, text.as_bytes())?;
            } else if fs_err::read_to_string(&path)? != text {
                anyhow::bail!("{} is not up to date; run `cargo xtask schema`", path.display());
            }
        }
        Ok(())
    }
}

/// The configuration files: title, path, schema.
fn files() -> [(&'static str, &'static str, Schema); 7] {
    fn of<T: JsonSchema>() -> Schema {
        schema_for!(T)
    }
    [
        ("detector", "configs/detectors/NAME.toml", of::<DetectorConfig>()),
        ("dataset", "datasets/NAME.toml, or dataset.toml in the data set's folder", of::<DatasetConfig>()),
        ("study", "configs/studies/NAME.toml", of::<StudyConfig>()),
        ("race", "the file of `simulate --config`, with a rig", of::<RaceConfig>()),
        ("rig", "configs/sensors/NAME.toml", of::<Rig>()),
        ("effects", "lists of effects, as configs/simulate/measured.toml", of::<EffectList>()),
        ("road", "the file of `simulate --config`, without a rig", of::<RoadConfig>()),
    ]
}

/// One JSON schema with a definition for each file.
pub fn schema_json() -> Result<String> {
    let definitions: Map<String, Value> =
        files().into_iter().map(|(name, _, schema)| (name.to_string(), schema.to_value())).collect();
    let schema = json!({ "$schema": "https://json-schema.org/draft/2020-12/schema", "definitions": definitions });
    Ok(serde_json::to_string_pretty(&schema)? + "\n")
}

/// The page that lists the forms of JSON files.
fn list_of_forms(forms: &[JsonForm]) -> String {
    let mut text = String::from(
        "# JSON schemas\n\nGenerated from the Rust types by `cargo xtask schema`; do not edit. What the files mean is in [JSON files](json.md).\n\n\
         | schema | version in the field `schema` | files |\n|---|---|---|\n",
    );
    for JsonForm { name, version, written, .. } in forms {
        let version = version.map_or(String::new(), |version| format!("`{version}`"));
        let _ = writeln!(text, "| [{name}](schemas/{name}.schema.json) | {version} | {written} |");
    }
    text
}

/// The Markdown reference, with one table per type.
pub fn reference() -> String {
    let mut text = String::from(
        "# Configuration reference\n\nGenerated from the Rust types by `cargo xtask schema`; do not edit. Units are in the keys' names; an unknown key is an error.\n",
    );
    for (name, place, schema) in files() {
        let schema = schema.to_value();
        let _ = writeln!(text, "\n## {name}: {place}");
        table(&mut text, "top level", &schema);
        for (definition, value) in schema["$defs"].as_object().into_iter().flatten() {
            if value["properties"].is_object() || value["oneOf"].is_array() {
                table(&mut text, definition, value);
            }
        }
    }
    text
}

fn table(text: &mut String, name: &str, schema: &Value) {
    let _ = writeln!(text, "\n### {name}\n");
    if let Some(about) = schema["description"].as_str() {
        let _ = writeln!(text, "{}\n", about.replace('\n', " "));
    }
    let required: Vec<&str> = schema["required"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
    let Some(properties) = schema["properties"].as_object() else {
        for choice in schema["oneOf"].as_array().into_iter().flatten() {
            let key = choice["const"].as_str().or(choice["properties"]["kind"]["const"].as_str()).unwrap_or("one of");
            let _ =
                writeln!(text, "- `{key}`: {}", choice["description"].as_str().unwrap_or_default().replace('\n', " "));
        }
        return;
    };
    let _ = writeln!(text, "| key | type | default | meaning |\n|---|---|---|---|");
    for (key, value) in properties {
        let default = match value.get("default") {
            Some(default) => format!("`{default}`"),
            None if required.contains(&key.as_str()) => "must be given".into(),
            None => String::new(),
        };
        let about = value["description"].as_str().unwrap_or_default().replace('\n', " ").replace('|', "\\|");
        let _ = writeln!(text, "| `{key}` | {} | {default} | {about} |", kind(value));
    }
}

fn kind(value: &Value) -> String {
    if let Some(reference) = value["$ref"].as_str() {
        return reference.rsplit('/').next().unwrap_or(reference).to_string();
    }
    match &value["type"] {
        Value::String(kind) if kind == "array" => format!("list of {}", kind_of_items(&value["items"])),
        Value::String(kind) => kind.clone(),
        Value::Array(kinds) => kinds.iter().filter_map(Value::as_str).collect::<Vec<_>>().join(" or "),
        _ => "see below".into(),
    }
}

fn kind_of_items(items: &Value) -> String {
    if items.is_object() { kind(items) } else { "values".into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_up_to_date() {
        let root = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."));
        SchemaArgs { root, check: true }.run().unwrap();
    }
}
