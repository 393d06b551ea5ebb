//! One frame of both sides, return by return.

use super::boxes::{BoxShift, SurfacePoint, fit_shift};
use super::matching::Matched;
use super::of_sensor::{SensorPair, Use};
use super::ray::{Ray, Surface};
use super::recordings::SideFrame;
use super::row_edges::RowEdges;
use data::Object;
use geometry::Box3;
use nalgebra::{Point3, Vector3};
use sensor::assignment::Assignment;
use sensor::directions::{SensorScan, Sensors, in_or_beside};
use std::borrow::Cow;

/// One frame of both sides.
#[derive(Clone, Debug)]
pub struct FramePair {
    /// Its id.
    pub id: String,
    /// Returns of the measured side.
    pub measured: Vec<Ray>,
    /// Returns of the simulated side.
    pub simulated: Vec<Ray>,
    /// Measured returns without a counterpart. Those of a pattern that does not repeat are where the simulation has no
    /// return near, and have the surface that their own side has around them.
    pub only_measured: Vec<Ray>,
    /// Edges in the rows of the measured and of the simulated side, as they were recorded.
    pub edges: [RowEdges; 2],
    /// Shots around whose direction the simulation has no return. For sensors without known rows: by how many returns
    /// it has fewer. Of all shots, the share that is compared of the returns.
    pub open: f64,
    /// Second returns of the shots of the measured and of the simulated side, which the rays do not hold; the share
    /// that is compared of the returns.
    pub second: [f64; 2],
    /// Objects, those of the simulation first.
    pub objects: Vec<ObjectPair>,
}

impl FramePair {
    /// Returns of the simulated and of the measured side as losses count them.
    pub fn for_losses(&self) -> [Vec<&Ray>; 2] {
        let matched = self.measured.iter().filter(|r| r.matched);
        [self.simulated.iter().collect(), matched.chain(&self.only_measured).collect()]
    }
}

/// Those of some returns that have no counterpart.
pub(crate) fn alone(rays: &[Ray]) -> Vec<Ray> {
    rays.iter().filter(|r| !r.matched).copied().collect()
}

#[cfg(test)]
impl FramePair {
    /// Of the returns of both sides alone.
    pub fn of_rays(id: String, measured: Vec<Ray>, simulated: Vec<Ray>) -> FramePair {
        FramePair {
            only_measured: alone(&measured),
            id,
            measured,
            simulated,
            edges: Default::default(),
            open: 0.0,
            second: [0.0; 2],
            objects: vec![],
        }
    }
}

/// A labelled object of the two sides.
#[derive(Clone, Debug)]
pub struct ObjectPair {
    /// The simulation's label; `None` where only the measured side has it.
    pub simulated: Option<Box3>,
    /// The measured side's label.
    pub measured: Option<Box3>,
    /// Shift of the measured returns against the simulated ones.
    pub shift: Option<BoxShift>,
    /// Returns of the measured and the simulated side in the box.
    pub points: [usize; 2],
}

/// Error of a measured range, m.
pub type RangeError<'a> = &'a (dyn Fn(&Ray) -> f64 + Sync);

/// Displacement of a point of a frame and a sensor, by their numbers, in the cloud's frame, m.
pub type ShownShift<'a> = &'a (dyn Fn(usize, &Vector3<f64>, usize) -> Vector3<f64> + Sync);

/// Known differences between the sides that are corrected before frames are paired.
#[derive(Clone, Copy, Default)]
pub struct Corrections<'a> {
    /// Correction to subtract from the range of a measured ray, m.
    pub range_m: Option<RangeError<'a>>,
    /// Displacement of measured points that is undone.
    pub shift_m: Option<ShownShift<'a>>,
    /// Step to which simulated ranges are rounded as the measured ones are, m.
    pub step_m: Option<f64>,
}

/// Both sides of a frame as they were recorded.
pub struct RecordedFrame<'a> {
    /// Its number.
    pub number: usize,
    /// Its id.
    pub id: &'a str,
    /// Measured side.
    pub measured: &'a SideFrame,
    /// Simulated side.
    pub simulated: &'a SideFrame,
    /// Which returns have a counterpart, by sensor.
    pub matched: &'a [Matched],
    /// Edges in the rows of both sides.
    pub edges: &'a [RowEdges; 2],
}

