//! Notes: limits of the data, and what was left out.

use crate::channels::motion::OwnMotion;
use crate::channels::{labels, returns};
use crate::pairing::{FramePair, ObjectPair, Ray};
use sensor::directions::Sensors;
use std::collections::BTreeSet;

/// Notes about sensors whose rows are not known.
pub(super) fn without_rows(sensors: &Sensors) -> Vec<String> {
    let all = sensors.rig.sensors.iter().zip(&sensors.patterns);
    let note =
        |name: &str| format!("sensor {name}: no rows stand out in its elevations; what depends on rows cannot be told");
    all.filter(|(_, pattern)| pattern.rows_rad.is_empty()).map(|(mount, _)| note(&mount.name)).collect()
}

/// Keeps the first of frames that are identical to the bit; each scene counts once. Returns a note where there are
/// some.
pub(super) fn leave_out_copies(frames: &mut Vec<FramePair>) -> Option<String> {
    let before = frames.len();
    let mut seen = BTreeSet::new();
    let sum = |rays: &[Ray]| rays.iter().map(|r| u64::from(r.range_m.to_bits())).fold(0u64, u64::wrapping_add);
    frames.retain(|f| {
        let counts = [f.measured.len(), f.simulated.len()];
        counts == [0; 2] || seen.insert((counts, sum(&f.measured), sum(&f.simulated)))
    });
    let copies = before - frames.len();
    (copies > 0).then(|| format!("{copies} frames are copies of others: each scene counts once"))
}

/// Standard deviation of the objects' speeds, m/s, below which a late clock cannot be distinguished from a constant
/// offset.
const ONE_SPEED_M_S: f64 = 0.5;

/// A note where all objects move at one speed.
pub(super) fn one_speed(frames: &[FramePair], times: &[f64], to_next: &[Option<OwnMotion>]) -> Option<String> {
    let shifts = labels::object_shifts(frames, Some(times), to_next);
    let speeds: Vec<f64> = shifts.iter().filter_map(|s| Some(s.seen_velocity_m_s?[0])).collect();
    let n = speeds.len() as f64;
    let mean = speeds.iter().sum::<f64>() / n.max(1.0);
    let spread = (speeds.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n.max(1.0)).sqrt();
    (!speeds.is_empty() && spread < ONE_SPEED_M_S).then(|| {
        format!("all labelled objects move at one speed against the sensors (within {spread:.1} m/s): a late clock cannot be told from a constant offset of labels")
    })
}

/// Notes about limits of the data: labels that do not match, and a simulation with a shorter range.
pub(super) fn limits(frames: &[FramePair]) -> Vec<String> {
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
