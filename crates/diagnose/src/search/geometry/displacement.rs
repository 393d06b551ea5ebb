//! The displacement that the search of geometry found, to be undone before other channels are searched.

use super::hypotheses::{Hypothesis, is_sweep};
use super::sums::{Sums, group_fit, split};
use crate::channels::groups::{Group, Grouping, Undone, group_of};
use crate::channels::mean::Column;
use crate::channels::moments::{COURSES, Moment};
use crate::pairing::Ray;
use nalgebra::{Isometry3, Point3, SVector, Vector3};
use sensor::Rig;
#[cfg(doc)]
use sensor::Sensor;
use sensor::directions::Sensors;
use std::collections::BTreeMap;

/// Displacements of the measured side against the simulation.
#[derive(Clone, Debug, Default)]
pub struct Displacement {
    /// Turn and shift of the scene in the cloud's frame, rad and m.
    pub scene: SVector<f64, 6>,
    /// The same for what single sensors see, about their own origins.
    pub sensors: Vec<SVector<f64, 6>>,
    /// The same for single frames, as each sensor sees them, about the origin of the cloud; empty where frames lie as
    /// all do. See [`wandering`](super::wandering::wandering).
    pub frames: Vec<Vec<SVector<f64, 6>>>,
    /// Constant range offset, m, and relative range error.
    pub bias: [f64; 2],
    /// Range offsets that grow over the recording, m at its end: see [`Moment::course`].
    pub drift: [f64; COURSES],
    /// Pitch of the scene that grows with the square of the speed, rad at 10 m/s.
    pub lean_rad: f64,
    /// Moments of the frames; empty where nothing depends on them.
    pub moments: Vec<Moment>,
    /// Offsets of rows, of the range, m, and of the elevation, rad.
    pub rows: Undone,
    /// Range offsets of strips of azimuth, and of steps of range, m.
    pub strips: [BTreeMap<Group, f64>; 2],
    /// Displacement over a scan: along x and y, m, and about z, rad.
    pub shear: [f64; 3],
    /// Duration of a scan, s.
    pub scan_s: f64,
    /// How uneven it is, s.
    pub uneven_s: f64,
}

/// What surfaces show of a displacement over a scan: estimates with their standard errors.
#[derive(Clone, Copy, Debug)]
pub enum Swept {
    /// Duration of a scan, s, where the motion is known, and how unevenly it turns, s (see [`Sensor::uneven_phase`]).
    Duration([[f64; 2]; 2]),
    /// Displacement of what stands still: along x and y, m, and about z, rad.
    Shear([[f64; 2]; 3]),
}

impl Displacement {
    /// Whether the scene as a whole is turned or shifted.
    pub fn moves(&self) -> bool {
        self.lean_rad != 0.0
            || !self.frames.is_empty()
            || self.scene.norm() > 0.0
            || self.sensors.iter().any(|s| s.norm() > 0.0)
    }

    /// A note about frames that lie elsewhere than the others.
    pub fn note_of_frames(&self) -> Option<String> {
        let poses = || self.frames.iter().flatten();
        let rms = |of: fn(&SVector<f64, 6>) -> f64| {
            let squares: Vec<f64> = poses().map(|pose| of(pose).powi(2)).collect();
            (squares.iter().sum::<f64>() / squares.len() as f64).sqrt()
        };
        let [turn_deg, shift_m] =
            [rms(|p| p.fixed_rows::<3>(0).norm()).to_degrees(), rms(|p| p.fixed_rows::<3>(3).norm())];
        (!self.frames.is_empty()).then(|| {
            format!(
                "the measured frames are turned by {turn_deg:.2} degrees and shifted by {:.0} cm (root mean square) \
                 against the simulated ones, each by another pose error; other differences are searched with these undone",
                100.0 * shift_m
            )
        })
    }

    /// Whether rows have elevation offsets.
    pub fn rows_aim_elsewhere(&self) -> bool {
        self.rows.values().any(|[_, elevation_rad]| *elevation_rad != 0.0)
    }

    /// The displacement over a scan.
    pub fn swept(&self) -> Option<Swept> {
        if self.scan_s != 0.0 {
            return Some(Swept::Duration([self.scan_s, self.uneven_s].map(|by| [by, 0.0])));
        }
        (self.shear != [0.0; 3]).then(|| Swept::Shear(self.shear.map(|by| [by, 0.0])))
    }

