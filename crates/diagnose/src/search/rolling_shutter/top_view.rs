//! Returns of one frame in bird's-eye view.

use super::Motion;
use crate::channels::mean::common_bias_m;
use crate::channels::motion::{CELL_M, Cells, Ground, ground};
use crate::inference::median;
use crate::pairing::{FramePair, Ray};
use nalgebra::{Isometry3, Point3, Vector2, Vector3};
use sensor::{Rig, Sensor};

/// Returns of a frame that are moved, at most.
const POINTS: usize = 2500;

/// Smallest and largest range of returns that are used, m: farther ones are too sparse.
const REACH_M: std::ops::Range<f64> = 3.0..60.0;

/// A measured return.
struct Shown {
    place: Vector3<f64>,
    /// Part of the scan at which it was shot, -1/2 to 1/2.
    phase: f64,
    /// Whether it lies in an occupied cell where it was measured.
    on: bool,
}

/// Returns of one frame in bird's-eye view.
pub(super) struct TopView<'a> {
    /// Cells that the simulated surfaces occupy.
    occupied: Cells,
    points: Vec<Shown>,
    /// Measured returns for each of the points.
    pub(super) each: f64,
    /// Sensors with a blind sector, with `sensor_from_cloud`; none if one of them sees all around.
    sensors: Vec<(&'a Sensor, Isometry3<f64>)>,
}

impl<'a> TopView<'a> {
    pub(super) fn new(frame: &FramePair, rig: &'a Rig, origins: &[Point3<f64>]) -> Self {
        let near = |r: &&Ray| REACH_M.contains(&r.own_range_m());
        let road = Ground::new(ground(frame, origins));
        let stands = |r: &&Ray| road.is_below(&at(r, origins, 0.0).coords);
        let occupied = Cells::new(&occupied(frame.simulated.iter().filter(near).filter(stands), origins));
        let measured: Vec<_> = frame.measured.iter().filter(near).filter(stands).collect();
        let stride = measured.len().div_ceil(POINTS).max(1);
        // A common range bias is no displacement along the scan.
        let bias_m = common_bias_m(frame);
        let points = measured.iter().step_by(stride).map(|r| {
            let place = at(r, origins, bias_m).coords;
            let mount = &rig.sensors[r.sensor as usize];
            let phase = mount.scan_phase(f64::from(r.azimuth_rad), f64::from(r.elevation_rad));
            Shown { place, phase, on: occupied.contains(&place.xy()) }
        });
        let points = points.collect();
        let sees_all = rig.sensors.iter().any(Sensor::is_full_circle);
        let partial = rig.sensors.iter().filter(|_| !sees_all);
        let sensors = partial.map(|s| (s, s.pose().inverse())).collect();
        TopView { occupied, points, each: stride as f64, sensors }
    }

    /// Displacement of each point for each second of scan, m/s. A scan takes `longest_s` at most.
    pub(super) fn displacements(&self, motion: &Motion, longest_s: f64) -> Vec<Vector2<f64>> {
        self.points.iter().map(|point| motion.at(&point.place, longest_s).xy() * point.phase).collect()
    }

    /// Number of the points in occupied cells if they are moved back by their displacements in `scan_s`. A point that
    /// moves to where no sensor looks counts as where it was measured: nothing is known of that place.
    pub(super) fn on(&self, displacements: &[Vector2<f64>], scan_s: f64) -> f64 {
        let on = |(point, per_s): &(&Shown, &Vector2<f64>)| {
            let mut place = point.place;
            place.x -= per_s.x * scan_s;
            place.y -= per_s.y * scan_s;
            self.occupied.contains(&place.xy()) || point.on && !self.is_seen(&place)
        };
        self.points.iter().zip(displacements).filter(on).count() as f64
    }

    fn is_seen(&self, place: &Vector3<f64>) -> bool {
        let sees = |(sensor, sensor_from_cloud): &(&Sensor, Isometry3<f64>)| {
            sensor.sees(Sensor::azimuth_rad(&(sensor_from_cloud * Point3::from(*place))), 0.0)
        };
        self.sensors.is_empty() || self.sensors.iter().any(sees)
    }
}

/// The place of a return whose range is shorter by `off_m`.
fn at(ray: &Ray, origins: &[Point3<f64>], off_m: f64) -> Point3<f64> {
    origins[ray.sensor as usize] + ray.direction_vector() * (ray.own_range_m() - off_m)
}

