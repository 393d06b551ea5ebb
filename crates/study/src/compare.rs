//! Comparison of several simulations of the same recordings: a study of frozen detectors and distances, and the ranks
//! of the simulations.

use crate::cache::cached;
use crate::config::{FrozenDetector, StudyConfig, StudyEvaluation};
use crate::data_sets::{labelled_sha256, open};
use crate::detections::evenly_spaced;
use crate::error::{Result, refused};
use crate::folder::Study;
use crate::frozen::{FrozenState, prepare};
use crate::{Event, Listener};
use data::{Dataset, FolderLock};
use eval::comparison::{Comparison, Criterion};
use eval::distance::{DISTANCES_SCHEMA, DistanceError, FrameDistances, Measure, Part, compare_by_frame};
use eval::matrix::{PairedValues, Quantity, shared_ids};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// What is compared.
#[derive(Clone, Debug)]
pub struct CompareInput {
    /// The measured data set, then the simulations: folders or TOMLs, relative to the working directory.
    pub datasets: Vec<PathBuf>,
    /// Detectors that were trained elsewhere; the keys of `detections` are the names from [`names`].
    pub frozen: Vec<FrozenDetector>,
    /// Split whose frames are compared.
    pub split: String,
    /// Number of frames for distances, evenly spaced; 0: no distances.
    pub distance_frames: usize,
    /// Options of the evaluation.
    pub evaluation: StudyEvaluation,
}

/// Names of data sets, made of their paths: the last part, and the parts before it where names would be equal.
pub fn names(paths: &[PathBuf]) -> Vec<String> {
    let parts = |path: &PathBuf| -> Vec<String> {
        let absolute = std::path::absolute(path).unwrap_or_else(|_| path.clone());
        let whole = if absolute.ends_with("dataset.toml") {
            absolute.parent().map(Path::to_path_buf).unwrap_or_default()
        } else if absolute.extension().is_some_and(|ending| ending == "toml") {
            absolute.with_extension("")
        } else {
            absolute
        };
        let plain = |c: char| if c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.') { c } else { '_' };
        let normal = whole.components().filter(|part| matches!(part, std::path::Component::Normal(_)));
        let name = |part: std::path::Component| part.as_os_str().to_string_lossy().chars().map(plain).collect();
        normal.map(name).collect()
    };
    let all: Vec<Vec<String>> = paths.iter().map(parts).collect();
    let named = |n: usize| -> Vec<String> {
        let last = |parts: &Vec<String>| parts[parts.len().saturating_sub(n)..].join("-");
        all.iter().map(last).map(|name| name.trim_start_matches('.').to_string()).collect()
    };
    let distinct = |names: &[String]| {
        let sorted: BTreeSet<&String> = names.iter().collect();
        sorted.len() == names.len()
            && names.iter().all(|name| !name.is_empty() && name != "elsewhere" && name != "frozen")
    };
    let longest = all.iter().map(Vec::len).max().unwrap_or(1);
    (1..=longest).map(named).find(|names| distinct(names)).unwrap_or_else(|| {
        (0..all.len()).map(|i| if i == 0 { "measured".into() } else { format!("simulation-{i}") }).collect()
    })
}

/// The study of a comparison in the folder `out`.
///
/// # Errors
/// Fewer than one simulation, or detectors that are not valid.
pub fn study_of(input: &CompareInput, out: &Path) -> Result<Study> {
    if input.datasets.len() < 2 {
        return Err(refused("a comparison needs a measured data set and at least one simulation"));
    }
    let dataset = |(name, path): (String, &PathBuf)| json!({ "name": name, "source": { "path": path } });
    let datasets: Vec<Value> = names(&input.datasets).into_iter().zip(&input.datasets).map(dataset).collect();
    let split = &input.split;
    let mut config: StudyConfig = serde_json::from_value(json!({
        "name": "compare",
        "about": ["Simulations of the same recordings, compared with measured data."],
        "dataset": datasets,
        "splits": { "train": split, "val": split, "test": split },
    }))?;
    config.frozen.clone_from(&input.frozen);
    config.evaluation = StudyEvaluation { distance_frames: Some(input.distance_frames), ..input.evaluation.clone() };
    Study::from_config(&config, Path::new("."), out)
}

