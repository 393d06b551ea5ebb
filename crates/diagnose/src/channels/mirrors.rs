//! Returns behind smooth surfaces, and what a mirror would show there.
//!
//! A shot that one surface reflects like a mirror returns from another one. Its point is reported in the direction of
//! the shot, at the length of the whole path: behind the mirror. Mirrored about the plane of the mirror it lies on the
//! surface that it returned from. A false alarm behind a surface has such an image by chance alone: as often as if it
//! lay at another distance behind it.

use super::mean::origins;
use super::returns::{FEW, OWN_CAR_M, Odd, OddFrame};
use crate::pairing::{FramePair, Lies, Ray};
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Point3;
use sensor::Rig;

/// Smallest distance behind a surface, m: along the ray, and across the surface. The image of a nearer return may be a
/// part of the mirror itself.
const BEHIND_M: [f64; 2] = [2.0, 1.0];

/// Distance from a surface within which an image lies on it: m, and as a share of the distance from the mirror, as the
/// normal of a mirror is known to some hundredths; at most.
const ON: [f64; 3] = [0.4, 0.05, 1.5];

/// Other distances behind a surface, as ratios.
const OTHERS: [f64; 4] = [0.55, 0.75, 1.35, 1.8];

/// Images of the measured returns of one frame behind smooth surfaces.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Images {
    /// Returns behind smooth surfaces.
    pub all: f64,
    /// Those of them whose image lies on a surface.
    pub on_surfaces: f64,
    /// How many images would lie on surfaces if the returns lay at other distances.
    pub by_chance: f64,
}

/// Whether a return lies alone, so far behind a smooth surface that it has an image. Where the simulation has a thing
/// that is not there, all shots go on together.
pub fn is_behind(ray: &Ray) -> bool {
    ray.smooth
        && ray.company < FEW
        && ray.own_range_m() >= OWN_CAR_M
        && ray.lies() == Lies::Behind
        && f64::from(ray.residual_m) > BEHIND_M[0]
        && -ray.across_m() > BEHIND_M[1]
}

/// Number of the returns behind smooth surfaces, in the place of lone ones, and of all returns.
pub fn behind_frame(frame: &FramePair) -> OddFrame {
    let sides = [&frame.measured, &frame.simulated];
    let mut out = OddFrame { all: sides.map(|rays| rays.len() as f64), ..OddFrame::default() };
    out.counts[Odd::Alone as usize] = sides.map(|rays| rays.iter().filter(|ray| is_behind(ray)).count() as f64);
    out
}

/// The images of a frame's measured returns behind smooth surfaces.
pub fn images(frame: &FramePair, rig: &Rig) -> Images {
    let mut out = Images::default();
    let origins = origins(rig);
    let place = |ray: &Ray| ray.point(&origins[usize::from(ray.sensor)]);
    let points: Vec<[f32; 3]> = frame.simulated.iter().map(|ray| place(ray).coords.map(|c| c as f32).into()).collect();
    let Some(tree) = (!points.is_empty()).then(|| ImmutableKdTree::new_from_slice(&points).ok()).flatten() else {
        return out;
    };
    for ray in frame.measured.iter().filter(|ray| is_behind(ray)) {
        let origin = &origins[usize::from(ray.sensor)];
        let on_surface = |times: f64| has_image(&tree, ray, origin, times * f64::from(ray.residual_m));
        out.all += 1.0;
        out.on_surfaces += f64::from(u8::from(on_surface(1.0)));
        let others = OTHERS.iter().filter(|times| on_surface(**times)).count();
        out.by_chance += others as f64 / OTHERS.len() as f64;
    }
    out
}

/// Whether the image of a point so far behind the predicted surface of a ray, m along it, lies on a simulated surface.
fn has_image(tree: &ImmutableKdTree<f32, 3>, ray: &Ray, origin: &Point3<f64>, behind_m: f64) -> bool {
    let (d, n) = (ray.direction_vector(), ray.normal_vector());
    let mirrored = d - n * (2.0 * d.dot(&n));
    let image = ray.predicted_point(origin) + mirrored * behind_m;
    let on_m = (ON[0] + ON[1] * behind_m).min(ON[2]) as f32;
    let image: [f32; 3] = image.coords.map(|c| c as f32).into();
    tree.query(&image).nearest_one::<SquaredEuclidean<f32>>().execute().distance <= on_m * on_m
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Vector3;
    use rand::RngExt;

    /// A street: a glass front 8 m to the left, a row of houses 12 m to the right, both 60 m long. Of the shots at the
    /// glass some return from further on, as `behind_m` says of their directions.
    fn street(behind_m: impl Fn(&Vector3<f64>) -> f64) -> FramePair {
        let shot = |azimuth: f64, elevation: f64| {
            let (sin, cos) = azimuth.sin_cos();
            let d = Vector3::new(cos * elevation.cos(), sin * elevation.cos(), elevation.sin());
            let (wall_m, normal) = if d.y > 0.0 { (8.0, -Vector3::y()) } else { (-12.0, Vector3::y()) };
            let range = wall_m / d.y;
            let met = (range * d.x).abs() < 30.0;
            met.then(|| Ray {
                normal: normal.cast::<f32>().into(),
                cos_incidence: -normal.dot(&d) as f32,
                ..Ray::standing(&(d * range))
            })
        };
        let at = |k: u32| shot(f64::from(k % 720) * 0.0087 + 1e-3, f64::from(k / 720) * 0.02 - 0.1);
        let simulated: Vec<Ray> = (0..720 * 16).filter_map(at).collect();
        let farther = |(k, ray): (usize, &Ray)| {
            let d = ray.direction_vector();
            let ghost = d.y > 0.0 && k % 7 == 0;
            let residual_m = if ghost { behind_m(&d) as f32 } else { 0.0 };
            Ray { residual_m, company: if ghost { 0 } else { 5 }, ..*ray }
        };
        let measured = simulated.iter().enumerate().map(farther).collect();
        FramePair::of_rays(String::new(), measured, simulated)
    }

    #[test]
    fn what_a_mirror_shows_has_an_image_on_a_surface_and_false_returns_have_one_by_chance() {
        let rig = Rig::single();
        // From the glass to the houses.
        let street_of_ghosts = street(|d| 20.0 / d.y);
        assert_eq!(behind_frame(&street_of_ghosts).counts[Odd::Alone as usize][1], 0.0);
        let ghosts = images(&street_of_ghosts, &rig);
        assert!(ghosts.all > 300.0, "{ghosts:?}");
        // The others show what lies beyond the ends of the street.
        assert!(ghosts.on_surfaces > 0.5 * ghosts.all, "{ghosts:?}");
        assert!(ghosts.by_chance < 0.1 * ghosts.all, "{ghosts:?}");
        let rng = std::cell::RefCell::new(data::stream(1, "mirrors test", 0, 0));
        let others = images(&street(|_| rng.borrow_mut().random_range(3.0..60.0)), &rig);
        assert!(others.all > 300.0, "{others:?}");
        assert!((others.on_surfaces - others.by_chance).abs() < 0.1 * others.all, "{others:?}");
    }
}
