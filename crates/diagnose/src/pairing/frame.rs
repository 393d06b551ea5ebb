//! One frame of both sides, return by return.

use super::boxes::{BoxShift, SurfacePoint, fit_shift, in_or_beside};
use super::gaps::{in_gap, mixed_per_rad};
use super::matching::match_directions;
use super::pattern::ScanPattern;
use super::ray::{Ray, Surface};
use super::scan::{DirectionIndex, SensorScan, Steps, split_by_sensor};
use super::sight::Sight;
use super::surface::fit_surface;
use data::{Cloud, Object};
use geometry::Box3;
use nalgebra::{Point3, Vector3};
use sensor::Rig;

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
    /// Shots around whose direction the simulation has nothing; of sensors whose rows are not known, returns that it has fewer.
    pub open: f64,
    /// Objects, those of the simulation first.
    pub objects: Vec<ObjectPair>,
}

/// A labelled object of the two sides.
#[derive(Clone, Debug)]
pub struct ObjectPair {
    /// The simulation's label; `None` where only the measured side has it.
    pub simulated: Option<Box3>,
    /// The measured side's label.
    pub measured: Option<Box3>,
    /// How far the measured returns stand from the simulated ones.
    pub shift: Option<BoxShift>,
    /// Returns of the measured and the simulated side in the box.
    pub points: [usize; 2],
}

/// What is known of the sensors before any frame is looked at.
pub struct Sensors {
    /// Mounts.
    pub rig: Rig,
    /// Scan pattern of each.
    pub patterns: Vec<ScanPattern>,
    /// Farther than that across a plane a neighbour belongs to something else, m.
    pub edge_m: f64,
}

/// Half widths of the window of neighbours, in steps.
const WINDOW: [f32; 2] = [2.2, 1.4];

/// Of so many shots of a row one is looked at, to count those that meet nothing.
const EVERY: usize = 3;

/// Returns with no more than that in company are not of a surface.
const LONE: u8 = 1;

/// A measured return farther than that from the surface says nothing of its neighbours, m across.
const STRAY_M: f64 = 0.5;

impl Sensors {
    /// Row of a shot; `u16::MAX` where rows are not known.
    pub(super) fn row(&self, sensor: usize, elevation_rad: f32) -> u16 {
        self.patterns[sensor].row(elevation_rad).map_or(u16::MAX, |r| r as u16)
    }

    /// Shots of a scan, over the azimuths that its returns span, around which a side has nothing; `None` where rows are not known.
    fn open(&self, sensor: usize, scans: [&SensorScan; 2], side: &DirectionIndex) -> Option<f64> {
        let pattern = &self.patterns[sensor];
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

    pub(super) fn window(&self, sensor: usize) -> Steps {
        let steps = self.patterns[sensor].steps;
        Steps { azimuth_rad: WINDOW[0] * steps.azimuth_rad, elevation_rad: WINDOW[1] * steps.elevation_rad }
    }
}

/// How far a point of a frame and a sensor, each by its number, is shown from where it is, both in the cloud's frame, m.
pub type ShownShift<'a> = &'a (dyn Fn(usize, &Vector3<f64>, usize) -> Vector3<f64> + Sync);

/// What is known to be wrong with the measured side and is taken out before the frames are paired.
#[derive(Clone, Copy, Default)]
pub struct Mending<'a> {
    /// What is to be taken off the range of a ray, m.
    pub range_m: Option<&'a (dyn Fn(&Ray) -> f64 + Sync)>,
    /// How far points are shown from where they are.
    pub shift_m: Option<ShownShift<'a>>,
    /// Step to which simulated ranges are to be rounded as the measured ones are, m.
    pub step_m: Option<f64>,
}

