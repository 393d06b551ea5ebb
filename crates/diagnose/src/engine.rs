//! The whole way from two data sets to a diagnosis.

use crate::channels::mask::Shown;
use crate::channels::returns;
use crate::diagnosis::{Diagnosis, Finding, FrameRoles, Gain, SCHEMA, Status, Verdict};
use crate::effects::fill_effects;
use crate::error::DiagnoseError;
use crate::inference::roles::{FEWEST_FRAMES, Role, roles};
use crate::pairing::{
    FramePair, Mending, ObjectPair, Ray, ShownShift, check_identity, common_ids, find_sensors, pair_all, with_points,
};
use crate::search::labels::Side;
use crate::search::shutter::Sliding;
use crate::search::{self, ChannelResult, Context, REPETITIONS, by_block, draw_blocks, mean_interval};
use data::Dataset;
use geometry::Box3;
use nalgebra::Vector3;
use sensor::Rig;
use std::collections::BTreeMap;

/// What to look at.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// A split of both data sets; all frames without one.
    pub split: Option<String>,
}

/// What is being done, for whoever shows progress.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Looking for scan patterns and whether the scenes are the same.
    Comparing,
    /// Pairing frames.
    Pairing,
    /// Weighing causes.
    Weighing,
}

/// Told what is being done, how much of it is finished and how much there is.
pub type Progress<'a> = &'a (dyn Fn(Stage, usize, usize) + Sync);

/// A diagnosis with what follows from it.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// What is said.
    pub diagnosis: Diagnosis,
    /// Boxes of the measured labels moved to where they belong, by frame id; empty where the labels are not at fault.
    pub corrected: Vec<(String, Vec<Box3>)>,
}