/// Pairs a frame, return by return. About `kept` of the returns of the side with more are compared, chosen at random,
/// and the same share of the other's: their numbers are compared as well. All of them say what lies around these, and
/// what the objects of the frame are.
pub fn pair_frame(recorded: &RecordedFrame, sensors: &Sensors, corrections: Corrections, kept: usize) -> FramePair {
    let mut objects = pair_labels(&recorded.measured.objects, &recorded.simulated.objects);
    let boxes: Vec<Box3> = objects.iter().filter_map(|o| o.simulated).collect();
    let mut measured = moved_back(recorded, sensors, corrections.shift_m);
    let simulated = rounded(&recorded.simulated.scans, corrections.step_m);
    // A return that is moved out of the field of view of its sensor has nothing to be compared with.
    let views = corrections.shift_m.map(|_| Assignment::new(&sensors.rig));
    let seen = |sensor: usize, scan: &SensorScan, i: usize| {
        views.as_ref().is_none_or(|views| {
            let mount = &sensors.rig.sensors[sensor];
            let at = views.of_point(mount.pose() * scan.point(i)).filter(|at| at.sensor == sensor);
            let pattern = &sensors.patterns[sensor];
            at.is_some_and(|at| mount.sees(at.spherical[0], 0.0) && pattern.reaches(at.spherical[1]))
        })
    };
    let returns = [&measured[..], &simulated[..]].map(|scans| scans.iter().map(SensorScan::len).sum::<usize>());
    let share = (kept as f64 / returns[0].max(returns[1]).max(1) as f64).min(1.0);
    let uses = [
        uses(&measured, seen, share, [recorded.number as u64, 0]),
        uses(&simulated, |_, _, _| true, share, [recorded.number as u64, 1]),
    ];
    let (mut rays, mut shots_open): ([Vec<(Ray, Use)>; 2], f64) = Default::default();
    let mut only_measured = Vec::new();
    for (sensor, scan) in measured.iter_mut().enumerate() {
        let pair = SensorPair {
            sensors,
            sensor,
            sent: &recorded.measured.scans[sensor],
            simulated: &simulated[sensor],
            matched: &recorded.matched[sensor],
            boxes: &boxes,
        };
        let compared = pair.compare(scan, corrections.range_m, [&uses[0][sensor], &uses[1][sensor]]);
        rays.iter_mut().zip(compared.rays).for_each(|(all, own)| all.extend(own));
        only_measured.extend(compared.only_measured);
        shots_open += compared.open;
    }
    fit_objects(&mut objects, &rays, sensors);
    let compared = |side: Vec<(Ray, Use)>| {
        let mut kept: Vec<Ray> = side.into_iter().filter(|(_, r#use)| *r#use == Use::Compared).map(|r| r.0).collect();
        kept.shrink_to_fit();
        kept
    };
    let [measured, simulated_rays] = rays.map(compared);
    FramePair {
        id: recorded.id.into(),
        measured,
        simulated: simulated_rays,
        only_measured,
        edges: *recorded.edges,
        open: share * shots_open,
        second: [recorded.measured, recorded.simulated].map(|side| share * side.second as f64),
        objects,
    }
}

/// Uses of the returns of a side, by sensor: of those that are `seen`, a share is drawn. `stream` is the number of the
/// frame and that of the side.
fn uses(
    scans: &[SensorScan],
    seen: impl Fn(usize, &SensorScan, usize) -> bool,
    share: f64,
    stream: [u64; 2],
) -> Vec<Vec<Use>> {
    let mut keeps = super::keeps(share, stream);
    let mut of_return = |sensor: usize, scan: &SensorScan, i: usize| match seen(sensor, scan, i) {
        false => Use::Neighbour,
        true if keeps() => Use::Compared,
        true => Use::AtObject,
    };
    let scans = scans.iter().enumerate();
    scans.map(|(sensor, scan)| (0..scan.len()).map(|i| of_return(sensor, scan, i)).collect()).collect()
}

/// Measured scans with a displacement undone.
fn moved_back(recorded: &RecordedFrame, sensors: &Sensors, shift_m: Option<ShownShift>) -> Vec<SensorScan> {
    let mut scans = recorded.measured.scans.clone();
    if let Some(shift_m) = shift_m {
        for (sensor, scan) in scans.iter_mut().enumerate() {
            let pose = sensors.rig.sensors[sensor].pose();
            scan.move_points(|p| {
                let at = pose * p;
                pose.inverse() * (at - shift_m(recorded.number, &at.coords, sensor))
            });
        }
    }
    scans
}

/// Simulated scans with ranges rounded to a step.
fn rounded(scans: &[SensorScan], step_m: Option<f64>) -> Cow<'_, [SensorScan]> {
    let Some(step) = step_m else { return Cow::Borrowed(scans) };
    let mut scans = scans.to_vec();
    scans.iter_mut().for_each(|scan| round_ranges(scan, step));
    Cow::Owned(scans)
}

/// Rounds the ranges of a scan to a step, m.
pub(crate) fn round_ranges(scan: &mut SensorScan, step_m: f64) {
    scan.range_m.iter_mut().for_each(|r| *r = ((f64::from(*r) / step_m).round() * step_m).max(0.05) as f32);
}

/// Distance from which on labels are not of the same object, m.
const SAME_OBJECT_M: f64 = 4.0;

/// Labels of the simulation in their order, each with the nearest one of the measured side; then what only the
/// measured side has.
fn pair_labels(measured: &[Object], simulated: &[Object]) -> Vec<ObjectPair> {
    let mut candidates = Vec::new();
    for (i, s) in simulated.iter().enumerate() {
        for (j, m) in measured.iter().enumerate() {
            let d = (Vector3::from(s.bbox.center) - Vector3::from(m.bbox.center)).norm();
            if d < SAME_OBJECT_M {
                candidates.push((d, i, j));
            }
        }
    }
    candidates.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)).then(a.2.cmp(&b.2)));
    let mut partner = vec![None; simulated.len()];
    let mut taken = vec![false; measured.len()];
    for (_, i, j) in candidates {
        if partner[i].is_none() && !taken[j] {
            (partner[i], taken[j]) = (Some(j), true);
        }
    }
    let both = simulated.iter().zip(partner).map(|(s, j)| ObjectPair {
        simulated: Some(s.bbox),
        measured: j.map(|j| measured[j].bbox),
        shift: None,
        points: [0; 2],
    });
    let alone = measured.iter().zip(&taken).filter(|(_, taken)| !**taken).map(|(m, _)| ObjectPair {
        simulated: None,
        measured: Some(m.bbox),
        shift: None,
        points: [0; 2],
    });
    both.chain(alone).collect()
}

