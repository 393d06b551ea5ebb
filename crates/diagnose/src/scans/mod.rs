//! Real scans of a spinning sensor by themselves, against an ideal sensor: what the sensor's own table of beams, ground and walls that are
//! flat leave of the measured ranges and intensities.
//!
//! The ideal side is computed where the scene is known: planes of the ground and of walls fitted to each scan. Everything else, and what
//! is labelled, is masked. Each finding is fitted on all scans and its gain measured on each scan with what the others tell.

mod brightness;
mod comb;
mod findings;
mod offsets;
mod planes;
mod rings;
mod scatter;
mod tilt;

use crate::diagnosis::{Diagnosis, FindingGain, FrameRoles, Gain, SCHEMA, Status, Verdict};
use crate::effects::fill_effects;
use crate::engine::{Options, Outcome, Progress, Stage};
use crate::error::DiagnoseError;
use crate::pairing::load;
use crate::search::REPETITIONS;
use data::Dataset;
use planes::Patch;
use rand::RngExt;
use rayon::prelude::*;
use rings::{Beam, RingScan};
use sensor::Rig;

/// Fewer scans do not let one be held out.
const FEWEST_SCANS: usize = 3;

/// Points of all scans that are read at most: enough for every finding, and memory stays bounded.
const MOST_POINTS: usize = 30_000_000;

/// The scans with the planes found in them.
struct Seen {
    name: String,
    beams: Vec<Beam>,
    scans: Vec<RingScan>,
    ground: Vec<Option<Patch>>,
    walls: Vec<Vec<Patch>>,
}

/// Diagnoses the scans of one spinning sensor at the clouds' origin, against an ideal one.
pub fn diagnose_scans(
    dataset: &Dataset,
    rig: &Rig,
    options: &Options,
    progress: Progress,
) -> Result<Outcome, DiagnoseError> {
    let mount = match rig.sensors.as_slice() {
        [one] if one.position == [0.0; 3] && [one.yaw_deg, one.pitch_deg, one.roll_deg] == [0.0; 3] => one,
        _ => {
            return Err(DiagnoseError::Pair(
                "scans alone are diagnosed for one sensor that stands at the origin of its clouds, unturned: rings cannot be told in fused clouds"
                    .into(),
            ));
        }
    };
    let ids = match &options.split {
        Some(split) => dataset.ids(split)?,
        None => dataset.all_ids()?,
    };
    if ids.len() < FEWEST_SCANS {
        return Err(DiagnoseError::Pair(format!(
            "{}: {} scans; at least {FEWEST_SCANS} are wanted, so that gains are measured on scans that were not fitted on",
            dataset.config.root.display(),
            ids.len()
        )));
    }
    // What the camera sees of a scan is not all of it.
    let mut whole = dataset.clone();
    whole.config.fov_crop = false;
    progress(Stage::Pairing, 0, ids.len());
    let mut frames = Vec::new();
    let mut points = 0;
    for id in &ids {
        let frame = load(&whole, id)?;
        points += frame.0.len();
        frames.push(frame);
        if points > MOST_POINTS {
            break;
        }
    }
    let mut notes = Vec::new();
    if frames.len() < ids.len() {
        notes.push(format!("only the first {} of {} scans were read", frames.len(), ids.len()));
    }
    let (clouds, objects): (Vec<_>, Vec<_>) =
        frames.into_iter().zip(&ids).map(|((c, o), id)| ((id.clone(), c), o)).unzip();
    let (beams, scans) = rings::rings(&clouds)?;
    drop(clouds);
    let done = std::sync::atomic::AtomicUsize::new(0);
    let planes: Vec<(Option<Patch>, Vec<Patch>)> = scans
        .par_iter()
        .zip(&objects)
        .enumerate()
        .map(|(i, (scan, boxes))| {
            let mut rng = data::stream(0, "diagnose planes", 0, i as u64);
            let ground = planes::ground(scan, &beams, boxes, &mut rng);
            let walls =
                ground.as_ref().map_or_else(Vec::new, |g| planes::walls(scan, &beams, boxes, &g.plane, &mut rng));
            let finished = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
            progress(Stage::Pairing, finished, scans.len());
            (ground, walls)
        })
        .collect();
    let (ground, walls): (Vec<_>, Vec<_>) = planes.into_iter().unzip();
    let count = walls.iter().map(Vec::len).sum::<usize>();
    notes.push(format!(
        "{} lasers, {} scans, {count} flat walls, ground in {} scans; all else is masked. Gains are of each scan with what the others tell",
        beams.len(),
        scans.len(),
        ground.iter().flatten().count()
    ));
    let seen = Seen { name: mount.name.clone(), beams, scans, ground, walls };
    progress(Stage::Weighing, 0, 1);
    let (mut found, minimum_detectable, considered) = findings::all(&seen, &mut notes);
    progress(Stage::Weighing, 1, 1);
    found.sort_by(|a, b| b.gain.nats_per_ray.total_cmp(&a.gain.nats_per_ray));
    let named = found.iter().filter(|f| f.status == Status::Named).count();
    let verdict = match (found.len(), named) {
        (0, _) => Verdict::NothingFound,
        (all, named) if all == named => Verdict::Explained,
        (_, 0) => Verdict::Unexplained,
        _ => Verdict::PartlyExplained,
    };
    let used: Vec<String> = seen.scans.iter().map(|s| s.id.clone()).collect();
    let together: f64 = found.iter().map(|f| f.gain.nats_per_ray.max(0.0)).sum();
    let rows_deg = seen.beams.iter().rev().map(|b| b.elevation_rad.to_degrees()).collect();
    let mut diagnosis = Diagnosis {
        schema: SCHEMA.into(),
        verdict,
        frames: FrameRoles { select: vec![], estimate: used.clone(), hold_out: used },
        findings: found,
        minimum_detectable,
        gain: Gain {
            metric: "nats_per_ray".into(),
            before: together,
            after: 0.0,
            floor: 0.0,
            closed: None,
            ci95: None,
            channels: Default::default(),
        },
        detectors: Vec::new(),
        considered,
        notes,
    };
    fill_effects(&mut diagnosis.findings, rig, &[rows_deg]);
    Ok(Outcome { diagnosis, corrected: vec![] })
}

/// Draws of scans with replacement, the same for every finding.
fn draws(scans: usize) -> Vec<Vec<usize>> {
    let mut rng = data::stream(0, "diagnose scans", 0, 0);
    (0..REPETITIONS / 2).map(|_| (0..scans).map(|_| rng.random_range(0..scans)).collect()).collect()
}

/// 95 % interval of drawn values.
fn interval(mut drawn: Vec<f64>) -> [f64; 2] {
    drawn.retain(|v| v.is_finite());
    drawn.sort_by(f64::total_cmp);
    let at = |q: f64| drawn.get(((drawn.len().max(1) - 1) as f64 * q).round() as usize).copied().unwrap_or(0.0);
    [at(0.025), at(0.975)]
}

/// Gain in nats a return, of each scan's nats and returns, with an interval over draws of scans.
fn gain_of(scans: &[[f64; 2]]) -> FindingGain {
    let mean = |which: &mut dyn Iterator<Item = usize>| {
        let sum = which.fold([0.0; 2], |s, i| [s[0] + scans[i][0], s[1] + scans[i][1]]);
        sum[0] / sum[1].max(1.0)
    };
    let drawn = draws(scans.len()).into_iter().map(|d| mean(&mut d.into_iter())).collect();
    FindingGain { nats_per_ray: mean(&mut (0..scans.len())), ci95: interval(drawn) }
}