/// Pairs a frame, return by return; `number` is its place among all.
pub fn pair_frame(
    (number, id): (usize, &str),
    measured: (&Cloud, &[Object]),
    simulated: (&Cloud, &[Object]),
    sensors: &Sensors,
    mending: Mending,
) -> FramePair {
    let mut objects = pair_labels(measured.1, simulated.1);
    let boxes: Vec<Box3> = objects.iter().filter_map(|o| o.simulated).collect();
    let mut scans = [measured.0, simulated.0].map(|cloud| split_by_sensor(cloud, &sensors.rig));
    // Whether a shot came back is asked by the direction in which it was sent, wherever what it met is moved to.
    let mut matched: Vec<_> = (0..sensors.rig.sensors.len())
        .map(|k| {
            let closes = sensors.rig.sensors[k].closes();
            match_directions(&scans[0][k], &scans[1][k], &sensors.patterns[k], closes)
        })
        .collect();
    let sent: Vec<[Vec<f32>; 2]> =
        scans[0].iter().map(|scan| [scan.azimuth_rad.clone(), scan.elevation_rad.clone()]).collect();
    if let Some(shift_m) = mending.shift_m {
        for (sensor, scan) in scans[0].iter_mut().enumerate() {
            let pose = sensors.rig.sensors[sensor].pose();
            scan.move_points(|p| {
                let at = pose * p;
                pose.inverse() * (at - shift_m(number, &at.coords, sensor))
            });
        }
    }
    if let Some(step) = mending.step_m {
        let round = |r: &mut f32| *r = ((f64::from(*r) / step).round() * step).max(0.05) as f32;
        scans[1].iter_mut().flat_map(|s| &mut s.range_m).for_each(round);
    }
    let mut frame = FramePair {
        id: id.into(),
        measured: Vec::new(),
        simulated: Vec::new(),
        mixed_per_rad: 0.0,
        open: 0.0,
        objects: Vec::new(),
    };
    for sensor in 0..sensors.rig.sensors.len() {
        let (measured_scans, simulated_scans) = scans.split_at_mut(1);
        let (a, b) = (&mut measured_scans[0][sensor], &simulated_scans[0][sensor]);
        let closes = sensors.rig.sensors[sensor].closes();
        let (of_a, of_b) = std::mem::take(&mut matched[sensor]);
        let sight = Sight::new(sensors, sensor, b, &boxes);
        let mut simulated: Vec<Ray> = (0..b.len()).map(|i| sight.ray(b, i, true)).collect();
        for (i, (ray, matched)) in simulated.iter_mut().zip(of_b).enumerate() {
            ray.matched = matched;
            ray.company = company(&sight.index, b, i);
            (ray.roughness_m, ray.roughness_leverage) =
                if ray.smooth && ray.company > LONE { (ray.residual_m, ray.leverage) } else { (f32::NAN, 0.0) };
        }
        let mut measured: Vec<Ray> = (0..a.len()).map(|i| sight.ray(a, i, false)).collect();
        if let Some(correction) = mending.range_m {
            for (i, ray) in measured.iter_mut().enumerate().filter(|(_, r)| r.smooth) {
                let off = correction(ray) as f32;
                ray.residual_m -= off;
                a.range_m[i] = (a.range_m[i] - off).max(0.05);
            }
        }
        let own = DirectionIndex::new(a, sensors.window(sensor), closes);
        for (i, (ray, matched)) in measured.iter_mut().zip(of_a).enumerate() {
            ray.matched = matched;
            (ray.azimuth_rad, ray.elevation_rad) = (sent[sensor][0][i], sent[sensor][1][i]);
            ray.row = sensors.row(sensor, ray.elevation_rad);
            ray.company = company(&own, a, i);
            ray.in_gap = in_gap(&sight.index, a, i);
        }
        simulated.iter_mut().enumerate().for_each(|(i, ray)| ray.in_gap = in_gap(&own, b, i));
        // A return without any other at its range is no surface: false alarms would make all around them rough.
        let stray: Vec<bool> =
            measured.iter().map(|r| r.company <= LONE || r.smooth && r.across_m().abs() > STRAY_M).collect();
        for (i, ray) in measured.iter_mut().enumerate() {
            if ray.smooth && !stray[i] {
                let others = |e: &super::scan::Entry| e.index != i as u32 && !stray[e.index as usize];
                if let Some(s) = fit_surface(&own, sight.window, a.azimuth_rad[i], a.elevation_rad[i], others) {
                    ray.roughness_m = (f64::from(a.range_m[i]) - s.range_m) as f32;
                    ray.roughness_leverage = s.leverage as f32;
                }
            }
        }
        frame.mixed_per_rad += mixed_per_rad(&simulated, &sight.index);
        let missing = measured.len() as f64 - simulated.len() as f64;
        frame.open += sensors.open(sensor, [a, b], &sight.index).unwrap_or(missing.max(0.0));
        frame.measured.append(&mut measured);
        frame.simulated.append(&mut simulated);
    }
    frame.mixed_per_rad /= frame.simulated.len().max(1) as f64;
    fit_objects(&mut objects, &frame, sensors);
    frame.objects = objects;
    frame
}

/// Returns nearer to each other than that are in company, m.
pub fn company_m(range_m: f64) -> f64 {
    0.3 + 0.03 * range_m
}

/// Number of returns of a scan around one of its own that lie at about its range.
fn company(index: &DirectionIndex, scan: &SensorScan, i: usize) -> u8 {
    let range = scan.range_m[i];
    let mut n = 0u8;
    index.around(scan.azimuth_rad[i], scan.elevation_rad[i], |e, _, _| {
        if e.index != i as u32 && f64::from((e.range_m - range).abs()) < company_m(f64::from(range)) {
            n = n.saturating_add(1);
        }
    });
    n
}

/// Labels farther apart than that are not of the same object, m.
const SAME_OBJECT_M: f64 = 4.0;

/// Labels of the simulation in their order, each with the nearest one of the measured side; then what only the measured side has.
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

/// Returns around an object, this far beside its box, may be its own after a shift, m.
const AROUND_M: f64 = 1.2;

fn fit_objects(objects: &mut [ObjectPair], frame: &FramePair, sensors: &Sensors) {
    let origins: Vec<Point3<f64>> =
        sensors.rig.sensors.iter().map(|s| Point3::from(Vector3::from(s.position))).collect();
    let boxes: Vec<Box3> = objects.iter().filter_map(|o| o.simulated).collect();
    let mut measured = vec![Vec::new(); boxes.len()];
    let mut simulated = vec![Vec::new(); boxes.len()];
    for ray in &frame.measured {
        let p = origins[ray.sensor as usize] + ray.direction_vector() * ray.own_range_m();
        // What the simulation says is ground, and lies on it, is ground.
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

    #[test]
    fn shots_that_meet_nothing_are_counted_but_for_those_beside_what_others_meet() {
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
            }
        };
        let (measured, simulated) = (scan_up_to(300), scan_up_to(100));
        let index = DirectionIndex::new(&simulated, sensors.window(0), false);
        let open = sensors.open(0, [&measured, &simulated], &index).unwrap();
        // Two columns beside the last return are seen together with it.
        assert!((open - 4.0 * 198.0).abs() < 4.0 * EVERY as f64, "{open}");
        let whole = DirectionIndex::new(&measured, sensors.window(0), false);
        assert_eq!(sensors.open(0, [&measured, &simulated], &whole), Some(0.0));
    }
}
