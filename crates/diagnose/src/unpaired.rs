//! Two data sets that show different streets, seen by the same sensor or by its model.
//!
//! No return has a counterpart. Each side is looked at by itself: returns against the surfaces of their own neighbours,
//! shots of smooth surfaces with and without a return, lone returns, returns at edges. What is compared is how these
//! depend on range, incidence and direction, which the street does not change: cells that both sides have, one by one.
//! The searches are those of pairs.

mod gain;
mod limits;
mod sides;

use crate::catalogue::Channel;
use crate::channels::mask::Shown;
use crate::diagnosis::{Diagnosis, Finding, Gain, Status, Verdict};
use crate::effects::{RowsOf, fill_effects, rows_of};
use crate::engine::{Options, Outcome, Progress, Remake, Stage, refused, report, set_reached};
use crate::error::DiagnoseError;
use crate::extended::{extended_toml, made_from};
use crate::inference::roles::{FEWEST_FRAMES, roles};
use crate::pairing::{FrameAlone, FramePair, kept_of_frame};
use crate::search::returns::{self, Scenes};
use crate::search::{Context, hits, mask, mixed_pixels, noise, quantisation};
use data::Dataset;
use gain::Verification;
use sensor::effects::MadeFrom;
use sensor::{EffectList, Rig};
use sides::{How, Side, as_pairs, edge_m};
use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Ratio of the excess noise on the ground to that on standing surfaces from which on it is not one of the sensor.
const SAME_NOISE: f64 = 1.6;

/// Pairs of frames for the searches of returns, and for those of shots.
type Pairs = (Vec<FramePair>, Vec<FramePair>);

/// Contexts of the searches.
struct Contexts<'a> {
    returns: Context<'a>,
    shots: Context<'a>,
}

/// Both sides as they were recorded.
struct Unpaired<'a> {
    rig: &'a Rig,
    /// Ids of the frames of the diagnosis: those of the measured side.
    ids: Vec<String>,
    /// The simulated side.
    side: Side<'a>,
    /// The measured side.
    measured: Vec<FrameAlone>,
    /// How both sides are looked at.
    recorded: How,
}

impl Unpaired<'_> {
    /// The measured side with a simulated one.
    fn pairs(&self, simulated: Vec<FrameAlone>) -> Pairs {
        as_pairs(&self.ids, [self.measured.clone(), simulated])
    }

    fn contexts<'c>(&'c self, (returns, shots): &'c Pairs) -> Contexts<'c> {
        let context = |frames: &'c [FramePair]| Context {
            rig: self.rig,
            frames,
            roles: roles(frames.len()),
            times: None,
            motion: None,
            to_next: vec![],
        };
        Contexts { returns: context(returns), shots: context(shots) }
    }
}

/// Diagnoses two data sets of different streets. The gain is measured on frames that `remake` makes anew.
///
/// # Errors
/// Data sets without frames, and files that cannot be read.
pub fn diagnose_unpaired(
    measured: &Dataset,
    simulated: &Dataset,
    rig: &Rig,
    options: &Options,
    remake: &dyn Remake,
    progress: Progress,
) -> Result<Outcome, DiagnoseError> {
    progress(Stage::Comparing, 0, 1);
    let ids = |dataset: &Dataset| -> Result<Vec<String>, DiagnoseError> {
        let mut ids = dataset.ids_of(options.split.as_deref())?;
        ids.sort();
        ids.dedup();
        Ok(ids)
    };
    let used: Vec<String> = ids(measured)?.into_iter().filter(|id| !options.leave_out.contains(id)).collect();
    let (mut a, mut b) = (Side::open(measured, rig, used)?, Side::open(simulated, rig, ids(simulated)?)?);
    let mut notes = vec![
        "the sides show different streets: only what each side tells by itself was compared, where both have \
         surfaces at the same range and incidence"
            .to_owned(),
    ];
    let [of_a, of_b] = [a.ids.len(), b.ids.len()];
    let frames = of_a.min(of_b);
    if frames < FEWEST_FRAMES {
        notes.push(format!(
            "{of_a} measured and {of_b} simulated frames can be used; with fewer than {FEWEST_FRAMES} of a side nothing \
             can be found, fitted and tested on different frames"
        ));
        return Ok(Outcome::without_findings(Diagnosis { verdict: Verdict::TooFewFrames, ..refused(notes) }));
    }
    a.keep(frames);
    b.keep(frames);
    if a.ids.len() < of_a.max(of_b) {
        notes.push(format!("{} of {of_a} measured and of {of_b} simulated frames were used", a.ids.len()));
    }
    notes.extend(patterns(&a, &b));
    progress(Stage::Comparing, 1, 1);
    let (unpaired, recorded) = look(rig, a, b, progress)?;
    let contexts = unpaired.contexts(&recorded);
    let (mut diagnosis, rows) = search_all(&unpaired, &contexts, notes, progress)?;
    fill_effects(&mut diagnosis.findings, rig, &rows);
    let made_from = made_from(measured, simulated, rig);
    progress(Stage::Verifying, 0, 1);
    let verification = Verification::new(&unpaired, &contexts);
    let mut extended = verify(&mut diagnosis, &verification, &made_from, remake)?;
    if judge_by_gain(&mut diagnosis.findings) {
        extended = verify(&mut diagnosis, &verification, &made_from, remake)?;
    }
    diagnosis.verdict = Verdict::of(&diagnosis.findings);
    progress(Stage::Verifying, 1, 1);
    Ok(Outcome { diagnosis, corrected: vec![], extended, view: None })
}

