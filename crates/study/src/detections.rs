//! Detections of a trained run on the test sets, and features of its layers, stored in the run folder.

use crate::config::StudyRun;
use crate::data_sets::{frames_sha256, open};
use crate::error::{InPart, Result};
use crate::folder::Study;
use crate::written::{CellFiles, WrittenFile};
use data::Presence as _;
use data::{DETECTIONS_FILE, Dataset, DetectionsWriter, write_atomic, write_detections, write_json};
use models::{Detector, LayerFeatures, inference_samples, predict_frames};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Inputs of the detections of a run on a test set. Written to `cell.json` after the detections, so that it marks them
/// as complete.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub(crate) struct DetectionCell {
    schema: String,
    run: String,
    test_set: String,
    split: String,
    frames: usize,
    frames_sha256: String,
    weights_sha256: String,
    /// The files; none in cells of text files, which version 2 had.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    files: Option<CellFiles>,
}

/// Features of all layers of a run on test clouds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RunFeatures {
    schema: String,
    frames_sha256: String,
    weights_sha256: String,
    /// Ids of the test frames.
    pub frames: Vec<String>,
    /// Names of the layers, from first to last.
    pub layers: Vec<String>,
    /// For each layer, the concatenated feature vectors of all frames.
    pub values: Vec<Vec<f32>>,
}

/// Version of [`DetectionCell`].
pub(crate) const CELL_SCHEMA: &str = "lidarshift/detection-cell/3";
/// Version of [`RunFeatures`].
pub(crate) const RUN_FEATURES_SCHEMA: &str = "lidarshift/run-features/1";

/// Hash of the weights of a run.
///
/// # Errors
/// A run without weights.
pub fn weights_sha256(run_folder: &Path) -> Result<String> {
    Ok(data::checksum::file_sha256(&run_folder.join("checkpoint/last.safetensors"))?)
}

fn cell_path(study: &Study, run: &StudyRun, test_set: &str) -> PathBuf {
    run.detections(&study.folder, test_set).join("cell.json")
}

fn features_path(study: &Study, run: &StudyRun) -> PathBuf {
    run.folder(&study.folder).join("features").join(format!("{}.json", study.feature_set()))
}

/// The data set, the frame ids, and the `cell.json` that up-to-date detections have.
fn expected_cell(
    study: &Study,
    run: &StudyRun,
    test_set: &str,
    weights: &str,
) -> Result<(Dataset, Vec<String>, DetectionCell)> {
    let dataset = open(study, test_set)?;
    let ids = dataset.ids(&study.config.splits.test)?;
    let cell = DetectionCell {
        schema: CELL_SCHEMA.into(),
        run: run.to_string(),
        test_set: test_set.into(),
        split: study.config.splits.test.clone(),
        frames: ids.len(),
        frames_sha256: frames_sha256(&dataset, &ids)?,
        weights_sha256: weights.into(),
        files: None,
    };
    Ok((dataset, ids, cell))
}

/// Whether the detections of a run on a test set are complete and were made with these weights on the present frames.
///
/// # Errors
/// A missing test set.
pub fn is_done(study: &Study, run: &StudyRun, test_set: &str, weights: &str) -> Result<bool> {
    let Ok(bytes) = fs_err::read(cell_path(study, run, test_set)) else { return Ok(false) };
    let Ok(mut found) = serde_json::from_slice::<DetectionCell>(&bytes) else { return Ok(false) };
    if found.weights_sha256 != weights {
        return Ok(false);
    }
    let files = found.files.take();
    found.schema = CELL_SCHEMA.into();
    let feature_is_there = test_set != study.feature_set() || features_path(study, run).may_be_file();
    let (_, ids, cell) = expected_cell(study, run, test_set, weights)?;
    Ok(feature_is_there && found == cell && CellFiles::are_there(files.as_ref(), &run.cell(study, test_set), &ids))
}

/// Detects on every test set without complete detections, and stores the features on one of them. `note` is called with
/// the progress.
///
/// # Errors
/// A missing test set, a frame that cannot be read, scores that are NaN.
pub fn detect_all(
    study: &Study,
    run: &StudyRun,
    detector: &Detector,
    workers: usize,
    note: &dyn Fn(&str),
) -> Result<()> {
    let weights = weights_sha256(&run.folder(&study.folder))?;
    for dataset in &study.config.datasets {
        if is_done(study, run, &dataset.name, &weights)? {
            continue;
        }
        note(&format!("detecting on {}", dataset.name));
        let (set, ids, mut cell) = expected_cell(study, run, &dataset.name, &weights)?;
        if dataset.name == study.feature_set() {
            write_features(study, run, detector, &set, &ids, &weights)?;
        }
        let folders = run.cell(study, &dataset.name);
        let files = detect(detector, &set, &ids, &folders, workers).in_part(|| format!("test set {}", dataset.name))?;
        cell.files = Some(files);
        write_json(&cell_path(study, run, &dataset.name), &cell)?;
    }
    Ok(())
}

