//! Writes the data sets of a race.

use super::config::{RaceConfig, SetConfig};
use super::files::ConfigFiles;
use super::frames::{FrameKey, SPLITS};
use super::simulator::{PreparedSet, Simulator};
use crate::SimulateError;
use crate::auto_label::{LabelError, label_errors};
use crate::street::SplitCounts;
use data::output::create_folder;
use data::toml_text::wrong;
use data::write::{TRUE_LABELS, label_boxes, true_labels_path, write_kitti_text};
use data::{
    DataError, Dataset, DatasetConfig, KittiText, LabelFrame, NewDataset, PointColumns, read_kitti_text, write_atomic,
};
use rayon::prelude::*;
use schemars::JsonSchema;
use sensor::attributes;
use sensor::effects::{Effect, EffectList};
use sensor::matched::{RangeHistogram, fit_range_dropout};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// Schema version of the manifest.
pub const RACE_MANIFEST_SCHEMA: &str = "lidarshift/race-dataset/1";
/// Bytes per point in a cloud and in its attributes.
const POINT_BYTES: (u64, u64) = (16, 53);
/// Disk space that is kept free, bytes.
const SPARE_BYTES: u64 = 200 << 20;

/// Content of a data set's `manifest.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RaceManifest {
    /// [`RACE_MANIFEST_SCHEMA`].
    pub schema: String,
    /// Whether all frames exist. An interrupted run leaves `false` and can be resumed.
    pub complete: bool,
    /// Names of the race and of the data set.
    pub name: [String; 2],
    /// Seed of the race.
    pub seed: u64,
    /// SHA-256 of everything that determines the frames: configuration, rig, trajectories, effects, and program
    /// version.
    pub config_sha256: String,
    /// Counts by split.
    pub splits: BTreeMap<String, SplitCounts>,
    /// Label errors, for automatic labels.
    pub label_errors: Vec<LabelError>,
    /// SHA-256 of `frames.jsonl`, which has those of the files of each frame.
    #[serde(default)]
    pub frames_sha256: String,
    /// Builds of the program that wrote the frames; several if one of them was interrupted.
    #[serde(default)]
    pub builds: Vec<String>,
}

data::manifest!(RaceManifest, "from another configuration or version");

/// Writes the data sets of a race below `out`, one folder each: clouds, labels, `ImageSets/`, `dataset.toml`,
/// `rig.toml`, `manifest.json`, and `effects.toml` unless hidden. `only` selects data sets by name; empty for all.
///
/// `progress(name, done, total)` is called with the data set and its number of frames, from several threads. Frames
/// finished by an earlier run with the same configuration are kept; a folder with other content is an error. The files
/// do not depend on the number of threads.
pub fn make_race_datasets(
    config: &RaceConfig,
    files: &ConfigFiles,
    out: &Path,
    only: &[String],
    progress: &(dyn Fn(&str, usize, usize) + Sync),
) -> Result<Vec<RaceManifest>, SimulateError> {
    config.check()?;
    if let Some(name) = only.iter().find(|name| !config.datasets.iter().any(|s| s.name == **name)) {
        let known: Vec<&str> = config.datasets.iter().map(|s| s.name.as_str()).collect();
        return Err(wrong("dataset", format!("there is no {name:?}; there are: {}", known.join(", "))).into());
    }
    let simulator = Simulator::new(config.clone(), files)?;
    let wanted: Vec<&SetConfig> =
        config.datasets.iter().filter(|s| only.is_empty() || only.contains(&s.name)).collect();
    check_space(&simulator, out, &wanted)?;
    wanted.into_iter().map(|set| make_set(&simulator, files, out, set, progress)).collect()
}

