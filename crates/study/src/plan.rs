//! What a study will be able to see, before anything runs.

use crate::config::{Source, StudyConfig};
use crate::data_sets::open;
use crate::error::{InPart, Result, refused};
use crate::folder::Study;
use data::Dataset;
use eval::matrix::{Matrix, Power, Scatter};
use schemars::JsonSchema;
use serde::Serialize;
use simulate::Scenery;
use std::path::Path;

/// Scatter of paired differences in the study `quick` (PointPillars; measured against sim, tested on measured):
/// overlap, deviation over seeds, standard error of the frames times the square root of their number. At 0.5 the
/// deviation over seeds is that of an earlier form: four seeds happened to agree within 0.6.
const STORED: [(f64, Scatter); 2] =
    [(0.5, Scatter { of_seeds: 1.9, of_frames: 20.8 }), (0.7, Scatter { of_seeds: 3.2, of_frames: 31.8 })];

/// Origin of the scatter behind a plan.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ScatterFrom {
    /// Results of this study, or of a pilot.
    Results,
    /// The stored values of `quick`.
    Stored,
}

/// The difference between two cells that a study will be able to see.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Planned {
    /// Title of the network.
    pub network: String,
    /// Title of the test set.
    pub test_set: String,
    /// IoU threshold.
    pub overlap: f64,
    /// Number of seeds.
    pub seeds: usize,
    /// Number of test frames.
    pub frames: usize,
    /// The scatter.
    pub scatter: Scatter,
    /// Where it is from.
    pub from: ScatterFrom,
    /// Smallest difference of 3D AP that is seen in 80 of 100 repetitions, percentage points.
    pub detectable: f64,
}

/// Version of [`PlanReport`].
pub const PLAN_SCHEMA: &str = "lidarshift/study-plan/1";

/// The plan of a study, as `study plan --json` writes it.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct PlanReport {
    /// [`PLAN_SCHEMA`].
    pub schema: String,
    /// Name of the study.
    pub study: String,
    /// What it will be able to see.
    pub planned: Vec<Planned>,
}

impl PlanReport {
    /// Of a study.
    pub fn new(study: &Study, planned: &[Planned]) -> Self {
        PlanReport { schema: PLAN_SCHEMA.into(), study: study.config.name.clone(), planned: planned.to_vec() }
    }
}

/// What a study will be able to see, by network, test set and overlap. The scatter is that of the results of `pilot`, a
/// folder of a study; without one that of the study's own results; without these the stored one.
///
/// # Errors
/// A pilot without results.
pub fn plan(study: &Study, pilot: Option<&Path>) -> Result<Vec<Planned>> {
    let results = match pilot {
        Some(folder) => Some(read_matrix(folder)?),
        None => read_matrix(&study.folder).ok(),
    };
    let powers = results.map_or(Vec::new(), |matrix| matrix.power);
    let config = &study.config;
    let mut planned = Vec::new();
    for network in config.plan().networks {
        for test_set in &config.plan().test_sets {
            let Some(frames) = test_frames(study, config, &test_set.name) else { continue };
            for &overlap in &config.evaluation.matrix.overlaps {
                let (scatter, from) = scatter(&powers, &network.network.name, &test_set.name, overlap);
                let seeds = network.seeds.len();
                planned.push(Planned {
                    network: network.network.title.clone(),
                    test_set: test_set.title.clone(),
                    overlap,
                    seeds,
                    frames,
                    scatter,
                    from,
                    detectable: scatter.detectable(seeds, frames),
                });
            }
        }
    }
    Ok(planned)
}

fn read_matrix(folder: &Path) -> Result<Matrix> {
    let path = folder.join("matrix.json");
    let text = fs_err::read(&path)
        .map_err(|_| refused(format!("{}: there are no results of a study in this folder", path.display())))?;
    serde_json::from_slice(&text).in_part(|| path.display().to_string())
}

/// The largest scatter that is known: of the same network and test set, else of any, else the stored one of the nearest
/// overlap. Scatters of one seed say nothing of seeds; then the stored one stands in.
fn scatter(powers: &[Power], network: &str, test_set: &str, overlap: f64) -> (Scatter, ScatterFrom) {
    let nearest = STORED.iter().min_by(|a, b| (a.0 - overlap).abs().total_cmp(&(b.0 - overlap).abs()));
    let stored = nearest.map_or(STORED[0].1, |(_, scatter)| *scatter);
    let at: Vec<&Power> = powers.iter().filter(|p| p.overlap == overlap).collect();
    let own: Vec<&Power> = at.iter().copied().filter(|p| p.network == network && p.test_set == test_set).collect();
    let known = if own.is_empty() { at } else { own };
    let of_frames = known.iter().map(|p| p.scatter.of_frames).max_by(f64::total_cmp);
    let of_seeds = known.iter().filter(|p| p.seeds > 1).map(|p| p.scatter.of_seeds).max_by(f64::total_cmp);
    match of_frames {
        Some(of_frames) => (Scatter { of_frames, of_seeds: of_seeds.unwrap_or(stored.of_seeds) }, ScatterFrom::Results),
        None => (stored, ScatterFrom::Stored),
    }
}

/// Number of test frames of a data set: of the data if they exist, else as planned.
fn test_frames(study: &Study, config: &StudyConfig, name: &str) -> Option<usize> {
    let dataset = config.datasets.iter().find(|d| d.name == name)?;
    let count = |set: Dataset| Some(set.ids(&config.splits.test).ok()?.len());
    if let Some(n) = open(study, name).ok().and_then(count) {
        return Some(n);
    }
    match &dataset.source {
        Source::Path(_) => None,
        Source::Simulate { config, frames, seed, .. } => {
            Some(match Scenery::find(&study.scenes_config(config), Some(*frames), Some(*seed)).ok()? {
                Scenery::Street(street) => street.frames.test,
                Scenery::Race(race) => race.0.test_frames(),
            })
        }
        Source::Resim { of, .. } | Source::TrueLabels { of } => test_frames(study, config, of),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plan_needs_no_data() {
        let study = Study::open("quick", Some(Path::new("no/such/folder"))).unwrap();
        let planned = plan(&study, None).unwrap();
        assert!(planned.iter().all(|p| p.from == ScatterFrom::Stored && p.detectable > 1.0 && p.frames > 50));
        assert!(plan(&study, Some(Path::new("no/pilot"))).unwrap_err().to_string().contains("no results of a study"));
    }

    #[test]
    fn results_come_before_stored_values() {
        let power = |seeds: usize, of_seeds: f64| Power {
            network: "a".into(),
            test_set: "real".into(),
            train_set: "sim".into(),
            compared_to: "real".into(),
            class: "Car".into(),
            overlap: 0.7,
            seeds,
            frames: 100,
            scatter: Scatter { of_seeds, of_frames: 10.0 },
            detectable: 0.0,
            seen: 0.0,
            interval: None,
        };
        let (found, from) = scatter(&[power(3, 1.5)], "a", "real", 0.7);
        assert_eq!((found.of_seeds, found.of_frames, from), (1.5, 10.0, ScatterFrom::Results));
        let (found, _) = scatter(&[power(1, 0.0)], "b", "real", 0.7);
        assert_eq!(found.of_seeds, STORED[1].1.of_seeds);
        assert_eq!(scatter(&[], "a", "real", 0.6).1, ScatterFrom::Stored);
    }
}
