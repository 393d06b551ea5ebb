//! One sensor of a frame, return by return.

use super::frame::{AROUND_M, RangeError};
use super::matching::Matched;
use super::prediction::{Intensities, Predictor};
use super::ray::Ray;
use super::roughness::{LONE, Roughness, STRAY_M};
use geometry::Box3;
use sensor::directions::{DirectionIndex, Neighbour, SensorScan, Sensors, in_or_beside};

/// What a return is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Use {
    /// It says what lies around others.
    Neighbour,
    /// The same, and it is a ray of an object where it is at one.
    AtObject,
    /// The same, and it is compared.
    Compared,
}

/// One sensor of a frame.
pub(super) struct SensorPair<'a> {
    pub sensors: &'a Sensors,
    pub sensor: usize,
    /// Measured scan as it was recorded: the directions in which shots were sent.
    pub sent: &'a SensorScan,
    pub simulated: &'a SensorScan,
    pub matched: &'a Matched,
    pub boxes: &'a [Box3],
}

/// What a sensor adds to a frame.
pub(super) struct Compared {
    /// Rays of both sides, and what they are used for.
    pub rays: [Vec<(Ray, Use)>; 2],
    /// Compared measured rays without a counterpart, see [`super::FramePair::only_measured`].
    pub only_measured: Vec<Ray>,
    /// Shots without a simulated return.
    pub open: f64,
}