/// Compares the first data set of a study from [`study_of`] with the others. `device` are the command line arguments of
/// the device.
///
/// # Errors
/// Data sets without shared frames; detections that do not fit; frames that cannot be read.
pub fn compare(study: &Study, device: &[String], listener: Listener<'_>) -> Result<Comparison> {
    let _lock = FolderLock::acquire(&study.folder)?;
    study.update_copy()?;
    let split = &study.config.splits.test;
    let sets: Vec<Dataset> = study.config.datasets.iter().map(|d| open(study, &d.name)).collect::<Result<_>>()?;
    let ids: Vec<Vec<String>> = sets.iter().map(|set| Ok(set.ids(split)?)).collect::<Result<_>>()?;
    let all: Vec<&[String]> = ids.iter().map(Vec::as_slice).collect();
    let shared = shared_ids(&all);
    if shared.is_empty() {
        let counts: Vec<String> =
            study.config.datasets.iter().zip(&ids).map(|(d, i)| format!("{} {}", i.len(), d.name)).collect();
        return Err(refused(format!(
            "no frame of split {split:?} is in all data sets ({} frames): simulations of the same recordings have the \
             frame ids of the measured data",
            counts.join(", ")
        )));
    }
    prepare(study, device, listener)?;
    let (measured, simulations) = study.config.datasets.split_first().ok_or_else(|| refused("there is no data set"))?;
    let simulations: Vec<String> = simulations.iter().map(|d| d.name.clone()).collect();
    let mut criteria = detector_criteria(study, &simulations, listener)?;
    criteria.extend(distance_criteria(study, &sets, &shared, &simulations, listener)?);
    let mut comparison = Comparison::new(&measured.name, simulations, criteria);
    if ids.iter().any(|ids| ids.len() > shared.len()) {
        let counts: Vec<String> = ids.iter().map(|ids| ids.len().to_string()).collect();
        comparison.warnings.push(format!(
            "only the {} frames that all data sets have are compared; they have {}",
            shared.len(),
            counts.join(", ")
        ));
    }
    Ok(comparison)
}

/// The gaps of all detectors; their mean first if there are several values.
fn detector_criteria(study: &Study, simulations: &[String], listener: Listener<'_>) -> Result<Vec<Criterion>> {
    let options = &study.config.evaluation.matrix;
    let state = FrozenState::read(study)?;
    let names: Vec<&str> = study.config.datasets.iter().map(|d| d.name.as_str()).collect();
    let (mut criteria, mut all) = (Vec::new(), Vec::<(usize, Vec<PairedValues>)>::new());
    for frozen in &study.config.frozen {
        if names.iter().any(|name| !frozen.is_tested_on(name)) {
            return Err(refused(format!("detector {} has no detections on some of the data sets", frozen.name)));
        }
        listener(Event::Note(&format!("scoring {}", frozen.name)));
        let (frames, values) = state.values(study, frozen, &names)?;
        let wanted = |v: &&PairedValues| match v.quantity {
            Quantity::Ap40 => true,
            _ => v.section.is_none() && v.quantity == Quantity::RecallMatched,
        };
        let of_value = |v| Criterion::of_detector(&frozen.title, simulations, frames, v, &options.bootstrap);
        criteria.extend(values.iter().filter(wanted).map(of_value));
        all.push((frames, values));
    }
    let values: Vec<&PairedValues> = all.iter().flat_map(|(_, values)| values).collect();
    let frames = all.iter().map(|(frames, _)| *frames).min().unwrap_or(0);
    let mean = Criterion::mean_gap(simulations, frames, &values, &options.bootstrap);
    Ok(mean.into_iter().chain(criteria).collect())
}

/// The distances of each simulation from the measured clouds on the same frames.
fn distance_criteria(
    study: &Study,
    sets: &[Dataset],
    shared: &[String],
    simulations: &[String],
    listener: Listener<'_>,
) -> Result<Vec<Criterion>> {
    let ids = evenly_spaced(shared, study.config.evaluation.distance_frames.unwrap_or(shared.len()));
    let options = &study.config.evaluation.distances;
    if ids.is_empty() {
        return Ok(Vec::new());
    }
    let first = &study.config.datasets[0].name;
    let first_hash = labelled_sha256(&sets[0], &ids)?;
    let mut all: Vec<Vec<FrameDistances>> = Vec::new();
    for (set, name) in sets[1..].iter().zip(simulations) {
        listener(Event::Note(&format!("computing the distances between {first} and {name} on {} frames", ids.len())));
        let key = (DISTANCES_SCHEMA, [&first_hash, &labelled_sha256(set, &ids)?], options);
        let path = study.folder.join(format!("distances/frames-{first}--{name}.json"));
        all.push(cached(&path, &key, || {
            let load = |id: &str| Ok::<_, DistanceError>([sets[0].load(id)?, set.load(id)?]);
            Ok(compare_by_frame([first, name], &ids, load, None, options)?.1)
        })?);
    }
    let n = all.first().map_or(0, Vec::len);
    let mut criteria: Vec<(bool, Criterion)> = Vec::new();
    for k in 0..n {
        let values: Vec<&FrameDistances> = all.iter().map(|of_set| &of_set[k]).collect();
        let leads = values[0].part == Part::Whole && values[0].measure == Measure::ChamferMeanM2;
        criteria.extend(Criterion::of_distance(simulations, &values, &options.bootstrap).map(|c| (leads, c)));
    }
    criteria.sort_by_key(|(leads, _)| !leads); // stable
    Ok(criteria.into_iter().map(|(_, criterion)| criterion).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn data_sets_are_named_by_the_last_parts_of_their_paths() {
        let named = |paths: &[&str]| names(&paths.iter().map(PathBuf::from).collect::<Vec<_>>());
        assert_eq!(named(&["/data/real", "/data/sim a", "/data/sim-b.toml"]), ["real", "sim_a", "sim-b"]);
        assert_eq!(named(&["/x/a/test", "/x/b/test/dataset.toml"]), ["a-test", "b-test"]);
        assert_eq!(named(&["/x/same", "/x/same"]), ["measured", "simulation-1"]);
        assert_eq!(named(&["/x/real", "/x/frozen"]), ["x-real", "x-frozen"]);
    }
}
