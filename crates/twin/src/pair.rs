//! A twin on disk: the recording and its simulated partner as two data sets with the same ids and labels.

use crate::TwinError;
use crate::agreement::{Agreement, AgreementNumbers};
use crate::baked_in::{BakedIn, baked_in};
use crate::map::{FusionConfig, encode_ply};
use crate::odometry::Sharpness;
use crate::plan::{Leave, jobs};
use crate::recording::{PoseSource, Recording};
use crate::world::{FrameShots, World};
use data::checksum::hex;
use data::limits::read_text;
use data::output::remove_unfinished;
use data::{
    Cloud, DataError, Dataset, DatasetConfig, Frame, JsonForm, LabelFrame, Layout, NewDataset, Object, Presence,
    write_atomic, write_json,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::path::Path;

/// Schema version of `twin.json`.
pub const TWIN_SCHEMA: &str = "lidarshift/twin/2";
/// Schema version of the manifests of both sides.
pub const TWIN_MANIFEST_SCHEMA: &str = "lidarshift/twin-dataset/1";
/// Folder with the directions of which the twin knows nothing.
pub const UNKNOWN_FOLDER: &str = "unknown";

/// Folder of the static maps.
const MAPS_FOLDER: &str = "maps";

/// How a twin is made.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TwinConfig {
    /// Frames left out of the map that a frame is shot with.
    pub leave: Leave,
    /// How scans are fused.
    pub fusion: FusionConfig,
    /// Memory that a map may take, bytes.
    pub most_bytes: u64,
    /// Whether to write the static maps as PLY files.
    pub write_maps: bool,
}

/// Content of `twin.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct TwinReport {
    /// [`TWIN_SCHEMA`].
    pub schema: String,
    /// Name of the recording.
    pub recording: String,
    /// Frames of the pair.
    pub frames: usize,
    /// Where the poses come from.
    pub poses: PoseSource,
    /// Median thickness of walls before and after the refinement of the poses, m; `None` if poses were not refined or
    /// the scans share no wall.
    pub wall_thickness_m: Option<[f64; 2]>,
    /// Largest distance that the refinement moved a position, m.
    pub farthest_moved_m: Option<f64>,
    /// Frames left out of the map that a frame is shot with.
    pub leave: Leave,
    /// Surfels of all maps.
    pub surfels: usize,
    /// Whether shots without a return are known.
    pub lost_shots_known: bool,
    /// Returns of a frame on average: as recorded, of the measured side, and of the simulated side.
    pub returns_per_frame: [f64; 3],
    /// Agreement of both sides, off the labelled objects.
    pub static_world: AgreementNumbers,
    /// Agreement of both sides on labelled objects.
    pub objects: AgreementNumbers,
    /// Causes that a diagnosis of this pair cannot tell.
    pub baked_in: Vec<BakedIn>,
    /// What else to know of this twin.
    pub notes: Vec<String>,
}

/// Content of the `manifest.json` of one side.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct TwinManifest {
    schema: String,
    complete: bool,
    /// Name of the recording.
    recording: String,
    /// SHA-256 of the configuration, the poses and the program version.
    config_sha256: String,
    frames: usize,
    frames_sha256: String,
    #[serde(default)]
    builds: Vec<String>,
}

data::manifest!(TwinManifest, "with other options, poses or another version");

