//! Shift of an object of the measured cloud against the simulated one. It is fitted to the surface, so that lost
//! returns and other shot directions do not bias it.

use geometry::Box3;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{Matrix3, Point3, Vector3};

/// A return with the surface it lies on, in the cloud's frame.
#[derive(Clone, Copy, Debug)]
pub struct SurfacePoint {
    /// Place, m.
    pub point: Point3<f64>,
    /// Unit normal; zero where it is not known.
    pub normal: Vector3<f64>,
}

/// A fitted shift in the box's own frame (forward, left, up).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoxShift {
    /// Measured minus simulated, m.
    pub shift_m: [f64; 3],
    /// Its standard errors, m; large along directions that the visible faces do not constrain.
    pub error_m: [f64; 3],
    /// What this shift changes by for each metre that the object is longer, wider and higher: the surfaces grow from
    /// the middle, and from the ground.
    pub by_size: [[f64; 3]; 3],
    /// Measured returns used.
    pub points: usize,
}

/// Prior standard deviation of a shift, m.
const PRIOR_M: f64 = 1.0;

/// Rounds of a fit: gate of the distance from the nearest surface point and scale of the weights, m.
const GATES: [(f64, f64); 7] = [(1.2, 0.6), (1.0, 0.4), (0.8, 0.25), (0.6, 0.15), (0.5, 0.1), (0.4, 0.08), (0.4, 0.08)];

/// First rounds, which only lead to where the last ones begin, and the most returns that they use.
const COARSE: usize = 5;
const COARSE_POINTS: usize = 150;

/// Fits the shift that brings the simulated surfaces onto the measured returns: nearest surface point, distance
/// across the surface, redescending weights, gates that narrow.
pub fn fit_shift(bbox: &Box3, measured: &[Point3<f64>], simulated: &[SurfacePoint]) -> Option<BoxShift> {
    if measured.len() < 8 || simulated.len() < 8 {
        return None;
    }
    let local: Vec<(Vector3<f64>, Vector3<f64>)> = simulated
        .iter()
        .map(|s| {
            let tip = bbox.to_local((s.point + s.normal).into());
            let foot = Vector3::from(bbox.to_local(s.point.into()));
            (foot, Vector3::from(tip) - foot)
        })
        .collect();
    let feet: Vec<[f64; 3]> = local.iter().map(|(q, _)| (*q).into()).collect();
    let surfaces = ImmutableKdTree::<f64, 3>::new_from_slice(&feet).ok()?;
    let points: Vec<Vector3<f64>> = measured.iter().map(|p| Vector3::from(bbox.to_local((*p).into()))).collect();
    let mut shift = Vector3::zeros();
    let mut result = None;
    for (round, (gate, scale)) in GATES.into_iter().enumerate() {
        let mut information = Matrix3::identity() / (PRIOR_M * PRIOR_M);
        let mut right = Vector3::zeros();
        let (mut used, mut squares) = (0usize, 0.0);
        let (mut system, mut of_size) = (Matrix3::zeros(), Matrix3::zeros());
        let every = if round < COARSE { points.len().div_ceil(COARSE_POINTS) } else { 1 };
        for p in points.iter().step_by(every) {
            let back = p - shift;
            let nearest = surfaces.query(&back.into()).nearest_one::<SquaredEuclidean<f64>>().execute();
            let (q, n) = &local[nearest.item as usize];
            if nearest.distance > gate * gate || n.norm_squared() < 0.5 {
                continue;
            }
            let off = n.dot(&(p - q)); // across the surface, before any shift
            let now = off - n.dot(&shift);
            let u = now / (4.0 * scale);
            if u.abs() >= 1.0 {
                continue;
            }
            let w = (1.0 - u * u).powi(2);
            system += n * n.transpose() * w;
            right += n * (w * off);
            of_size += n * grown(bbox, q).component_mul(n).transpose() * w;
            squares += w * now * now;
            used += 1;
        }
        if used < 8 {
            return None;
        }
        // Errors of neighbouring returns are correlated: a fifth of them counts.
        let variance = (squares / used as f64).max(1e-5) * 5.0;
        information += system / variance;
        let inverse = information.try_inverse()?;
        shift = inverse * (right / variance);
        let by_size = inverse * of_size / variance;
        result = Some(BoxShift {
            shift_m: shift.into(),
            error_m: [0, 1, 2].map(|k| inverse[(k, k)].sqrt()),
            by_size: [0, 1, 2].map(|k| by_size.column(k).into_owned().into()),
            points: used,
        });
    }
    result
}

