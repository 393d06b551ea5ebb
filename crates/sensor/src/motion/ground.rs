//! Motion out of the plane from frame to frame, from the ground: on a banked or hilly road the axis of a turn is not
//! upright in the frame of the vehicle.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{Matrix3, Rotation3, Vector3};
use statistics::{MEDIAN_OF_NORMAL, median_upper};

/// A point of the ground and its unit normal, cloud's frame, m.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundPoint {
    /// The point.
    pub place: Vector3<f64>,
    /// Upward normal.
    pub normal: Vector3<f64>,
}

/// Points of a frame that are used, at most.
pub(super) const SOME: usize = 1500;

/// Largest distance between two points that are on one plane of the road, m.
const REACH_M: f64 = 2.0;

/// Fewest pairs of points.
const FEWEST: usize = 100;

/// Rounds of the robust fit.
const ROUNDS: usize = 4;

/// Distance in standard deviations from which on Tukey's weight is zero: 95 % efficient for normal errors.
const TUKEY: f64 = 4.7;

/// Smallest height above the ground of what stands, m. A ring of returns of the ground resembles standstill, wherever
/// it is cut.
const CLEAR_M: f64 = 0.25;

/// The ground of a frame.
pub struct Ground {
    points: Vec<GroundPoint>,
    /// By place in bird's-eye view; `None` without points.
    tree: Option<ImmutableKdTree<f64, 2>>,
}

impl Ground {
    /// From points of it.
    pub fn new(points: Vec<GroundPoint>) -> Self {
        let places: Vec<[f64; 2]> = points.iter().map(|g| [g.place.x, g.place.y]).collect();
        let tree = ImmutableKdTree::new_from_slice(&places).ok().filter(|_| !places.is_empty());
        Ground { tree, points }
    }

    /// The point that is nearest in bird's-eye view, and its squared distance there, m2; `None` without points.
    fn nearest(&self, p: &Vector3<f64>) -> Option<(&GroundPoint, f64)> {
        let found = self.tree.as_ref()?.query(&[p.x, p.y]).nearest_one::<SquaredEuclidean<f64>>().execute();
        Some((&self.points[found.item as usize], found.distance))
    }

    /// Whether a point is clearly above the plane of the nearest piece of ground; without ground all points are.
    pub fn is_below(&self, p: &Vector3<f64>) -> bool {
        self.nearest(p).is_none_or(|(near, _)| near.normal.dot(&(p - near.place)) > CLEAR_M)
    }
}