/// The text of `extended.toml`; its gain goes into the diagnosis.
fn verify(
    diagnosis: &mut Diagnosis,
    verification: &Verification,
    made_from: &MadeFrom,
    remake: &dyn Remake,
) -> Result<String, DiagnoseError> {
    let extended = extended_toml(diagnosis, Some(made_from));
    let list = EffectList::parse(&extended, Path::new("extended.toml"))?;
    let found = diagnosis.findings.iter().map(|f| f.channel).collect();
    let gain = verification.of(&found, Some(&list).filter(|list| !list.effects.is_empty()), remake)?;
    diagnosis.gain = Gain { predicted: diagnosis.gain.predicted.take(), ..gain };
    set_reached(diagnosis, &BTreeMap::new());
    Ok(extended)
}

/// Notes about scan patterns that differ, and about sensors without rows.
fn patterns(a: &Side, b: &Side) -> Vec<String> {
    let mut notes = Vec::new();
    let both = a.sensors.rig.sensors.iter().zip(a.sensors.patterns.iter().zip(&b.sensors.patterns));
    for (mount, (of_a, of_b)) in both {
        let [rows_a, rows_b] = [of_a, of_b].map(|p| p.rows_rad.len());
        if rows_a.min(rows_b) == 0 {
            notes.push(format!(
                "sensor {}: no rows stand out in its elevations on {}; lost returns are counted along rows, and were not compared",
                mount.name,
                if rows_a == 0 { "the measured side" } else { "the simulated side" }
            ));
        } else if rows_a != rows_b {
            notes.push(format!(
                "sensor {}: {rows_a} rows are seen on the measured side, {rows_b} on the simulated side: is the simulated sensor the same?",
                mount.name
            ));
        }
    }
    notes
}

/// Reads both sides, each frame by itself, and pairs them as they were recorded.
fn look<'a>(
    rig: &'a Rig,
    a: Side<'a>,
    b: Side<'a>,
    progress: Progress,
) -> Result<(Unpaired<'a>, Pairs), DiagnoseError> {
    let n = a.ids.len();
    let finished = AtomicUsize::new(0);
    let done = || progress(Stage::Pairing, finished.fetch_add(1, Ordering::Relaxed) + 1, 3 * n);
    let first = How { step_m: None, edge_m: sensor::directions::EDGE_M, kept: kept_of_frame(n) / 2 };
    // The noise of a few frames says which differences between neighbours are no edges.
    let recorded = How { edge_m: edge_m([&a.some_frames(&first)?, &b.some_frames(&first)?]), ..first };
    let measured = a.frames(&recorded, &done)?;
    let simulated = b.frames(&recorded, &done)?;
    let unpaired = Unpaired { rig, ids: a.ids, side: b, measured, recorded };
    let pairs = unpaired.pairs(simulated);
    Ok((unpaired, pairs))
}

