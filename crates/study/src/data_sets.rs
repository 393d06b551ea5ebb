//! The data sets of a study: generated if missing, opened, and hashed.

use crate::config::{Source, StudyDataset};
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::{Event, Listener};
use data::checksum::hex;
use data::limits::MOST_TEXT_BYTES;
use data::write::write_dataset_toml;
use data::{Dataset, DatasetConfig};
use rayon::prelude::*;
use sensor::{EffectList, Rig};
use sha2::{Digest, Sha256};
use simulate::race::{RaceConfig, make_race_datasets};
use simulate::resim::Resim;
use simulate::{Scenery, make_road_dataset};

/// Generates the missing data sets in the order of the study, and completes unfinished ones.
///
/// # Errors
/// A missing source, or an error of the simulation.
pub fn make_datasets(study: &Study, listener: Listener<'_>) -> Result<()> {
    for dataset in &study.config.datasets {
        make(study, dataset, listener).in_part(|| format!("data set {}", dataset.name))?;
    }
    Ok(())
}

fn make(study: &Study, dataset: &StudyDataset, listener: Listener<'_>) -> Result<()> {
    let show = |done: usize, total: usize| listener(Event::Frames { dataset: &dataset.name, done, total });
    let path = study.dataset_path(dataset);
    match &dataset.source {
        Source::Path(_) => {
            Dataset::open(&path)?;
        }
        Source::Simulate { config, dataset: name, frames, seed } => {
            match (Scenery::find(&study.scenes_config(config), Some(*frames), Some(*seed))?, name) {
                (Scenery::Street(config), None) => {
                    make_road_dataset(&config, &path, &show)?;
                }
                (Scenery::Race(race), Some(name)) => {
                    let out = study.scenes_folder(config, *frames, *seed);
                    let only = with_sources(&race.0, name);
                    make_race_datasets(&race.0, &race.1, &out, &only, &|_, done, total| show(done, total))?;
                }
                (Scenery::Street(_), Some(name)) => {
                    return Err(refused(format!("a street has only one data set; remove dataset = {name:?}")));
                }
                (Scenery::Race(race), None) => {
                    let names: Vec<&str> = race.0.datasets.iter().map(|set| set.name.as_str()).collect();
                    return Err(refused(format!(
                        "{} has several data sets; set dataset to one of {}",
                        config.display(),
                        names.join(", ")
                    )));
                }
            }
        }
        Source::Resim { of, effects, sensor } => {
            let source = Dataset::open(&study.dataset_path(study.dataset(of)?))?;
            let effects = EffectList::read(&study.path(effects))?;
            let rig = sensor.as_ref().map(|path| Rig::read(&study.path(path))).transpose()?;
            Resim { dataset: &source, effects: &effects, rig, seed: 0 }.make(&path, &show)?;
        }
        Source::TrueLabels { of } => {
            let source = Dataset::open(&study.dataset_path(study.dataset(of)?))?.config;
            let Some(labels) = source.true_labels else {
                return Err(refused(format!(
                    "{of} has no true boxes beside its labels (`true_labels` in its TOML); they are known of simulated data \
                     sets with automatic labels"
                )));
            };
            // Absolute, since the folder of a study may be given by another relative path later.
            let root = data::absolute(&source.root)?;
            let rig = source.rig.map(std::path::absolute).transpose()?;
            let name = format!("{}-true-labels", source.name);
            let config = DatasetConfig {
                name,
                root,
                rig,
                labels: Some(labels),
                true_labels: None,
                repaired_labels: None,
                ..source
            };
            write_dataset_toml(&path.join("dataset.toml"), &config)?;
        }
    }
    listener(Event::DatasetMade);
    Ok(())
}

/// A data set of a race, preceded by the data sets that it needs.
fn with_sources(race: &RaceConfig, name: &str) -> Vec<String> {
    let mut names = vec![name.to_string()];
    let set = race.datasets.iter().find(|set| set.name == name);
    if let Some((target, from)) = set.and_then(|set| Some((set.matched_to.as_ref()?, set.from.as_ref()?))) {
        names.splice(0..0, [target, from].into_iter().flat_map(|name| with_sources(race, name)));
    }
    names
}

/// Names of the data sets that do not exist or are not complete.
pub fn absent_datasets(study: &Study) -> Vec<&str> {
    let is_complete = |dataset: &StudyDataset| {
        let path = study.dataset_path(dataset);
        let manifest = fs_err::read(path.join("manifest.json")).ok();
        let value = manifest.and_then(|bytes| serde_json::from_slice::<serde_json::Value>(&bytes).ok());
        let unfinished = value.is_some_and(|manifest| manifest["complete"] == false);
        Dataset::open(&path).is_ok() && !unfinished
    };
    study.config.datasets.iter().filter(|dataset| !is_complete(dataset)).map(|dataset| dataset.name.as_str()).collect()
}

/// Opens an existing data set of the study.
///
/// # Errors
/// A missing or incomplete data set.
pub fn open(study: &Study, name: &str) -> Result<Dataset> {
    let dataset = study.dataset(name)?;
    let path = study.dataset_path(dataset);
    Dataset::open(&path).in_part(|| match dataset.source {
        Source::Path(_) => format!("data set {name}"),
        _ => format!("data set {name} does not exist; generate it with `lidarshift study {} --only data`", study.named),
    })
}

/// Hash of frame ids and the file sizes of their clouds, in hexadecimal.
///
/// # Errors
/// A missing cloud.
pub fn frames_sha256(dataset: &Dataset, ids: &[String]) -> Result<String> {
    let mut hash = Sha256::new();
    let lengths = ids.par_iter().map(|id| Ok(dataset.cloud_part(id)?.length()?));
    for (id, length) in ids.iter().zip(lengths.collect::<Result<Vec<u64>>>()?) {
        hash.update(id.as_bytes());
        hash.update(length.to_le_bytes());
    }
    Ok(hex(&hash.finalize()))
}

/// Hash of frame ids, the file sizes of their clouds and the content of their labels and true boxes, in hexadecimal.
///
/// # Errors
/// A missing cloud or label file.
pub fn labelled_sha256(dataset: &Dataset, ids: &[String]) -> Result<String> {
    let mut hash = Sha256::new();
    hash.update(frames_sha256(dataset, ids)?);
    let labels = |id: &String| {
        let mut text = dataset.labels_part(id)?.read(MOST_TEXT_BYTES)?;
        let repaired = dataset.repaired_labels_paths(id).into_iter().flatten();
        for beside in repaired.chain(dataset.true_labels_path(id)) {
            text.extend(fs_err::read(beside)?);
        }
        Ok(text)
    };
    // Some at a time, so that not all labels are in memory.
    for some in ids.chunks(1 << 12) {
        let texts = some.par_iter().map(labels).collect::<Result<Vec<_>>>()?;
        texts.into_iter().for_each(|text| hash.update(text));
    }
    Ok(hex(&hash.finalize()))
}
