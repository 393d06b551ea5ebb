//! The surface around a direction, from the returns around it.
//!
//! A plane n . p = h seen from the origin along the unit direction u has the inverse range q = n . u / h: linear in
//! u, so that a linear fit of q in the two angles is exact for planes up to second order of the window.

use super::scan::{DirectionIndex, Entry, Neighbour};

/// A local plane in inverse range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LocalSurface {
    /// Predicted range along the direction, m.
    pub range_m: f64,
    /// Change of range with azimuth times cos(elevation), and with elevation, m/rad.
    pub slope_m_per_rad: [f64; 2],
    /// Cosine of the angle of incidence.
    pub cos_incidence: f64,
    /// Variance of the prediction in units of the variance of one range.
    pub leverage: f64,
    /// Largest distance of a neighbour from the plane, across it, m.
    pub misfit_m: f64,
    /// Largest distance of a neighbour from the plane along its ray, m.
    pub misfit_along_m: f64,
    /// Nearest and farthest neighbour, m.
    pub near_far_m: [f64; 2],
    /// Range of the neighbour closest in direction minus the range of the plane there, m: the deviation from a plane.
    pub bulge_m: f64,
}

/// Fewest neighbours of a surface.
const FEWEST: usize = 5;

/// Smallest inverse range, 1/m: surfaces farther than 10 km are none.
const LEAST_INVERSE_RANGE: f64 = 1e-4;

/// Smallest area between three directions that make a plane, in windows squared: two of them a tenth of a window apart
/// in one angle, a third of one in the other.
const LEAST_AREA: f64 = 0.03;

/// Support of a plane by the logarithm of its cosine of incidence: at 0.02 it counts as one neighbour less.
const NORMAL_INCIDENCE: f64 = 0.25;

/// Largest distance of a neighbour from the plane along its ray: as a share of the difference of the nearest and the
/// farthest range, and in m. Between the top of a wall and the road behind it a plane at grazing incidence fits, from
/// which no neighbour is far across.
const ALONG: (f64, f64) = (0.15, 0.5);

/// Largest distance of a neighbour from the plane along its ray, by the nearest and the farthest range, m.
fn most_along_m([near, far]: [f64; 2]) -> f64 {
    (ALONG.0 * (far - near)).max(ALONG.1)
}

/// Fits the surface around a direction to the neighbours that `keep` accepts. `None` where they are too few, or lie
/// on a line.
pub fn fit_surface(
    index: &DirectionIndex,
    window: [f64; 2],
    az: f32,
    el: f32,
    keep: impl Fn(&Entry) -> bool,
) -> Option<LocalSurface> {
    let mut near = Points::default();
    index.around(az, el, |entry, dx, dy| {
        if keep(entry) {
            near.push(entry, [dx, dy]);
        }
    });
    near.surface(window, el)
}

/// The same, to neighbours that are known.
pub fn fit_surface_to<'a>(
    neighbours: impl Iterator<Item = &'a Neighbour>,
    window: [f64; 2],
    el: f32,
) -> Option<LocalSurface> {
    let mut near = Points::default();
    neighbours.for_each(|n| near.push(&n.entry, n.offset));
    near.surface(window, el)
}

/// Most neighbours of a fit.
const MOST: usize = 32;

/// A neighbour of a direction.
#[derive(Clone, Copy, Default)]
struct Point {
    /// Offset in azimuth and elevation, in windows.
    x: f64,
    y: f64,
    /// m.
    range: f64,
    /// 1/m.
    inverse_range: f64,
    weight: f64,
}

/// The first neighbours of a direction.
#[derive(Default)]
struct Points {
    points: [Point; MOST],
    n: usize,
}

