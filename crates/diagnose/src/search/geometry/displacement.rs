//! The displacement that the search of geometry found, to be undone before other channels are searched.

use super::hypotheses::Hypothesis;
use super::sums::{Sums, group_fit, split};
use crate::channels::groups::{Group, Grouping, STRIP_RAD, elevation_lever, group_of};
use crate::channels::mean::Column;
use crate::pairing::Ray;
use nalgebra::{Point3, SVector, UnitQuaternion, Vector3};
use sensor::Rig;
use std::collections::BTreeMap;

/// Displacements of the measured side against the simulation.
#[derive(Clone, Debug, Default)]
pub struct Displacement {
    /// Turn and shift of the scene in the cloud's frame, rad and m.
    pub scene: SVector<f64, 6>,
    /// The same for what single sensors see, about their own origins.
    pub sensors: Vec<SVector<f64, 6>>,
    /// Constant range offset, m, and relative range error.
    pub bias: [f64; 2],
    /// Offsets of groups of rays: the grouping, the column (0: range, m; 1: elevation, rad), and the offset of each
    /// group.
    pub groups: Vec<(Grouping, usize, BTreeMap<Group, f64>)>,
}

impl Displacement {
    /// Whether the scene as a whole is turned or shifted.
    pub fn moves(&self) -> bool {
        self.scene.norm() > 0.0 || self.sensors.iter().any(|s| s.norm() > 0.0)
    }

    /// Whether rows have elevation offsets.
    pub fn rows_aim_elsewhere(&self) -> bool {
        self.groups.iter().any(|(grouping, column, _)| (*grouping, *column) == (Grouping::Row, 1))
    }

    /// Displacement of a point seen by a sensor, m.
    pub fn of_point(&self, point: &Vector3<f64>, sensor: usize, origin: &Point3<f64>) -> Vector3<f64> {
        let turned = |p: &SVector<f64, 6>, about: Vector3<f64>| {
            Vector3::new(p[0], p[1], p[2]).cross(&(point - about)) + Vector3::new(p[3], p[4], p[5])
        };
        let to = point - origin.coords;
        let own = self.sensors.get(sensor).map_or_else(Vector3::zeros, |p| turned(p, origin.coords));
        turned(&self.scene, Vector3::zeros()) + own + to.normalize() * (self.bias[0] + self.bias[1] * to.norm())
    }

    /// Correction to subtract from the range of a measured ray, for the offset of its row or strip, m.
    pub fn of_range(&self, ray: &Ray, turn: &UnitQuaternion<f64>) -> f64 {
        self.groups.iter().map(|groups| of_groups(groups, ray, turn)).sum()
    }
}

/// Offset of the range of a ray by those of groups, m.
fn of_groups(
    (grouping, column, offsets): &(Grouping, usize, BTreeMap<Group, f64>),
    ray: &Ray,
    turn: &UnitQuaternion<f64>,
) -> f64 {
    let Some(group) = group_of(ray, *grouping) else { return 0.0 };
    let of = |g: Group| offsets.get(&g).copied();
    let Some(offset) = of(group) else { return 0.0 };
    if *grouping == Grouping::Azimuth {
        // Offsets vary continuously: interpolated between the middles of strips.
        let beside = (f64::from(ray.azimuth_rad) - group.place(*grouping)) / STRIP_RAD;
        let next = if beside < 0.0 { group.previous().and_then(of) } else { of(group.next()) };
        return offset + beside.abs().min(0.5) * (next.unwrap_or(offset) - offset);
    }
    if *column == 0 { offset } else { -offset * elevation_lever(ray, turn) / f64::from(ray.cos_incidence.max(0.01)) }
}

/// The displacement by the chosen hypotheses, fitted on the selecting frames.
pub(super) fn displacement(
    rig: &Rig,
    sums: &Sums,
    select: &[usize],
    blocks: &[usize],
    chosen: &[Hypothesis],
) -> Displacement {
    let mut out = Displacement { sensors: vec![SVector::zeros(); rig.sensors.len()], ..Displacement::default() };
    let (columns, groups) = split(chosen);
    let fitted = sums.fit_all(select, blocks, chosen);
    for (c, theta) in fitted.columns.iter().zip(fitted.theta.iter()).filter(|(c, _)| columns.contains(c)) {
        match sums.columns[*c] {
            Column::Pose(k) => out.scene[k] += theta,
            Column::SensorPose(s, k) => out.sensors[s][k] += theta,
            Column::RangeOffset => out.bias[0] = *theta,
            Column::RangeScale => out.bias[1] = *theta,
            Column::Sweep(_) | Column::Structure(_) => {}
        }
    }
    for (grouping, column) in groups {
        let offsets = sums.offsets(select, grouping, group_fit(column), chosen);
        out.groups.push((grouping, column, offsets));
    }
    out
}
