//! Checks JSON files against the schemas in `docs/src/reference/schemas`.

use serde_json::{Map, Value};
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

/// Files whose form is known by the beginning of their name: they have no field `schema`.
const BY_NAME: [(&str, &str); 5] = [
    ("analyses.json", "analyses"),
    ("frames-", "frame-distances"),
    ("frames.jsonl", "frame-record"),
    ("metrics.jsonl", "metrics"),
    ("paired.json", "paired"),
];

/// Checks every JSON file below a folder, and returns the names of their forms. `foreign` are parts of the paths of
/// files that other programs define.
pub fn check_files(folder: &Path, foreign: &[&str]) -> BTreeSet<String> {
    let mut found = BTreeSet::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            let shown = path.display().to_string();
            if path.is_dir() {
                folders.push(path);
            } else if foreign.iter().all(|part| !shown.contains(part)) && shown.ends_with(".json") {
                check_file(&path, &serde_json::from_slice(&fs::read(&path).unwrap()).unwrap(), &mut found);
            } else if shown.ends_with(".jsonl") {
                let text = fs::read_to_string(&path).unwrap();
                let lines = text.lines().map(|line| serde_json::from_str::<Value>(line).unwrap());
                lines.for_each(|line| check_file(&path, &line, &mut found));
            }
        }
    }
    found
}

fn check_file(path: &Path, value: &Value, found: &mut BTreeSet<String>) {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let by_name = BY_NAME.iter().find(|(start, _)| name.starts_with(start));
    match (by_name, value) {
        (Some((_, form)), value) => {
            check(&form_named(form), value, &path.display().to_string());
            found.insert((*form).into());
        }
        // Lists of results.
        (None, Value::Array(items)) => items.iter().for_each(|item| {
            found.insert(check_value(item, &path.display().to_string()));
        }),
        (None, value) => {
            found.insert(check_value(value, &path.display().to_string()));
        }
    }
}

/// Checks a value against the schema that its field `schema` names, and returns the name of the form.
pub fn check_value(value: &Value, of: &str) -> String {
    let version = value["schema"].as_str().unwrap_or_else(|| panic!("{of}: no field `schema`"));
    let forms = lidarshift::json_forms();
    let form = forms.iter().find(|form| form.version == Some(version));
    let form = form.unwrap_or_else(|| panic!("{of}: the schema {version:?} is not published")).name;
    check(&form_named(form), value, of);
    form.into()
}

fn form_named(name: &str) -> Value {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/src/reference/schemas");
    serde_json::from_slice(&fs::read(format!("{folder}/{name}.schema.json")).unwrap()).unwrap()
}

fn check(schema: &Value, value: &Value, of: &str) {
    let Err(why) = validate(schema, schema, value, &BTreeSet::new()) else { return };
    panic!("{of}: {why}");
}

/// What of JSON schema the generator writes. A key that the schema does not name is an error, unless it says that there
/// may be others; `outer` are keys that the schemas around this one name.
fn validate(root: &Value, schema: &Value, value: &Value, outer: &BTreeSet<&str>) -> Result<(), String> {
    let Value::Object(schema) = schema else {
        return if schema == &Value::Bool(true) { Ok(()) } else { Err(format!("{value} is not allowed")) };
    };
    let own = schema.get("properties").and_then(Value::as_object);
    let named: BTreeSet<&str> =
        outer.iter().copied().chain(own.into_iter().flatten().map(|(k, _)| k.as_str())).collect();
    if let Some(reference) = schema.get("$ref").and_then(Value::as_str) {
        let target = root.pointer(reference.strip_prefix('#').unwrap()).ok_or(format!("{reference} is not there"))?;
        validate(root, target, value, &named)?;
    }
    for part in schema.get("allOf").and_then(Value::as_array).into_iter().flatten() {
        validate(root, part, value, &named)?;
    }
    for key in ["oneOf", "anyOf"] {
        let Some(choices) = schema.get(key).and_then(Value::as_array) else { continue };
        let results: Vec<_> = choices.iter().map(|choice| validate(root, choice, value, &named)).collect();
        let fitting = results.iter().filter(|r| r.is_ok()).count();
        if fitting == 0 || (key == "oneOf" && fitting > 1) {
            return Err(format!("{fitting} of {} choices fit: {results:?}", choices.len()));
        }
    }
    if schema.get("const").is_some_and(|wanted| wanted != value) {
        return Err(format!("{value} is not {}", schema["const"]));
    }
    if schema.get("enum").and_then(Value::as_array).is_some_and(|all| !all.contains(value)) {
        return Err(format!("{value} is not one of {}", schema["enum"]));
    }
    if let Some(kinds) = schema.get("type") {
        let is = |kind: &Value| is_kind(kind.as_str().unwrap_or_default(), value);
        let fits = kinds.as_array().map_or_else(|| is(kinds), |kinds| kinds.iter().any(is));
        if !fits {
            return Err(format!("{value} is not of the type {kinds}"));
        }
    }
    match value {
        Value::Object(value) => members(root, schema, value, &named),
        Value::Array(items) => elements(root, schema, items),
        _ => Ok(()),
    }
}