/// Climb, m, and turns about the forward and the left axis, rad, of a vehicle that moves ahead by `d` along its mean
/// heading and turns by `yaw`: the least squares of the distances of the ground of the first frame from the planes of
/// the second one, with Tukey's weights. `None` with too few points.
pub(super) fn tilt(first: &Ground, second: &Ground, d: f64, yaw: f64) -> Option<[f64; 3]> {
    let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), -yaw);
    let way = Vector3::new(d * (0.5 * yaw).cos(), d * (0.5 * yaw).sin(), 0.0);
    // Distance from the plane, and its derivatives by the three.
    let distance = |g: &GroundPoint| {
        let p = turn * (g.place - way);
        let (near, _) = second.nearest(&p).filter(|(_, square_m2)| *square_m2 < REACH_M * REACH_M)?;
        let arm = p.cross(&near.normal);
        Some((near.normal.dot(&(p - near.place)), Vector3::new(near.normal.z, arm.x, arm.y)))
    };
    let rows: Vec<(f64, Vector3<f64>)> = first.points.iter().filter_map(distance).collect();
    if rows.len() < FEWEST {
        return None;
    }
    let mut found = Vector3::zeros();
    for _ in 0..ROUNDS {
        let left = |(e, x): &(f64, Vector3<f64>)| e - x.dot(&found);
        let usual = median_upper(rows.iter().map(|r| left(r).abs()).collect())?;
        let width = TUKEY * usual.max(1e-4) / MEDIAN_OF_NORMAL;
        let (mut gram, mut right) = (Matrix3::zeros(), Vector3::zeros());
        for row in &rows {
            let weight = (1.0 - (left(row) / width).powi(2)).max(0.0).powi(2);
            gram += row.1 * row.1.transpose() * weight;
            right += row.1 * (row.0 * weight);
        }
        found = gram.cholesky()?.solve(&right);
    }
    // The vehicle also moves along its mean heading out of the plane.
    Some([found.x + 0.5 * d * found.z, found.y, found.z])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_stands_is_above_a_sloping_ground() {
        let normal = Vector3::new(0.0, -0.3, 1.0).normalize();
        let point = |x: i32, y: i32| GroundPoint {
            place: Vector3::new(f64::from(x), f64::from(y), 0.3 * f64::from(y)),
            normal,
        };
        let ground = Ground::new((-9..9).flat_map(|x| (-9..9).map(move |y| point(x, y))).collect());
        // Far off the known ground its plane goes on.
        for (x, y) in [(0.4, 0.3), (-7.2, 8.0), (3.0, 20.0)] {
            assert!(!ground.is_below(&Vector3::new(x, y, 0.3 * y + 0.2)), "{x} {y}");
            assert!(ground.is_below(&Vector3::new(x, y, 0.3 * y + 0.4)), "{x} {y}");
        }
        assert!(Ground::new(Vec::new()).is_below(&Vector3::zeros()));
    }

    /// The ground that a vehicle sees after `driven` m on a circle of 100 m on a cone that falls to the inside with a
    /// slope of 0.3; `at` are places in its frame.
    fn seen(driven: f64, at: impl Iterator<Item = [f64; 2]>) -> Ground {
        let (radius, slope) = (100.0, 0.3_f64);
        let angle = driven / radius;
        let height = |p: &Vector3<f64>| slope * (p.xy().norm() - radius);
        let place = Vector3::new(radius * angle.sin(), -radius * angle.cos(), 0.0);
        let bank = Rotation3::from_axis_angle(&Vector3::x_axis(), -slope.atan());
        let world_from_ego = Rotation3::from_axis_angle(&Vector3::z_axis(), angle) * bank;
        let points: Vec<GroundPoint> = at
            .map(|[x, y]| {
                // The point of the ground above or below a place in the plane of the vehicle.
                let (mut z, up) = (0.0, world_from_ego * Vector3::z());
                for _ in 0..20 {
                    let p = place + world_from_ego * Vector3::new(x, y, z);
                    z += (height(&p) - p.z) * up.z;
                }
                let p = place + world_from_ego * Vector3::new(x, y, z);
                let out = p.xy() / p.xy().norm();
                let normal = Vector3::new(-slope * out.x, -slope * out.y, 1.0).normalize();
                GroundPoint { place: Vector3::new(x, y, z), normal: world_from_ego.inverse() * normal }
            })
            .collect();
        Ground::new(points)
    }

    #[test]
    fn the_axis_of_a_turn_on_a_banked_road_is_not_upright() {
        // A vehicle on the road stands across its slope; the road rises to the right, which is outside.
        let lines = |off: f64| (0..1200).map(move |k| [f64::from(k % 40) - 20.0 + off, f64::from(k / 40) * 0.5 - 7.0]);
        let (driven, bank) = (8.0, 0.3_f64.atan());
        let turn = driven / 100.0;
        let [climb_m, roll, pitch] =
            tilt(&seen(0.0, lines(0.0)), &seen(driven, lines(0.37)), driven, turn * bank.cos()).unwrap();
        assert!(climb_m.abs() < 0.02 && roll.abs() < 2e-3, "{climb_m} {roll}");
        assert!((pitch + turn * bank.sin()).abs() < 2e-3, "{pitch}");
        let nothing = Ground::new(vec![]);
        assert_eq!(tilt(&nothing, &seen(0.0, lines(0.0)), 1.0, 0.0), None);
        assert_eq!(tilt(&seen(0.0, lines(0.0)), &nothing, 1.0, 0.0), None);
    }
}