impl Points {
    fn push(&mut self, entry: &Entry, offset: [f32; 2]) {
        if self.n < MOST {
            let [x, y] = offset.map(f64::from);
            let weight = (1.0 - 0.7 * (x * x + y * y).min(1.2)).max(0.05);
            let range = f64::from(entry.range_m);
            self.points[self.n] = Point { x, y, range, inverse_range: 1.0 / range, weight };
            self.n += 1;
        }
    }

    /// The surface of points that lie around the direction.
    fn surface(&self, window: [f64; 2], el: f32) -> Option<LocalSurface> {
        let near = &self.points[..self.n];
        Plane::fit(near).filter(Plane::is_inside).map(|plane| plane.surface(near, window, el))
    }
}

/// Fits the surface of one of the neighbours of a direction, which are of several surfaces: of the planes `through` it,
/// given by its number, and two others the one with the largest support, fitted again to the neighbours that support
/// it. A neighbour gives 1 - d^2, where d is the distance across in units of `edge_m`, or that along the ray in units
/// of its limit, whichever is more. Of two with as many neighbours the one closer to normal incidence is taken: a plane
/// through both sides of an edge is met at grazing incidence. `None` where fewer than five are on it, or on a line.
pub fn fit_surface_through(
    index: &DirectionIndex,
    window: [f64; 2],
    az: f32,
    el: f32,
    through: u32,
    edge_m: f64,
) -> Option<LocalSurface> {
    let (mut near, mut at) = (Points::default(), None);
    index.around(az, el, |entry, dx, dy| {
        near.push(entry, [dx, dy]);
        at = if entry.index == through { Some([dx, dy].map(f64::from)) } else { at };
    });
    let near = &mut near.points[..near.n];
    let at = at.filter(|_| near.len() >= FEWEST)?;
    let squared = |p: &Point| (p.x - at[0]).powi(2) + (p.y - at[1]).powi(2);
    near.sort_unstable_by(|a, b| squared(a).total_cmp(&squared(b)));
    let ranges = near.iter().map(|p| p.range);
    let along_m = most_along_m(ranges.fold([f64::INFINITY, 0.0f64], |[l, h], r| [l.min(r), h.max(r)]));
    let cos = |[q0, bx, by]: [f64; 3]| {
        let (gx, gy) = (bx / window[0] / f64::from(el.cos()) / q0, by / window[1] / q0);
        1.0 / (1.0 + gx * gx + gy * gy).sqrt()
    };
    // What a neighbour gives to a plane with that cosine of incidence.
    let support = |plane: [f64; 3], cos: f64, p: &Point| {
        let predicted = plane[0] + plane[1] * p.x + plane[2] * p.y;
        if plane[0] < LEAST_INVERSE_RANGE || predicted < LEAST_INVERSE_RANGE {
            return 0.0;
        }
        let along = p.range - 1.0 / predicted;
        (1.0 - (along * cos / edge_m).powi(2).max((along / along_m).powi(2))).max(0.0)
    };
    let total = |plane: [f64; 3]| {
        let cos = cos(plane);
        near.iter().map(|p| support(plane, cos, p)).sum::<f64>() + NORMAL_INCIDENCE * cos.ln()
    };
    let others = (1..near.len()).flat_map(|i| (1..i).map(move |j| (i, j)));
    let planes = others.filter_map(|(i, j)| plane_through([near[0], near[i], near[j]]));
    let (_, best) = planes.map(|plane| (total(plane), plane)).max_by(|a, b| a.0.total_cmp(&b.0))?;
    let mut on = Points::default();
    for p in near.iter() {
        let share = support(best, cos(best), p);
        if share > 0.0 {
            on.points[on.n] = Point { weight: p.weight * share * share, ..*p };
            on.n += 1;
        }
    }
    let on = &on.points[..on.n];
    Plane::fit(on).map(|plane| plane.surface(on, window, el))
}

