//! Scans of a spinning sensor alone, against an ideal sensor: residuals of ranges and intensities on flat ground and
//! walls, given the sensor's own table of beams.
//!
//! The ideal side is computed on planes of the ground and of walls that are fitted to each scan. Everything else, and
//! labelled objects, are masked. Each finding is fitted on all scans. Its gain is measured on each scan with a fit of
//! the others.

mod brightness;
mod comb;
mod findings;
mod offsets;
mod planes;
mod rings;
mod scatter;
mod tilt;

use crate::catalogue::Cause;
use crate::diagnosis::{
    Considered, Diagnosis, Finding, FindingGain, FrameRoles, Gain, Minimum, Predicted, SCHEMA, Verdict,
};
use crate::effects::{RowsOf, fill_effects};
use crate::engine::{Options, Outcome, Progress, Stage};
use crate::error::DiagnoseError;
use crate::extended::extended_toml;
use crate::pairing::load;
use crate::search::REPETITIONS;
use data::{Cloud, Dataset, Object};
use planes::Patch;
use rayon::prelude::*;
use rings::RingScan;
use sensor::directions::lasers::Beam;
use sensor::{Rig, Sensor};
use std::collections::BTreeMap;

/// Fewest scans: one is held out in turn.
const FEWEST_SCANS: usize = 3;

/// Largest number of points of all scans that are read. More do not improve findings, and memory stays bounded.
const MOST_POINTS: usize = 30_000_000;

/// The scans with the planes that were found in them.
struct Seen {
    name: String,
    beams: Vec<Beam>,
    scans: Vec<RingScan>,
    ground: Vec<Option<Patch>>,
    walls: Vec<Vec<Patch>>,
}

/// Diagnoses the scans of one spinning sensor at the origin of the clouds, against an ideal one.
///
/// # Errors
/// A rig with another mount, fewer than three scans, clouds that are not in the order of lasers, files that cannot be
/// read.
pub fn diagnose_scans(
    dataset: &Dataset,
    rig: &Rig,
    options: &Options,
    progress: Progress,
) -> Result<Outcome, DiagnoseError> {
    let mount = only_mount(rig)?;
    let ids = dataset.ids_of(options.split.as_deref())?;
    if ids.len() < FEWEST_SCANS {
        return Err(DiagnoseError::Pair(format!(
            "{}: {} scans; at least {FEWEST_SCANS} are wanted, so that gains are measured on scans that were not fitted on",
            dataset.config.root.display(),
            ids.len()
        )));
    }
    progress(Stage::Pairing, 0, ids.len());
    let mut notes = Vec::new();
    let (clouds, objects) = read(dataset, &ids, &mut notes)?;
    let (beams, scans) = rings::rings(&clouds)?;
    drop(clouds);
    let seen = see(mount.name.clone(), beams, scans, &objects, progress);
    notes.push(format!(
        "{} lasers, {} scans, {} flat walls, ground in {} scans; all else is masked. Gains are of each scan with what the others tell",
        seen.beams.len(),
        seen.scans.len(),
        seen.walls.iter().map(Vec::len).sum::<usize>(),
        seen.ground.iter().flatten().count()
    ));
    progress(Stage::Weighing, 0, 1);
    let (found, minimum_detectable, considered) = findings::all(&seen, &mut notes);
    progress(Stage::Weighing, 1, 1);
    let mut diagnosis = report(&seen, found, minimum_detectable, considered, notes);
    let rows = RowsOf {
        deg: seen.beams.iter().rev().map(|b| b.elevation_rad.to_degrees()).collect(),
        heights_m: seen.beams.iter().rev().map(|b| b.height_m).collect(),
    };
    fill_effects(&mut diagnosis.findings, rig, &[rows]);
    // Contrasts of single lasers are differences of intensities, not gains.
    let contrasts = diagnosis.findings.iter_mut().filter(|f| f.cause == Some(Cause::BeamIntensity));
    contrasts.for_each(|f| f.effects.clear());
    let extended = extended_toml(&diagnosis, None);
    Ok(Outcome { diagnosis, corrected: vec![], extended, view: None })
}

/// The one sensor of a rig that stands at the origin of its clouds, unturned.
fn only_mount(rig: &Rig) -> Result<&Sensor, DiagnoseError> {
    match rig.sensors.as_slice() {
        [one] if one.position == [0.0; 3] && [one.yaw_deg, one.pitch_deg, one.roll_deg] == [0.0; 3] => Ok(one),
        _ => Err(DiagnoseError::Pair(
            "scans alone are diagnosed for one sensor at the origin of its clouds without rotation: the rows of several sensors cannot be separated in a fused cloud"
                .into(),
        )),
    }
}

