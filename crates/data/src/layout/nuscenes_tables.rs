//! The JSON tables of nuScenes, as far as the LiDAR needs them.
//!
//! Rows are taken one by one, so that of the millions of rows of all sensors only those of the LiDAR stay in memory.

use super::pose_text::{check_box, pose_from_quaternion};
use crate::DataError;
use crate::limits::{MOST_CLOUD_BYTES, length_of_file};
use geometry::{Box3, Pose, yaw_rad};
use serde::Deserialize;
use serde::de::{DeserializeOwned, DeserializeSeed, SeqAccess, Visitor};
use std::collections::{BTreeMap, HashMap};
use std::fmt;
use std::io::BufReader;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::SystemTime;

/// A scan of the LiDAR.
#[derive(Clone, Debug)]
pub(super) struct Scan {
    /// Path of its cloud below the root.
    pub file: String,
    /// Name of its scene.
    pub scene: String,
    /// Time stamp, us.
    pub stamp_us: i64,
    /// Pose of the sensor (with the axes of nuScenes) in the map.
    pub map_from_sensor: Pose,
}

/// An annotated object at a keyframe.
#[derive(Clone, Debug)]
pub(super) struct Annotation {
    /// Name of the category.
    pub class: Arc<str>,
    /// Box in the map.
    pub box_map: Box3,
}

/// Annotated objects at the time of a keyframe, by instance.
pub(super) type Keyframe = HashMap<Arc<str>, Annotation>;

/// What the tables say of the LiDAR.
#[derive(Debug, Default)]
pub(super) struct Tables {
    /// The scans by frame id. Ids begin with the scene and end with the time: their order is that of both.
    pub scans: BTreeMap<String, Scan>,
    /// The keyframes of each scene by their time, us.
    pub keyframes: HashMap<String, BTreeMap<i64, Keyframe>>,
}

#[derive(Deserialize)]
struct SampleData {
    sample_token: String,
    ego_pose_token: String,
    calibrated_sensor_token: String,
    timestamp: i64,
    filename: String,
}

#[derive(Deserialize)]
struct Placed {
    token: String,
    translation: [f64; 3],
    rotation: [f64; 4],
}

#[derive(Deserialize)]
struct Sample {
    token: String,
    timestamp: i64,
    scene_token: String,
}

#[derive(Deserialize)]
struct Named {
    token: String,
    name: String,
}

#[derive(Deserialize)]
struct Instance {
    token: String,
    category_token: String,
}

#[derive(Deserialize)]
struct SampleAnnotation {
    token: String,
    sample_token: String,
    instance_token: String,
    translation: [f64; 3],
    size: [f64; 3],
    rotation: [f64; 4],
}

/// The folder of the tables: the first of `v1.0-*` with a table of scans.
pub(super) fn tables_folder(root: &Path) -> Option<PathBuf> {
    let mut folders: Vec<PathBuf> =
        std::fs::read_dir(root).ok()?.filter_map(|entry| Some(entry.ok()?.path())).collect();
    folders.sort();
    let named = |path: &PathBuf| path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("v1.0-"));
    folders.into_iter().find(|path| named(path) && path.join("sample_data.json").is_file())
}

/// The tables that were read last: frames are read one by one, and the tables are long.
static LAST: Mutex<Option<(PathBuf, SystemTime, Arc<Tables>)>> = Mutex::new(None);

/// The tables below a root. They are read again if they have changed.
pub(super) fn tables(root: &Path) -> Result<Arc<Tables>, DataError> {
    let folder = tables_folder(root)
        .ok_or_else(|| DataError::file(root, "has no folder v1.0-* with the tables of nuScenes (sample_data.json)"))?;
    let changed = fs_err::metadata(folder.join("sample_data.json"))?.modified()?;
    let mut last = LAST.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    if let Some((path, at, tables)) = last.as_ref().filter(|(path, at, _)| *path == folder && *at == changed) {
        let _ = (path, at);
        return Ok(tables.clone());
    }
    let tables = Arc::new(read(&folder)?);
    *last = Some((folder, changed, tables.clone()));
    Ok(tables)
}

