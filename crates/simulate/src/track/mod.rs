//! The track and its surroundings as triangle meshes.

mod centre_line;
mod oval;
mod roadside;
mod stands;
mod surface;

pub use centre_line::{CentreLine, CentrePoint, MOST_LAP_M, Station};
pub use oval::las_vegas;

use crate::mesh::Mesh;
use geometry::Pose;
use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion, Vector3};
use sensor::effects::Undulation;
use sensor::object::Group;

/// A track with its surroundings.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// Its centre line; turns to the left.
    pub line: CentreLine,
    /// Seed of the surroundings.
    pub seed: u64,
}

impl Track {
    /// Height of the surface at `way_m` along and `left_m` to the left of the centre line, m; includes apron, infield
    /// and outside ground.
    pub fn height_m(&self, way_m: f64, left_m: f64) -> f64 {
        surface::height_m(&self.line.at(way_m), left_m)
    }

    /// Pose of a car on the surface: x along the track, rotated left by `yaw_rad`, z along the surface normal, origin
    /// `above_m` above it.
    pub fn pose_on(&self, way_m: f64, left_m: f64, yaw_rad: f64, above_m: f64) -> Pose {
        let station = self.line.at(way_m);
        let (s, c) = station.heading_rad.sin_cos();
        let across = Vector3::new(-s, c, -station.bank_rad.tan()).normalize();
        let along = Vector3::new(c, s, station.slope);
        let along = (along - across * along.dot(&across)).normalize();
        let up = along.cross(&across);
        let world_from_track = Rotation3::from_matrix_unchecked(Matrix3::from_columns(&[along, across, up]));
        let [x, y, _] = station.position;
        let ground = Vector3::new(x - s * left_m, y + c * left_m, surface::height_m(&station, left_m));
        let rotation = UnitQuaternion::from_rotation_matrix(&world_from_track)
            * UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad);
        Isometry3::from_parts(Translation3::from(ground + up * above_m), rotation)
    }

    /// Minimum and maximum lateral offset of a car's centre at `way_m`, with `margin_m` to both edges, m.
    pub fn lateral_limits_m(&self, way_m: f64, margin_m: f64) -> [f64; 2] {
        let station = self.line.at(way_m);
        [margin_m - station.width_right_m, station.width_left_m - margin_m]
    }

    /// Lateral position of the outer wall's face at `way_m`, to the left of the centre line, m: negative.
    pub fn outer_wall_m(&self, way_m: f64) -> f64 {
        -self.line.at(way_m).width_right_m - surface::WALL_GAP_M
    }

    /// All static objects of these groups, in the world frame.
    pub fn mesh(&self, groups: &[Group], undulation: Option<Undulation>) -> Mesh {
        let mut mesh = Mesh::default();
        for group in Group::ALL.into_iter().filter(|g| groups.contains(g)) {
            let part = match group {
                Group::Surface | Group::Apron | Group::Infield | Group::OutsideGround => surface::ground(self, group),
                Group::OuterWall => surface::outer_wall(self),
                Group::Fence => roadside::fence(self),
                Group::PitWall => surface::pit_wall(self),
                Group::Grandstand => stands::grandstand(self),
                Group::InfieldObjects => roadside::infield_objects(self),
                Group::OutsideObjects => roadside::outside_objects(self),
            };
            mesh.append(&part.of_object(group as u16));
        }
        match undulation {
            Some(wave) => {
                let lap = self.line.length_m();
                let waves = (lap / wave.length_m).round().max(1.0);
                mesh.mapped(|[x, y, z]| {
                    let (way, _) = self.line.project([x, y]);
                    let phase = std::f64::consts::TAU * waves * way / lap + wave.phase_rad;
                    [x, y, z + wave.amplitude_m * phase.sin()]
                })
            }
            None => mesh,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Point3;

    fn track() -> Track {
        Track { line: las_vegas(), seed: 1 }
    }

    #[test]
    fn cars_stand_on_the_surface() {
        let track = track();
        for (way, left) in [(0.0, 0.0), (300.0, 4.0), (700.0, -5.0), (1500.0, 2.0)] {
            let pose = track.pose_on(way, left, 0.05, 0.2);
            let up = pose.rotation * Vector3::z();
            for (x, y) in [(3.0, 0.8), (0.0, -0.8), (3.0, -0.8)] {
                let below = pose * Point3::new(x, y, -0.2);
                let (w, l) = track.line.project([below.x, below.y]);
                let off = below.z - track.height_m(w, l);
                assert!(off.abs() < 0.03, "({way}, {left}): {off} m off the ground");
            }
            let bank = track.line.at(way).bank_rad;
            assert!((up.z - bank.cos()).abs() < 0.01);
            let left_side = pose.rotation * Vector3::y();
            assert!(left_side.z < -0.05, "the left side is the lower one");
        }
    }

    #[test]
    fn the_mesh_is_where_the_surface_is() {
        let track = track();
        let mesh = track.mesh(&[Group::Surface], None);
        for face in mesh.faces.iter().step_by(37) {
            let middle: [f64; 3] =
                std::array::from_fn(|k| face.corners.iter().map(|c| mesh.vertices[*c as usize][k]).sum::<f64>() / 3.0);
            let (way, left) = track.line.project([middle[0], middle[1]]);
            assert!((middle[2] - track.height_m(way, left)).abs() < 0.03);
        }
    }

    #[test]
    fn the_world_has_all_its_groups() {
        let track = track();
        let mesh = track.mesh(&Group::ALL, None);
        mesh.check().unwrap();
        assert!((60_000..200_000).contains(&mesh.faces.len()), "{} triangles", mesh.faces.len());
        for group in Group::ALL {
            let own = mesh.faces.iter().filter(|f| f.object == group as u16).count();
            assert!(own > 100, "{group:?}: {own}");
        }
        // Nothing stands on the track.
        for face in mesh
            .faces
            .iter()
            .filter(|f| f.object != Group::Surface as u16 && f.object != Group::Fence as u16)
            .step_by(3)
        {
            let v = mesh.vertices[face.corners[0] as usize];
            let (way, left) = track.line.project([v[0], v[1]]);
            let station = track.line.at(way);
            let inside = left < station.width_left_m - 0.01 && left > 0.01 - station.width_right_m;
            assert!(!inside, "{:?} stands on the track at {way} m, {left} m to the left", face.object);
        }
        assert!(track.mesh(&Group::ALL, None) == mesh, "the same seed is the same world");
    }

    #[test]
    fn waves_move_all_of_it() {
        let track = track();
        let flat = track.mesh(&[Group::Surface], None);
        let wave = Undulation { amplitude_m: 0.1, length_m: 120.0, phase_rad: 0.3 };
        let wavy = track.mesh(&[Group::Surface], Some(wave));
        let off: Vec<f64> = flat.vertices.iter().zip(&wavy.vertices).map(|(a, b)| b[2] - a[2]).collect();
        let square = off.iter().map(|o| o * o).sum::<f64>() / off.len() as f64;
        assert!((square - 0.005).abs() < 2e-4, "the mean square of a sine: {square}");
    }
}
