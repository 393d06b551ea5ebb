//! The whole way from two data sets to a diagnosis.

mod baked_in;
mod curves;
mod known;
mod lacking;
mod measured_gain;
mod notes;
mod places;
mod progress;
mod reached;
mod report;
mod verification;

pub use progress::{Progress, Stage};
pub(crate) use reached::set_reached;
pub(crate) use report::{refused, report};
pub use verification::{Discrepancy, OnClouds, RemadeFrames, Remake, SEEDS, Switch, View, ViewState};
pub(crate) use verification::{Distances, GainFrames, of_channels};

use self::known::Known;
use self::lacking::add_what_is_lacking;
use self::measured_gain::with_gain;
use self::notes::{leave_out_copies, limits, one_speed, without_rows};
use self::places::places_of;
use self::report::corrected;
use self::verification::Verification;
use crate::channels::mask::Shown;
use crate::channels::mean::origins;
use crate::channels::motion;
use crate::diagnosis::{Diagnosis, Gain, Unidentifiable, Verdict};
use crate::effects::{fill_effects, rows_of};
use crate::error::DiagnoseError;
use crate::extended::{extended_toml, made_from};
use crate::inference::roles::{FEWEST_FRAMES, Role, roles};
use crate::pairing::{
    Corrections, FramePair, RangeError, Ray, Recordings, ShownShift, check_identity, common_ids, find_sensors,
    kept_of_frame, pair_all, with_points,
};
use crate::search::geometry::{Displacement, Geometry};
use crate::search::labels::Side;
use crate::search::quantisation::Rounded;
use crate::search::returns::Scenes;
use crate::search::rolling_shutter::{self, Slide};
use crate::search::{self, ChannelResult, Context};
use data::Dataset;
use geometry::Box3;
use nalgebra::{Point3, Vector3};
use sensor::directions::Sensors;
use sensor::effects::MadeFrom;
use sensor::{EffectList, Rig};
use std::collections::BTreeSet;

/// What to diagnose.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// A split of both data sets; all frames without one.
    pub split: Option<String>,
    /// Frames that are not used, such as those on which something else is tested.
    pub leave_out: BTreeSet<String>,
    /// Causes that are in both sides, as the simulated one was made of the measured one.
    pub baked_in: Vec<Unidentifiable>,
}

/// A diagnosis with what follows from it.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// The diagnosis.
    pub diagnosis: Diagnosis,
    /// Corrected boxes of the measured labels, by frame id; empty where the labels are correct. The estimate, and the
    /// boxes with the correction at both ends of its interval (see [`data::write::REPAIRED_ENDINGS`]).
    pub corrected: Vec<(String, [Vec<Box3>; 3])>,
    /// The text of `extended.toml`.
    pub extended: String,
    /// One frame with the findings applied and not; `None` where none of them changes it.
    pub view: Option<View>,
}

impl Outcome {
    /// A diagnosis without findings.
    pub(crate) fn without_findings(diagnosis: Diagnosis) -> Self {
        let extended = extended_toml(&diagnosis, None);
        Outcome { diagnosis, corrected: vec![], extended, view: None }
    }
}

/// Diagnoses a pair of data sets. The gain is measured on frames that are made anew with the effects of the findings,
/// as `lidarshift resim` makes them.
///
/// # Errors
/// Data sets without a common frame, and files that cannot be read.
pub fn diagnose(
    measured: &Dataset,
    simulated: &Dataset,
    rig: &Rig,
    options: &Options,
    progress: Progress,
) -> Result<Outcome, DiagnoseError> {
    diagnose_with(measured, simulated, rig, options, &OnClouds { simulated, rig }, progress)
}

/// The same with frames that `remake` makes anew.
///
/// # Errors
/// Data sets without a common frame, and files that cannot be read.
pub fn diagnose_with(
    measured: &Dataset,
    simulated: &Dataset,
    rig: &Rig,
    options: &Options,
    remake: &dyn Remake,
    progress: Progress,
) -> Result<Outcome, DiagnoseError> {
    let made_from = made_from(measured, simulated, rig);
    let paired = with_pairs(measured, simulated, rig, options, progress, |engine, context, notes| {
        engine.diagnose(context, notes, remake, Extension::Found(&made_from))
    })?;
    Ok(paired.unwrap_or_else(Outcome::without_findings))
}

