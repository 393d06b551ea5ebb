//! Per-point attributes: a PCD file with one row per point, in the order of the cloud.
//!
//! Columns: `x y z` (as in the cloud, m), `range` (from the sensor, m), `normal_x normal_y normal_z` (towards the
//! sensor, cloud frame), `cos_incidence`, `reflectivity` (at normal incidence, relative to a white plate), `returned`
//! (fraction of the light that returned), `time` (relative to the middle of the scan, s), `object` (track groups from
//! 1, cars from 100, 0 unknown), `row`, `column` (65535 unknown), `sensor` (index in the rig), `material` (index in
//! `names.json` in the same folder), `echo` (0 first return, 1 second).

use crate::material::{MaterialId, MaterialTable};
use crate::object::{FIRST_CAR, Group};
use crate::rig::Rig;
use crate::scan::{Echo, Scan};
use data::limits::{MOST_CLOUD_BYTES, read_file};
use data::{DataError, JsonForm, PcdColumn, encode_pcd_columns, parse_pcd_columns, write_json};
use schemars::JsonSchema;
use serde::Serialize;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Attribute folder below the root of a data set.
pub const FOLDER: &str = "attributes";

const NAMES: [&str; 17] = [
    "x",
    "y",
    "z",
    "range",
    "normal_x",
    "normal_y",
    "normal_z",
    "cos_incidence",
    "reflectivity",
    "returned",
    "time",
    "object",
    "row",
    "column",
    "sensor",
    "material",
    "echo",
];

/// Path of a frame's attribute file.
pub fn path(root: &Path, id: &str) -> PathBuf {
    root.join(FOLDER).join(format!("{id}.pcd"))
}

/// Encodes the returns of a scan.
pub fn encode(scan: &Scan) -> Vec<u8> {
    let echoes: Vec<&Echo> = scan.returns().collect();
    let float = |f: &dyn Fn(&Echo) -> f32| PcdColumn::F32(echoes.iter().map(|e| f(e)).collect());
    let short = |f: &dyn Fn(&Echo) -> u16| PcdColumn::U16(echoes.iter().map(|e| f(e)).collect());
    let byte = |f: &dyn Fn(&Echo) -> u8| PcdColumn::U8(echoes.iter().map(|e| f(e)).collect());
    let columns = [
        float(&|e| e.point()[0]),
        float(&|e| e.point()[1]),
        float(&|e| e.point()[2]),
        float(&|e| e.range_m),
        float(&|e| e.normal[0]),
        float(&|e| e.normal[1]),
        float(&|e| e.normal[2]),
        float(&|e| e.cos_incidence),
        float(&|e| e.reflectivity),
        float(&|e| e.returned),
        float(&|e| e.time_s),
        short(&|e| e.object),
        short(&|e| e.row),
        short(&|e| e.column),
        byte(&|e| e.sensor),
        byte(&|e| e.material.0),
        byte(&|e| e.number),
    ];
    encode_pcd_columns(&NAMES.into_iter().zip(columns).collect::<Vec<_>>())
}

/// Writes `names.json` with the names of sensors, materials and objects to the attribute folder.
pub fn write_names(root: &Path, rig: &Rig, materials: &MaterialTable) -> Result<(), DataError> {
    let names = AttributeNames {
        schema: NAMES_SCHEMA,
        sensors: rig.sensors.iter().map(|s| s.name.clone()).collect(),
        materials: materials.names().to_vec(),
        objects: Group::ALL.into_iter().map(|g| ((g as u16).to_string(), g)).collect(),
        first_car: FIRST_CAR,
    };
    write_json(&root.join(FOLDER).join("names.json"), &names)
}

/// Version of `names.json`.
const NAMES_SCHEMA: &str = "lidarshift/attribute-names/1";

/// The content of `names.json`: what the numbers in the attributes mean.
#[derive(Serialize, JsonSchema)]
struct AttributeNames {
    /// `lidarshift/attribute-names/1`.
    schema: &'static str,
    /// Sensors by their number.
    sensors: Vec<String>,
    /// Materials by their number.
    materials: Vec<String>,
    /// Groups of static objects by the number `object`.
    objects: BTreeMap<String, Group>,
    /// Number `object` of the first car; the others follow.
    first_car: u16,
}

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    let written = "`names.json` of the attributes of simulated data sets";
    vec![JsonForm::of::<AttributeNames>("attribute-names", written, Some(NAMES_SCHEMA))]
}

/// The materials of a data set, by their index in the attributes.
pub fn read_materials(root: &Path) -> Result<MaterialTable, DataError> {
    let path = root.join(FOLDER).join("names.json");
    let value: serde_json::Value = serde_json::from_str(&fs_err::read_to_string(&path)?)
        .map_err(|e| DataError::line(&path, e.line(), e.to_string()))?;
    let names = value["materials"].as_array().into_iter().flatten().map(|n| n.as_str().map(String::from));
    match names.collect::<Option<Vec<_>>>() {
        Some(names) if (1..=256).contains(&names.len()) => Ok(MaterialTable::named(&names)),
        _ => Err(DataError::file(&path, "has no list of names under \"materials\"")),
    }
}

/// Reads the returns of a frame from its attributes. Sensor positions are taken from `rig`.
pub fn read(path: &Path, rig: &Rig) -> Result<Scan, DataError> {
    let columns = parse_pcd_columns(&read_file(path, MOST_CLOUD_BYTES)?, path, &NAMES)?;
    let origins: Vec<[f32; 3]> = rig.sensors.iter().map(|s| s.position.map(|v| v as f32)).collect();
    let echo = |i: usize| {
        let v: [f32; NAMES.len()] = std::array::from_fn(|k| columns[k][i]);
        let origin = origins.get(v[14] as usize).copied().unwrap_or_default();
        let mut echo = Echo {
            range_m: v[3],
            normal: [v[4], v[5], v[6]],
            cos_incidence: v[7],
            reflectivity: v[8],
            returned: v[9],
            time_s: v[10],
            object: v[11] as u16,
            row: v[12] as u16,
            column: v[13] as u16,
            sensor: v[14] as u8,
            material: MaterialId(v[15] as u8),
            number: v[16] as u8,
            source: i as u32,
            ..Echo::nothing(origin, [1.0, 0.0, 0.0])
        };
        echo.move_point([v[0], v[1], v[2]]);
        echo
    };
    Ok(Scan { echoes: (0..columns[0].len()).map(echo).collect() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::testing::{rig, scene};
    use data::write_atomic;

    #[test]
    fn what_is_written_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        let file = path(folder.path(), "000001");
        let scan = scene();
        write_atomic(&file, &encode(&scan)).unwrap();
        write_names(folder.path(), &rig(), &MaterialTable::default()).unwrap();
        let read = read(&file, &rig()).unwrap();
        let returns: Vec<&Echo> = scan.returns().collect();
        assert_eq!(read.echoes.len(), returns.len());
        for (a, b) in read.echoes.iter().zip(returns) {
            assert!((a.range_m - b.range_m).abs() < 1e-4 && (0..3).all(|k| (a.point()[k] - b.point()[k]).abs() < 1e-4));
            assert_eq!(
                (a.row, a.column, a.object, a.material, a.normal),
                (b.row, b.column, b.object, b.material, b.normal)
            );
        }
        let names = std::fs::read_to_string(folder.path().join("attributes/names.json")).unwrap();
        assert_eq!(read_materials(folder.path()).unwrap(), MaterialTable::default());
        assert!(names.contains("outer_wall") && names.contains("rubber") && names.contains("front"));
    }
}