/// Clouds with their ids, and the objects of each.
type Clouds = (Vec<(String, Cloud)>, Vec<Vec<Object>>);

/// Reads scans up to [`MOST_POINTS`]. Points outside of a camera's field of view are kept.
fn read(dataset: &Dataset, ids: &[String], notes: &mut Vec<String>) -> Result<Clouds, DiagnoseError> {
    let mut whole = dataset.clone();
    whole.config.fov_crop = false;
    let (mut clouds, mut objects) = (Vec::new(), Vec::new());
    let mut points = 0;
    for id in ids {
        let (cloud, of_cloud) = load(&whole, id)?;
        points += cloud.len();
        clouds.push((id.clone(), cloud));
        objects.push(of_cloud);
        if points > MOST_POINTS {
            break;
        }
    }
    if clouds.len() < ids.len() {
        notes.push(format!("only the first {} of {} scans were read", clouds.len(), ids.len()));
    }
    Ok((clouds, objects))
}

/// Finds the ground and flat walls of every scan.
fn see(name: String, beams: Vec<Beam>, scans: Vec<RingScan>, objects: &[Vec<Object>], progress: Progress) -> Seen {
    let done = std::sync::atomic::AtomicUsize::new(0);
    let of_scan = |(i, (scan, boxes)): (usize, (&RingScan, &Vec<Object>))| {
        let mut rng = data::stream(0, "diagnose planes", 0, i as u64);
        let ground = planes::ground(scan, &beams, boxes, &mut rng);
        let walls = ground.as_ref().map_or_else(Vec::new, |g| planes::walls(scan, &beams, boxes, &g.plane, &mut rng));
        let finished = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
        progress(Stage::Pairing, finished, scans.len());
        (ground, walls)
    };
    let planes: Vec<(Option<Patch>, Vec<Patch>)> = scans.par_iter().zip(objects).enumerate().map(of_scan).collect();
    let (ground, walls): (Vec<_>, Vec<_>) = planes.into_iter().unzip();
    Seen { name, beams, scans, ground, walls }
}

/// The diagnosis of all findings. Scans alone have no distance of their own: it is the sum of the gains.
fn report(
    seen: &Seen,
    mut findings: Vec<Finding>,
    minimum_detectable: BTreeMap<Cause, Minimum>,
    considered: Vec<Considered>,
    notes: Vec<String>,
) -> Diagnosis {
    findings.sort_by(|a, b| b.gain.nats_per_ray.total_cmp(&a.gain.nats_per_ray));
    let used: Vec<String> = seen.scans.iter().map(|s| s.id.clone()).collect();
    let together: f64 = findings.iter().map(|f| f.gain.nats_per_ray.max(0.0)).sum();
    Diagnosis {
        schema: SCHEMA.into(),
        build: data::build_id().into(),
        verdict: Verdict::of(&findings),
        frames: FrameRoles { select: vec![], estimate: used.clone(), hold_out: used },
        findings,
        minimum_detectable,
        gain: Gain {
            metric: "nats_per_ray".into(),
            before: together,
            // No frame is made anew: there is no simulation.
            after: together,
            predicted: Some(Predicted { before: together, ..Predicted::default() }),
            ..Gain::default()
        },
        detectors: Vec::new(),
        not_identifiable: Vec::new(),
        considered,
        notes,
    }
}

/// Draws of scans with replacement, the same for every finding.
fn draws(scans: usize) -> Vec<Vec<usize>> {
    let mut rng = data::stream(0, "diagnose scans", 0, 0);
    (0..REPETITIONS / 2).map(|_| statistics::draw(scans, &mut rng)).collect()
}

/// 95 % interval of drawn values.
fn interval(mut drawn: Vec<f64>) -> [f64; 2] {
    drawn.retain(|v| v.is_finite());
    statistics::interval_nearest(drawn).unwrap_or_default()
}

/// Gain in nats a return from the nats and returns of each scan, with an interval over draws of scans.
fn gain_of(scans: &[[f64; 2]]) -> FindingGain {
    let mean = |which: &mut dyn Iterator<Item = usize>| {
        let sum = which.fold([0.0; 2], |s, i| [s[0] + scans[i][0], s[1] + scans[i][1]]);
        sum[0] / sum[1].max(1.0)
    };
    let drawn = draws(scans.len()).into_iter().map(|d| mean(&mut d.into_iter())).collect();
    FindingGain { nats_per_ray: mean(&mut (0..scans.len())), ci95: interval(drawn) }
}
