//! Rigid transforms: poses of sensors and vehicles. Values are named `dst_from_src`, as in `map_from_car * p_car`.

use crate::Box3;
use nalgebra::{Isometry3, Point3, Translation3, UnitQuaternion, Vector3};

/// A rotation followed by a translation, m.
pub type Pose = Isometry3<f64>;

/// An upright pose at `position` (m) with heading `yaw_rad`, counter-clockwise from +x.
pub fn upright_pose(position: [f64; 3], yaw_rad: f64) -> Pose {
    Pose::from_parts(Translation3::from(position), UnitQuaternion::from_axis_angle(&Vector3::z_axis(), yaw_rad))
}

/// Heading of the rotated x axis, rad, counter-clockwise from +x.
pub fn yaw_rad(pose: &Pose) -> f64 {
    let x = pose.rotation * Vector3::x();
    x.y.atan2(x.x)
}

/// An upright box transformed to the frame `dst`. Roll and pitch of the pose move its centre, but the box stays
/// upright.
pub fn move_box(dst_from_src: &Pose, box_src: &Box3) -> Box3 {
    let center = dst_from_src * Point3::from(box_src.center);
    let heading = dst_from_src.rotation * Vector3::new(box_src.yaw_rad.cos(), box_src.yaw_rad.sin(), 0.0);
    Box3 { center: center.coords.into(), size: box_src.size, yaw_rad: heading.y.atan2(heading.x) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_box_keeps_its_corners() {
        let map_from_car = upright_pose([10.0, -4.0, 0.5], 0.8);
        let box_car = Box3::from_array([5.0, 1.0, 0.3, 4.0, 2.0, 1.5, -0.3]);
        let box_map = move_box(&map_from_car, &box_car);
        for p in [[2.0, 1.0, 0.75], [-2.0, 1.0, 0.0]] {
            let want = map_from_car * Point3::from(box_car.from_local(p));
            let got = box_map.from_local(p);
            assert!((0..3).all(|i| (want[i] - got[i]).abs() < 1e-12), "{want} {got:?}");
        }
        assert!((yaw_rad(&map_from_car) - 0.8).abs() < 1e-15);
        let back = move_box(&map_from_car.inverse(), &box_map);
        assert!(back.to_array().iter().zip(box_car.to_array()).all(|(a, b)| (a - b).abs() < 1e-12));
    }
}