/// Diagnoses a pair of data sets.
pub fn diagnose(
    measured: &Dataset,
    simulated: &Dataset,
    rig: &Rig,
    options: &Options,
    progress: Progress,
) -> Result<Outcome, DiagnoseError> {
    let (ids, mut notes) = common_ids(measured, simulated, options.split.as_deref())?;
    progress(Stage::Comparing, 0, 2);
    let (ids, empty) = with_points(measured, simulated, ids)?;
    notes.extend(empty);
    let sensors = find_sensors(measured, simulated, &ids, rig)?;
    for (mount, pattern) in rig.sensors.iter().zip(&sensors.patterns) {
        if pattern.rows_rad.is_empty() {
            notes.push(format!(
                "sensor {}: no rows stand out in its elevations; what depends on rows cannot be told",
                mount.name
            ));
        }
    }
    progress(Stage::Comparing, 1, 2);
    let identity = check_identity(measured, simulated, &ids, &sensors)?;
    progress(Stage::Comparing, 2, 2);
    if !identity.identical {
        notes.insert(0, identity.reason);
        return Ok(Outcome { diagnosis: refused(notes), corrected: vec![] });
    }
    for id in &identity.strangers {
        notes.push(format!("frame {id}: the two sides do not show the same scene"));
    }
    let ids: Vec<String> = ids.into_iter().filter(|id| !identity.strangers.contains(id)).collect();
    let mut frames = pair_all(measured, simulated, &ids, &sensors, Mending::default(), &|done| {
        progress(Stage::Pairing, done, ids.len())
    })?;
    let before = frames.len();
    leave_out_copies(&mut frames);
    if frames.len() < before {
        notes.push(format!("{} frames are copies of others: each scene counts once", before - frames.len()));
    }
    if frames.len() < FEWEST_FRAMES {
        notes.push(format!(
            "{} frames can be used; with fewer than {FEWEST_FRAMES} nothing can be found, fitted and tested on different frames",
            frames.len()
        ));
        let diagnosis = Diagnosis { verdict: Verdict::NothingFound, ..refused(notes) };
        return Ok(Outcome { diagnosis, corrected: vec![] });
    }
    let used: Vec<String> = frames.iter().map(|f| f.id.clone()).collect();
    let rate_hz = rig.sensors.first().map_or(20.0, |s| s.rate_hz);
    let times = crate::channels::labels::times_s(&used, rate_hz);
    if times.is_none() {
        notes.push("frame ids are no rising numbers: velocities, and what depends on them, are not known".into());
    }
    notes.extend(limits(&frames));
    notes.extend(times.as_deref().and_then(|t| one_speed(&frames, t)));
    let origins = crate::channels::mean::origins(rig);
    let motion = times.as_deref().map(|t| crate::channels::motion::own_motion(&frames, t, &origins));
    let mut context = Context { rig, frames: &frames, roles: roles(frames.len()), times, motion };
    let mut results: Vec<ChannelResult> = Vec::new();
    let mut keep = |channel, result| results.push(ChannelResult { channel, ..result });
    progress(Stage::Weighing, 0, SEARCHES);
    let again = |mending: Mending| pair_all(measured, simulated, &used, &sensors, mending, &|_| ());
    // What slides over a scan is moved back before anything else is looked at, but for the ranges as they were measured.
    let (sliding, slide) = match search::shutter::search(&context) {
        Sliding::No(result) => (result, None),
        Sliding::Yes(result, slide) => (result, Some(slide)),
        Sliding::Perhaps(result, slide, none) => {
            let shift: ShownShift = &|frame, p, sensor| slide.shift_m(frame, p, sensor);
            let moved_back = again(Mending { shift_m: Some(shift), ..Mending::default() })?;
            let moved_back = Context { frames: &moved_back, ..context.clone() };
            if search::returns::comes_to_lie(&context, &moved_back) { (result, Some(slide)) } else { (none, None) }
        }
    };
    keep("slide", sliding);
    let (rounding, step_m) = search::quantisation::search(&context);
    keep("ranges", rounding);
    let slid = |frame: usize, p: &Vector3<f64>, sensor: usize| match &slide {
        Some(slide) => slide.shift_m(frame, p, sensor),
        None => Vector3::zeros(),
    };
    // Coarse steps put level ground off by a whole row's width: the simulated side is rounded alike.
    let coarse_m = step_m.filter(|step| *step > COARSE_M);
    let standing = match (&slide, coarse_m) {
        (None, None) => None,
        _ => {
            let shift: ShownShift = &slid;
            Some(again(Mending { shift_m: slide.as_ref().map(|_| shift), step_m: coarse_m, ..Mending::default() })?)
        }
    };
    let frames = standing.as_deref().unwrap_or(&frames);
    context.frames = frames;
    progress(Stage::Weighing, 2, SEARCHES);
    let (geometry, displaced) = search::geometry::search(&context);
    keep("residuals", geometry);
    progress(Stage::Weighing, 3, SEARCHES);
    // What stands elsewhere is moved back before silhouettes and single returns are looked at.
    let shift = |frame: usize, p: &Vector3<f64>, sensor: usize| {
        slid(frame, p, sensor) + displaced.of_point(p, sensor, &origins[sensor])
    };
    let moves = slide.is_some() || displaced.moves();
    let moved = Mending { shift_m: moves.then_some(&shift), step_m: coarse_m, ..Mending::default() };
    let upright = if displaced.moves() { Some(again(moved)?) } else { None };
    context.frames = upright.as_deref().unwrap_or(frames);
    let elsewhere = slide.is_some() || displaced.moves() || displaced.aims();
    let shown = match (slide.is_some() || displaced.aims(), displaced.moves()) {
        (true, _) => Shown::Elsewhere,
        (false, true) => Shown::MovedBack,
        (false, false) => Shown::InPlace,
    };
    let (hidden, mask) = search::mask::search(&context, shown);
    keep("hits", hidden);
    keep("hits", search::hits::search(&context, &mask, elsewhere));
    progress(Stage::Weighing, 5, SEARCHES);
    keep("returns", search::returns::search(&context));
    progress(Stage::Weighing, 6, SEARCHES);
    // Rows that measure or aim wrongly look like noise between neighbouring rows: they are mended first.
    let turns: Vec<_> = rig.sensors.iter().map(|s| s.pose().rotation).collect();
    let off = |ray: &Ray| displaced.of_range(ray, &turns[ray.sensor as usize]);
    let uneven = displaced.groups.is_some();
    let even = match (uneven, step_m) {
        (false, None) => None,
        // Rounding steps are no noise: the simulated side is rounded alike.
        _ => Some(again(Mending { range_m: uneven.then_some(&off), step_m, ..moved })?),
    };
    if let Some(even) = &even {
        context.frames = even;
    }
    let least_cos = if uneven { 0.12 } else { 0.0 };
    keep("roughness", search::noise::search(&context, least_cos));
    context.frames = frames;
    progress(Stage::Weighing, 7, SEARCHES);
    keep("labels", search::labels::search(&context, Side::Labels, &displaced));
    keep("objects", search::labels::search(&context, Side::Objects, &displaced));
    progress(Stage::Weighing, SEARCHES, SEARCHES);
    search::leftovers::without_leftovers(&mut results, context.returns(&context.of(Role::HoldOut)));
    if let Some(note) = search::set_aside(&mut results) {
        notes.push(note);
    }
    let corrected = corrected(&context, &results);
    // From the lowest row; empty where none stand out.
    let degrees = |rows: &Vec<f32>| rows.iter().map(|r| f64::from(*r).to_degrees()).collect();
    let rows_deg: Vec<Vec<f64>> = sensors.patterns.iter().map(|p| degrees(&p.rows_rad)).collect();
    let mut diagnosis = write_up(&context, results, notes);
    fill_effects(&mut diagnosis.findings, rig, &rows_deg);
    Ok(Outcome { diagnosis, corrected })
}

