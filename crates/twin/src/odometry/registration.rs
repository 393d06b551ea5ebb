//! The alignment of points to a map: iterated least squares with a robust kernel.

use super::motion::exp;
use super::voxels::VoxelMap;
use geometry::Pose;
use nalgebra::{Matrix3, Matrix6, Point3, Vector3, Vector6};
use rayon::prelude::*;

/// Points whose equations one task sums. Sums are made of these pieces in their order, for any number of threads.
const PIECE: usize = 256;

/// Parameters of [`align`].
pub(super) struct Registration {
    /// Neighbours farther than this are not used, m.
    pub max_distance_m: f64,
    /// Scale of the kernel, m2: a squared residual of this size has a quarter of the weight.
    pub kernel_m2: f64,
    /// Most iterations.
    pub max_iterations: usize,
    /// The alignment ends with a step below this, m and rad.
    pub least_step: f64,
}

/// The pose that brings points of the LiDAR frame to the map, point to point, beginning with `start`.
pub(super) fn align(points: &[Point3<f64>], map: &VoxelMap, start: &Pose, parameters: &Registration) -> Pose {
    let mut world_from_lidar = *start;
    for _ in 0..parameters.max_iterations {
        let center = world_from_lidar.translation.vector;
        let equations = sum_of_equations(points, |equations, p| {
            let p = world_from_lidar * p;
            let Some(near) = map.nearest(&p, parameters.max_distance_m) else { return };
            let residual = p - near;
            let weight = geman_mcclure(residual.norm_squared(), parameters.kernel_m2);
            equations.add_point(&(p - center), &residual, weight);
        });
        let Some(step) = equations.solve() else { break };
        world_from_lidar = moved(&world_from_lidar, &step);
        if step.norm() < parameters.least_step {
            break;
        }
    }
    world_from_lidar
}

/// A pose after a step whose twist is about the position of the pose, along the axes of the world. Far from the origin
/// of the world, a twist about the origin would make the equations ill-conditioned.
pub(super) fn moved(world_from_lidar: &Pose, step: &Vector6<f64>) -> Pose {
    let center = world_from_lidar.translation;
    let mut pose = center * exp(step) * world_from_lidar.rotation;
    pose.rotation.renormalize();
    pose
}

/// The weight of Geman and McClure's kernel.
pub(super) fn geman_mcclure(residual_m2: f64, kernel_m2: f64) -> f64 {
    (kernel_m2 / (kernel_m2 + residual_m2)).powi(2)
}

/// The sum of what `add` adds for each point, in a fixed order.
pub(super) fn sum_of_equations(points: &[Point3<f64>], add: impl Fn(&mut Equations, &Point3<f64>) + Sync) -> Equations {
    let piece = |points: &[Point3<f64>]| {
        let mut equations = Equations::default();
        points.iter().for_each(|p| add(&mut equations, p));
        equations
    };
    let pieces: Vec<Equations> = points.par_chunks(PIECE).map(piece).collect();
    pieces.into_iter().fold(Equations::default(), Equations::plus)
}

/// Normal equations of a step: a twist about the position of the sensor, along the axes of the world.
#[derive(Clone, Debug, Default)]
pub(super) struct Equations {
    matrix: Matrix6<f64>,
    right: Vector6<f64>,
    /// Number of residuals.
    pub count: usize,
}

impl Equations {
    /// Adds the residual of a point at `p` (m, from the position of the sensor) from its neighbour. The Jacobian is
    /// [I, -[p]x].
    fn add_point(&mut self, p: &Point3<f64>, residual: &Vector3<f64>, weight: f64) {
        let cross = p.coords.cross_matrix();
        let weighted = weight * cross;
        let mut block = self.matrix.fixed_view_mut::<3, 3>(0, 0);
        block += Matrix3::from_diagonal_element(weight);
        let mut block = self.matrix.fixed_view_mut::<3, 3>(0, 3);
        block -= weighted;
        let mut block = self.matrix.fixed_view_mut::<3, 3>(3, 3);
        block -= weighted * cross;
        let mut part = self.right.fixed_rows_mut::<3>(0);
        part += weight * residual;
        let mut part = self.right.fixed_rows_mut::<3>(3);
        part += weighted * residual;
        self.count += 1;
    }

    /// Adds the distance of a point at `p` (m, from the position of the sensor) from a plane along its unit `normal`.
    pub(super) fn add_plane(&mut self, p: &Point3<f64>, normal: &Vector3<f64>, distance_m: f64, weight: f64) {
        let turn = p.coords.cross(normal);
        let row = Vector6::new(normal.x, normal.y, normal.z, turn.x, turn.y, turn.z);
        self.matrix += weight * row * row.transpose();
        self.right += (weight * distance_m) * row;
        self.count += 1;
    }

    fn plus(mut self, other: Equations) -> Equations {
        self.matrix += other.matrix;
        self.right += other.right;
        self.count += other.count;
        self
    }

    /// The step; `None` if the points do not determine it.
    pub(super) fn solve(&self) -> Option<Vector6<f64>> {
        let mut matrix = self.matrix;
        // Only the upper triangle was summed for points.
        matrix.fill_lower_triangle_with_upper_triangle();
        let step = -matrix.cholesky()?.solve(&self.right);
        step.iter().all(|v| v.is_finite()).then_some(step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_moved_cloud_is_moved_back() {
        // Three walls that are sampled densely, and the same points seen from a pose.
        let wall = |i: usize| {
            let (a, b) = ((i % 25) as f64 * 0.4 - 5.0, (i / 25) as f64 * 0.4);
            [[a, 5.0, b], [-5.0, a, b], [a, b - 5.0, 0.0]].map(Point3::from)
        };
        let world: Vec<Point3<f64>> = (0..625).flat_map(wall).collect();
        let mut map = VoxelMap::new(1.0, 20);
        map.add(world.iter().copied());
        let truth = Pose::new(Vector3::new(0.1, -0.08, 0.05), Vector3::new(0.005, -0.004, 0.01));
        let cloud: Vec<Point3<f64>> = world.iter().map(|p| truth.inverse() * p).collect();
        let parameters = Registration { max_distance_m: 1.0, kernel_m2: 0.3, max_iterations: 100, least_step: 1e-9 };
        let found = align(&cloud, &map, &Pose::identity(), &parameters);
        assert!((found.translation.vector - truth.translation.vector).norm() < 1e-6, "{found}");
        assert!(found.rotation.angle_to(&truth.rotation) < 1e-6);
        // One plane does not hold a pose: nothing moves and nothing fails.
        let mut map = VoxelMap::new(1.0, 20);
        map.add(std::iter::once(Point3::new(1.0, 0.0, 0.0)));
        let found = align(&[Point3::new(1.1, 0.0, 0.0)], &map, &Pose::identity(), &parameters);
        assert!(found.translation.vector.iter().all(|v| v.is_finite()));
    }
}
