//! Two data sets of the same scenes, return by return.

mod boxes;
mod frame;
mod gaps;
mod identical;
mod matching;
mod pattern;
mod ray;
mod scan;
mod sight;
mod surface;

pub use boxes::{BoxShift, SurfacePoint, fit_shift};
pub use frame::{FramePair, Mending, ObjectPair, Sensors, ShownShift, company_m, pair_frame};
pub use gaps::{GAP_M, gap_margin_m};
pub use identical::{Identity, check_identity, met_squarely};
pub use matching::match_directions;
pub use pattern::ScanPattern;
pub use ray::{Lies, Ray, Surface};
pub use scan::{DirectionIndex, SensorScan, Steps, split_by_sensor};
pub use surface::{LocalSurface, fit_surface};

use crate::error::DiagnoseError;
use data::{Cloud, Dataset, Object};
use rand::RngExt;
use rayon::prelude::*;
use sensor::Rig;
use std::collections::BTreeSet;
use std::io::Read;
use std::path::Path;

/// Returns kept of each side over all frames: enough for every finding, and memory stays bounded.
const KEPT: usize = 3_000_000;

/// Frames looked at for the scan patterns.
const PATTERN_FRAMES: usize = 10;

/// Whether a cloud's file holds no point: no byte, or a PCD that says so.
fn has_no_point(path: &Path) -> Result<bool, DiagnoseError> {
    let mut head = Vec::new();
    fs_err::File::open(path)?.take(2000).read_to_end(&mut head)?;
    let pcd = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("pcd"));
    let says_so = |line: &str| line.split_whitespace().eq(["POINTS", "0"]);
    Ok(head.is_empty() || pcd && String::from_utf8_lossy(&head).lines().any(says_so))
}

/// Those of the frames of which both sides have points, and what is to be said of the others.
pub fn with_points(
    measured: &Dataset,
    simulated: &Dataset,
    ids: Vec<String>,
) -> Result<(Vec<String>, Vec<String>), DiagnoseError> {
    let (mut kept, mut notes) = (Vec::new(), Vec::new());
    for id in ids {
        let empty = [("measured", measured), ("simulated", simulated)]
            .into_iter()
            .map(|(name, side)| Ok((name, has_no_point(&side.cloud_path(&id))?)))
            .collect::<Result<Vec<_>, DiagnoseError>>()?;
        match empty.iter().find(|e| e.1) {
            Some((name, _)) => notes.push(format!("frame {id}: the {name} cloud has no point; left out")),
            None => kept.push(id),
        }
    }
    // A side without a point is said once.
    const LISTED: usize = 8;
    if notes.len() > LISTED {
        let more = notes.len() - LISTED;
        notes.truncate(LISTED);
        notes.push(format!("and {more} more frames without a point on one side"));
    }
    Ok((kept, notes))
}

/// Cloud and objects of a frame.
pub(crate) fn load(dataset: &Dataset, id: &str) -> Result<(Cloud, Vec<Object>), DiagnoseError> {
    let cloud = dataset.load_cloud(id)?;
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
    rig: &Rig,
) -> Result<Sensors, DiagnoseError> {
    let step = ids.len().div_ceil(PATTERN_FRAMES).max(1);
    let some: Vec<&String> = ids.iter().step_by(step).collect();
    let scans = some
        .par_iter()
        .flat_map_iter(|id| [measured, simulated].map(|d| load(d, id).map(|(cloud, _)| split_by_sensor(&cloud, rig))));
    let scans: Vec<Vec<SensorScan>> = in_order(scans)?;
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
    mending: Mending,
    done: &(dyn Fn(usize) + Sync),
) -> Result<Vec<FramePair>, DiagnoseError> {
    let kept = (KEPT / ids.len().max(1)).max(500);
    let finished = std::sync::atomic::AtomicUsize::new(0);
    in_order(ids.par_iter().enumerate().map(|(i, id)| {
        let (a, b) = (load(measured, id)?, load(simulated, id)?);
        let mut frame = pair_frame((i, id), (&a.0, &a.1), (&b.0, &b.1), sensors, mending);
        for (k, rays) in [&mut frame.measured, &mut frame.simulated].into_iter().enumerate() {
            thin(rays, kept, i as u64, k as u64);
        }
        done(finished.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1);
        Ok(frame)
    }))
}

/// Results in order: all are there before the first damaged one is named, whatever the threads.
fn in_order<T: Send>(results: impl ParallelIterator<Item = Result<T, DiagnoseError>>) -> Result<Vec<T>, DiagnoseError> {
    results.collect::<Vec<_>>().into_iter().collect()
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