/// Number of searches, for the progress that is shown.
const SEARCHES: usize = 9;

/// Larger steps of the ranges matter to where surfaces lie, m.
const COARSE_M: f64 = 0.02;

/// Keeps the first of frames that show the same to the bit: they say nothing twice.
fn leave_out_copies(frames: &mut Vec<FramePair>) {
    let mut seen = std::collections::BTreeSet::new();
    let sum = |rays: &[Ray]| rays.iter().map(|r| u64::from(r.range_m.to_bits())).fold(0u64, u64::wrapping_add);
    frames.retain(|f| {
        let counts = [f.measured.len(), f.simulated.len()];
        counts == [0; 2] || seen.insert((counts, sum(&f.measured), sum(&f.simulated)))
    });
}

/// Speeds that differ by less do not tell a late clock from a constant offset, m/s.
const ONE_SPEED_M_S: f64 = 0.5;

/// Says so where all objects move alike.
fn one_speed(frames: &[FramePair], times: &[f64]) -> Option<String> {
    let shifts = crate::channels::labels::object_shifts(frames, Some(times));
    let speeds: Vec<f64> = shifts.iter().filter_map(|s| Some(s.seen_velocity_m_s?[0])).collect();
    let n = speeds.len() as f64;
    let mean = speeds.iter().sum::<f64>() / n.max(1.0);
    let spread = (speeds.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n.max(1.0)).sqrt();
    (!speeds.is_empty() && spread < ONE_SPEED_M_S).then(|| {
        format!("all labelled objects move at one speed against the sensors (within {spread:.1} m/s): a late clock cannot be told from a constant offset of labels")
    })
}

/// What the pairs themselves do not let be judged: labels that do not meet, and a simulation that ends earlier.
fn limits(frames: &[FramePair]) -> Vec<String> {
    let mut notes = Vec::new();
    let count = |f: fn(&ObjectPair) -> bool| frames.iter().flat_map(|p| &p.objects).filter(|o| f(o)).count();
    let [both, simulated, measured] = [
        count(|o| o.simulated.is_some() && o.measured.is_some()),
        count(|o| o.simulated.is_some()),
        count(|o| o.measured.is_some()),
    ];
    if simulated.min(measured) > 10 && both * 5 < simulated.min(measured) {
        notes.push(format!(
            "of {measured} measured and {simulated} simulated labels only {both} lie within 4 m of each other: are they written in the same frame (label_frame, calib)?"
        ));
    }
    let end = returns::end_m(frames);
    let all: usize = frames.iter().map(|f| f.measured.len()).sum();
    let beyond = frames.iter().flat_map(|f| &f.measured).filter(|r| r.own_range_m() > 1.05 * end).count();
    if beyond * 200 > all {
        notes.push(format!(
            "{:.1} % of the measured returns lie beyond {end:.0} m, where the simulation ends: they were not looked at",
            100.0 * beyond as f64 / all as f64
        ));
    }
    notes
}

/// Measured boxes after all repairs; nothing where there is none.
fn corrected(context: &Context, results: &[ChannelResult]) -> Vec<(String, Vec<Box3>)> {
    let repairs: Vec<_> = results.iter().flat_map(|r| &r.repairs).collect();
    if repairs.is_empty() {
        return vec![];
    }
    let boxes = |(f, frame): (usize, &FramePair)| {
        let moved = frame.objects.iter().enumerate().filter_map(|(k, o)| {
            let mut b = o.measured?;
            for r in repairs.iter().filter(|r| (r.frame, r.object) == (f, k)) {
                (0..3).for_each(|axis| b.center[axis] += r.shift_m[axis]);
            }
            Some(b)
        });
        (frame.id.clone(), moved.collect())
    };
    context.frames.iter().enumerate().map(boxes).collect()
}

/// A diagnosis that says nothing but its notes.
fn refused(notes: Vec<String>) -> Diagnosis {
    Diagnosis {
        schema: SCHEMA.into(),
        verdict: Verdict::NotScenarioIdentical,
        frames: FrameRoles::default(),
        findings: vec![],
        minimum_detectable: Default::default(),
        gain: Gain {
            metric: "nats_per_ray".into(),
            before: 0.0,
            after: 0.0,
            floor: 0.0,
            closed: None,
            ci95: None,
            channels: BTreeMap::new(),
        },
        detectors: Vec::new(),
        considered: vec![],
        notes,
    }
}

