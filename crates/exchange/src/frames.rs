//! Frames of the programs, and the heads of their files.

use crate::number::number;
use crate::placement::{FitError, NotExpressed};
use crate::program::Program;
use geometry::Pose;
use nalgebra::Vector3;

/// What stands at the top of every file.
pub(crate) struct Head {
    /// The program.
    pub program: Program,
    /// The sensor model, as it was named.
    pub model: String,
    /// The rig, as it was named; `None` for one sensor at the origin.
    pub rig: Option<String>,
}

/// What a writer makes.
#[derive(Default)]
pub(crate) struct Made {
    /// Files by name.
    pub files: Vec<(String, String)>,
    /// What the form of the program's files cannot express of the rig.
    pub not_expressed: Vec<NotExpressed>,
    /// Fitted laws.
    pub fits: Vec<FitError>,
    /// What has to be known.
    pub notes: Vec<String>,
}

impl Head {
    /// Lines of a comment, without its marks.
    pub fn lines(&self) -> Vec<String> {
        let rig =
            self.rig.as_deref().map_or("one sensor at the origin of the clouds".into(), |rig| format!("rig {rig}"));
        vec![
            format!(
                "Sensor model for {}, written by lidarshift export from {} ({rig}).",
                self.program.title(),
                self.model
            ),
            "What it does not express is in not_expressed.json.".into(),
        ]
    }

    /// The lines with a mark in front of each.
    pub fn comment(&self, mark: &str, more: &[String]) -> String {
        self.lines().iter().chain(more).map(|line| format!("{mark} {line}\n")).collect()
    }
}

/// Roll, pitch and yaw of a pose, degrees: about x, then y, then z.
pub(crate) fn angles_deg(pose: &Pose) -> [f64; 3] {
    let (roll, pitch, yaw) = pose.rotation.euler_angles();
    [roll, pitch, yaw].map(f64::to_degrees)
}

/// Position of a pose, m.
pub(crate) fn position_m(pose: &Pose) -> [f64; 3] {
    let Vector3 { data, .. } = pose.translation.vector;
    data.0[0]
}

/// A pose in the frame of Unreal Engine, as `carla.Transform` has it: x, y, z (m), then pitch, yaw, roll (degrees).
///
/// The frame is left-handed with y to the right, so that y and yaw are negated. Positive pitch turns the x axis up,
/// hence pitch is negated as well. Roll keeps its sign.
pub(crate) fn carla_transform(pose: &Pose) -> [f64; 6] {
    let ([x, y, z], [roll, pitch, yaw]) = (position_m(pose), angles_deg(pose));
    [x, -y, z, -pitch, -yaw, roll]
}

/// A pose in the frame of HELIOS++ (x right, y forward, z up): x, y, z (m), then the rotations about the fixed axes y,
/// x and z, in this order (degrees).
pub(crate) fn helios_mount(pose: &Pose) -> [f64; 6] {
    let ([x, y, z], [roll, pitch, yaw]) = (position_m(pose), angles_deg(pose));
    [-y, x, z, roll, -pitch, yaw]
}

/// A pose as six numbers in SDF: x, y, z (m), roll, pitch, yaw (degrees). The frame is the program's own.
pub(crate) fn sdf_pose(pose: &Pose) -> String {
    let (at, angles) = (position_m(pose), angles_deg(pose));
    at.iter().chain(&angles).map(|v| number(*v)).collect::<Vec<_>>().join(" ")
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Isometry3, Matrix3, Rotation3, Translation3, UnitQuaternion};

    fn pose(angles_deg: [f64; 3]) -> Pose {
        let [r, p, y] = angles_deg.map(f64::to_radians);
        Isometry3::from_parts(Translation3::new(1.0, 2.0, 3.0), UnitQuaternion::from_euler_angles(r, p, y))
    }

    /// `carla::geom::Transform::GetMatrix` of LibCarla, for pitch, yaw, roll in degrees.
    fn carla_matrix([pitch, yaw, roll]: [f64; 3]) -> Matrix3<f64> {
        let ((sy, cy), (sp, cp), (sr, cr)) =
            (yaw.to_radians().sin_cos(), pitch.to_radians().sin_cos(), roll.to_radians().sin_cos());
        Matrix3::new(
            cp * cy,
            cy * sp * sr - sy * cr,
            -cy * sp * cr - sy * sr,
            cp * sy,
            sy * sp * sr + cy * cr,
            -sy * sp * cr + cy * sr,
            sp,
            -cp * sr,
            cp * cr,
        )
    }

    #[test]
    fn carla_sees_the_mirrored_rotation() {
        let mirror = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 1.0));
        for angles in [[0.0, 0.0, 30.0], [0.0, 10.0, 0.0], [5.0, 0.0, 0.0], [4.0, -7.0, 120.0]] {
            let ours = pose(angles);
            let [x, y, z, pitch, yaw, roll] = carla_transform(&ours);
            assert_eq!([x, y, z], [1.0, -2.0, 3.0]);
            let want = mirror * ours.rotation.to_rotation_matrix().matrix() * mirror;
            assert!((carla_matrix([pitch, yaw, roll]) - want).abs().max() < 1e-12, "{angles:?}");
        }
    }

    #[test]
    fn helios_sees_the_same_rotation_in_its_axes() {
        // helios_from_ours: x right, y forward.
        let helios_from_ours = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
        let ours = pose([4.0, -7.0, 120.0]);
        let [x, y, z, about_y, about_x, about_z] = helios_mount(&ours);
        assert_eq!(helios_from_ours * ours.translation.vector, Vector3::new(x, y, z));
        let about = |axis: Vector3<f64>, deg: f64| Rotation3::new(axis * deg.to_radians());
        let made = about(Vector3::z(), about_z) * about(Vector3::x(), about_x) * about(Vector3::y(), about_y);
        let want = helios_from_ours * ours.rotation.to_rotation_matrix().matrix() * helios_from_ours.transpose();
        assert!((made.matrix() - want).abs().max() < 1e-12);
    }
}