/// Inverse range at the middle and its slopes of the plane through three neighbours; `None` where they are on a line.
fn plane_through([first, a, b]: [Point; 3]) -> Option<[f64; 3]> {
    let [[xa, ya, qa], [xb, yb, qb]] =
        [a, b].map(|p| [p.x - first.x, p.y - first.y, p.inverse_range - first.inverse_range]);
    let det = xa * yb - xb * ya;
    let (bx, by) = ((qa * yb - qb * ya) / det, (xa * qb - xb * qa) / det);
    (det.abs() >= LEAST_AREA).then_some([first.inverse_range - bx * first.x - by * first.y, bx, by])
}

/// A weighted linear fit of the inverse range over offsets in windows.
struct Plane {
    /// Sum of the weights.
    weights: f64,
    /// Weighted means of the offsets.
    mean: [f64; 2],
    /// Second central moments of the offsets and their determinant.
    moments: [f64; 3],
    determinant: f64,
    /// Inverse range at the direction, and its slopes.
    q0: f64,
    slope: [f64; 2],
}

impl Plane {
    /// Fits neighbours; `None` where they are too few, or lie on a line.
    fn fit(near: &[Point]) -> Option<Plane> {
        if near.len() < FEWEST {
            return None;
        }
        let mut s = [0.0f64; 9]; // w, wx, wy, wxx, wxy, wyy, wq, wxq, wyq
        for &Point { x, y, inverse_range: q, weight: w, .. } in near {
            for (sum, v) in s.iter_mut().zip([1.0, x, y, x * x, x * y, y * y, q, x * q, y * q]) {
                *sum += w * v;
            }
        }
        let (mx, my, mq) = (s[1] / s[0], s[2] / s[0], s[6] / s[0]);
        let (xx, xy, yy) = (s[3] - s[0] * mx * mx, s[4] - s[0] * mx * my, s[5] - s[0] * my * my);
        let (xq, yq) = (s[7] - s[0] * mx * mq, s[8] - s[0] * my * mq);
        let det = xx * yy - xy * xy;
        if xx < 0.02 * s[0] || yy < 0.02 * s[0] || det < 0.1 * xx * yy {
            return None;
        }
        let (bx, by) = ((yy * xq - xy * yq) / det, (xx * yq - xy * xq) / det);
        let q0 = mq - bx * mx - by * my;
        let plane =
            Plane { weights: s[0], mean: [mx, my], moments: [xx, xy, yy], determinant: det, q0, slope: [bx, by] };
        (q0 > LEAST_INVERSE_RANGE).then_some(plane)
    }

    /// Whether the neighbours lie around the direction, not all to one side of it.
    fn is_inside(&self) -> bool {
        self.mean.iter().all(|m| m.abs() <= 0.6)
    }

    /// The surface, with what the neighbours say of its flatness.
    fn surface(&self, near: &[Point], window: [f64; 2], el: f32) -> LocalSurface {
        let (q0, [bx, by]) = (self.q0, self.slope);
        let range = 1.0 / q0;
        // The inverse range at the direction is the sum of those of the neighbours, each with its weight times
        // `level` + `by_x` x + `by_y` y, x and y from the mean.
        let ([mx, my], [xx, xy, yy]) = (self.mean, self.moments);
        let [by_x, by_y] = [my * xy - mx * yy, mx * xy - my * xx].map(|v| v / self.determinant);
        let level = 1.0 / self.weights;
        let (mut leverage, mut misfit, mut along) = (0.0f64, 0.0f64, 0.0f64);
        let mut near_far = [f64::INFINITY, 0.0f64];
        let (mut closest, mut bulge) = (f64::INFINITY, 0.0);
        let (gx, gy) = (bx / window[0] / f64::from(el.cos()), by / window[1]);
        let cos = 1.0 / (1.0 + (gx * gx + gy * gy) * range * range).sqrt();
        for &Point { x, y, range: own, inverse_range: q, weight } in near {
            // An error dR of a range is one of q^2 dR of the inverse range.
            leverage += (weight * (level + by_x * (x - mx) + by_y * (y - my)) * (q * range).powi(2)).powi(2);
            let predicted = q0 + bx * x + by * y;
            let met = predicted > LEAST_INVERSE_RANGE;
            let predicted_m = 1.0 / predicted.max(LEAST_INVERSE_RANGE);
            let off = if met { (own - predicted_m).abs() } else { f64::INFINITY };
            along = along.max(off);
            // The smaller of the two ranges by the larger one.
            let ratio = if predicted_m < range { predicted_m * q0 } else { predicted.max(LEAST_INVERSE_RANGE) * range };
            misfit = misfit.max(off * cos * ratio);
            near_far = [near_far[0].min(own), near_far[1].max(own)];
            let distance = x * x + y * y;
            if distance < closest && met {
                (closest, bulge) = (distance, own - predicted_m);
            }
        }
        LocalSurface {
            range_m: range,
            slope_m_per_rad: [-gx * range * range, -gy * range * range],
            cos_incidence: cos,
            leverage,
            misfit_m: misfit,
            misfit_along_m: along,
            near_far_m: near_far,
            bulge_m: bulge,
        }
    }
}