impl SensorPair<'_> {
    /// Compares the returns of both sides, of which there are `uses`. A correction of the ranges is subtracted from the
    /// measured `scan` as well.
    pub(super) fn compare(&self, scan: &mut SensorScan, range_m: Option<RangeError>, uses: [&[Use]; 2]) -> Compared {
        let predictor = Predictor::new(self.sensors, self.sensor, self.simulated, self.boxes);
        let which = [self.rays(scan, uses[0]), self.rays(self.simulated, uses[1])];
        let mut simulated = self.simulated_rays(&predictor, &which[1]);
        let (mut measured, off_surface) = self.measured_rays(&predictor, scan, range_m, &which[0]);
        let closes = self.sensors.rig.sensors[self.sensor].is_full_circle();
        let own = DirectionIndex::new(scan, self.sensors.window(self.sensor), closes);
        let lone = self.compare_with_measured(&own, scan, [&mut measured, &mut simulated], [&which[0], &which[1]]);
        let stray: Vec<bool> = lone.iter().zip(off_surface).map(|(lone, off)| *lone || off).collect();
        let (window, edge_m) = (predictor.around.window, self.sensors.edge_m);
        Roughness { own: &own, window, edge_m, stray: &stray }
            .set([(&mut measured, &which[0], scan), (&mut simulated, &which[1], self.simulated)]);
        let missing = scan.len() as f64 - self.simulated.len() as f64;
        let open = open(self.sensors, self.sensor, [scan, self.simulated], &predictor.around.index);
        let with_use = |rays: Vec<Ray>, which: &[usize], uses: &[Use]| -> Vec<(Ray, Use)> {
            rays.into_iter().zip(which.iter().map(|&i| uses[i])).collect()
        };
        Compared {
            only_measured: self.only_measured(scan, &measured, &which[0], uses[0]),
            open: open.unwrap_or(missing.max(0.0)),
            rays: [with_use(measured, &which[0], uses[0]), with_use(simulated, &which[1], uses[1])],
        }
    }

    /// Numbers of the returns of a scan that become rays.
    fn rays(&self, scan: &SensorScan, uses: &[Use]) -> Vec<usize> {
        let pose = self.sensors.rig.sensors[self.sensor].pose();
        let at_object = |i: usize| {
            let place = (pose * scan.point(i)).into();
            self.boxes.iter().any(|b| in_or_beside(b, place, AROUND_M))
        };
        let is_ray = |i: &usize| match uses[*i] {
            Use::Neighbour => false,
            Use::AtObject => at_object(*i),
            Use::Compared => true,
        };
        (0..scan.len()).filter(is_ray).collect()
    }

    /// Simulated rays, each predicted from the others.
    fn simulated_rays(&self, predictor: &Predictor, which: &[usize]) -> Vec<Ray> {
        let mut neighbours = Vec::new();
        let mut own = |&i: &usize| Ray {
            matched: self.matched.simulated[i],
            ..predictor.own_ray(self.simulated, i, &mut neighbours).0
        };
        which.iter().map(&mut own).collect()
    }

    /// Measured rays as the simulation predicts them, in the directions in which they were sent; and for each return of
    /// the scan whether it lies off the surface that the simulation has there.
    fn measured_rays(
        &self,
        predictor: &Predictor,
        scan: &mut SensorScan,
        range_m: Option<RangeError>,
        which: &[usize],
    ) -> (Vec<Ray>, Vec<bool>) {
        let mut neighbours = Vec::new();
        let turn = self.sensors.rig.sensors[self.sensor].pose().rotation;
        let mut rays = Vec::with_capacity(which.len());
        let mut off_surface = Vec::with_capacity(scan.len());
        let mut which = which.iter().peekable();
        for (i, matched) in self.matched.measured.iter().enumerate() {
            let is_ray = which.next_if_eq(&&i).is_some();
            if !is_ray && range_m.is_none() {
                let off_m = predictor.across_m(scan, i, &mut neighbours);
                off_surface.push(off_m.is_some_and(|off_m| off_m > STRAY_M));
                continue;
            }
            let mut ray = predictor.seen(scan, i, None, &mut neighbours).0;
            if let Some(correction) = range_m.filter(|_| ray.smooth) {
                let off = correction(&ray) as f32;
                ray.residual_m -= off;
                scan.range_m[i] = (scan.range_m[i] - off).max(0.05);
            }
            off_surface.push(ray.smooth && ray.across_m().abs() > STRAY_M);
            if is_ray {
                ray.matched = *matched;
                (ray.azimuth_rad, ray.elevation_rad) = (self.sent.azimuth_rad[i], self.sent.elevation_rad[i]);
                ray.row = self.sensors.row(self.sensor, ray.elevation_rad, self.sent.range_m[i]);
                ray.recorded_m = (turn * self.sent.point(i).coords).cast::<f32>().into();
                rays.push(ray);
            }
        }
        (rays, off_surface)
    }

    /// Those of the measured rays that are compared and have no counterpart; of a pattern that does not repeat as their
    /// own side predicts them.
    fn only_measured(&self, scan: &SensorScan, rays: &[Ray], which: &[usize], uses: &[Use]) -> Vec<Ray> {
        let alone = || which.iter().zip(rays).filter(|(i, ray)| !ray.matched && uses[**i] == Use::Compared);
        if self.matched.repeats {
            return alone().map(|(_, ray)| *ray).collect();
        }
        let predictor = Predictor::new(self.sensors, self.sensor, scan, self.boxes);
        let mut neighbours = Vec::new();
        let mut own = |(i, ray): (&usize, &Ray)| Ray {
            azimuth_rad: ray.azimuth_rad,
            elevation_rad: ray.elevation_rad,
            ..predictor.own_ray(scan, *i, &mut neighbours).0
        };
        alone().map(&mut own).collect()
    }

    /// Sets what depends on the measured returns around measured and simulated rays, which are given with their
    /// numbers. `own` is the index of the measured scan. For each return of that: whether it is not of a surface.
    fn compare_with_measured(
        &self,
        own: &DirectionIndex,
        scan: &SensorScan,
        [measured, simulated]: [&mut [Ray]; 2],
        which: [&[usize]; 2],
    ) -> Vec<bool> {
        let intensities = Intensities::of(scan);
        let mut neighbours = Vec::new();
        let mut lone = Vec::with_capacity(scan.len());
        let mut rays = which[0].iter().zip(measured).peekable();
        for i in 0..scan.len() {
            own.neighbours(scan.azimuth_rad[i], scan.elevation_rad[i], &mut neighbours);
            let company = company(&neighbours, scan.range_m[i], Some(i as u32));
            lone.push(company <= LONE);
            if let Some((_, ray)) = rays.next_if(|(of, _)| **of == i) {
                ray.company = company;
                if ray.smooth {
                    ray.intensity_beside = intensities.mean(&neighbours, scan.range_m[i], Some(i as u32));
                }
            }
        }
        let scan = self.simulated;
        for (&i, ray) in which[1].iter().zip(simulated) {
            own.neighbours(scan.azimuth_rad[i], scan.elevation_rad[i], &mut neighbours);
            ray.shown = company(&neighbours, scan.range_m[i], None) > 0;
        }
        lone
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

#[cfg(test)]
mod tests {
    use super::*;
    use sensor::Rig;
    use sensor::directions::{ScanPattern, Steps};

    #[test]
    fn shots_without_a_return_are_counted_except_beside_returns() {
        let (rows, step) = ([-0.06f32, -0.04, -0.02, 0.0], 0.01f32);
        let steps = Steps { azimuth_rad: step, elevation_rad: 0.02 };
        let pattern = ScanPattern { rows_rad: rows.to_vec(), steps, ..ScanPattern::default() };
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
