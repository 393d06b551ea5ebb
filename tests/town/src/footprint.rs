//! A beam of some width: Gaussian profile, pulses of some length.

use crate::solid::Ray;
use crate::world::Hit;
use nalgebra::Vector3;
use std::f64::consts::TAU;

/// Width of a beam and length of its pulses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Full width between the points of 1 / e^2 of the intensity, rad.
    pub full_width_rad: f64,
    /// Surfaces nearer to each other than this are one return, m.
    pub pulse_m: f64,
}

/// What the receiver reports of a beam.
#[derive(Clone, Copy, Debug, Default)]
pub struct Beam {
    /// The strongest return, at the centroid of its energy.
    pub first: Option<Hit>,
    /// Range of another return, which has at least [`LEAST_SECOND`] of the energy of the first, m.
    pub second_m: Option<f64>,
}

/// Rings of sub-rays: radius in units of half of the full width, number, and energy of a ray relative to the centre.
const RINGS: [(f64, usize); 3] = [(0.35, 6), (0.7, 8), (1.05, 12)];

/// Distance from the plane of the central surface from which on a ray counts as on another surface, m.
const ON_PLANE_M: f64 = 0.03;

/// Smallest energy of a return, as a share of that of a beam that meets one surface.
const LEAST_ENERGY: f64 = 0.08;

/// Smallest energy of a second return, as a share of that of the first.
const LEAST_SECOND: f64 = 0.1;

/// What a beam about a ray meets. `center` is what the ray itself meets.
pub fn mixed(ray: &Ray, center: Option<Hit>, spread: &Spread, cast: impl Fn(&Ray) -> Option<Hit>) -> Beam {
    let beside = ray.direction.cross(&Vector3::z()).normalize();
    let above = beside.cross(&ray.direction);
    let half = spread.full_width_rad / 2.0;
    let sub_ray = |radius: f64, angle: f64| {
        let off = (beside * angle.cos() + above * angle.sin()) * (radius * half);
        Ray { origin: ray.origin, direction: (ray.direction + off).normalize() }
    };
    // Four rays at the rim say whether there is an edge at all.
    let on_plane = |sub: &Ray, hit: Option<Hit>| match (&center, hit) {
        (Some(middle), Some(hit)) => {
            let off = sub.at(hit.range_m) - ray.at(middle.range_m);
            off.dot(&middle.normal).abs() < ON_PLANE_M
        }
        (None, None) => true,
        _ => false,
    };
    let whole = (0..4).all(|i| {
        let sub = sub_ray(RINGS[2].0, TAU * (f64::from(i) + 0.5) / 4.0);
        on_plane(&sub, cast(&sub))
    });
    if whole {
        return Beam { first: center, second_m: None };
    }
    let mut met: Vec<(f64, f64, Hit)> = Vec::new();
    let mut full = 0.0;
    let mut collect = |sub: &Ray, hit: Option<Hit>, weight: f64| {
        full += weight;
        if let Some(hit) = hit {
            let light = hit.reflectivity * hit.cos_incidence(&sub.direction);
            met.push((hit.range_m, weight * light.min(3.0), hit));
        }
    };
    collect(ray, center, 0.4);
    for (radius, number) in RINGS {
        for i in 0..number {
            let sub = sub_ray(radius, TAU * (i as f64 + 0.25) / number as f64);
            collect(&sub, cast(&sub), (-2.0 * radius * radius).exp() * radius * 2.0 / number as f64);
        }
    }
    met.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Returns: runs of surfaces whose neighbours are within a pulse.
    let mut returns: Vec<(f64, f64, Hit)> = Vec::new();
    let mut last = f64::NEG_INFINITY;
    for (range, energy, hit) in met {
        match returns.last_mut() {
            Some(group) if range - last < spread.pulse_m => {
                group.0 += energy * range;
                group.1 += energy;
            }
            _ => returns.push((energy * range, energy, hit)),
        }
        last = range;
    }
    let strong = |group: &&(f64, f64, Hit)| group.1 / full > LEAST_ENERGY * group.2.reflectivity.min(1.0);
    let mut order: Vec<&(f64, f64, Hit)> = returns.iter().filter(strong).collect();
    order.sort_by(|a, b| b.1.total_cmp(&a.1));
    let range = |group: &&(f64, f64, Hit)| group.0 / group.1;
    let first = order.first().map(|group| Hit { range_m: range(group), ..group.2 });
    let second_m = order.get(1).filter(|g| g.1 > LEAST_SECOND * order[0].1).map(range);
    Beam { first, second_m }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::solid::{Block, Material};
    use crate::world::Object;
    use nalgebra::Point3;

    /// A wall of which the part at y > 0 is nearer.
    fn step(near_m: f64, far_m: f64) -> impl Fn(&Ray) -> Option<Hit> {
        move |ray| {
            let near = Block::new([near_m + 1.0, 50.0, 0.0], [2.0, 100.0, 100.0], 0.0);
            let far = Block::new([far_m + 1.0, 0.0, 0.0], [2.0, 200.0, 100.0], 0.0);
            let (range_m, normal) = near.enter(ray).or_else(|| far.enter(ray))?;
            Some(Hit { range_m, normal, material: Material::Plaster, reflectivity: 0.5, object: Object::House(0) })
        }
    }

    fn beam(azimuth: f64, spread: Spread, near: f64, far: f64) -> Beam {
        let ray = Ray { origin: Point3::origin(), direction: crate::sensor::direction(azimuth, 0.0) };
        let cast = step(near, far);
        mixed(&ray, cast(&ray), &spread, cast)
    }

    #[test]
    fn surfaces_within_a_pulse_are_mixed_at_an_edge_alone() {
        let spread = Spread { full_width_rad: 4e-3, pulse_m: 1.5 };
        let range = |azimuth: f64| beam(azimuth, spread, 20.0, 21.0).first.unwrap().range_m;
        assert!((range(0.01) - 20.0).abs() < 0.01 && (range(-0.01) - 21.0).abs() < 0.01);
        let middle = range(0.0);
        assert!((20.3..20.7).contains(&middle), "{middle}");
        assert!(range(5e-4) < middle && middle < range(-5e-4));
    }

    #[test]
    fn surfaces_farther_apart_are_two_returns() {
        let spread = Spread { full_width_rad: 4e-3, pulse_m: 1.0 };
        let both = beam(2e-4, spread, 20.0, 25.0);
        assert!((both.first.unwrap().range_m - 20.0).abs() < 0.05);
        assert!((both.second_m.unwrap() - 25.0).abs() < 0.05);
        assert!(beam(0.01, spread, 20.0, 25.0).second_m.is_none());
    }
}