impl LocalSurface {
    /// Whether the neighbours lie on one surface: within `edge_m` of the plane across it, and along their rays no
    /// farther than on a plane at this incidence.
    pub fn smooth(&self, edge_m: f64) -> bool {
        self.smooth_but_for(0.0, edge_m)
    }

    /// The same where ranges may be off by `noise_m`.
    pub fn smooth_but_for(&self, noise_m: f64, edge_m: f64) -> bool {
        self.misfit_m < edge_m + self.cos_incidence * noise_m
            && self.misfit_along_m < most_along_m(self.near_far_m) + noise_m
    }

    /// Unit normal towards the sensor, in the basis (along the ray, along growing azimuth, along growing elevation).
    pub fn normal(&self) -> [f64; 3] {
        let c = self.cos_incidence;
        [-c, c * self.slope_m_per_rad[0] / self.range_m, c * self.slope_m_per_rad[1] / self.range_m]
    }
}

#[cfg(test)]
mod tests {
    use super::super::scan::{SensorScan, Steps};
    use super::*;
    use nalgebra::Vector3;

    fn direction(az: f64, el: f64) -> Vector3<f64> {
        Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin())
    }

    /// A plane n . p = h seen by a grid of rays.
    fn plane(normal: Vector3<f64>, h: f64, step: f64) -> (DirectionIndex, [f64; 2]) {
        let mut scan = SensorScan::default();
        for i in -10..10 {
            for j in -10..10 {
                let (az, el) = (0.3 + i as f64 * step, -0.1 + j as f64 * 2.0 * step);
                let range = h / normal.dot(&direction(az, el));
                if range > 0.0 {
                    scan.azimuth_rad.push(az as f32);
                    scan.elevation_rad.push(el as f32);
                    scan.range_m.push(range as f32);
                }
            }
        }
        let window = [2.1 * step, 2.6 * step];
        let steps = Steps { azimuth_rad: window[0] as f32, elevation_rad: window[1] as f32 };
        (DirectionIndex::new(&scan, steps, false), window)
    }

    #[test]
    fn planes_are_predicted_between_the_rays() {
        for (normal, h) in [(Vector3::new(0.0, 0.0, -1.0), 1.5), (Vector3::new(0.8, 0.6, 0.0), 20.0)] {
            let (index, window) = plane(normal, h, 0.004);
            let (az, el) = (0.3017f64, -0.1031f64);
            let s = fit_surface(&index, window, az as f32, el as f32, |_| true).unwrap();
            let u = direction(f64::from(az as f32), f64::from(el as f32));
            let range = h / normal.dot(&u);
            assert!((s.range_m - range).abs() < 2e-3, "{} {range}", s.range_m);
            assert!((s.cos_incidence / normal.dot(&u).abs() - 1.0).abs() < 0.01);
            assert!(s.misfit_m < 1e-2 && s.smooth(0.12) && s.leverage < 0.5, "{s:?}");
            let side = Vector3::new(-az.sin(), az.cos(), 0.0);
            let up = u.cross(&side);
            let [a, b, c] = s.normal();
            let n = u * a + side * b + up * c;
            assert!((n + normal).norm() < 0.02, "{n} {normal}");
        }
    }

    #[test]
    fn the_top_of_a_wall_and_the_road_behind_it_are_no_plane_at_grazing_incidence() {
        let (mut scan, step) = (SensorScan::default(), 0.01);
        for row in -3..4 {
            for i in -10..10 {
                let (az, el) = (0.1 * step * f64::from(i), -0.04 + step * f64::from(row));
                let road = 1.5 / -el.sin();
                scan.azimuth_rad.push(az as f32);
                scan.elevation_rad.push(el as f32);
                scan.range_m.push(if row < 0 { 0.4 * road } else { road } as f32);
            }
        }
        let window = [0.22 * step, 1.4 * step];
        let index =
            DirectionIndex::new(&scan, Steps { azimuth_rad: window[0] as f32, elevation_rad: window[1] as f32 }, false);
        let at = |el: f64| fit_surface(&index, window, 1e-4, el as f32, |_| true).unwrap();
        let (edge, road) = (at(-0.05), at(-0.03));
        assert!(road.smooth(0.12) && (road.cos_incidence / 0.03 - 1.0).abs() < 0.02, "{road:?}");
        assert!(!edge.smooth(0.12), "{edge:?}");
    }

    /// A wall 10 m ahead that ends in front of another one, oblique and farther: each side has its own plane, up to the
    /// edge.
    #[test]
    fn at_an_edge_the_surface_is_that_of_the_nearest_return() {
        let (mut scan, step) = (SensorScan::default(), 0.004);
        let (near, far) = ((Vector3::x(), 10.0), (Vector3::new(0.8, 0.6, 0.0), 14.0));
        let range = |(normal, h): (Vector3<f64>, f64), az: f64, el: f64| h / normal.dot(&direction(az, el));
        for i in -10..10 {
            for j in -10..10 {
                let (az, el) = (f64::from(i) * step, f64::from(j) * 2.0 * step);
                scan.azimuth_rad.push(az as f32);
                scan.elevation_rad.push(el as f32);
                scan.range_m.push(range(if i < 0 { near } else { far }, az, el) as f32);
            }
        }
        let window = [2.2 * step, 2.8 * step];
        let steps = Steps { azimuth_rad: window[0] as f32, elevation_rad: window[1] as f32 };
        let index = DirectionIndex::new(&scan, steps, false);
        for (az, of) in [(-0.6 * step, near), (-0.4 * step, far), (0.3 * step, far), (-1.2 * step, near)] {
            let el = 0.3 * step;
            assert!(fit_surface(&index, window, az as f32, el as f32, |_| true).is_none_or(|s| !s.smooth(0.12)));
            let mut nearest = (f32::INFINITY, 0);
            index.around(az as f32, el as f32, |e, dx, dy| {
                let distance = dx * dx + dy * dy;
                nearest = if distance < nearest.0 { (distance, e.index) } else { nearest };
            });
            let s = fit_surface_through(&index, window, az as f32, el as f32, nearest.1, 0.12).unwrap();
            assert!((s.range_m - range(of, az, el)).abs() < 5e-3 && s.bulge_m.abs() < 5e-3, "{az}: {s:?}");
        }
    }

    #[test]
    fn an_edge_misfits_and_a_line_is_no_surface() {
        let (index, window) = plane(Vector3::x(), 10.0, 0.004);
        let far = fit_surface(&index, window, 0.3, -0.1, |e| e.elevation_rad > -0.104 && e.elevation_rad < -0.096);
        assert!(far.is_none());
    }
}