    /// Whether ranges have offsets by row or by azimuth.
    pub fn is_uneven(&self) -> bool {
        !self.rows.is_empty() || self.has_strips()
    }

    /// Whether ranges have offsets by azimuth or by range.
    pub fn has_strips(&self) -> bool {
        self.strips.iter().any(|offsets| !offsets.is_empty())
    }

    /// The displacement by one of the columns.
    pub(super) fn of_column(&self, column: Column) -> f64 {
        match column {
            Column::Pose(k) => self.scene[k],
            Column::SensorPose(s, k) => self.sensors.get(s).map_or(0.0, |pose| pose[k]),
            Column::RangeOffset => self.bias[0],
            Column::RangeScale => self.bias[1],
            Column::Drift(k) => self.drift[k],
            Column::Lean => self.lean_rad,
            Column::Sweep(k) => self.shear[k],
            Column::Scan => self.scan_s,
            Column::Uneven => self.uneven_s,
            Column::Structure(_) => 0.0,
        }
    }

    /// Displacement of a point seen by a sensor in a frame, m, without that of its row.
    pub fn of_point(
        &self,
        point: &Vector3<f64>,
        (frame, sensor): (usize, usize),
        origin: &Point3<f64>,
    ) -> Vector3<f64> {
        let turned = |p: &SVector<f64, 6>, about: Vector3<f64>| {
            Vector3::new(p[0], p[1], p[2]).cross(&(point - about)) + Vector3::new(p[3], p[4], p[5])
        };
        let to = point - origin.coords;
        let own = self.sensors.get(sensor).map_or_else(Vector3::zeros, |p| turned(p, origin.coords));
        let moment = self.moments.get(frame).copied().unwrap_or_default();
        let drift_m: f64 = self.drift.iter().enumerate().map(|(k, by)| by * moment.course(k)).sum();
        let mut scene = self.scene;
        scene[1] += self.lean_rad * moment.lean();
        let bias_m = self.bias[0] + self.bias[1] * to.norm() + drift_m;
        if let Some(of_frame) = self.frames.get(frame).and_then(|sensors| sensors.get(sensor)) {
            scene += of_frame;
        }
        turned(&scene, Vector3::zeros()) + own + to.normalize() * bias_m
    }

    /// Displacement of a point by the offsets of the row that it was shot by, m; `pose` is that of the sensor.
    pub fn of_row(
        &self,
        point: &Vector3<f64>,
        sensor: usize,
        sensors: &Sensors,
        pose: &Isometry3<f64>,
    ) -> Vector3<f64> {
        let seen = pose.inverse_transform_point(&Point3::from(*point)).coords;
        let (range_m, flat_m) = (seen.norm(), seen.xy().norm());
        let elevation_rad = seen.z.atan2(flat_m);
        let group = Group { sensor: sensor as u8, index: sensors.row(sensor, elevation_rad as f32, range_m as f32) };
        let Some([offset_m, offset_rad]) = self.rows.get(&group) else { return Vector3::zeros() };
        // The shot was sent higher and came back over another length.
        let (sin, cos) = (elevation_rad + offset_rad).sin_cos();
        let flat = seen.xy() / flat_m.max(1e-9) * cos;
        let shot = Vector3::new(flat.x, flat.y, sin) * (range_m - offset_m);
        pose.rotation * (seen - shot)
    }

    /// Correction to subtract from the range of a measured ray, for the offsets of its strip of azimuth and of its step
    /// of range, m.
    pub fn of_strip(&self, ray: &Ray) -> f64 {
        let groupings = [Grouping::Azimuth, Grouping::Range];
        groupings.into_iter().zip(&self.strips).map(|(grouping, offsets)| of_group(ray, grouping, offsets)).sum()
    }
}

/// The offset of a ray's group. Offsets vary continuously: they are interpolated between the middles of groups.
fn of_group(ray: &Ray, grouping: Grouping, offsets: &BTreeMap<Group, f64>) -> f64 {
    let of = |g: Group| offsets.get(&g).copied();
    let Some(group) = group_of(ray, grouping) else { return 0.0 };
    let Some(offset) = of(group) else { return 0.0 };
    let beside = (grouping.place_of(ray) - group.place(grouping)) / grouping.width();
    let next = if beside < 0.0 { group.previous().and_then(of) } else { of(group.next()) };
    offset + beside.abs().min(0.5) * (next.unwrap_or(offset) - offset)
}

