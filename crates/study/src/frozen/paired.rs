//! Differences of frozen detectors between data sets of the same frames.

use super::FrozenState;
use crate::cache::cached;
use crate::config::FrozenDetector;
use crate::data_sets::open;
use crate::error::{Result, refused};
use crate::folder::Study;
use eval::matrix::{Between, PairedDifference, RunScores, ScoredFrames, Standing, paired_differences, shared_ids};
use std::sync::Arc;

/// The data sets that are compared with the first one by the same frames.
fn compared<'a>(study: &'a Study, frozen: &FrozenDetector) -> Option<(&'a str, Vec<&'a str>)> {
    let mut names = study.config.datasets.iter().map(|d| d.name.as_str());
    let first = names.next().filter(|name| frozen.is_tested_on(name))?;
    Some((first, names.filter(|name| frozen.is_tested_on(name)).collect()))
}

/// Refuses data sets that share no frames with the first one.
///
/// # Errors
/// Such data sets, or ones that cannot be read.
pub(super) fn check_shared_frames(study: &Study, frozen: &FrozenDetector) -> Result<()> {
    let Some((first, others)) = compared(study, frozen) else { return Ok(()) };
    let split = &study.config.splits.test;
    let a = open(study, first)?;
    for other in others {
        let b = open(study, other)?;
        let (a_ids, b_ids) = (a.ids(split)?, b.ids(split)?);
        if shared_ids(&[&a_ids, &b_ids]).is_empty() {
            return Err(refused(format!(
                "{}: none of its {} frames is among the {} of {}; measured minus simulated is compared over the same \
                 frames. Give both data sets the same frame ids and test splits, or evaluate {other} in a study of its \
                 own",
                b.split_path(split)?.display(),
                b_ids.len(),
                a_ids.len(),
                a.split_path(split)?.display()
            )));
        }
    }
    Ok(())
}

/// Scores on a data set that has the scenes of one of two data sets and the sensor of the other.
struct ScoredBetween {
    ids: Vec<String>,
    scores: Arc<RunScores>,
    /// Whether the sensor is that of the first.
    sensor_of_first: bool,
}

impl ScoredBetween {
    fn standing(&self) -> Standing<'_> {
        let frames = ScoredFrames::new(&self.scores, &self.ids);
        if self.sensor_of_first { Standing::SensorOfFirst(frames) } else { Standing::SceneOfFirst(frames) }
    }
}

impl FrozenState {
    /// Differences of every frozen detector between the first data set and each other one over their shared frames,
    /// cached in `paired.json`; and a warning for data sets that share only a part of their frames.
    ///
    /// # Errors
    /// Labels or detections that cannot be read.
    pub(crate) fn paired(&self, study: &Study, key: &str) -> Result<(Vec<PairedDifference>, Vec<String>)> {
        if self.cells.is_empty() {
            return Ok((Vec::new(), Vec::new()));
        }
        let options = &study.config.evaluation.matrix;
        cached(&study.folder.join("paired.json"), &("lidarshift.paired/2", key, options), || {
            let (mut out, mut warnings) = (Vec::new(), Vec::new());
            for frozen in &study.config.frozen {
                let Some((first, others)) = compared(study, frozen) else { continue };
                let others: Vec<&str> = others.into_iter().filter(|name| self.has(&frozen.name, name)).collect();
                if !self.has(&frozen.name, first) || others.is_empty() {
                    continue;
                }
                let (a_ids, a) = self.scored(study, frozen, first)?;
                for other in others {
                    let (b_ids, b) = self.scored(study, frozen, other)?;
                    let names = [frozen.name.as_str(), first, other];
                    let between = self.between(study, frozen, first, other)?;
                    let standing = between.as_ref().map(ScoredBetween::standing);
                    let sets = [ScoredFrames::new(&a, &a_ids), ScoredFrames::new(&b, &b_ids)];
                    let found = paired_differences(names, sets, standing, options);
                    let shared = found.first().map_or(0, |d| d.frames);
                    if shared < a_ids.len().max(b_ids.len()) {
                        warnings.push(format!(
                            "{}: {} minus {} is over the {shared} frames that both have, of {} and {}",
                            frozen.title,
                            study.title(first),
                            study.title(other),
                            a_ids.len(),
                            b_ids.len()
                        ));
                    }
                    out.extend(found);
                }
            }
            Ok((out, warnings))
        })
    }

    /// The scores on the data set that has the scenes of one of two data sets and the sensor of the other.
    fn between(
        &self,
        study: &Study,
        frozen: &FrozenDetector,
        first: &str,
        other: &str,
    ) -> Result<Option<ScoredBetween>> {
        let between = study.config.plan().between;
        let stands = |b: &&Between| {
            let of = (b.sensor_of.as_str(), b.scene_of.as_str());
            (of == (first, other) || of == (other, first)) && self.has(&frozen.name, &b.test_set)
        };
        let Some(between) = between.iter().find(stands) else { return Ok(None) };
        let (ids, scores) = self.scored(study, frozen, &between.test_set)?;
        Ok(Some(ScoredBetween { ids, scores, sensor_of_first: between.sensor_of == first }))
    }
}
