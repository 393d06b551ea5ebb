//! What the geometry is off by, so that other channels can be looked at without it.

use super::suspects::Suspect;
use super::{Sums, fit_all, groups_of, how, split};
use crate::channels::groups::{Grouping, STRIP_RAD, elevation_lever, group_of, place_of, total};
use crate::channels::mean::Column;
use crate::inference::grouped;
use crate::pairing::Ray;
use nalgebra::{Point3, SVector, UnitQuaternion, Vector3};
use sensor::Rig;
use std::collections::BTreeMap;

/// What was found of the geometry, to be taken out before other channels are looked at.
#[derive(Clone, Debug, Default)]
pub struct Displacement {
    /// The scene's turn and shift in the cloud's frame, rad and m.
    pub scene: SVector<f64, 6>,
    /// The same for what single sensors see, about their origins.
    pub sensors: Vec<SVector<f64, 6>>,
    /// Offset of range, m, and share of it.
    pub bias: [f64; 2],
    /// Offsets of groups of rays: which, of range or elevation, by group.
    pub groups: Option<(Grouping, usize, BTreeMap<u32, f64>)>,
}

impl Displacement {
    /// Whether the scene as a whole is turned or moved.
    pub fn moves(&self) -> bool {
        self.scene.norm() > 0.0 || self.sensors.iter().any(|s| s.norm() > 0.0)
    }

    /// Whether rows aim elsewhere than believed.
    pub fn aims(&self) -> bool {
        matches!(self.groups, Some((Grouping::Row, 1, _)))
    }

    /// How far a thing at `point` seen by a sensor is shown from where it is, m.
    pub fn of_point(&self, point: &Vector3<f64>, sensor: usize, origin: &Point3<f64>) -> Vector3<f64> {
        let turned = |p: &SVector<f64, 6>, about: Vector3<f64>| {
            Vector3::new(p[0], p[1], p[2]).cross(&(point - about)) + Vector3::new(p[3], p[4], p[5])
        };
        let to = point - origin.coords;
        let own = self.sensors.get(sensor).map_or_else(Vector3::zeros, |p| turned(p, origin.coords));
        turned(&self.scene, Vector3::zeros()) + own + to.normalize() * (self.bias[0] + self.bias[1] * to.norm())
    }

    /// What is to be taken off the range of a measured ray of a row or strip that measures or aims wrongly, m.
    pub fn of_range(&self, ray: &Ray, turn: &UnitQuaternion<f64>) -> f64 {
        let Some((grouping, column, offsets)) = &self.groups else { return 0.0 };
        let Some(group) = group_of(ray, *grouping) else { return 0.0 };
        let of = |g: usize| offsets.get(&(g as u32)).copied();
        let Some(offset) = of(group) else { return 0.0 };
        if *grouping == Grouping::Azimuth {
            // Strips have no edges: from middle to middle.
            let beside = (f64::from(ray.azimuth_rad) - place_of(group, *grouping).1) / STRIP_RAD;
            let next = if beside < 0.0 { group.checked_sub(1).and_then(of) } else { of(group + 1) };
            return offset + beside.abs().min(0.5) * (next.unwrap_or(offset) - offset);
        }
        if *column == 0 {
            offset
        } else {
            -offset * elevation_lever(ray, turn) / f64::from(ray.cos_incidence.max(0.01))
        }
    }
}

/// Of what was chosen, as the selecting frames tell it.
pub(super) fn displacement(
    rig: &Rig,
    sums: &Sums,
    select: &[usize],
    blocks: &[usize],
    chosen: &[Suspect],
) -> Displacement {
    let mut out = Displacement { sensors: vec![SVector::zeros(); rig.sensors.len()], ..Displacement::default() };
    let (columns, groups) = split(chosen);
    let fitted = fit_all(sums, select, blocks, chosen);
    for (c, theta) in fitted.columns.iter().zip(fitted.theta.iter()).filter(|(c, _)| columns.contains(c)) {
        match sums.columns[*c] {
            Column::Pose(k) => out.scene[k] += theta,
            Column::SensorPose(s, k) => out.sensors[s][k] += theta,
            Column::RangeOffset => out.bias[0] = *theta,
            Column::RangeScale => out.bias[1] = *theta,
            Column::Sweep(_) | Column::Structure(_) => {}
        }
    }
    if let Some((grouping, column)) = groups.first() {
        let frames = groups_of(sums, *grouping);
        let offsets = grouped::offsets(&total(select.iter().map(|&i| &frames[i])), how(*column));
        out.groups = Some((*grouping, *column, offsets));
    }
    out
}