/// How far a place in the box's own frame moves for each metre that the object is longer, wider and higher.
fn grown(bbox: &Box3, place: &Vector3<f64>) -> Vector3<f64> {
    let [length, width, height] = bbox.size.map(|m| m.max(0.1));
    Vector3::new(place.x / length, place.y / width, place.z / height + 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Returns on the rear and the left side of a box, seen from behind.
    fn faces(b: &Box3, shift: [f64; 3], step: f64, keep: impl Fn(f64) -> bool) -> Vec<SurfacePoint> {
        let [l, w, h] = b.size;
        let mut points = Vec::new();
        let mut push = |p: [f64; 3], n: [f64; 3]| {
            let at = b.from_local([p[0] + shift[0], p[1] + shift[1], p[2] + shift[2]]);
            let tip = b.from_local([p[0] + shift[0] + n[0], p[1] + shift[1] + n[1], p[2] + shift[2] + n[2]]);
            if keep(p[2]) {
                points.push(SurfacePoint { point: at.into(), normal: Vector3::from(tip) - Vector3::from(at) });
            }
        };
        let (mut z, mut k) = (-h / 2.0 + 0.1, 0);
        while z < h / 2.0 {
            let mut u = step * 0.3 * f64::from(k % 3);
            while u < w {
                push([-l / 2.0, u - w / 2.0, z], [-1.0, 0.0, 0.0]);
                u += step;
            }
            let mut u = step * 0.5 * f64::from(k % 2);
            while u < l {
                push([u - l / 2.0, w / 2.0, z], [0.0, 1.0, 0.0]);
                u += step;
            }
            (z, k) = (z + 0.2, k + 1);
        }
        points
    }

    #[test]
    fn a_shift_is_found_although_half_of_the_returns_are_lost() {
        let b = Box3::from_array([20.0, 3.0, 0.0, 4.8, 1.9, 1.2, 0.4]);
        let simulated = faces(&b, [0.0; 3], 0.13, |_| true);
        let measured = faces(&b, [0.4, -0.1, 0.0], 0.11, |z| z > 0.0);
        let points: Vec<_> = measured.iter().map(|s| s.point).collect();
        let fit = fit_shift(&b, &points, &simulated).unwrap();
        assert!((fit.shift_m[0] - 0.4).abs() < 0.02 && (fit.shift_m[1] + 0.1).abs() < 0.02, "{fit:?}");
        assert!(fit.error_m[2] > 0.5, "no horizontal face, no height: {fit:?}");
    }

    /// Of a longer object the rear is farther back, its side is where it was; of a higher one a roof at its top rises
    /// as much, and a bonnet at half of its height half as much.
    #[test]
    fn what_a_larger_object_does_is_known() {
        let b = Box3::from_array([20.0, 3.0, 0.0, 4.8, 1.9, 1.2, 0.4]);
        let simulated = faces(&b, [0.0; 3], 0.13, |_| true);
        let points: Vec<_> = simulated.iter().map(|s| s.point).collect();
        let [longer, wider, _] = fit_shift(&b, &points, &simulated).unwrap().by_size;
        assert!((longer[0] + 0.5).abs() < 0.03 && longer[1].abs() < 0.03, "{longer:?}");
        assert!((wider[1] - 0.5).abs() < 0.03 && wider[0].abs() < 0.03, "{wider:?}");
        let level = |z: f64| {
            let at = |k: usize| b.from_local([0.1 * k as f64 - 1.0, 0.02 * (k % 7) as f64, z]);
            (0..20).map(at).map(|p| SurfacePoint { point: p.into(), normal: Vector3::z() }).collect::<Vec<_>>()
        };
        for (z, rises) in [(0.6, 1.0), (0.0, 0.5)] {
            let simulated = level(z);
            let points: Vec<_> = simulated.iter().map(|s| s.point).collect();
            let [.., higher] = fit_shift(&b, &points, &simulated).unwrap().by_size;
            assert!((higher[2] - rises).abs() < 0.02, "{z} {higher:?}");
        }
    }
}
