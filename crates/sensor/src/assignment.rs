//! Assignment of the points of an unordered cloud to the sensors of a rig.

use crate::rig::{Rig, Sensor};
use geometry::Pose;
use nalgebra::Point3;

/// Assigns points to the sensors of a rig.
///
/// A point is assigned to the sensor whose horizontal field of view contains it. If several contain it, it is assigned
/// to the narrowest: a narrower field of view has more shots per degree, so the point is more probably from that
/// sensor. If none contains it, it is assigned to the sensor whose edge is closest in degrees: points leave a field of
/// view by motion or by a mount error, and such angles do not depend on the width of the field. Among fields of equal
/// width it is assigned to the one in which it is most central; remaining ties go to the first sensor.
#[derive(Clone, Debug)]
pub struct Assignment {
    views: Vec<View>,
}

#[derive(Clone, Debug)]
struct View {
    sensor_from_cloud: Pose,
    half_fov_rad: f64,
}

/// A point in its sensor's frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Assigned {
    /// Index of the sensor in its rig.
    pub sensor: usize,
    /// Azimuth (counter-clockwise from the sensor's x axis, rad), elevation (rad) and range (m) in the sensor's frame.
    pub spherical: [f64; 3],
}

impl Assignment {
    /// Assignment to the sensors of a rig.
    pub fn new(rig: &Rig) -> Assignment {
        let view = |s: &Sensor| View { sensor_from_cloud: s.pose().inverse(), half_fov_rad: s.half_fov_rad() };
        Assignment { views: rig.sensors.iter().map(view).collect() }
    }

    /// Sensor of a point in the cloud's frame (m); `None` for a rig without sensors.
    pub fn of_point(&self, point: Point3<f64>) -> Option<Assigned> {
        let mut best: Option<([f64; 3], usize, Point3<f64>)> = None;
        for (sensor, view) in self.views.iter().enumerate() {
            let seen = view.sensor_from_cloud * point;
            let (off_rad, half_rad) = (Sensor::azimuth_rad(&seen).abs(), view.half_fov_rad);
            let order = [(off_rad - half_rad).max(0.0), half_rad, off_rad / half_rad];
            if best.is_none_or(|(least, ..)| order < least) {
                best = Some((order, sensor, seen));
            }
        }
        best.map(|(_, sensor, seen)| Assigned { sensor, spherical: Sensor::spherical(&seen) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use std::path::Path;

    fn rig(text: &str) -> Rig {
        Rig::parse(text, Path::new("rig.toml")).unwrap()
    }

    fn at(azimuth_deg: f64) -> Point3<f64> {
        let (s, c) = azimuth_deg.to_radians().sin_cos();
        Point3::new(30.0 * c, 30.0 * s, 0.0)
    }

    /// Azimuth distance from the centre of each field of view, and half of its width, rad.
    fn off_and_half(rig: &Rig, point: Point3<f64>) -> Vec<(f64, f64)> {
        rig.sensors
            .iter()
            .map(|s| (Sensor::spherical(&(s.pose().inverse() * point))[0].abs(), s.half_fov_rad()))
            .collect()
    }

    /// Index of the smallest value; the first of equal values.
    fn least(values: impl Iterator<Item = f64>) -> usize {
        values.enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap().0
    }

    #[test]
    fn for_equal_fields_the_nearest_centre_and_the_nearest_edge_agree() {
        let three = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/sensors/av21.toml"));
        for text in [three.unwrap(), "[[sensor]]\nname = \"one\"\n".to_owned()] {
            let rig = rig(&text);
            let assignment = Assignment::new(&rig);
            let mut rng = data::stream(1, "assignment", 0, 0);
            for _ in 0..20_000 {
                let mut number = |far: f64| f64::from(rng.random_range(-far..far) as f32);
                let point = Point3::new(number(80.0), number(80.0), number(5.0));
                let seen = off_and_half(&rig, point);
                let sensor = assignment.of_point(point).unwrap().sensor;
                assert_eq!(sensor, least(seen.iter().map(|(off, half)| off / half)), "{point}");
                assert_eq!(sensor, least(seen.iter().map(|(off, half)| off - half)), "{point}");
            }
        }
    }

    #[test]
    fn for_unequal_fields_the_narrower_or_nearer_one_wins() {
        let fields = |yaw_deg: f64| {
            rig(&format!(
                "[[sensor]]\nname = \"wide\"\nhorizontal_fov_deg = 120\n\
                 [[sensor]]\nname = \"narrow\"\nyaw_deg = {yaw_deg}\nhorizontal_fov_deg = 10\n"
            ))
        };
        let by_share = |rig: &Rig, p| least(off_and_half(rig, p).iter().map(|(off, half)| off / half));
        let by_margin = |rig: &Rig, p| least(off_and_half(rig, p).iter().map(|(off, half)| off - half));
        let of = |rig: &Rig, p| Assignment::new(rig).of_point(p).unwrap().sensor;

        // In both fields, 1 degree from the centre of the narrow one, which has 12 times as many shots per degree. The
        // distance to the edge would assign every point in the narrow field to the wide one.
        let (both, point) = (fields(40.0), at(41.0));
        assert_eq!([by_share(&both, point), by_margin(&both, point), of(&both, point)], [1, 0, 1]);
        // Near the centre of both fields, the distance relative to the width would assign it to the wide one as well.
        let (both, point) = (fields(0.0), at(1.0));
        assert_eq!([by_share(&both, point), by_margin(&both, point), of(&both, point)], [0, 0, 1]);
        // In neither field, 6 degrees beyond the edge of the narrow one, 15 beyond that of the wide one: the distance
        // relative to the width would assign it to the wide one.
        let (apart, point) = (fields(86.0), at(75.0));
        assert_eq!([by_share(&apart, point), by_margin(&apart, point), of(&apart, point)], [0, 1, 1]);
        // In one field only: assigned to that sensor.
        assert_eq!([of(&apart, at(59.0)), of(&apart, at(90.5)), of(&both, at(5.5))], [0, 1, 0]);
    }
}