fn members(
    root: &Value,
    schema: &Map<String, Value>,
    value: &Map<String, Value>,
    named: &BTreeSet<&str>,
) -> Result<(), String> {
    let required = schema.get("required").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str);
    for key in required {
        if !value.contains_key(key) {
            return Err(format!("{key} is missing"));
        }
    }
    let others = schema.get("additionalProperties");
    let says = schema.contains_key("properties") && others.is_none();
    for (key, member) in value {
        let at = |why| format!("{key}: {why}");
        match (schema.get("properties").and_then(|p| p.get(key)), others) {
            (Some(schema), _) => validate(root, schema, member, &BTreeSet::new()).map_err(at)?,
            (None, Some(_)) if named.contains(key.as_str()) => {}
            (None, Some(schema)) => validate(root, schema, member, &BTreeSet::new()).map_err(at)?,
            (None, None) if says && !combines(schema) && !named.contains(key.as_str()) => {
                return Err(format!("{key} is not known"));
            }
            (None, None) => {}
        }
    }
    Ok(())
}

/// Whether further keys may be those of a schema that is combined with this one.
fn combines(schema: &Map<String, Value>) -> bool {
    ["$ref", "allOf", "oneOf", "anyOf"].iter().any(|key| schema.contains_key(*key))
}

fn elements(root: &Value, schema: &Map<String, Value>, items: &[Value]) -> Result<(), String> {
    let prefix = schema.get("prefixItems").and_then(Value::as_array).map_or(&[][..], Vec::as_slice);
    for (i, item) in items.iter().enumerate() {
        if let Some(schema) = prefix.get(i).or_else(|| schema.get("items")) {
            validate(root, schema, item, &BTreeSet::new()).map_err(|why| format!("[{i}]: {why}"))?;
        }
    }
    let count = |key: &str| schema.get(key).and_then(Value::as_u64).map(|n| n as usize);
    if count("minItems").is_some_and(|least| items.len() < least) || count("maxItems").is_some_and(|n| items.len() > n)
    {
        return Err(format!("has {} elements", items.len()));
    }
    Ok(())
}

fn is_kind(kind: &str, value: &Value) -> bool {
    match kind {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "string" => value.is_string(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        other => panic!("the type {other:?} is not known to this check"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[test]
    fn what_does_not_fit_is_found() {
        let schema = json!({
            "type": "object",
            "properties": { "a": { "type": ["integer", "null"] }, "b": { "$ref": "#/$defs/list" }, "c": { "const": 3 } },
            "required": ["a"],
            "$defs": { "list": { "type": "array", "items": { "oneOf": [
                { "type": "object", "properties": { "kind": { "const": "x" }, "v": { "type": "number" } }, "required": ["kind", "v"] },
                { "enum": ["y", "z"] },
            ] } } },
        });
        let fits = |value: Value| validate(&schema, &schema, &value, &BTreeSet::new()).is_ok();
        assert!(fits(json!({ "a": null, "b": [{ "kind": "x", "v": 1.5 }, "z"], "c": 3 })));
        for wrong in [
            json!([]),
            json!({}),
            json!({ "a": 1.5 }),
            json!({ "a": 1, "c": 4 }),
            json!({ "a": 1, "d": 4 }),
            json!({ "a": 1, "b": ["x"] }),
            json!({ "a": 1, "b": [{ "kind": "x" }] }),
            json!({ "a": 1, "b": [{ "kind": "x", "v": 1, "w": 2 }] }),
        ] {
            assert!(!fits(wrong.clone()), "{wrong}");
        }
    }
}
