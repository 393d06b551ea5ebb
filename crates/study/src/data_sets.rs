//! The data sets of a study: made where they are not there, opened, and told apart by what is in them.

use crate::config::{Source, StudyDataset};
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use crate::{Event, Listener};
use data::Dataset;
use sha2::{Digest, Sha256};
use simulate::effects::EffectList;
use simulate::race::{RaceConfig, make_race_datasets};
use simulate::resim::Resim;
use simulate::{Scenery, make_road_dataset};
use std::path::Path;

/// Makes what is missing of the data sets, in their order. What an earlier process began is gone on with.
///
/// # Errors
/// A source that does not exist or cannot be made.
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
                    return Err(refused(format!("a street has but one data set: leave dataset = {name:?} out")));
                }
                (Scenery::Race(race), None) => {
                    let names: Vec<&str> = race.0.datasets.iter().map(|set| set.name.as_str()).collect();
                    return Err(refused(format!(
                        "{} makes several data sets: say dataset = one of {}",
                        config.display(),
                        names.join(", ")
                    )));
                }
            }
        }
        Source::Resim { of, effects } => {
            let source = Dataset::open(&study.dataset_path(study.dataset(of)?))?;
            let effects = EffectList::read(&study.path(effects))?;
            Resim { dataset: &source, effects: &effects, rig: None, seed: 0 }.make(&path, &show)?;
        }
    }
    listener(Event::DatasetMade);
    Ok(())
}

/// A data set of a race, behind those whose frames decide its own.
fn with_sources(race: &RaceConfig, name: &str) -> Vec<String> {
    let mut names = vec![name.to_string()];
    let set = race.datasets.iter().find(|set| set.name == name);
    if let Some((target, from)) = set.and_then(|set| Some((set.matched_to.as_ref()?, set.from.as_ref()?))) {
        names.splice(0..0, [target, from].into_iter().flat_map(|name| with_sources(race, name)));
    }
    names
}

/// A data set of the study, which is there already.
///
/// # Errors
/// A data set that is not there, or not whole.
pub fn open(study: &Study, name: &str) -> Result<Dataset> {
    let dataset = study.dataset(name)?;
    let path = study.dataset_path(dataset);
    Dataset::open(&path).in_part(|| match dataset.source {
        Source::Path(_) => format!("data set {name}"),
        _ => format!("data set {name} is not there: `lidarshift study {} --only data` makes it", study.named),
    })
}

/// A hash of the ids of frames and of the sizes of their clouds, in hexadecimal.
///
/// # Errors
/// A cloud that is missing.
pub fn frames_sha256(dataset: &Dataset, ids: &[String]) -> Result<String> {
    let mut hash = Sha256::new();
    for id in ids {
        hash.update(id.as_bytes());
        hash.update(fs_err::metadata(dataset.cloud_path(id))?.len().to_le_bytes());
    }
    Ok(hex(hash))
}

/// The same with the labels.
///
/// # Errors
/// A cloud or a label that is missing.
pub fn labelled_sha256(dataset: &Dataset, ids: &[String]) -> Result<String> {
    let mut hash = Sha256::new();
    hash.update(frames_sha256(dataset, ids)?);
    for id in ids {
        hash.update(fs_err::read(dataset.labels_path(id))?);
    }
    Ok(hex(hash))
}

/// A hash of a file.
///
/// # Errors
/// A file that cannot be read.
pub fn file_sha256(path: &Path) -> Result<String> {
    Ok(hex(Sha256::new().chain_update(fs_err::read(path)?)))
}

fn hex(hash: Sha256) -> String {
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}