/// Makes the twin of a recording in the folder `out`: `measured`, `sim`, `unknown`, `sensor.toml` and `twin.json`.
///
/// `progress(done, total)` is called with the number of frames.
pub fn make(
    recording: &Recording,
    config: &TwinConfig,
    out: &Path,
    progress: &dyn Fn(usize, usize),
) -> Result<TwinReport, TwinError> {
    let moments = recording.moments();
    let stamp = |f: usize| moments[f].stamp_s.unwrap_or(0.1 * f as f64);
    let times: Vec<f64> = (0..moments.len()).map(stamp).collect();
    let jobs = jobs(&times, config.leave);
    let mut ids: Vec<String> = jobs.iter().flat_map(|j| &j.shoot).map(|f| moments[*f].id.clone()).collect();
    ids.sort();
    if ids.is_empty() {
        let why = "no frame can be shot: all frames are left out of the map of each; give a smaller --leave";
        return Err(TwinError::Recording(why.into()));
    }
    let name = recording.dataset().config.name.clone();
    let mut manifest = TwinManifest {
        schema: TWIN_MANIFEST_SCHEMA.into(),
        complete: false,
        recording: name.clone(),
        config_sha256: fingerprint(recording, config, &ids),
        frames: ids.len(),
        frames_sha256: String::new(),
        builds: Vec::new(),
    };
    let roots = ["measured", "sim"].map(|side| out.join(side));
    let [measured, sim] = &roots;
    let mut manifests = [manifest.clone(), manifest.clone()];
    let [first, second] = &mut manifests;
    let sides =
        [NewDataset::begin(measured, Layout::Kitti, &[], first)?, NewDataset::begin(sim, Layout::Kitti, &[], second)?];
    // Of a killed process. Both sides are locked.
    for inside in ["", UNKNOWN_FOLDER, MAPS_FOLDER] {
        remove_unfinished(&out.join(inside))?;
    }
    let classes: BTreeSet<String> = moments.iter().flat_map(|m| &m.objects).map(|o| o.class.clone()).collect();
    for (side, suffix) in sides.iter().zip(["measured", "twin"]) {
        let described = DatasetConfig {
            name: format!("{name}-{suffix}"),
            label_frame: LabelFrame::Lidar,
            classes: classes.iter().cloned().collect(),
            ..DatasetConfig::default()
        };
        side.describe(described, splits(&ids))?;
    }
    let (mut still, mut objects) = (Agreement::default(), Agreement::default());
    let (mut returns, mut done, mut surfels, mut lost_shots) = ([0usize; 3], 0, 0, false);
    progress(0, ids.len());
    for (number, job) in jobs.iter().enumerate() {
        let world = World::build(recording, job, &config.fusion, config.most_bytes)?;
        surfels += world.map().surfels().len();
        if config.write_maps {
            write_atomic(&out.join(MAPS_FOLDER).join(format!("map_{number:03}.ply")), &encode_ply(world.map()))?;
        }
        for frame in &job.shoot {
            let shot = world.shoot(recording, *frame)?;
            still.add(&shot, false);
            objects.add(&shot, true);
            lost_shots |= shot.scan.rows.is_some();
            let made = write_frame(recording, *frame, &shot, &sides, out)?;
            for (sum, points) in returns.iter_mut().zip([shot.scan.points.len(), made[0], made[1]]) {
                *sum += points;
            }
            done += 1;
            progress(done, ids.len());
        }
    }
    for (side, manifest) in sides.iter().zip([&mut manifest.clone(), &mut manifest]) {
        side.finish(manifest, &ids)?;
    }
    crate::pattern::write(recording, out)?;
    let refined = recording.refined.as_ref();
    let thickness = |s: Option<Sharpness>| s.map(|s| s.wall_thickness_m);
    let report = TwinReport {
        schema: TWIN_SCHEMA.into(),
        recording: name,
        frames: ids.len(),
        poses: recording.pose_source,
        wall_thickness_m: refined.and_then(|r| Some([thickness(r.before)?, thickness(r.after)?])),
        farthest_moved_m: refined.map(|r| r.farthest_m),
        leave: config.leave,
        surfels,
        lost_shots_known: lost_shots,
        returns_per_frame: returns.map(|n| n as f64 / ids.len() as f64),
        static_world: still.numbers(),
        objects: objects.numbers(),
        baked_in: baked_in(),
        notes: notes(recording, lost_shots),
    };
    write_json(&out.join("twin.json"), &report)?;
    Ok(report)
}

