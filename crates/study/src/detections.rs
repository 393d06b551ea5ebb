//! What a trained run finds on the test sets, and what its layers make of them: texts and numbers in the run's folder.

use crate::config::StudyRun;
use crate::data_sets::{file_sha256, frames_sha256, open};
use crate::error::{InPart, Result};
use crate::folder::Study;
use data::write::write_kitti_text;
use data::{Dataset, write_atomic, write_json};
use models::{Detector, LayerFeatures, inference_samples, predict_frames};
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What the detections of a run on a test set were made of, beside them: it is written last.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct DetectionCell {
    schema: String,
    run: String,
    test_set: String,
    split: String,
    frames: usize,
    frames_sha256: String,
    weights_sha256: String,
}

/// Features of the layers of a run on test clouds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RunFeatures {
    schema: String,
    frames_sha256: String,
    weights_sha256: String,
    /// The test frames.
    pub frames: Vec<String>,
    /// The layers, first to last.
    pub layers: Vec<String>,
    /// Of each layer the vectors of all frames, one after the other.
    pub values: Vec<Vec<f32>>,
}

/// The hash of a run's weights.
///
/// # Errors
/// A run that has none.
pub fn weights_sha256(run_folder: &Path) -> Result<String> {
    file_sha256(&run_folder.join("checkpoint/last.safetensors"))
}

fn cell_path(study: &Study, run: &StudyRun, test_set: &str) -> PathBuf {
    run.detections(&study.folder, test_set).join("cell.json")
}

fn features_path(study: &Study, run: &StudyRun) -> PathBuf {
    run.folder(&study.folder).join("features").join(format!("{}.json", study.feature_set()))
}

/// What the cell of a run and a test set has to be made of.
fn wanted(
    study: &Study,
    run: &StudyRun,
    test_set: &str,
    weights: &str,
) -> Result<(Dataset, Vec<String>, DetectionCell)> {
    let dataset = open(study, test_set)?;
    let ids = dataset.ids(&study.config.splits.test)?;
    let cell = DetectionCell {
        schema: "lidarshift/detection-cell/2".into(),
        run: run.to_string(),
        test_set: test_set.into(),
        split: study.config.splits.test.clone(),
        frames: ids.len(),
        frames_sha256: frames_sha256(&dataset, &ids)?,
        weights_sha256: weights.into(),
    };
    Ok((dataset, ids, cell))
}

/// Whether the detections of a run on a test set are there, all of them, made of these weights and of the frames as they are.
///
/// # Errors
/// A test set that is not there.
pub fn is_done(study: &Study, run: &StudyRun, test_set: &str, weights: &str) -> Result<bool> {
    let Ok(bytes) = fs_err::read(cell_path(study, run, test_set)) else { return Ok(false) };
    let Ok(found) = serde_json::from_slice::<DetectionCell>(&bytes) else { return Ok(false) };
    if found.weights_sha256 != weights {
        return Ok(false);
    }
    let feature_is_there = test_set != study.feature_set() || features_path(study, run).is_file();
    let (_, ids, cell) = wanted(study, run, test_set, weights)?;
    let folder = run.detections(&study.folder, test_set);
    Ok(feature_is_there && found == cell && ids.iter().all(|id| folder.join(format!("{id}.txt")).is_file()))
}

/// Detects every test set that is not done, and keeps the features of one of them. `say` hears what is being done.
///
/// # Errors
/// A test set that is not there, a frame that cannot be read, scores that are not numbers.
pub fn detect_all(
    study: &Study,
    run: &StudyRun,
    detector: &Detector,
    workers: usize,
    say: &dyn Fn(&str),
) -> Result<()> {
    let weights = weights_sha256(&run.folder(&study.folder))?;
    for dataset in &study.config.datasets {
        if is_done(study, run, &dataset.name, &weights)? {
            continue;
        }
        say(&format!("detecting {}", dataset.name));
        let (set, ids, cell) = wanted(study, run, &dataset.name, &weights)?;
        if dataset.name == study.feature_set() {
            keep_features(study, run, detector, &set, &ids, &weights)?;
        }
        let folders = [run.detections(&study.folder, &dataset.name), run.regions(&study.folder, &dataset.name)];
        detect(detector, &set, &ids, &folders, workers).in_part(|| format!("test set {}", dataset.name))?;
        write_json(&cell_path(study, run, &dataset.name), &cell)?;
    }
    Ok(())
}

/// The detections of a run on frames, a text a frame, and the regions of a two-stage network likewise.
fn detect(detector: &Detector, set: &Dataset, ids: &[String], folders: &[PathBuf; 2], workers: usize) -> Result<()> {
    let [of_detections, of_regions] = folders;
    let two_stage = detector.config().network.is_two_stage();
    let samples = inference_samples(detector, set, ids, workers).zip(ids).map(|(sample, id)| Ok((sample?, id)));
    predict_frames(detector, detector.config().optimization.batch_size, samples, |batch| {
        for (id, found) in batch {
            let name = format!("{id}.txt");
            write_kitti_text(&of_detections.join(&name), &set.detection_boxes(id, &found.detections)?)?;
            if two_stage {
                write_kitti_text(&of_regions.join(&name), &set.detection_boxes(id, &found.regions)?)?;
            }
        }
        Ok(())
    })
}

fn keep_features(
    study: &Study,
    run: &StudyRun,
    detector: &Detector,
    set: &Dataset,
    ids: &[String],
    weights: &str,
) -> Result<()> {
    let most = study.config.evaluation.tsne_frames.unwrap_or(ids.len());
    let ids = spread(ids, most);
    let mut features = RunFeatures {
        schema: "lidarshift/run-features/1".into(),
        frames_sha256: frames_sha256(set, &ids)?,
        weights_sha256: weights.into(),
        frames: Vec::new(),
        layers: Vec::new(),
        values: Vec::new(),
    };
    for (sample, id) in inference_samples(detector, set, &ids, 1).zip(&ids) {
        let layers = detector.layer_features(&sample?)?;
        // A frame without points has no features; it is left out.
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

/// At most `most` of them, evenly over all.
pub fn spread(ids: &[String], most: usize) -> Vec<String> {
    let n = most.min(ids.len());
    (0..n).map(|i| ids[i * ids.len() / n].clone()).collect()
}

/// The features that a run has left; `None` where there are none of its present weights.
///
/// # Errors
/// A file that is damaged.
pub fn read_features(study: &Study, run: &StudyRun) -> Result<Option<RunFeatures>> {
    let path = features_path(study, run);
    if !path.is_file() {
        return Ok(None);
    }
    let features: RunFeatures = serde_json::from_slice(&fs_err::read(&path)?)
        .in_part(|| format!("{}: is damaged; remove it and run the study again", path.display()))?;
    let weights = weights_sha256(&run.folder(&study.folder))?;
    Ok((features.weights_sha256 == weights && !features.frames.is_empty()).then_some(features))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_over_all() {
        let ids: Vec<String> = (0..10).map(|i| i.to_string()).collect();
        assert_eq!(spread(&ids, 4), ["0", "2", "5", "7"]);
        assert_eq!(spread(&ids, 100), ids);
        assert!(spread(&[], 3).is_empty());
    }
}