/// Largest angle between two neighbours of a row, in units of the median: one or two returns between them may be lost.
const STEPS_APART: f64 = 3.0;

/// Smallest cosine of the angle between two segments of one surface, in bird's-eye view: 20 degrees. From a near
/// surface to a far one the segment runs along the ray, across those on either side.
const STRAIGHT: f64 = 0.94;

/// Places of returns of standing surfaces, and places between neighbours of a row on one surface: those whose segment
/// goes on straight to the next neighbour on either side. Both sides are shot in the same directions: with the returns
/// alone, measured ones would lie on simulated ones best where they are not moved, on whatever surface.
fn occupied<'a>(standing: impl Iterator<Item = &'a Ray>, origins: &[Point3<f64>]) -> Vec<Vector2<f64>> {
    let mut rays: Vec<&Ray> = standing.collect();
    rays.sort_by(|a, b| (a.sensor, a.row).cmp(&(b.sensor, b.row)).then(a.azimuth_rad.total_cmp(&b.azimuth_rad)));
    let mut places: Vec<Vector2<f64>> = rays.iter().map(|r| at(r, origins, 0.0).coords.xy()).collect();
    let of_one_row = |w: &[&Ray]| w[0].row != u16::MAX && (w[0].sensor, w[0].row) == (w[1].sensor, w[1].row);
    let apart = |w: &[&Ray]| f64::from(w[1].azimuth_rad - w[0].azimuth_rad);
    let most = STEPS_APART * median(rays.windows(2).filter(|w| of_one_row(w)).map(apart).collect());
    // The segment from each return to the next one of its row.
    let next = rays.windows(2).zip(places.windows(2));
    let segments: Vec<_> = next.map(|(w, p)| (of_one_row(w) && apart(w) < most).then(|| p[1] - p[0])).collect();
    let straight = |a: &Vector2<f64>, b: Option<&Option<Vector2<f64>>>| {
        b.copied().flatten().is_some_and(|b| a.dot(&b) >= STRAIGHT * a.norm() * b.norm())
    };
    for (i, segment) in segments.iter().enumerate() {
        let Some(along) = segment else { continue };
        if straight(along, segments.get(i + 1)) || straight(along, i.checked_sub(1).map(|i| &segments[i])) {
            let steps = (along.norm() / (0.5 * CELL_M)).ceil() as usize;
            places.extend((1..steps).map(|k| places[i] + along * (k as f64 / steps as f64)).collect::<Vec<_>>());
        }
    }
    places
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::motion::OwnMotion;

    /// A wall 6 m beside the sensor, shot by both sides in the same directions, from 20 degrees to `to_deg`: the number
    /// of its returns, and of those on the simulation by the displacement over a scan, m.
    fn wall(rig: &Rig, to_deg: i32) -> (f64, impl Fn(f64) -> f64) {
        let place = |deg: i32| Vector3::new(6.0 / f64::from(deg).to_radians().tan(), 6.0, 0.0);
        let rays = || (20..=to_deg).map(|deg| Ray::standing(&place(deg))).collect::<Vec<_>>();
        let frame = FramePair::of_rays("wall".into(), rays(), rays());
        let motion = Motion { own: OwnMotion::ahead(1.0), objects: Vec::new() };
        let view = TopView::new(&frame, rig, &[Point3::origin()]);
        let displacements = view.displacements(&motion, 7.0);
        (displacements.len() as f64, move |shift_m| view.on(&displacements, shift_m))
    }

    #[test]
    fn a_wall_along_the_motion_does_not_tell_the_displacement() {
        let rig = Rig::single();
        let (points, on) = wall(&rig, 160);
        assert_eq!(on(0.0), points);
        for shift_m in [-2.0, -0.7, 0.7, 2.0] {
            // Neighbours are up to 0.9 m apart; at the end of the wall one or two points pass it.
            assert!(on(shift_m) > 0.97 * points, "{shift_m} {} {points}", on(shift_m));
        }
    }

    #[test]
    fn places_that_no_sensor_sees_tell_nothing() {
        let mut rig = Rig::single();
        rig.sensors[0].horizontal_fov_deg = 120.0;
        // The points of the wall at the edge of the field of view move out of it.
        let [out, all] = [-4.0, 0.0].map(wall(&rig, 60).1);
        assert_eq!(out, all);
        rig.sensors[0].horizontal_fov_deg = 360.0;
        assert!(wall(&rig, 60).1(-9.0) < all);
    }
}