/// Two thirds of the frames, then the rest: frames of a recording are alike, so that blocks are divided, not frames.
fn splits(ids: &[String]) -> [(&'static str, Vec<String>); 2] {
    let (train, test) = ids.split_at(ids.len() * 2 / 3);
    [("train", train.to_vec()), ("test", test.to_vec())]
}

fn write_frame(
    recording: &Recording,
    frame: usize,
    shot: &FrameShots,
    sides: &[NewDataset; 2],
    out: &Path,
) -> Result<[usize; 2], TwinError> {
    let moment = &recording.moments()[frame];
    let objects: Vec<Object> = moment
        .objects
        .iter()
        .map(|o| Object { class: o.class.clone(), bbox: o.bbox, truncation: None, occlusion: None, image_box: None })
        .collect();
    let (mut measured, mut sim, mut unknown) = (Cloud::new(4), Cloud::new(4), Vec::new());
    for (at, shown) in shot.shots.iter().zip(&shot.shown) {
        match (at.measured, shown) {
            (Some(i), Some(_)) => {
                measured.values.extend(shot.scan.points[i as usize]);
                measured.values.push(shot.scan.intensity[i as usize]);
            }
            (Some(_), None) => unknown.extend(at.direction.iter().flat_map(|v| v.to_le_bytes())),
            _ => {}
        }
        if let Some(shown) = shown {
            sim.values.extend(at.direction.map(|v| v * shown.range_m));
            sim.values.push(shown.intensity);
        }
    }
    write_atomic(&out.join(UNKNOWN_FOLDER).join(format!("{}.bin", moment.id)), &unknown)?;
    let counts = [measured.len(), sim.len()];
    for (side, cloud) in sides.iter().zip([measured, sim]) {
        let (layout, root, id) = (side.layout(), side.root(), &moment.id);
        let files = || vec![layout.cloud_path(root, id), layout.labels_path(root, id)];
        let made = Frame { id: id.clone(), cloud, objects: objects.clone() };
        side.frame(id, None, files, || layout.write_frame(root, &made).map_err(TwinError::from))?;
    }
    Ok(counts)
}

/// With fewer frames a map is thin.
const FEW: usize = 6;

fn notes(recording: &Recording, lost_shots: bool) -> Vec<String> {
    let mut notes = recording.findings.clone();
    if !lost_shots {
        let why =
            "rows of the sensor are not known: shots without a return are not shot again, and losses cannot be told";
        notes.push(why.into());
    }
    if recording.len() < FEW {
        notes.push(format!("{} frames: each is held against a map of hardly more than one scan", recording.len()));
    }
    let poses = recording.world_from_lidar();
    let path: f64 = poses.windows(2).map(|w| (w[1].translation.vector - w[0].translation.vector).norm()).sum();
    if path < 3.0 {
        notes.push(format!(
            "the sensor moved {path:.1} m: every surface is seen from one place, so that what is between the rows, and the sensor's errors by direction, cannot be told from the scene"
        ));
    }
    if recording.moments().iter().all(|m| m.objects.is_empty()) {
        notes.push("there are no tracked boxes: what moved is taken out of the map where other shots passed it, and is in no twin".into());
    }
    if recording.moments().iter().any(|m| m.stamp_s.is_none()) {
        notes.push("frames have no time stamps: 10 Hz is assumed".into());
    }
    notes
}

fn fingerprint(recording: &Recording, config: &TwinConfig, ids: &[String]) -> String {
    let poses: Vec<String> = recording.world_from_lidar().iter().map(|p| format!("{:?}", p.to_matrix())).collect();
    let fusion = format!("{:?}", config.fusion);
    let text = serde_json::to_string(&(
        env!("CARGO_PKG_VERSION"),
        &recording.dataset().config.name,
        ids,
        poses,
        config.leave,
        fusion,
    ))
    .expect("plain data");
    hex(&Sha256::digest(text))
}

/// What is known of a simulated data set that is one side of a twin; `None` if it is none.
///
/// # Errors
/// A `twin.json` that cannot be read.
pub fn twin_of(simulated: &Dataset) -> Result<Option<TwinReport>, DataError> {
    let path = simulated.config.root.join("../twin.json");
    if !path.may_be_file() {
        return Ok(None);
    }
    let text = read_text(&path)?;
    let twin: TwinReport = serde_json::from_str(&text).map_err(|e| DataError::line(&path, e.line(), e.to_string()))?;
    if twin.schema != TWIN_SCHEMA {
        let message = format!("has the schema {}, not {TWIN_SCHEMA}; make the twin anew", twin.schema);
        return Err(DataError::file(&path, message));
    }
    Ok(Some(twin))
}

impl TwinReport {
    /// What to know of a diagnosis whose simulated side is this twin.
    pub fn note_for_diagnosis(&self) -> String {
        let names: Vec<&str> = self.baked_in.iter().map(|b| b.cause.as_str()).collect();
        format!(
            "the simulated side is a twin of {}: these causes are in both sides and are not identifiable: {}",
            self.recording,
            names.join(", ")
        )
    }
}

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<TwinReport>("twin", "`twin.json` of `twin`, `twin --json`", Some(TWIN_SCHEMA)),
        JsonForm::of::<TwinManifest>("twin-dataset", "`manifest.json` of `twin`", Some(TWIN_MANIFEST_SCHEMA)),
    ]
}