/// The gain of a list of effects on a pair of data sets: of one that was edited by hand, or made elsewhere. The frames
/// are those that a diagnosis of the pair holds out. The error is the reason for which there is none.
///
/// # Errors
/// Data sets without a common frame, and files that cannot be read.
pub fn verify(
    measured: &Dataset,
    simulated: &Dataset,
    rig: &Rig,
    options: &Options,
    effects: &EffectList,
    remake: &dyn Remake,
    progress: Progress,
) -> Result<Result<Gain, Diagnosis>, DiagnoseError> {
    with_pairs(measured, simulated, rig, options, progress, |engine, context, notes| {
        Ok(engine.diagnose(context, notes, remake, Extension::Given(effects))?.diagnosis.gain)
    })
}

/// The list of effects whose gain is measured.
#[derive(Clone, Copy)]
enum Extension<'a> {
    /// That of the findings; what it is made from.
    Found(&'a MadeFrom),
    /// Another one.
    Given(&'a EffectList),
}

/// Pairs two data sets and hands the pairs to `work`. The error is a diagnosis that says why they cannot be compared.
fn with_pairs<T>(
    measured: &Dataset,
    simulated: &Dataset,
    rig: &Rig,
    options: &Options,
    progress: Progress,
    work: impl FnOnce(&Engine, Context, Vec<String>) -> Result<T, DiagnoseError>,
) -> Result<Result<T, Diagnosis>, DiagnoseError> {
    let (mut ids, mut notes) = common_ids(measured, simulated, options.split.as_deref())?;
    let all = ids.len();
    ids.retain(|id| !options.leave_out.contains(id));
    if ids.len() < all {
        notes.push(format!(
            "{} frames are kept for the test of detectors; the diagnosis does not use them",
            all - ids.len()
        ));
    }
    progress(Stage::Comparing, 0, 2);
    let (ids, empty) = with_points(measured, simulated, ids)?;
    notes.extend(empty);
    let mut recordings = Recordings::new(measured, simulated, rig, ids);
    let sensors = find_sensors(&recordings, rig)?;
    notes.extend(without_rows(&sensors));
    progress(Stage::Comparing, 1, 2);
    let identity = check_identity(&recordings, &sensors)?;
    progress(Stage::Comparing, 2, 2);
    if !identity.identical {
        notes.insert(0, identity.reason);
        return Ok(Err(refused(notes)));
    }
    for id in &identity.strangers {
        notes.push(format!("frame {id}: the two sides do not show the same scene"));
    }
    recordings.retain(|id| identity.strangers.iter().all(|s| s != id));
    let all = recordings.len();
    let done = |finished| progress(Stage::Pairing, finished, all);
    let mut frames = pair_all(&recordings, &sensors, Corrections::default(), kept_of_frame(all), &done)?;
    notes.extend(leave_out_copies(&mut frames));
    if frames.len() < FEWEST_FRAMES {
        notes.push(format!(
            "{} frames can be used; with fewer than {FEWEST_FRAMES} nothing can be found, fitted and tested on different frames",
            frames.len()
        ));
        return Ok(Err(Diagnosis { verdict: Verdict::TooFewFrames, ..refused(notes) }));
    }
    let used: BTreeSet<&str> = frames.iter().map(|f| f.id.as_str()).collect();
    recordings.retain(|id| used.contains(id));
    let context = context(rig, &frames, &mut notes);
    let baked_in = &options.baked_in;
    let engine = Engine { recordings: &recordings, sensors: &sensors, origins: origins(rig), baked_in, progress };
    work(&engine, context, notes).map(Ok)
}

/// What all searches share: roles, times and ego motion of the frames; with notes about what is not known.
fn context<'a>(rig: &'a Rig, frames: &'a [FramePair], notes: &mut Vec<String>) -> Context<'a> {
    let ids: Vec<String> = frames.iter().map(|f| f.id.clone()).collect();
    let rate_hz = rig.sensors.first().map_or(20.0, |s| s.rate_hz);
    let times = motion::times_s(&ids, rate_hz);
    if times.is_none() {
        notes.push("frame ids are no rising numbers: velocities, and what depends on them, are not known".into());
    }
    notes.extend(limits(frames));
    let driven = times.as_deref().map(|t| motion::own_motion(frames, t, &origins(rig)));
    let (motion, to_next) = driven.map_or((None, vec![]), |driven| (Some(driven.at), driven.to_next));
    notes.extend(times.as_deref().and_then(|t| one_speed(frames, t, &to_next)));
    Context { rig, frames, roles: roles(frames.len()), times, motion, to_next }
}

/// Number of searches, for the progress that is shown.
const SEARCHES: usize = 9;

/// Smallest cosine of incidence for roughness where offsets of rows were corrected.
const LEAST_COS: f64 = 0.12;

/// Runs the searches one after the other, on frames that are paired anew where an earlier search found something to
/// correct.
struct Engine<'a> {
    recordings: &'a Recordings<'a>,
    sensors: &'a Sensors,
    origins: Vec<Point3<f64>>,
    baked_in: &'a [Unidentifiable],
    progress: Progress<'a>,
}