fn make_set(
    simulator: &Simulator,
    files: &ConfigFiles,
    out: &Path,
    set: &SetConfig,
    progress: &(dyn Fn(&str, usize, usize) + Sync),
) -> Result<RaceManifest, SimulateError> {
    let mut lists = simulator.config.effects_of(set, files)?;
    if let (Some(target), Some(from)) = (&set.matched_to, &set.from) {
        let effects = vec![Effect::RangeDropout(matched(&out.join(target), &out.join(from))?)];
        lists.push((format!("{}/matched", set.name), EffectList::of(effects)));
    }
    let prepared = simulator.prepare(lists, set.auto_label);
    let root = out.join(&set.name);
    let mut manifest = RaceManifest {
        schema: RACE_MANIFEST_SCHEMA.into(),
        complete: false,
        name: [simulator.config.name.clone(), set.name.clone()],
        seed: simulator.config.seed,
        config_sha256: fingerprint(simulator, &prepared),
        splits: BTreeMap::new(),
        label_errors: Vec::new(),
        frames_sha256: String::new(),
        builds: Vec::new(),
    };
    let extra = [attributes::FOLDER, TRUE_LABELS];
    let new = NewDataset::begin(&root, simulator.config.layout, &extra, &mut manifest)?;
    if set.auto_label.is_some() {
        create_folder(&root.join(TRUE_LABELS))?;
    }
    write_descriptions(simulator, &new, set, &prepared)?;
    let progress = |done: usize, all: usize| progress(&set.name, done, all);
    let counts = new.make_frames(simulator.keys(), &progress, |_, key| {
        Ok::<_, SimulateError>((key.split_name(), make_frame_file(simulator, &prepared, &new, key)?))
    })?;
    manifest.splits = SplitCounts::of_splits(counts);
    if set.auto_label.is_some() {
        manifest.label_errors = errors_of_labels(simulator, &new)?;
    }
    let ids: Vec<String> = simulator.keys().iter().map(FrameKey::id).collect();
    new.finish(&mut manifest, &ids)?;
    Ok(manifest)
}

/// Writes one frame unless it is there; returns its counts.
fn make_frame_file(
    simulator: &Simulator,
    set: &PreparedSet,
    new: &NewDataset,
    key: &FrameKey,
) -> Result<SplitCounts, SimulateError> {
    let (config, id) = (&simulator.config, key.id());
    let beside = attributes::path(new.root(), &id);
    let truth = set.auto_label.map(|_| true_labels_path(new.root(), &id));
    let (layout, root) = (new.layout(), new.root());
    let files = || {
        let beside = config.attributes.then(|| beside.clone());
        let frame = [layout.cloud_path(root, &id), layout.labels_path(root, &id)];
        frame.into_iter().chain(truth.clone()).chain(beside).collect()
    };
    new.frame(&id, None, files, || {
        let made = simulator.make(set, key)?;
        if made.frame.cloud.is_empty() {
            let message = "would be empty: no shot has a return within the crop; check rig, effects and crop_m";
            return Err(DataError::file(&new.layout().cloud_path(new.root(), &id), message).into());
        }
        if config.attributes {
            write_atomic(&beside, &attributes::encode(&made.scan))?;
        }
        if let Some(path) = &truth {
            write_kitti_text(path, &label_boxes(&made.with_true_boxes()))?;
        }
        Ok::<(), SimulateError>(layout.write_frame(root, &made.frame)?)
    })?;
    let [points, cars] = new.count(&id, PointColumns::Xyzi)?;
    Ok(SplitCounts { frames: 1, cars, points })
}

/// Writes all files of a data set except the frames.
fn write_descriptions(
    simulator: &Simulator,
    new: &NewDataset,
    set: &SetConfig,
    prepared: &PreparedSet,
) -> Result<(), SimulateError> {
    let (config, root) = (&simulator.config, new.root());
    let ids = |split: usize| simulator.keys().iter().filter(move |k| k.split == split).map(FrameKey::id);
    let splits = SPLITS.iter().enumerate().map(|(split, name)| (*name, ids(split).collect()));
    let dataset = DatasetConfig {
        name: format!("{}-{}", config.name, set.name),
        points: PointColumns::Xyzi,
        label_frame: LabelFrame::Lidar,
        classes: vec![config.class.clone()],
        rig: Some("rig.toml".into()),
        true_labels: set.auto_label.map(|_| TRUE_LABELS.into()),
        ..DatasetConfig::default()
    };
    new.describe(dataset, splits)?;
    write_atomic(&root.join("rig.toml"), to_toml(&simulator.rig)?.as_bytes())?;
    if config.attributes {
        attributes::write_names(root, &simulator.rig, &simulator.materials)?;
    }
    if !set.hidden {
        let effects = prepared.lists.iter().flat_map(|(_, list)| list.effects.clone()).collect();
        write_atomic(&root.join("effects.toml"), to_toml(&EffectList::of(effects))?.as_bytes())?;
    }
    Ok(())
}

