//! The air behind vehicles, where wheels throw up water and dust, and as a comparison the air before them.

use super::mask::on_ego_vehicle;
use crate::pairing::{FramePair, Ray};
use geometry::Box3;
use nalgebra::Point3;
use sensor::directions::in_or_beside;
use std::collections::HashSet;

/// Where the air behind a vehicle begins, m from its box: nearer returns may be those of a longer vehicle.
const FROM_M: f64 = 1.5;

/// Where the air begins over the ground, m: what is lower may be the ground.
const OVER_GROUND_M: f64 = 0.35;

/// How far the air behind a vehicle reaches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    /// Distance from the vehicle, m.
    pub until_m: f64,
    /// Height over the ground, m.
    pub height_m: f64,
    /// Beyond the vehicle's width on either side, m.
    pub beside_m: f64,
}

/// The largest extent.
pub const MOST: Extent = Extent { until_m: 13.5, height_m: 2.0, beside_m: 0.3 };

/// Distance from other labelled objects within which returns may be theirs, m.
const OTHERS_M: f64 = 0.8;

/// Margin around the air within which droplets may lie that are not counted as such, m: along the vehicle, across it
/// and upwards.
const AROUND_M: [f64; 3] = [1.2, 1.0, 1.0];

/// Smallest length of what is a vehicle, m.
const LEAST_LENGTH_M: f64 = 2.5;

/// A return in the air behind a vehicle, or before one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Droplet {
    /// Distance from the box, m.
    pub behind_m: f64,
    /// Height over the ground of the box, m.
    pub over_ground_m: f64,
    /// Whether the simulation has a surface behind it, to which the path of the shot goes.
    pub on_path: bool,
}

/// What one frame shows of the air behind vehicles, and of that before them.
#[derive(Clone, Debug, Default)]
pub struct PlumeFrame {
    /// Returns that nothing simulated explains: behind, before; measured.
    pub measured: [Vec<Droplet>; 2],
    /// The same of the simulated side.
    pub simulated: [Vec<Droplet>; 2],
    /// Places of all returns of either side in the air behind vehicles or around it, measured first.
    pub around: [HashSet<usize>; 2],
    /// Paths of shots with a simulated surface, m: behind, before.
    pub paths_m: [Vec<f32>; 2],
    /// The air behind each vehicle.
    pub plumes: Vec<Plume>,
}

/// The air behind one vehicle.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Plume {
    /// Speed of the vehicle over the ground, m/s, where it is known.
    pub speed_m_s: Option<f64>,
    /// Paths of shots with a simulated surface, m, and the whole path of each in the plume, also close to the vehicle,
    /// to the ground and to the surface, where droplets are not counted: one there hides others behind it.
    pub paths_m: Vec<[f32; 2]>,
    /// Measured droplets on such paths.
    pub droplets: f64,
}

impl PlumeFrame {
    /// Metres of all paths: behind, before.
    pub fn path_m(&self, place: usize) -> f64 {
        self.paths_m[place].iter().copied().map(f64::from).sum()
    }
}

/// The air of a vehicle: behind it (0) or before it (1).
struct Air<'a> {
    vehicle: &'a Box3,
    place: usize,
    /// Where droplets are counted.
    air: Box3,
    /// From the vehicle and from the ground on.
    whole: Box3,
}

impl Air<'_> {
    fn of(vehicle: &Box3, Extent { until_m, height_m, beside_m }: Extent) -> [Air<'_>; 2] {
        let until_m = until_m.max(FROM_M + 0.5);
        let height_m = height_m.max(OVER_GROUND_M + 0.1);
        let part = |place: usize, from_m: f64, over_ground_m: f64| {
            let [from, to] = [from_m, until_m].map(|m| vehicle.size[0] / 2.0 + m);
            let along = if place == 0 { -(from + to) / 2.0 } else { (from + to) / 2.0 };
            let [low, high] = [over_ground_m, height_m].map(|m| m - vehicle.size[2] / 2.0);
            let center = vehicle.from_local([along, 0.0, (low + high) / 2.0]);
            let size = [to - from, vehicle.size[1] + 2.0 * beside_m, high - low];
            Box3 { center, size, yaw_rad: vehicle.yaw_rad }
        };
        [0, 1].map(|place| Air {
            vehicle,
            place,
            air: part(place, FROM_M, OVER_GROUND_M),
            whole: part(place, 0.0, 0.0),
        })
    }

    /// Whether a point lies in this air or around it.
    fn is_around(&self, point: [f64; 3]) -> bool {
        let local = self.air.to_local(point);
        (0..3).all(|k| local[k].abs() <= self.air.size[k] / 2.0 + AROUND_M[k])
    }

    /// A return at a point, where it lies in this air.
    fn droplet(&self, on_path: bool, point: [f64; 3]) -> Option<Droplet> {
        let local = self.air.to_local(point);
        if (0..3).any(|k| local[k].abs() > self.air.size[k] / 2.0) {
            return None;
        }
        let of_vehicle = self.vehicle.to_local(point);
        Some(Droplet {
            on_path,
            behind_m: of_vehicle[0].abs() - self.vehicle.size[0] / 2.0,
            over_ground_m: of_vehicle[2] + self.vehicle.size[2] / 2.0,
        })
    }
}