/// All searches, and the elevations of the rows, degrees.
fn search_all(
    unpaired: &Unpaired,
    contexts: &Contexts,
    notes: Vec<String>,
    progress: Progress,
) -> Result<(Diagnosis, Vec<RowsOf>), DiagnoseError> {
    const SEARCHES: usize = 5;
    let finished = |searches: usize| progress(Stage::Weighing, searches, SEARCHES);
    finished(0);
    let (rounding, step_m) = quantisation::search(&contexts.returns, quantisation::Rounded::Ranges);
    let (of_coordinates, _) = quantisation::search(&contexts.returns, quantisation::Rounded::Coordinates);
    finished(1);
    let (hidden, hides) = mask::search(&contexts.returns, Shown::Another);
    finished(2);
    // Without rows there are no shots, and without a loss that could be seen none is said to have been looked for.
    let has_shots = contexts.shots.frames.iter().any(|f| !f.measured.is_empty() && !f.simulated.is_empty());
    let lost = has_shots.then(|| hits::search(&contexts.shots, &hides, false));
    finished(3);
    let odd = returns::search(&contexts.returns, Scenes::Different);
    finished(4);
    // Rounding is no noise: the simulated side is rounded as well.
    let rounded = match step_m {
        Some(_) => Some(unpaired.side.frames(&How { step_m, ..unpaired.recorded }, &|| ())?),
        None => None,
    };
    let pairs = rounded.map(|simulated| unpaired.pairs(simulated));
    let even = pairs.as_ref().map(|pairs| unpaired.contexts(pairs));
    let returns = &even.as_ref().unwrap_or(contexts).returns;
    let (rough, by_surface) = noise::search_by_surface(returns);
    finished(SEARCHES);
    let mixed = mixed_pixels::search(&contexts.returns);
    let results = [Some(rounding), Some(of_coordinates), Some(hidden), lost, Some(odd), Some(mixed), Some(rough)];
    let mut diagnosis = report(&contexts.returns, results.into_iter().flatten().collect(), notes);
    for finding in diagnosis.findings.iter_mut().filter(|f| f.channel == Channel::Roughness) {
        judge_by_surface(finding, by_surface);
    }
    diagnosis.cannot_tell(limits::not_identifiable());
    diagnosis.verdict = Verdict::of(&diagnosis.findings);
    Ok((diagnosis, rows_of(&unpaired.side.sensors)))
}

/// What recording tells noise of the sensor from rough surfaces.
const TELL_NOISE_BY: &str = "a flat wall from a standing sensor, or the same scenes on both sides";

/// Takes the name of noise that is not the same on the ground and on standing surfaces: the sensor does not know on
/// what it measures, and streets differ in how rough they are.
fn judge_by_surface(finding: &mut Finding, [ground, standing]: [Option<noise::SurfaceShare>; 2]) {
    let (Some(ground), Some(standing)) = (ground, standing) else { return };
    let surely_more = |a: noise::SurfaceShare, b: noise::SurfaceShare| a.ci95[0] > SAME_NOISE * b.ci95[1].max(0.0);
    if finding.status != Status::Named || !(surely_more(ground, standing) || surely_more(standing, ground)) {
        return;
    }
    let why = format!(
        ": on the ground it is {:.1} times, on standing surfaces {:.1} times that; the surfaces of one street are \
         rougher",
        ground.ratio.max(0.0),
        standing.ratio.max(0.0)
    );
    finding.becomes_not_identifiable(&why, TELL_NOISE_BY);
}

/// Share of the difference of roughness that has to be gone with noise. Below it the streets differ more than by it.
const MOST_OF_IT: f64 = 0.5;

/// Takes the name of noise with which most of the difference of roughness stays: streets differ by as much. Says
/// whether there was such noise.
fn judge_by_gain(findings: &mut [Finding]) -> bool {
    let rough = findings.iter_mut().filter(|f| f.channel == Channel::Roughness && f.status != Status::NotIdentifiable);
    let mut taken = false;
    for finding in rough.filter(|f| f.reached.is_none_or(|reached| reached < MOST_OF_IT)) {
        let why = ": most of the difference of roughness stays with it; the streets differ by more";
        finding.becomes_not_identifiable(why, TELL_NOISE_BY);
        taken = true;
    }
    taken
}