/// Margin beside the box of an object within which returns may belong to it after a shift, m.
pub(super) const AROUND_M: f64 = 1.2;

fn fit_objects(objects: &mut [ObjectPair], [on_measured, on_simulated]: &[Vec<(Ray, Use)>; 2], sensors: &Sensors) {
    let origins: Vec<Point3<f64>> =
        sensors.rig.sensors.iter().map(|s| Point3::from(Vector3::from(s.position))).collect();
    let boxes: Vec<Box3> = objects.iter().filter_map(|o| o.simulated).collect();
    let mut measured = vec![Vec::new(); boxes.len()];
    let mut simulated = vec![Vec::new(); boxes.len()];
    for (ray, _) in on_measured {
        let p = ray.point(&origins[ray.sensor as usize]);
        // Returns on predicted ground are ground.
        let ground = ray.surface == Surface::Ground && ray.across_m().abs() < 0.15;
        for (k, b) in boxes.iter().enumerate() {
            if !ground && in_or_beside(b, p.into(), AROUND_M) {
                measured[k].push(p);
            }
        }
    }
    for (ray, _) in on_simulated {
        if ray.surface != Surface::Object {
            continue;
        }
        let point = ray.point(&origins[ray.sensor as usize]);
        simulated[ray.object as usize].push(SurfacePoint { point, normal: ray.normal_vector() });
    }
    for (k, object) in objects.iter_mut().take(boxes.len()).enumerate() {
        object.points = [measured[k].len(), simulated[k].len()];
        object.shift = fit_shift(&boxes[k], &measured[k], &simulated[k]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use sensor::Rig;
    use sensor::directions::{ScanPattern, Steps};

    /// Rows of the sensor, rad.
    fn rows() -> Vec<f32> {
        (0..24).map(|i| -0.05 + 0.006 * i as f32).collect()
    }

    /// A car 10 m ahead before a front of houses with steps, and some false alarms.
    fn scan(beside_m: f32, seed: u64) -> SensorScan {
        let mut rng = data::stream(seed, "pairs", 0, 0);
        let mut scan = SensorScan::default();
        for (row, el) in rows().iter().enumerate() {
            for k in 0..500 {
                let az = (k as f32 - 250.0) * 0.003;
                let stands_back = ((20.0 * az.tan() + beside_m) / 3.0).rem_euclid(1.0) < 0.5;
                let wall = if stands_back { 22.5 } else { 20.0 };
                let depth = if az.abs() < 0.1 && row < 16 { 10.0 + beside_m } else { wall };
                let range =
                    if rng.random_bool(0.01) { rng.random_range(3.0..9.0) } else { depth / az.cos() / el.cos() };
                scan.azimuth_rad.push(az);
                scan.elevation_rad.push(*el);
                scan.range_m.push(range + rng.random_range(-0.01..0.01));
                scan.intensity.push(rng.random_range(0.4..0.5));
            }
        }
        scan
    }

    fn paired(kept: usize, corrections: Corrections) -> FramePair {
        let steps = Steps { azimuth_rad: 0.003, elevation_rad: 0.006 };
        let pattern = ScanPattern { rows_rad: rows(), steps, ..ScanPattern::default() };
        let sensors = Sensors { rig: Rig::single(), patterns: vec![pattern], edge_m: 0.12 };
        let origin = sensors.rig.sensors[0].position;
        let bbox = Box3::from_array([origin[0] + 12.0, origin[1], origin[2], 4.0, 2.0, 1.6, 0.0]);
        let car = Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None };
        let side = |scan, second| SideFrame { scans: vec![scan], objects: vec![car.clone()], second };
        let (measured, simulated) = (side(scan(0.05, 1), 200), side(scan(0.0, 2), 100));
        let n = measured.scans[0].len();
        let matched = [Matched { measured: vec![true; n], simulated: vec![true; n], repeats: true }];
        let recorded = RecordedFrame {
            number: 3,
            id: "3",
            measured: &measured,
            simulated: &simulated,
            matched: &matched,
            edges: &Default::default(),
        };
        pair_frame(&recorded, &sensors, corrections, kept)
    }

    /// Moved up by 60 cm, the upper rows lie above all rows of the sensor, where the simulation shows nothing.
    #[test]
    fn what_moves_out_of_the_rows_is_not_compared_and_the_rest_knows_where_it_was_recorded() {
        let up = Vector3::new(0.0, 0.0, 0.6);
        let shift_m: ShownShift = &|_, _, _| -up;
        let moved = paired(usize::MAX, Corrections { shift_m: Some(shift_m), ..Corrections::default() }).measured;
        let all = rows().len() * 500;
        assert!((all / 2..all * 9 / 10).contains(&moved.len()), "{} of {all}", moved.len());
        let highest = f64::from(rows()[rows().len() - 1]) + 0.003;
        for ray in &moved {
            let shown = ray.direction_vector() * ray.own_range_m();
            assert!(shown.z.atan2(shown.xy().norm()) < highest + 1e-6);
            assert!((shown - ray.recorded_vector() - up).norm() < 1e-4, "{shown} {ray:?}");
        }
    }

    #[test]
    fn some_of_the_rays_are_as_they_are_among_all() {
        let [all, some] = [usize::MAX, 3_000].map(|kept| paired(kept, Corrections::default()));
        assert_eq!(all.measured.len(), rows().len() * 500);
        let share = 3_000.0 / (rows().len() * 500) as f64;
        assert_eq!(some.open, share * all.open);
        assert_eq!((all.second, some.second), ([200.0, 100.0], [share * 200.0, share * 100.0]));
        let [of_some, of_all] = [&some, &all].map(|f| &f.objects[0]);
        assert_eq!((of_some.shift, of_some.points[0]), (of_all.shift, of_all.points[0]));
        // A false alarm far before an object is no return at it, though the surface behind it is the object's.
        assert!((of_all.points[1] - 12..=of_all.points[1]).contains(&of_some.points[1]), "{of_some:?} {of_all:?}");
        assert!((all.objects[0].shift.unwrap().shift_m[0] - 0.05).abs() < 0.01, "{:?}", all.objects[0].shift);
        for (some, all) in [(&some.measured, &all.measured), (&some.simulated, &all.simulated)] {
            assert!((2_700..3_300).contains(&some.len()), "{}", some.len());
            for ray in some {
                let among = all.iter().find(|r| (r.azimuth_rad, r.row) == (ray.azimuth_rad, ray.row)).unwrap();
                // The noise of other rays says which roughness is used.
                let said = |r: &Ray| format!("{:?}", Ray { roughness_m: 0.0, roughness_leverage: 0.0, ..*r });
                assert_eq!(said(ray), said(among));
            }
        }
        let rough = |rays: &[Ray]| rays.iter().filter(|r| r.roughness_m.is_finite()).count() as f64 / rays.len() as f64;
        assert!((rough(&some.measured) - rough(&all.measured)).abs() < 0.03);
    }
}