/// Writes the detections on all frames to one file ([`data::write_detections`]), and the regions of a two-stage network
/// in the same way.
///
/// # Errors
/// As [`detect_all`].
pub(crate) fn detect(
    detector: &Detector,
    set: &Dataset,
    ids: &[String],
    folders: &[PathBuf; 2],
    workers: usize,
) -> Result<CellFiles> {
    let [detections, regions] = folders.each_ref().map(|folder| folder.join(DETECTIONS_FILE));
    type Writer<'a, 'b> = &'a mut DetectionsWriter<'b>;
    let work = |of_detections: Writer<'_, '_>, mut of_regions: Option<Writer<'_, '_>>| -> Result<()> {
        let samples = inference_samples(detector, set, ids, workers).zip(ids).map(|(sample, id)| Ok((sample?, id)));
        predict_frames(detector, detector.config().optimization.batch_size, samples, |batch| {
            for (id, found) in batch {
                of_detections.frame(id, &set.detection_boxes(id, &found.detections)?)?;
                if let Some(of_regions) = &mut of_regions {
                    of_regions.frame(id, &set.detection_boxes(id, &found.regions)?)?;
                }
            }
            Ok(())
        })
    };
    let two_stage = detector.config().network.is_two_stage();
    write_detections(&detections, |of_detections| match two_stage {
        true => write_detections(&regions, |of_regions| work(of_detections, Some(of_regions))),
        false => work(of_detections, None),
    })?;
    folders.iter().try_for_each(|folder| remove_text(folder, ids))?;
    Ok(CellFiles {
        detections: WrittenFile::of(&detections)?,
        regions: two_stage.then(|| WrittenFile::of(&regions)).transpose()?,
    })
}

/// Removes the text files that an earlier version of the program wrote. The first one is removed last, so that all are
/// gone if it is.
fn remove_text(folder: &Path, ids: &[String]) -> Result<()> {
    let text = |id: &String| folder.join(format!("{id}.txt"));
    if ids.first().is_some_and(|id| text(id).may_be_file()) {
        for path in ids.iter().rev().map(text).filter(|path| path.may_be_file()) {
            fs_err::remove_file(path)?;
        }
    }
    Ok(())
}

fn write_features(
    study: &Study,
    run: &StudyRun,
    detector: &Detector,
    set: &Dataset,
    ids: &[String],
    weights: &str,
) -> Result<()> {
    let most = study.config.evaluation.tsne_frames.unwrap_or(ids.len());
    let ids = evenly_spaced(ids, most);
    let mut features = RunFeatures {
        schema: RUN_FEATURES_SCHEMA.into(),
        frames_sha256: frames_sha256(set, &ids)?,
        weights_sha256: weights.into(),
        frames: Vec::new(),
        layers: Vec::new(),
        values: Vec::new(),
    };
    for (sample, id) in inference_samples(detector, set, &ids, 1).zip(&ids) {
        let layers = detector.layer_features(&sample?)?;
        // A frame without points has no features and is left out.
        if layers.is_empty() {
            continue;
        }
        if features.layers.is_empty() {
            features.layers = layers.iter().map(|l| l.layer.clone()).collect();
            features.values = vec![Vec::new(); layers.len()];
        }
        features.frames.push(id.clone());
        for (kept, LayerFeatures { values, .. }) in features.values.iter_mut().zip(layers) {
            kept.extend(values);
        }
    }
    Ok(write_atomic(&features_path(study, run), &serde_json::to_vec(&features)?)?)
}

/// At most `most` of the ids, evenly spaced.
pub fn evenly_spaced(ids: &[String], most: usize) -> Vec<String> {
    let n = most.min(ids.len());
    (0..n).map(|i| ids[i * ids.len() / n].clone()).collect()
}

/// The stored features of a run; `None` if there are none for its present weights.
///
/// # Errors
/// A damaged file.
pub fn read_features(study: &Study, run: &StudyRun) -> Result<Option<RunFeatures>> {
    let path = features_path(study, run);
    if !path.may_be_file() {
        return Ok(None);
    }
    let features: RunFeatures = serde_json::from_slice(&fs_err::read(&path)?)
        .in_part(|| format!("{} is damaged; remove it and run the study again", path.display()))?;
    let weights = weights_sha256(&run.folder(&study.folder))?;
    Ok((features.weights_sha256 == weights && !features.frames.is_empty()).then_some(features))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_evenly_spaced() {
        let ids: Vec<String> = (0..10).map(|i| i.to_string()).collect();
        assert_eq!(evenly_spaced(&ids, 4), ["0", "2", "5", "7"]);
        assert_eq!(evenly_spaced(&ids, 100), ids);
        assert!(evenly_spaced(&[], 3).is_empty());
    }
}
