//! Two data sets of the same scenes, return by return.

mod boxes;
mod frame;
mod identical;
mod matching;
mod pattern;
mod ray;
mod scan;
mod surface;

pub use boxes::{BoxShift, SurfacePoint, fit_shift};
pub use frame::{FramePair, ObjectPair, RangeCorrection, Sensors, pair_frame};
pub use identical::{Identity, check_identity};
pub use matching::match_directions;
pub use pattern::ScanPattern;
pub use ray::{Lies, Ray, Surface};
pub use scan::{DirectionIndex, SensorScan, Steps, split_by_sensor};
pub use surface::{LocalSurface, fit_surface};

use crate::error::DiagnoseError;
use crate::rig::SensorRig;
use data::{Cloud, Dataset, Object};
use rand::RngExt;
use rayon::prelude::*;
use std::collections::BTreeSet;

/// Both data sets, paired.
#[derive(Debug)]
pub struct Pairs {
    /// Sensors.
    pub rig: SensorRig,
    /// Their scan patterns.
    pub patterns: Vec<ScanPattern>,
    /// Frames in the order of their ids.
    pub frames: Vec<FramePair>,
    /// What could not be paired, in words.
    pub notes: Vec<String>,
}

/// Returns kept of each side over all frames: enough for every finding, and memory stays bounded.
const KEPT: usize = 3_000_000;

/// Frames looked at for the scan patterns.
const PATTERN_FRAMES: usize = 10;

/// Cloud and objects of a frame; a file without a single point is an empty cloud.
pub(crate) fn load(dataset: &Dataset, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError> {
    let path = dataset.cloud_path(id);
    let empty = fs_err::metadata(&path)?.len() == 0;
    let cloud = if empty { Cloud::new(dataset.config.points.channels()) } else { dataset.load_cloud(id)? };
    let lines = if dataset.has_labels() { dataset.labels(id)? } else { Vec::new() };
    Ok((cloud, dataset.objects(id, &lines)?))
}

/// Ids that both sides have, in order, and what is to be said of the others.
pub fn common_ids(
    measured: &Dataset,
    simulated: &Dataset,
    split: Option<&str>,
) -> Result<(Vec<String>, Vec<String>), DiagnoseError> {
    let ids = |d: &Dataset| match split {
        Some(split) => d.ids(split),
        None => d.all_ids(),
    };
    let (a, b) = (ids(measured)?, ids(simulated)?);
    let in_b: BTreeSet<&String> = b.iter().collect();
    let mut common: Vec<String> = a.iter().filter(|id| in_b.contains(id)).cloned().collect();
    common.sort();
    common.dedup();
    if common.is_empty() {
        let show = |ids: &[String]| ids.first().cloned().unwrap_or_default();
        return Err(DiagnoseError::Pair(format!(
            "no frame id is in both data sets: {} has {} frames ({}, ...), {} has {} ({}, ...)",
            measured.config.root.display(),
            a.len(),
            show(&a),
            simulated.config.root.display(),
            b.len(),
            show(&b),
        )));
    }
    let mut notes = Vec::new();
    for (name, ids) in [("measured", &a), ("simulated", &b)] {
        let alone = ids.iter().collect::<BTreeSet<_>>().len() - common.len();
        if alone > 0 {
            notes.push(format!("{alone} frames are only in the {name} data set and were left out"));
        }
    }
    Ok((common, notes))
}

/// Scan patterns from some frames of both sides.
pub fn find_sensors(
    measured: &Dataset,
    simulated: &Dataset,
    ids: &[String],
    rig: &SensorRig,
) -> Result<Sensors, DiagnoseError> {
    let step = ids.len().div_ceil(PATTERN_FRAMES).max(1);
    let some: Vec<&String> = ids.iter().step_by(step).collect();
    let scans: Vec<Vec<SensorScan>> = some
        .par_iter()
        .flat_map_iter(|id| [measured, simulated].map(|d| load(d, id).map(|(cloud, _)| split_by_sensor(&cloud, rig))))
        .collect::<Result<_, _>>()?;
    let patterns = (0..rig.sensors.len())
        .map(|k| ScanPattern::of_scans(&scans.iter().map(|s| &s[k]).collect::<Vec<_>>()))
        .collect();
    Ok(Sensors { rig: rig.clone(), patterns, edge_m: 0.12 })
}

/// Pairs all frames. `done` is told the number of frames finished so far.
pub fn pair_all(
    measured: &Dataset,
    simulated: &Dataset,
    ids: &[String],
    sensors: &Sensors,
    correction: Option<RangeCorrection>,
    done: &(dyn Fn(usize) + Sync),
) -> Result<(Vec<FramePair>, Vec<String>), DiagnoseError> {
    let kept = (KEPT / ids.len()).max(500);
    let finished = std::sync::atomic::AtomicUsize::new(0);
    let frames: Vec<(FramePair, [usize; 2])> = ids
        .par_iter()
        .enumerate()
        .map(|(i, id)| {
            let (a, b) = (load(measured, id)?, load(simulated, id)?);
            let counts = [a.0.len(), b.0.len()];
            let mut frame = pair_frame(id, (&a.0, &a.1), (&b.0, &b.1), sensors, correction);
            for (k, rays) in [&mut frame.measured, &mut frame.simulated].into_iter().enumerate() {
                thin(rays, kept, i as u64, k as u64);
            }
            done(finished.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1);
            Ok((frame, counts))
        })
        .collect::<Result<_, DiagnoseError>>()?;
    let mut notes = Vec::new();
    let mut used = Vec::new();
    for (frame, counts) in frames {
        if counts.contains(&0) {
            let side = if counts[0] == 0 { "measured" } else { "simulated" };
            notes.push(format!("frame {}: the {side} cloud has no point; left out", frame.id));
        } else {
            used.push(frame);
        }
    }
    Ok((used, notes))
}

/// Keeps about `kept` of the rays, by chance.
fn thin(rays: &mut Vec<Ray>, kept: usize, frame: u64, side: u64) {
    if rays.len() > kept {
        let share = kept as f64 / rays.len() as f64;
        let mut rng = data::stream(0, "diagnose thin", side, frame);
        rays.retain(|_| rng.random::<f64>() < share);
    }
    rays.shrink_to_fit();
}