/// The displacement by the chosen hypotheses, fitted on the selecting frames.
pub(super) fn displacement(
    rig: &Rig,
    sums: &Sums,
    select: &[usize],
    blocks: &[usize],
    chosen: &[Hypothesis],
) -> Displacement {
    let mut out = Displacement {
        sensors: vec![SVector::zeros(); rig.sensors.len()],
        moments: sums.moments.of_frames.clone(),
        ..Displacement::default()
    };
    let (columns, groups) = split(chosen);
    let fitted = sums.fit_all(select, blocks, chosen);
    let undone = |c: &usize| columns.contains(c) || is_sweep(sums.columns[*c]);
    for (c, theta) in fitted.columns.iter().zip(fitted.theta.iter()).filter(|(c, _)| undone(c)) {
        match sums.columns[*c] {
            Column::Pose(k) => out.scene[k] += theta,
            Column::SensorPose(s, k) => out.sensors[s][k] += theta,
            Column::RangeOffset => out.bias[0] = *theta,
            Column::RangeScale => out.bias[1] = *theta,
            Column::Drift(k) => out.drift[k] = *theta,
            Column::Lean => out.lean_rad = *theta,
            Column::Sweep(k) => out.shear[k] = *theta,
            Column::Scan => out.scan_s = *theta,
            Column::Uneven => out.uneven_s = *theta,
            Column::Structure(_) => {}
        }
    }
    for (grouping, column) in groups {
        let offsets = sums.offsets(select, grouping, group_fit(column), chosen);
        match grouping {
            Grouping::Row => offsets.into_iter().for_each(|(g, o)| out.rows.entry(g).or_default()[column] = o),
            Grouping::Azimuth => out.strips[0] = offsets,
            Grouping::Range => out.strips[1] = offsets,
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use sensor::directions::{ScanPattern, Steps};

    #[test]
    fn a_point_without_the_displacement_of_its_row_is_where_the_shot_met_it() {
        let pattern = ScanPattern {
            rows_rad: vec![-0.1, 0.0],
            steps: Steps { azimuth_rad: 0.01, elevation_rad: 0.1 },
            ..ScanPattern::default()
        };
        let sensors = Sensors { rig: Rig::single(), patterns: vec![pattern], edge_m: 0.1 };
        let pose = Isometry3::translation(1.0, 2.0, 3.0);
        let rows = Undone::from([(Group { sensor: 0, index: 0 }, [0.05, 0.02])]);
        let displaced = Displacement { rows, ..Displacement::default() };
        let shot = |elevation_rad: f64, range_m: f64| {
            let (sin, cos) = elevation_rad.sin_cos();
            pose.translation.vector + Vector3::new(0.6 * cos, 0.8 * cos, sin) * range_m
        };
        let reported = shot(-0.1, 20.05);
        let undone = reported - displaced.of_row(&reported, 0, &sensors, &pose);
        assert!((undone - shot(-0.08, 20.0)).norm() < 1e-9, "{undone}");
        let other = shot(0.0, 20.0);
        assert_eq!(displaced.of_row(&other, 0, &sensors, &pose), Vector3::zeros());
    }

    #[test]
    fn a_frame_has_its_own_pose_beside_that_of_all() {
        let shift = |by: f64| SVector::from([0.0, 0.0, 0.0, by, 0.0, 0.0]);
        let turn = SVector::from([0.0, 0.0, 0.01, 0.0, 0.0, 0.0]);
        let frames = vec![vec![shift(0.2)], vec![turn]];
        let displaced = Displacement { scene: shift(0.1), frames, ..Displacement::default() };
        let of = |frame: usize| displaced.of_point(&Vector3::new(20.0, 0.0, 0.0), (frame, 0), &Point3::origin());
        assert!((of(0) - Vector3::new(0.3, 0.0, 0.0)).norm() < 1e-12);
        assert!((of(1) - Vector3::new(0.1, 0.2, 0.0)).norm() < 1e-12);
        assert!(
            displaced.moves() && displaced.note_of_frames().unwrap().contains("by 0.41 degrees and shifted by 14 cm")
        );
        assert_eq!(Displacement { frames: vec![], ..displaced }.note_of_frames(), None);
    }
}