fn to_toml<T: Serialize>(value: &T) -> Result<String, SimulateError> {
    toml::to_string_pretty(value).map_err(|e| wrong("", e.to_string()).into())
}

/// The dropout that matches the ranges of `from` to those of `target`, from their common training frames.
fn matched(target: &Path, from: &Path) -> Result<sensor::effects::RangeDropout, SimulateError> {
    let histogram = |folder: &Path| {
        let dataset = Dataset::open(folder)?;
        let ids = dataset.ids("train")?;
        RangeHistogram::of_dataset(&dataset, &ids)
    };
    Ok(fit_range_dropout(&histogram(target)?, &histogram(from)?))
}

/// Compares the written labels with the true boxes.
fn errors_of_labels(simulator: &Simulator, new: &NewDataset) -> Result<Vec<LabelError>, SimulateError> {
    let of_frame = |key: &FrameKey| {
        let labels = new.layout().read_labels(new.root(), &key.id())?;
        let truth = read_kitti_text(&true_labels_path(new.root(), &key.id()), KittiText::Labels)?;
        Ok(labels.iter().zip(&truth).map(|(label, truth)| (label.lidar_box(), truth.lidar_box())).collect())
    };
    let pairs: Result<Vec<Vec<_>>, SimulateError> = simulator.keys().par_iter().map(of_frame).collect();
    Ok(label_errors(pairs?.into_iter().flatten()))
}

/// Hash of everything that determines the frames of a data set.
fn fingerprint(simulator: &Simulator, set: &PreparedSet) -> String {
    // Other data sets of the configuration and file locations do not matter; the content of the files does.
    let config = RaceConfig { datasets: Vec::new(), runs: Vec::new(), car: None, ..simulator.config.clone() };
    let mut hash = Sha256::new();
    for text in [
        env!("CARGO_PKG_VERSION").into(),
        json(&config),
        json(&simulator.rig),
        json(&set.lists),
        json(&set.auto_label),
        simulator.track.line.to_csv(),
        format!("{:?}", simulator.materials),
        format!("{:?}", simulator.car),
    ] {
        hash.update(text.as_bytes());
        hash.update([0]);
    }
    for shot in simulator.rig.sensors.iter().flat_map(|s| s.pattern.iter().flat_map(|p| p.shots())) {
        hash.update(format!("{shot:?}").as_bytes());
    }
    if !simulator.config.runs.is_empty() {
        for car in simulator.runs.iter().flat_map(|run| std::iter::once(&run.ego).chain(&run.rivals)) {
            hash.update(car.to_csv().as_bytes());
        }
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn json<T: Serialize>(value: &T) -> String {
    serde_json::to_string(value).expect("a configuration is plain data")
}

/// Checks that the disk has enough free space.
fn check_space(simulator: &Simulator, out: &Path, sets: &[&SetConfig]) -> Result<(), SimulateError> {
    let point = POINT_BYTES.0 + if simulator.config.attributes { POINT_BYTES.1 } else { 0 };
    let frame = simulator.shots() as u64 * point + 1024;
    let missing = |set: &&SetConfig| {
        let root = out.join(&set.name);
        let there = |key: &&FrameKey| simulator.config.layout.has_cloud(&root, &key.id());
        (simulator.keys().len() - simulator.keys().iter().filter(there).count()) as u64
    };
    let needed = sets.iter().map(missing).sum::<u64>() * frame;
    check_free(out, needed, &format!("{} data sets of {} frames", sets.len(), simulator.keys().len()))
}

/// Checks that the disk of `folder` (which need not exist yet) has `needed` free bytes.
fn check_free(folder: &Path, needed: u64, what: &str) -> Result<(), SimulateError> {
    let mut existing = folder;
    while !existing.is_dir() {
        existing = match existing.parent() {
            Some(parent) if !parent.as_os_str().is_empty() => parent,
            _ => Path::new("."),
        };
    }
    let free = fs4::available_space(existing)?;
    if free < needed.saturating_add(SPARE_BYTES) {
        let gb = |bytes: u64| bytes as f64 / 1e9;
        let message = format!(
            "has {:.1} GB free, but up to {:.1} GB are needed for {what}; make room, choose another folder, or lower `frames` or `resolution`",
            gb(free),
            gb(needed.saturating_add(SPARE_BYTES)),
        );
        return Err(DataError::file(existing, message).into());
    }
    Ok(())
}

#[cfg(test)]
mod tests;
