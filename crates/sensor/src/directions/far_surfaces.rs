//! Surfaces beyond the returns that show them.

use crate::scan::dot;
use kiddo::{ImmutableKdTree, SquaredEuclidean};
use std::num::NonZeroUsize;

/// Distance up to which a surface goes on from a return that shows it, m and as a share of the range: rows of a sensor
/// with 16 of them, 1.8 m above a road, meet it at distances that grow by a third from row to row.
const REACH: [f32; 2] = [0.5, 0.4];

/// Distance across a plane up to which a point lies on its continuation, m and as a share of the distance along it.
const ACROSS: [f32; 2] = [0.05, 0.02];

/// Returns on smooth surfaces that are looked at for a point, nearest first.
const CANDIDATES: NonZeroUsize = NonZeroUsize::new(16).expect("not 0");

/// Smallest cosine of incidence of a surface that is met.
pub const LEAST_COS: f32 = 1e-3;

/// Smooth surfaces that go on beyond the returns that show them, as a road does between rows that lie metres apart.
pub struct FarSurfaces {
    tree: Option<ImmutableKdTree<f32, 3>>,
    normals: Vec<[f32; 3]>,
    points: Vec<[f32; 3]>,
}

impl FarSurfaces {
    /// Of returns on smooth surfaces, with the normals there.
    pub fn new(returns: impl Iterator<Item = ([f32; 3], [f32; 3])>) -> Self {
        let (points, normals): (Vec<_>, Vec<_>) = returns.unzip();
        FarSurfaces {
            tree: ImmutableKdTree::new_from_slice(&points).ok().filter(|_| !points.is_empty()),
            normals,
            points,
        }
    }

    /// The normal of the nearest return whose plane goes through a point that a ray meets, and the cosine of the angle
    /// of incidence. None where the plane is seen from behind.
    pub fn through(&self, point: [f32; 3], direction: [f32; 3], range_m: f32) -> Option<([f32; 3], f32)> {
        let reach_m = REACH[0] + REACH[1] * range_m;
        let near = self.tree.as_ref()?.query(&point).nearest_n::<SquaredEuclidean<f32>>(CANDIDATES);
        let near = near.within(reach_m * reach_m).execute();
        let goes_on = |place: usize, squared: f32| {
            let away: [f32; 3] = std::array::from_fn(|k| point[k] - self.points[place][k]);
            dot(self.normals[place], away).abs() < ACROSS[0] + ACROSS[1] * squared.sqrt()
        };
        let found = near.into_iter().find(|n| goes_on(n.item as usize, n.distance))?;
        let normal = self.normals[found.item as usize];
        let cos = -dot(normal, direction);
        (cos > LEAST_COS).then_some((normal, cos))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn planes_go_on_to_points_near_them() {
        let down = [0.8, 0.0, -0.6];
        let wall = ([20.0, 0.0, 1.0], [-1.0, 0.0, 0.0]);
        let surfaces = FarSurfaces::new([([18.0, 0.0, -2.0], [0.0, 0.0, 1.0]), wall].into_iter());
        assert_eq!(surfaces.through([25.0, 0.0, -2.05], down, 25.0).map(|met| met.0), Some([0.0, 0.0, 1.0]));
        assert_eq!(surfaces.through([20.0, 3.0, 1.0], down, 20.0), Some((wall.1, 0.8)));
        for (point, range_m) in [([25.0, 0.0, -1.0], 25.0), ([40.0, 0.0, -2.0], 40.0)] {
            assert_eq!(surfaces.through(point, down, range_m), None, "beside the planes, or too far along one");
        }
        assert_eq!(FarSurfaces::new(std::iter::empty()).through([1.0, 0.0, 0.0], down, 1.0), None);
        assert_eq!(surfaces.through([20.0, 3.0, 1.0], [-0.8, 0.0, -0.6], 20.0), None, "from behind");
    }
}