impl Engine<'_> {
    /// Pairs all frames anew, in place of others, of which the memory is freed before.
    fn pair(&self, corrections: Corrections, others: Option<Vec<FramePair>>) -> Result<Vec<FramePair>, DiagnoseError> {
        drop(others);
        pair_all(self.recordings, self.sensors, corrections, kept_of_frame(self.recordings.len()), &|_| ())
    }

    fn finished(&self, searches: usize) {
        (self.progress)(Stage::Weighing, searches, SEARCHES);
    }

    /// All searches in turn. Motion distortion is undone before anything else is compared, except for the ranges as
    /// they were measured.
    fn diagnose(
        &self,
        recorded: Context,
        mut notes: Vec<String>,
        remake: &dyn Remake,
        extension: Extension,
    ) -> Result<Outcome, DiagnoseError> {
        let context = recorded.clone();
        self.finished(0);
        let (mut sliding, slide) = self.rolling_shutter(&context)?;
        let (rounding, step_m) = search::quantisation::search(&context, Rounded::Ranges);
        let (of_coordinates, _) = search::quantisation::search(&context, Rounded::Coordinates);
        let mixed = |frame: usize| self.recordings.mixed_per_rad(frame, self.sensors);
        let dual = search::dual_returns::search(&context, mixed)?;
        let mut known = Known { slide, step_m, walk: None, displaced: Displacement::default() };
        let mut standing = known.standing(self, None)?;
        let recorded_still = Context { frames: standing.as_deref().unwrap_or(context.frames), ..context.clone() };
        let (by_brightness, walk) = search::geometry::walk::search(&recorded_still);
        if walk.is_some() {
            known.walk = walk;
            standing = known.standing(self, standing)?;
        }
        let moved_back = Context { frames: standing.as_deref().unwrap_or(context.frames), ..context.clone() };
        self.finished(2);
        let undo = |displaced: &Displacement| {
            let left = displaced.swept().map(|swept| Slide::of_surfaces(&moved_back, swept));
            known.undone(self, displaced, left.as_ref())
        };
        let Geometry { result, displaced, swept } = search::geometry::search(&moved_back, known.slide.as_ref(), &undo)?;
        let changed = swept.is_some_and(|swept| match (&mut known.slide, sliding.found.first_mut()) {
            (Some(slide), Some(found)) => slide.refine(found, swept),
            _ => {
                known.slide = Some(Slide::of_surfaces(&moved_back, swept));
                true
            }
        });
        let standing = if changed { known.standing(self, standing)? } else { standing };
        let context = Context { frames: standing.as_deref().unwrap_or(context.frames), ..context };
        let mut results = vec![sliding, rounding, of_coordinates, dual, by_brightness, result];
        notes.extend(displaced.note_of_frames());
        known.displaced = displaced;
        self.finished(3);
        results.extend(self.single_returns(&context, &known, &mut notes)?);
        self.finished(7);
        results.extend([Side::Labels, Side::Objects].map(|s| search::labels::search(&context, s, &known.displaced)));
        self.finished(SEARCHES);
        let held_out = context.blocks(&context.of(Role::HoldOut));
        search::confounders::drop_confounded(&mut results, &held_out);
        if known.slide.is_none() {
            notes.extend(search::set_aside(&mut results));
        }
        let corrected = corrected(&context, &results);
        let rows = rows_of(self.sensors);
        let mut diagnosis = report(&context, results, notes);
        baked_in::take_names(&mut diagnosis, self.baked_in);
        add_what_is_lacking(&mut diagnosis, rows.iter().any(|rows| !rows.deg.is_empty()));
        fill_effects(&mut diagnosis.findings, context.rig, &rows);
        (self.progress)(Stage::Verifying, 0, 1);
        let found = diagnosis.findings.iter().map(|f| f.channel).collect();
        let verification = Verification::new(self, &recorded, found, places_of(&diagnosis.findings, context.rig));
        let (mut extended, mut view) = (String::new(), None);
        match extension {
            Extension::Given(effects) => diagnosis.gain = verification.of(effects, &remake.with(effects)?)?.gain,
            Extension::Found(from) => (extended, view) = with_gain(&mut diagnosis, &verification, from, remake)?,
        }
        (self.progress)(Stage::Verifying, 1, 1);
        Ok(Outcome { diagnosis, corrected, extended, view })
    }

    /// Motion distortion. Where it is not decided from above, the scene is moved back to see whether it then lies on
    /// the simulation. What other frames do not confirm is not undone: other searches would find it with the opposite
    /// sign.
    fn rolling_shutter(&self, context: &Context) -> Result<(ChannelResult, Option<Slide>), DiagnoseError> {
        let (result, slide) = match rolling_shutter::search(context) {
            rolling_shutter::Search::NotFound(result) => (result, None),
            rolling_shutter::Search::Found(result, slide) => (result, Some(slide)),
            rolling_shutter::Search::Undecided { found, slide, not_found } => {
                let shift: ShownShift = &|frame, p, sensor| slide.shift_m(frame, p, sensor);
                let moved_back = self.pair(Corrections { shift_m: Some(shift), ..Corrections::default() }, None)?;
                let moved_back = Context { frames: &moved_back, ..context.clone() };
                if search::returns::is_explained_by_displacement(context, &moved_back) {
                    (found, Some(slide))
                } else {
                    (not_found, None)
                }
            }
        };
        let confirmed = result.found.iter().all(search::confounders::is_confirmed);
        Ok((result, slide.filter(|_| confirmed)))
    }

    /// Searches of silhouettes, single returns and intensities, on frames with the displacement of the scene undone;
    /// then of noise, with offsets of rows and quantisation corrected as well: they look like noise between
    /// neighbouring rows.
    fn single_returns(
        &self,
        context: &Context,
        known: &Known,
        notes: &mut Vec<String>,
    ) -> Result<Vec<ChannelResult>, DiagnoseError> {
        let displaced = &known.displaced;
        let shift = |frame: usize, p: &Vector3<f64>, sensor: usize| {
            known.slide_m(frame, p, sensor) + displaced.of_point(p, (frame, sensor), &self.origins[sensor])
        };
        let moves = known.slide.is_some() || displaced.moves();
        let walk = |ray: &Ray| known.walk_m(ray);
        let walks: Option<RangeError> = if known.walk.is_some() { Some(&walk) } else { None };
        let moved = Corrections { shift_m: moves.then_some(&shift), range_m: walks, step_m: known.coarse_m() };
        let upright = if displaced.moves() { Some(self.pair(moved, None)?) } else { None };
        let seen = Context { frames: upright.as_deref().unwrap_or(context.frames), ..context.clone() };
        let (packets, arrived) = search::packets::search(&seen, self.sensors);
        let seen = Context { frames: arrived.as_deref().unwrap_or(seen.frames), ..seen };
        let displaced_as_a_whole = known.shown() != Shown::InPlace;
        let (of_bright, without_halos) = search::bright_targets::search(&seen, displaced_as_a_whole);
        let seen = Context { frames: without_halos.as_deref().unwrap_or(seen.frames), ..seen };
        let (hidden, mask) = search::mask::search(&seen, known.shown());
        let hits = search::hits::search(&seen, &mask, displaced_as_a_whole);
        let mut results = vec![packets, hidden, hits];
        results.extend(of_bright);
        self.finished(5);
        results.extend([search::returns::search(&seen, Scenes::Same), search::mixed_pixels::search(&seen)]);
        results.push(search::intensity::search(&seen, notes));
        drop((arrived, without_halos));
        self.finished(6);
        let uneven = displaced.is_uneven();
        let in_row = |frame: usize, p: &Vector3<f64>, sensor: usize| known.shift_m(self, displaced, (frame, sensor), p);
        let off = |ray: &Ray| known.walk_m(ray) + displaced.of_strip(ray);
        let even = Corrections {
            shift_m: if displaced.rows.is_empty() { moved.shift_m } else { Some(&in_row) },
            range_m: if displaced.has_strips() { Some(&off) } else { walks },
            step_m: known.step_m,
        };
        let even = if uneven || known.step_m != known.coarse_m() { Some(self.pair(even, upright)?) } else { upright };
        let context = Context { frames: even.as_deref().unwrap_or(context.frames), ..context.clone() };
        let vibration = search::geometry::vibration::search(&context);
        // In frames that tilt within a scan the ground is elsewhere than it is.
        let ground = vibration.found.is_empty().then(|| search::geometry::ground::search(&context));
        results.extend([vibration].into_iter().chain(ground));
        results.push(search::noise::search(&context, if uneven { LEAST_COS } else { 0.0 }));
        Ok(results)
    }
}