/// Puts the results of all channels together.
fn write_up(context: &Context, results: Vec<ChannelResult>, notes: Vec<String>) -> Diagnosis {
    let hold_out = context.of(Role::HoldOut);
    let blocks = context.blocks(&hold_out);
    let returns = context.returns(&hold_out).max(1.0);
    let mut findings: Vec<Finding> = Vec::new();
    let mut considered = Vec::new();
    let mut minimum_detectable = BTreeMap::new();
    let mut distance = vec![[0.0; 3]; hold_out.len()];
    let mut channels = BTreeMap::<String, [f64; 3]>::new();
    for result in results {
        let of_channel = channels.entry(result.channel.into()).or_default();
        for [before, gained, best] in &result.distance {
            let left = [*before, before - gained, before - gained.max(*best)];
            (0..3).for_each(|k| of_channel[k] += left[k] / returns);
        }
        considered.extend(result.considered);
        minimum_detectable.extend(result.minimum);
        for (sum, d) in distance.iter_mut().zip(&result.distance) {
            (0..3).for_each(|k| sum[k] += d[k]);
        }
        for f in result.found {
            let named = f.status == Status::Named;
            let gain = mean_interval(&f.held_out_gains, &blocks, returns);
            // One cause seen in two channels is one finding.
            let same = findings
                .iter_mut()
                .find(|g: &&mut Finding| named && g.cause.as_deref() == f.causes.first().map(String::as_str));
            if let Some(same) = same {
                same.gain.nats_per_ray += gain.nats_per_ray;
                (0..2).for_each(|k| same.gain.ci95[k] += gain.ci95[k]);
                for (name, p) in f.parameters {
                    same.parameters.entry(name).or_insert(p);
                }
                continue;
            }
            findings.push(Finding {
                status: f.status,
                cause: named.then(|| f.causes[0].clone()),
                candidates: (f.status == Status::Ambiguous).then(|| f.causes.clone()),
                family: f.family.into(),
                parameters: f.parameters.into_iter().collect(),
                confidence: f.confidence,
                channel: f.channel.into(),
                covariate: f.covariate,
                gain,
                says: f.says,
                separate_by: f.separate_by,
                curve: f.curve,
                effects: vec![],
            });
        }
    }
    findings.sort_by(|a, b| b.gain.nats_per_ray.total_cmp(&a.gain.nats_per_ray));
    let named = findings.iter().filter(|f| f.status == Status::Named).count();
    let verdict = match (findings.len(), named) {
        (0, _) => Verdict::NothingFound,
        (all, named) if all == named => Verdict::Explained,
        (_, 0) => Verdict::Unexplained,
        _ => Verdict::PartlyExplained,
    };
    let ids = |role| context.of(role).into_iter().map(|i| context.frames[i].id.clone()).collect();
    Diagnosis {
        schema: SCHEMA.into(),
        verdict,
        frames: FrameRoles { select: ids(Role::Select), estimate: ids(Role::Estimate), hold_out: ids(Role::HoldOut) },
        gain: Gain { channels, ..gain(&distance, &blocks, returns, findings.is_empty()) },
        findings,
        minimum_detectable,
        detectors: Vec::new(),
        considered,
        notes,
    }
}

/// Distances of the held-out frames together, with the interval of what is closed. `sums` holds of every frame its distance, what the findings
/// gain, and what tables without any form would gain.
fn gain(sums: &[[f64; 3]], blocks: &[usize], returns: f64, nothing: bool) -> Gain {
    let total = |which: &[usize]| {
        which.iter().fold([0.0; 3], |s, &i| [s[0] + sums[i][0], s[1] + sums[i][1], s[2] + sums[i][2]])
    };
    let closed =
        |[_, gained, table]: [f64; 3]| (gained.max(table) > 0.0 && !nothing).then(|| gained / gained.max(table));
    let all = total(&(0..sums.len()).collect::<Vec<_>>());
    let members = by_block(blocks);
    let mut rng = data::stream(0, "diagnose closed", 0, 0);
    let mut drawn: Vec<f64> =
        (0..REPETITIONS).filter_map(|_| closed(total(&draw_blocks(&members, &mut rng)))).collect();
    drawn.sort_by(f64::total_cmp);
    let at = |q: f64| drawn.get(((drawn.len() as f64 - 1.0) * q).round() as usize).copied();
    let gained = if nothing { 0.0 } else { all[1] };
    let least = gained.max(if nothing { 0.0 } else { all[2] });
    let before = all[0].max(least);
    Gain {
        metric: "nats_per_ray".into(),
        before: before / returns,
        after: (before - gained) / returns,
        floor: (before - least) / returns,
        closed: closed(all),
        ci95: closed(all).and_then(|_| Some([at(0.025)?, at(0.975)?])),
        channels: BTreeMap::new(),
    }
}
