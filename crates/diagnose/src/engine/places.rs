//! Directions in which findings act.

use super::verification::Places;
use crate::channels::mask::{AZIMUTH_RAD, DirectionCell, ELEVATION_RAD};
use crate::channels::spot::Spot;
use crate::diagnosis::Finding;
use sensor::Rig;
use sensor::effects::{Effect, EgoBodyMask};
use std::collections::BTreeSet;

/// Cells of directions of the findings that act in some directions only, by their number.
pub(super) fn places_of(findings: &[Finding], rig: &Rig) -> Places {
    let of_finding = |(number, f): (usize, &Finding)| Some((number, cells_of(&f.effects, rig)?));
    findings.iter().enumerate().filter_map(of_finding).collect()
}

/// Cells in which the effects of a finding hide or lose returns; `None` where one of them acts elsewhere.
fn cells_of(effects: &[Effect], rig: &Rig) -> Option<BTreeSet<DirectionCell>> {
    let number = |name: &str| rig.find(name).map(|number| number as u8);
    let of_effect = |effect: &Effect| match effect {
        Effect::DirtyWindow(window) => Some(Spot::from(window).cells(number(&window.sensor)?)),
        Effect::EgoBodyMask(mask) if mask.boxes.is_empty() => Some(hidden_by(mask, number(&mask.sensor)?)),
        _ => None,
    };
    let cells: Option<Vec<BTreeSet<DirectionCell>>> = effects.iter().map(of_effect).collect();
    cells.map(|all| all.into_iter().flatten().collect()).filter(|cells: &BTreeSet<_>| !cells.is_empty())
}

/// Cells that a mask hides from a sensor. Its directions are whole cells.
fn hidden_by(mask: &EgoBodyMask, sensor: u8) -> BTreeSet<DirectionCell> {
    let cell = |degrees: f64, width_rad: f64| (degrees.to_radians() / width_rad).round() as i32;
    let of_directions = |&[from, to, low, high, _]: &[f64; 5]| {
        let columns = cell(from, AZIMUTH_RAD)..cell(to, AZIMUTH_RAD);
        let rows = cell(low, ELEVATION_RAD)..cell(high, ELEVATION_RAD);
        columns.flat_map(move |az| rows.clone().map(move |el| (sensor, az, el)))
    };
    mask.directions.iter().flat_map(of_directions).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::mask::neighbours;
    use sensor::effects::{DirtyWindow, RandomDropout};

    #[test]
    fn effects_on_directions_have_a_place_and_others_none() {
        let rig = Rig::single();
        let sensor = rig.sensors[0].name.clone();
        let [from, to] = [-3, 4].map(|k| f64::from(k) * AZIMUTH_RAD.to_degrees());
        let [low, high] = [-2, 1].map(|k| f64::from(k) * ELEVATION_RAD.to_degrees());
        let directions = vec![[from, to, low, high, 1.0]];
        let mask = Effect::EgoBodyMask(EgoBodyMask { sensor: sensor.clone(), directions, ..EgoBodyMask::default() });
        let window = DirtyWindow { sensor, azimuth_deg: 0.0, loss: 0.5, transmission: 0.5, ..DirtyWindow::default() };
        let everywhere = Effect::RandomDropout(RandomDropout::default());
        for elsewhere in [vec![], vec![everywhere.clone()], vec![mask.clone(), everywhere]] {
            assert_eq!(cells_of(&elsewhere, &rig), None);
        }
        let hidden = (-3..4).flat_map(|az| (-2..1).map(move |el| (0, az, el)));
        assert_eq!(cells_of(&[mask], &rig), Some(hidden.collect()));
        let spot = cells_of(&[Effect::DirtyWindow(window)], &rig).unwrap();
        let middle = (0, 0, (-3f64.to_radians() / ELEVATION_RAD).floor() as i32);
        assert!(neighbours(middle).all(|cell| spot.contains(&cell)) && spot.len() < 300, "{}", spot.len());
    }
}
