//! One frame of both sides, return by return.

use super::boxes::{BoxShift, SurfacePoint, fit_shift};
use super::gaps::{in_gap, mixed_per_rad};
use super::prediction::{Intensities, Predictor};
use super::ray::{Ray, Surface};
use super::recordings::{Matched, SideFrame};
use super::roughness::Roughness;
use data::Object;
use geometry::Box3;
use nalgebra::{Point3, Vector3};
use sensor::assignment::Assignment;
use sensor::directions::{DirectionIndex, Neighbour, SensorScan, Sensors, in_or_beside};
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
    /// Share of the simulated returns that beams would mix over the jumps of the scan, for each radian of their width.
    pub mixed_per_rad: f64,
    /// Jumps of the measured scan for each one of the simulated scan, over returns: 1 where both show one scene.
    pub jumps: f64,
    /// Shots around whose direction the simulation has no return. For sensors without known rows: by how many returns
    /// it has fewer.
    pub open: f64,
    /// Second returns of the shots of the measured and of the simulated side; the rays do not hold them.
    pub second: [f64; 2],
    /// Objects, those of the simulation first.
    pub objects: Vec<ObjectPair>,
}

#[cfg(test)]
impl FramePair {
    /// Of the returns of both sides alone.
    pub fn of_rays(id: String, measured: Vec<Ray>, simulated: Vec<Ray>) -> FramePair {
        FramePair {
            id,
            measured,
            simulated,
            mixed_per_rad: 0.0,
            jumps: 1.0,
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

/// Of this many shots of a row one is tested, to count those without a return.
const EVERY: usize = 3;

/// Shots of a sensor's scan, over the azimuths of its returns, around which a side has no return; `None` where rows are
/// not known.
fn open(sensors: &Sensors, sensor: usize, scans: [&SensorScan; 2], side: &DirectionIndex) -> Option<f64> {
    let pattern = &sensors.patterns[sensor];
    let azimuths = || scans.into_iter().flat_map(|s| &s.azimuth_rad).copied();
    let [least, most] = [azimuths().fold(f32::MAX, f32::min), azimuths().fold(f32::MIN, f32::max)];
    let columns = 1 + ((most - least).max(0.0) / pattern.steps.azimuth_rad).round() as usize;
    let empty = |azimuth_rad: f32, elevation_rad: f32| {
        let mut n = 0u32;
        side.around(azimuth_rad, elevation_rad, |_, _, _| n += 1);
        n == 0
    };
    let in_row = |el: &f32| {
        let places = (0..columns).step_by(EVERY).map(|k| least + k as f32 * pattern.steps.azimuth_rad);
        places.filter(|az| empty(*az, *el)).count() * EVERY
    };
    (!pattern.rows_rad.is_empty()).then(|| pattern.rows_rad.iter().map(in_row).sum::<usize>() as f64)
}

/// Displacement of a point of a frame and a sensor, by their numbers, in the cloud's frame, m.
pub type ShownShift<'a> = &'a (dyn Fn(usize, &Vector3<f64>, usize) -> Vector3<f64> + Sync);

/// Known differences between the sides that are corrected before frames are paired.
#[derive(Clone, Copy, Default)]
pub struct Corrections<'a> {
    /// Correction to subtract from the range of a measured ray, m.
    pub range_m: Option<&'a (dyn Fn(&Ray) -> f64 + Sync)>,
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
}

/// Pairs a frame, return by return.
pub fn pair_frame(recorded: &RecordedFrame, sensors: &Sensors, corrections: Corrections) -> FramePair {
    let mut objects = pair_labels(&recorded.measured.objects, &recorded.simulated.objects);
    let boxes: Vec<Box3> = objects.iter().filter_map(|o| o.simulated).collect();
    let measured = moved_back(recorded, sensors, corrections.shift_m);
    let simulated = rounded(&recorded.simulated.scans, corrections.step_m);
    // A return that is moved out of the field of view of its sensor has nothing to be compared with.
    let views = corrections.shift_m.map(|_| Assignment::new(&sensors.rig));
    let mut frame = FramePair {
        id: recorded.id.into(),
        measured: Vec::new(),
        simulated: Vec::new(),
        mixed_per_rad: 0.0,
        jumps: 1.0,
        open: 0.0,
        second: [recorded.measured, recorded.simulated].map(|side| side.second as f64),
        objects: Vec::new(),
    };
    for (sensor, scan) in measured.into_iter().enumerate() {
        let pair = SensorPair {
            sensors,
            sensor,
            sent: &recorded.measured.scans[sensor],
            simulated: &simulated[sensor],
            matched: &recorded.matched[sensor],
            boxes: &boxes,
            views: views.as_ref(),
        };
        pair.add_to(&mut frame, scan, corrections.range_m);
    }
    frame.mixed_per_rad /= frame.simulated.len().max(1) as f64;
    fit_objects(&mut objects, &frame, sensors);
    frame.objects = objects;
    frame
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

/// One sensor of a frame.
struct SensorPair<'a> {
    sensors: &'a Sensors,
    sensor: usize,
    /// Measured scan as it was recorded: the directions in which shots were sent.
    sent: &'a SensorScan,
    simulated: &'a SensorScan,
    matched: &'a Matched,
    boxes: &'a [Box3],
    /// Which sensor sees a place, where measured returns were moved.
    views: Option<&'a Assignment>,
}

impl SensorPair<'_> {
    /// Adds the rays of both sides to a frame; `scan` is the measured scan.
    fn add_to(&self, frame: &mut FramePair, mut scan: SensorScan, range_m: Option<&(dyn Fn(&Ray) -> f64 + Sync)>) {
        let (a, b) = (&mut scan, self.simulated);
        let predictor = Predictor::new(self.sensors, self.sensor, b, self.boxes);
        let mut simulated = self.simulated_rays(&predictor);
        let mut measured = self.measured_rays(&predictor, a, range_m);
        let closes = self.sensors.rig.sensors[self.sensor].is_full_circle();
        let own = DirectionIndex::new(a, self.sensors.window(self.sensor), closes);
        self.compare_with_measured(&own, a, [&mut measured, &mut simulated]);
        let edge_m = self.sensors.edge_m;
        Roughness { own: &own, window: predictor.around.window, edge_m }.set([&mut measured, &mut simulated], [a, b]);
        frame.mixed_per_rad += mixed_per_rad(&simulated, &predictor.around.index);
        let missing = measured.len() as f64 - simulated.len() as f64;
        frame.open += open(self.sensors, self.sensor, [a, b], &predictor.around.index).unwrap_or(missing.max(0.0));
        if let Some(views) = self.views {
            let mount = &self.sensors.rig.sensors[self.sensor];
            let seen = |r: &Ray| {
                let place = predictor.around.place(&r.direction_vector(), r.own_range_m());
                let at = views.of_point(place.into()).filter(|at| at.sensor == self.sensor);
                at.is_some_and(|at| mount.sees(at.spherical[0], 0.0))
            };
            measured.retain(seen);
        }
        frame.measured.append(&mut measured);
        frame.simulated.append(&mut simulated);
    }

    /// Simulated rays, each predicted from the others.
    fn simulated_rays(&self, predictor: &Predictor) -> Vec<Ray> {
        let mut neighbours = Vec::new();
        let mut own = |(i, matched): (usize, &bool)| Ray {
            matched: *matched,
            ..predictor.own_ray(self.simulated, i, &mut neighbours).0
        };
        self.matched.1.iter().enumerate().map(&mut own).collect()
    }

    /// Measured rays as the simulation predicts them, in the directions in which they were sent. A correction of the
    /// ranges is subtracted from the scan as well.
    fn measured_rays(
        &self,
        predictor: &Predictor,
        scan: &mut SensorScan,
        range_m: Option<&(dyn Fn(&Ray) -> f64 + Sync)>,
    ) -> Vec<Ray> {
        let mut neighbours = Vec::new();
        let mut rays = Vec::with_capacity(scan.len());
        for (i, matched) in self.matched.0.iter().enumerate() {
            let mut ray = predictor.seen(scan, i, None, &mut neighbours).0;
            if let Some(correction) = range_m.filter(|_| ray.smooth) {
                let off = correction(&ray) as f32;
                ray.residual_m -= off;
                scan.range_m[i] = (scan.range_m[i] - off).max(0.05);
            }
            ray.matched = *matched;
            (ray.azimuth_rad, ray.elevation_rad) = (self.sent.azimuth_rad[i], self.sent.elevation_rad[i]);
            ray.row = self.sensors.row(self.sensor, ray.elevation_rad);
            ray.in_gap = in_gap(&neighbours, scan.range_m[i]);
            rays.push(ray);
        }
        rays
    }

    /// Sets what depends on the measured returns around measured and simulated rays. `own` is the index of the measured
    /// scan.
    fn compare_with_measured(&self, own: &DirectionIndex, scan: &SensorScan, sides: [&mut [Ray]; 2]) {
        let [measured, simulated] = sides;
        let intensities = Intensities::of(scan);
        let mut neighbours = Vec::new();
        for (i, ray) in measured.iter_mut().enumerate() {
            own.neighbours(scan.azimuth_rad[i], scan.elevation_rad[i], &mut neighbours);
            ray.company = company(&neighbours, scan.range_m[i], Some(i as u32));
            if ray.smooth {
                ray.intensity_beside = intensities.mean(&neighbours, scan.range_m[i], Some(i as u32));
            }
        }
        let scan = self.simulated;
        for (i, ray) in simulated.iter_mut().enumerate() {
            own.neighbours(scan.azimuth_rad[i], scan.elevation_rad[i], &mut neighbours);
            ray.in_gap = in_gap(&neighbours, scan.range_m[i]);
            ray.shown = company(&neighbours, scan.range_m[i], None) > 0;
        }
    }
}

/// Difference in range up to which returns are neighbours at the same range, m.
pub fn company_m(range_m: f64) -> f64 {
    0.3 + 0.03 * range_m
}

/// Number of the returns around a direction that lie at about a range, m, but for one.
pub(super) fn company(around: &[Neighbour], range_m: f32, without: Option<u32>) -> u8 {
    let within_m = company_m(f64::from(range_m));
    let near = |n: &&Neighbour| f64::from((n.entry.range_m - range_m).abs()) < within_m;
    let others = around.iter().filter(|n| without != Some(n.entry.index));
    others.filter(near).count().min(usize::from(u8::MAX)) as u8
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
const AROUND_M: f64 = 1.2;

fn fit_objects(objects: &mut [ObjectPair], frame: &FramePair, sensors: &Sensors) {
    let origins: Vec<Point3<f64>> =
        sensors.rig.sensors.iter().map(|s| Point3::from(Vector3::from(s.position))).collect();
    let boxes: Vec<Box3> = objects.iter().filter_map(|o| o.simulated).collect();
    let mut measured = vec![Vec::new(); boxes.len()];
    let mut simulated = vec![Vec::new(); boxes.len()];
    for ray in &frame.measured {
        let p = origins[ray.sensor as usize] + ray.direction_vector() * ray.own_range_m();
        // Returns on predicted ground are ground.
        let ground = ray.surface == Surface::Ground && ray.across_m().abs() < 0.15;
        for (k, b) in boxes.iter().enumerate() {
            if !ground && in_or_beside(b, p.into(), AROUND_M) {
                measured[k].push(p);
            }
        }
    }
    for ray in &frame.simulated {
        if ray.surface != Surface::Object {
            continue;
        }
        let point = origins[ray.sensor as usize] + ray.direction_vector() * ray.own_range_m();
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
    use sensor::Rig;
    use sensor::directions::{ScanPattern, Steps};

    #[test]
    fn shots_without_a_return_are_counted_except_beside_returns() {
        let (rows, step) = ([-0.06f32, -0.04, -0.02, 0.0], 0.01f32);
        let steps = Steps { azimuth_rad: step, elevation_rad: 0.02 };
        let pattern = ScanPattern { rows_rad: rows.to_vec(), steps };
        let sensors = Sensors { rig: Rig::single(), patterns: vec![pattern], edge_m: 0.1 };
        let scan_up_to = |columns: usize| {
            let shots: Vec<_> = rows.iter().flat_map(|el| (0..columns).map(move |k| (k as f32 * step, *el))).collect();
            SensorScan {
                azimuth_rad: shots.iter().map(|s| s.0).collect(),
                elevation_rad: shots.iter().map(|s| s.1).collect(),
                range_m: vec![10.0; shots.len()],
                intensity: vec![],
            }
        };
        let (measured, simulated) = (scan_up_to(300), scan_up_to(100));
        let index = DirectionIndex::new(&simulated, sensors.window(0), false);
        let opened = open(&sensors, 0, [&measured, &simulated], &index).unwrap();
        // Two columns beside the last return are seen together with it.
        assert!((opened - 4.0 * 198.0).abs() < 4.0 * EVERY as f64, "{opened}");
        let whole = DirectionIndex::new(&measured, sensors.window(0), false);
        assert_eq!(open(&sensors, 0, [&measured, &simulated], &whole), Some(0.0));
    }
}
