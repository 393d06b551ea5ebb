//! Comparison of the data sets of a study: distances and targets.

use crate::cache::cached;
use crate::config::StudyDataset;
use crate::data_sets::{labelled_sha256, open};
use crate::detections::evenly_spaced;
use crate::error::{Result, refused};
use crate::folder::Study;
use crate::{Event, Listener};
use data::augment::{AugmentConfig, augment, crop_to_range};
use data::{DataError, Dataset, Frame, stream};
use eval::distance::{
    Compared, DISTANCES_SCHEMA, DistanceError, DistanceOptions, Distances, Regions, compare, paired_ids,
};
use eval::targets::{Targets, targets};
use models::config::DetectorConfig;

/// The training loader of a detector.
pub struct Loader {
    range_m: [f64; 6],
    augmentation: AugmentConfig,
}

impl Loader {
    /// The loader of a detector.
    pub fn of(detector: &DetectorConfig) -> Loader {
        Loader { range_m: detector.range_m.map(f64::from), augmentation: detector.augmentation.clone() }
    }

    /// The frame as it is compared. Ground-truth sampling, which inserts targets of other frames, is left out.
    fn apply(&self, frame: Frame, compared: Compared) -> Result<Frame, DataError> {
        let mut random = stream(0, &format!("compared {}", frame.id), 0, 0);
        Ok(match compared {
            Compared::Raw => frame,
            Compared::Loader => crop_to_range(frame, &self.range_m),
            Compared::Augmented => crop_to_range(augment(frame, &self.augmentation, None, &mut random)?, &self.range_m),
        })
    }
}

/// Distances between two data sets on at most `most` frames of a split, which both must have.
///
/// # Errors
/// Splits with different frames, or frames that cannot be read.
pub fn distances_of(
    names: [&str; 2],
    [a, b]: [&Dataset; 2],
    split: &str,
    most: Option<usize>,
    loader: Option<&Loader>,
    options: &DistanceOptions,
) -> Result<Distances> {
    let ids = paired_ids(&a.ids(split)?, &b.ids(split)?)?;
    let ids = evenly_spaced(&ids, most.unwrap_or(ids.len()));
    let load = |id: &str| -> Result<[Frame; 2], DistanceError> {
        let [a, b] = [a.load(id)?, b.load(id)?];
        Ok(match loader {
            Some(loader) => [loader.apply(a, options.compared)?, loader.apply(b, options.compared)?],
            None => [a, b],
        })
    };
    Ok(compare(names, &ids, load, Some(&Regions::of_scenery()), options)?)
}

/// Distances between the first data set of a study and each other one, cached in `distances/`; and a warning for each
/// pair that cannot be compared.
///
/// # Errors
/// Frames that cannot be read.
pub(crate) fn all_distances(study: &Study, listener: Listener<'_>) -> Result<(Vec<Distances>, Vec<String>)> {
    let evaluation = &study.config.evaluation;
    let split = study.config.compared_split();
    let loader = match study.config.runs().first() {
        Some(run) if evaluation.distances.compared != Compared::Raw => {
            Some(Loader::of(&study.run_config(run)?.detector))
        }
        _ => None,
    };
    let (first, others) = study.config.datasets.split_first().ok_or_else(|| refused("a study has data sets"))?;
    let a = open(study, &first.name)?;
    let a_key = labelled_sha256(&a, &a.ids(split)?)?;
    let (mut out, mut warnings) = (Vec::new(), Vec::new());
    for other in others {
        let b = open(study, &other.name)?;
        let b_ids = b.ids(split)?;
        if let Err(problem) = paired_ids(&a.ids(split)?, &b_ids) {
            warnings.push(format!("no distances between {} and {}: {problem}", first.title, other.title));
            continue;
        }
        listener(Event::Note(&format!("computing the distances between {} and {}", first.name, other.name)));
        let key = (
            DISTANCES_SCHEMA,
            [&a_key, &labelled_sha256(&b, &b_ids)?],
            &evaluation.distances,
            evaluation.distance_frames,
            [&first.title, &other.title],
        );
        let path = study.folder.join(format!("distances/{}--{}.json", first.name, other.name));
        out.push(cached(&path, &key, || {
            let names = [first.title.as_str(), &other.title];
            distances_of(names, [&a, &b], split, evaluation.distance_frames, loader.as_ref(), &evaluation.distances)
        })?);
    }
    Ok((out, warnings))
}

/// Target statistics of every data set of a study, cached in `targets/`.
///
/// # Errors
/// Frames that cannot be read.
pub(crate) fn all_targets(study: &Study) -> Result<Vec<Targets>> {
    let (split, options) = (study.config.compared_split(), &study.config.evaluation.targets);
    let of_set = |dataset: &StudyDataset| {
        let set = open(study, &dataset.name)?;
        let ids = set.ids(split)?;
        let path = study.folder.join(format!("targets/{}.json", dataset.name));
        cached(&path, &(labelled_sha256(&set, &ids)?, options, &dataset.title), || {
            Ok(targets(&dataset.title, &ids, |id| set.load(id), options)?)
        })
    };
    study.config.datasets.iter().map(of_set).collect()
}