fn read(folder: &Path) -> Result<Tables, DataError> {
    let table = |name: &str| folder.join(format!("{name}.json"));
    let mut scenes = HashMap::new();
    rows(&table("scene"), |row: Named| {
        scenes.insert(row.token, row.name);
    })?;
    let mut samples = HashMap::new();
    rows(&table("sample"), |row: Sample| {
        samples.insert(row.token.clone(), row);
    })?;
    let mut lidar = Vec::new();
    rows(&table("sample_data"), |row: SampleData| {
        if row.filename.split('/').nth(1) == Some("LIDAR_TOP") {
            lidar.push(row);
        }
    })?;
    let mut poses: HashMap<String, Option<Placed>> = HashMap::new();
    poses.extend(lidar.iter().map(|row| (row.ego_pose_token.clone(), None)));
    rows(&table("ego_pose"), |row: Placed| {
        if let Some(place) = poses.get_mut(&row.token) {
            *place = Some(row);
        }
    })?;
    let mut sensors = HashMap::new();
    rows(&table("calibrated_sensor"), |row: Placed| {
        sensors.insert(row.token.clone(), row);
    })?;
    let missing = |name: &str, token: &str| DataError::file(&table(name), format!("has no row with the token {token}"));
    let pose = |name: &str, row: &Placed| {
        pose_from_quaternion(row.rotation, row.translation)
            .map_err(|message| DataError::file(&table(name), format!("token {}: {message}", row.token)))
    };
    let scene_of = |sample: &str| {
        let sample = samples.get(sample).ok_or_else(|| missing("sample", sample))?;
        let scene = scenes.get(&sample.scene_token).ok_or_else(|| missing("scene", &sample.scene_token))?;
        Ok::<_, DataError>((scene, sample.timestamp))
    };
    let mut tables = Tables::default();
    for row in lidar {
        let (scene, _) = scene_of(&row.sample_token)?;
        let ego = poses.get(&row.ego_pose_token).and_then(Option::as_ref);
        let ego = ego.ok_or_else(|| missing("ego_pose", &row.ego_pose_token))?;
        let sensor = sensors.get(&row.calibrated_sensor_token);
        let sensor = sensor.ok_or_else(|| missing("calibrated_sensor", &row.calibrated_sensor_token))?;
        let map_from_sensor = pose("ego_pose", ego)? * pose("calibrated_sensor", sensor)?;
        let id = format!("{scene}_{}", row.timestamp);
        let scan = Scan { file: row.filename, scene: scene.clone(), stamp_us: row.timestamp, map_from_sensor };
        tables.scans.insert(id, scan);
    }
    for sample in samples.values() {
        let (scene, at_us) = scene_of(&sample.token)?;
        tables.keyframes.entry(scene.clone()).or_default().insert(at_us, Keyframe::new());
    }
    if !table("sample_annotation").is_file() {
        tables.keyframes.clear();
        return Ok(tables);
    }
    let mut categories: HashMap<String, Arc<str>> = HashMap::new();
    rows(&table("category"), |row: Named| {
        categories.insert(row.token, row.name.into());
    })?;
    let mut instances: HashMap<String, (Arc<str>, Arc<str>)> = HashMap::new();
    rows(&table("instance"), |row: Instance| {
        if let Some(class) = categories.get(&row.category_token) {
            instances.insert(row.token.clone(), (row.token.into(), class.clone()));
        }
    })?;
    let mut annotations = Vec::new();
    rows(&table("sample_annotation"), |row: SampleAnnotation| annotations.push(row))?;
    for row in annotations {
        let (scene, at_us) = scene_of(&row.sample_token)?;
        let (track, class) =
            instances.get(&row.instance_token).ok_or_else(|| missing("instance", &row.instance_token))?;
        let wrong = |message| DataError::file(&table("sample_annotation"), format!("token {}: {message}", row.token));
        let [w, l, h] = row.size;
        let yaw_rad = yaw_rad(&pose_from_quaternion(row.rotation, row.translation).map_err(wrong)?);
        let box_map = Box3 { center: row.translation, size: [l, w, h], yaw_rad };
        check_box(&box_map).map_err(wrong)?;
        let keyframe = tables.keyframes.entry(scene.clone()).or_default().entry(at_us).or_default();
        keyframe.insert(track.clone(), Annotation { class: class.clone(), box_map });
    }
    Ok(tables)
}

/// Hands the rows of a table to `keep`, one by one.
fn rows<T: DeserializeOwned>(path: &Path, keep: impl FnMut(T)) -> Result<(), DataError> {
    length_of_file(path, MOST_CLOUD_BYTES)?;
    let mut reader = serde_json::Deserializer::from_reader(BufReader::new(fs_err::File::open(path)?));
    let rows = Rows { keep, row: PhantomData };
    rows.deserialize(&mut reader).map_err(|e| DataError::line(path, e.line(), e.to_string()))
}

struct Rows<T, K> {
    keep: K,
    row: PhantomData<T>,
}

impl<'de, T: Deserialize<'de>, K: FnMut(T)> DeserializeSeed<'de> for Rows<T, K> {
    type Value = ();

    fn deserialize<D: serde::Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_seq(self)
    }
}

impl<'de, T: Deserialize<'de>, K: FnMut(T)> Visitor<'de> for Rows<T, K> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter) -> fmt::Result {
        f.write_str("a list of rows")
    }

    fn visit_seq<A: SeqAccess<'de>>(mut self, mut seq: A) -> Result<(), A::Error> {
        while let Some(row) = seq.next_element()? {
            (self.keep)(row);
        }
        Ok(())
    }
}
