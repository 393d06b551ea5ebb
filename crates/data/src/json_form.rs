//! Forms of the JSON files that the program writes, as JSON schemas. Each crate lists those of its files.

use crate::convert::{CONVERT_MANIFEST_SCHEMA, ConvertManifest};
use crate::doctor::{DOCTOR_SCHEMA, DoctorReport};
use crate::frame_records::FrameRecord;
use schemars::generate::SchemaSettings;
use schemars::{JsonSchema, Schema};
use serde_json::{Value, json};

/// The form of a JSON file, or of a line of a JSON lines file.
#[derive(Clone, Debug)]
pub struct JsonForm {
    /// Name of the schema: its file is `docs/src/reference/schemas/NAME.schema.json`.
    pub name: &'static str,
    /// Files with this form, and options that write it.
    pub written: &'static str,
    /// Name and version in the field `schema` of the files; `None` for files without the field.
    pub version: Option<&'static str>,
    schema: Schema,
}

impl JsonForm {
    /// The form of the values of a type.
    pub fn of<T: JsonSchema>(name: &'static str, written: &'static str, version: Option<&'static str>) -> Self {
        // What is written, not what can be read.
        let generator = SchemaSettings::draft2020_12().for_serialize().into_generator();
        JsonForm { name, written, version, schema: generator.into_root_schema_for::<T>() }
    }

    /// The JSON schema.
    pub fn schema(&self) -> Value {
        let mut schema = self.schema.clone().to_value();
        if let (Some(version), Some(own)) = (self.version, schema.pointer_mut("/properties/schema")) {
            own["const"] = json!(version);
        }
        schema
    }

    /// The text of its file.
    pub fn text(&self) -> String {
        format!("{:#}\n", self.schema())
    }
}

/// The forms of the files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<DoctorReport>("doctor", "`doctor --json`", Some(DOCTOR_SCHEMA)),
        JsonForm::of::<ConvertManifest>(
            "converted-dataset",
            "`manifest.json` of `convert`, `convert --json`",
            Some(CONVERT_MANIFEST_SCHEMA),
        ),
        JsonForm::of::<FrameRecord>("frame-record", "a line of `frames.jsonl`", None),
    ]
}