/// The air around the vehicles of a frame; `origins` are those of the sensors, in the cloud's frame, `speed_m_s` is
/// that of a vehicle over the ground.
pub fn plume_frame(
    frame: &FramePair,
    origins: &[Point3<f64>],
    extent: Extent,
    speed_m_s: &dyn Fn(&Box3) -> Option<f64>,
) -> PlumeFrame {
    let boxes: Vec<Box3> = frame.objects.iter().flat_map(|o| [o.simulated, o.measured]).flatten().collect();
    let vehicles: Vec<Box3> = frame.objects.iter().filter_map(|o| o.simulated).collect();
    let vehicles = vehicles.iter().filter(|b| b.size[0] > LEAST_LENGTH_M);
    // The ego vehicle's own air is that of the sensors.
    let vehicles = vehicles.filter(|b| origins.iter().all(|o| !in_or_beside(b, (*o).into(), OTHERS_M)));
    let vehicles: Vec<&Box3> = vehicles.collect();
    // Two for each vehicle: behind it, before it.
    let airs: Vec<Air> = vehicles.iter().flat_map(|b| Air::of(b, extent)).collect();
    let plume = |b: &&Box3| Plume { speed_m_s: speed_m_s(b), ..Plume::default() };
    let mut out = PlumeFrame { plumes: vehicles.iter().map(plume).collect(), ..PlumeFrame::default() };
    if airs.is_empty() {
        return out;
    }
    for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
        let in_the_air = |ray: &Ray| ray.is_in_the_air() && !on_ego_vehicle(ray);
        for (i, ray) in rays.iter().enumerate().filter(|(_, ray)| in_the_air(ray)) {
            let point: [f64; 3] = ray.point(&origins[ray.sensor as usize]).into();
            if airs.iter().any(|air| air.place == 0 && air.is_around(point)) {
                out.around[side].insert(i);
            }
            if boxes.iter().any(|b| in_or_beside(b, point, OTHERS_M)) {
                continue;
            }
            let of_air = |(k, air): (usize, &Air)| Some((k, air.place, air.droplet(ray.smooth, point)?));
            if let Some((k, place, droplet)) = airs.iter().enumerate().find_map(of_air) {
                let found = if side == 0 { &mut out.measured } else { &mut out.simulated };
                found[place].push(droplet);
                if side == 0 && place == 0 && droplet.on_path {
                    out.plumes[k / 2].droplets += 1.0;
                }
            }
        }
    }
    for ray in frame.simulated.iter().filter(|r| r.smooth) {
        let origin: [f64; 3] = origins[ray.sensor as usize].into();
        let (range_m, direction) = (ray.own_range_m(), ray.direction_vector().into());
        let path_m = |of: &Box3, until_m: f64| of.path_through(origin, direction, until_m).map(|[a, b]| (b - a) as f32);
        for (k, air) in airs.iter().enumerate() {
            let Some(counted) = path_m(&air.air, range_m - super::returns::margin_m(ray)) else { continue };
            out.paths_m[air.place].push(counted);
            if air.place == 0 {
                let whole = path_m(&air.whole, range_m).unwrap_or(counted).max(counted);
                out.plumes[k / 2].paths_m.push([counted, whole]);
            }
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_air_is_behind_and_before_a_vehicle_and_above_the_ground() {
        let car = Box3::from_array([20.0, 5.0, 0.8, 4.0, 2.0, 1.6, std::f64::consts::PI]);
        let [behind, before] = Air::of(&car, MOST);
        let droplet = behind.droplet(true, [20.0 + 2.0 + 4.0, 5.0, 1.0]).unwrap();
        assert!((droplet.behind_m - 4.0).abs() < 1e-9 && (droplet.over_ground_m - 1.0).abs() < 1e-9);
        assert!(before.droplet(true, [20.0 - 2.0 - 4.0, 5.0, 1.0]).is_some());
        for point in [[23.0, 5.0, 1.0], [26.0, 5.0, 0.2], [26.0, 7.0, 1.0], [40.0, 5.0, 1.0]] {
            assert!(behind.droplet(true, point).is_none(), "{point:?}");
        }
    }
}
