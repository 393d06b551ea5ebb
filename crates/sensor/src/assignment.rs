//! Which sensor of a rig a point of an unordered cloud belongs to.

use crate::rig::{Rig, Sensor};
use geometry::Pose;
use nalgebra::Point3;

/// The sensors of a rig as seen from the cloud's frame, ready to be asked for many points.
///
/// A point belongs to the sensor in whose horizontal field of view it lies. Where several fields hold it, it belongs to
/// the narrowest: a scan spreads its shots over its field, so that the narrower one has more returns a degree and a
/// point is more probably its own. Where no field holds it, it belongs to the one whose edge is the fewest degrees
/// away: points leave a field by motion or by a mount that is slightly off, and such angles do not grow with the width
/// of the field. Among equal fields it is the one in which the point lies most centrally; of equals the first.
#[derive(Clone, Debug)]
pub struct Assignment {
    views: Vec<View>,
}

#[derive(Clone, Debug)]
struct View {
    sensor_from_cloud: Pose,
    half_fov_rad: f64,
}

/// A point as its sensor sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Assigned {
    /// Number of the sensor in its rig.
    pub sensor: usize,
    /// Azimuth (counter-clockwise from the sensor's middle, rad), elevation (rad) and range (m) in the sensor's own
    /// frame.
    pub spherical: [f64; 3],
}

impl Assignment {
    /// For the sensors of a rig.
    pub fn new(rig: &Rig) -> Assignment {
        let view = |s: &Sensor| View { sensor_from_cloud: s.pose().inverse(), half_fov_rad: s.half_fov_rad() };
        Assignment { views: rig.sensors.iter().map(view).collect() }
    }

    /// The sensor of a point of the cloud's frame (m); `None` for a rig without sensors.
    pub fn of_point(&self, point: Point3<f64>) -> Option<Assigned> {
        let mut best: Option<([f64; 3], Assigned)> = None;
        for (sensor, view) in self.views.iter().enumerate() {
            let spherical = Sensor::spherical(&(view.sensor_from_cloud * point));
            let (off_rad, half_rad) = (spherical[0].abs(), view.half_fov_rad);
            let order = [(off_rad - half_rad).max(0.0), half_rad, off_rad / half_rad];
            if best.is_none_or(|(least, _)| order < least) {
                best = Some((order, Assigned { sensor, spherical }));
            }
        }
        best.map(|(_, assigned)| assigned)
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

    /// Azimuths off the middles and halves of the fields, rad.
    fn off_and_half(rig: &Rig, point: Point3<f64>) -> Vec<(f64, f64)> {
        rig.sensors
            .iter()
            .map(|s| (Sensor::spherical(&(s.pose().inverse() * point))[0].abs(), s.half_fov_rad()))
            .collect()
    }

    /// The place of the smallest number, of equals the first.
    fn least(values: impl Iterator<Item = f64>) -> usize {
        values.enumerate().min_by(|a, b| a.1.total_cmp(&b.1)).unwrap().0
    }

    #[test]
    fn equal_fields_split_as_by_both_rules_that_there_were() {
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
    fn unlike_fields_on_which_the_rules_disagreed() {
        let fields = |yaw_deg: f64| {
            rig(&format!(
                "[[sensor]]\nname = \"wide\"\nhorizontal_fov_deg = 120\n\
                 [[sensor]]\nname = \"narrow\"\nyaw_deg = {yaw_deg}\nhorizontal_fov_deg = 10\n"
            ))
        };
        let by_share = |rig: &Rig, p| least(off_and_half(rig, p).iter().map(|(off, half)| off / half));
        let by_margin = |rig: &Rig, p| least(off_and_half(rig, p).iter().map(|(off, half)| off - half));
        let of = |rig: &Rig, p| Assignment::new(rig).of_point(p).unwrap().sensor;

        // In both fields, 1 degree off the middle of the narrow one: 12 times as many returns a degree are the narrow
        // one's. The distance to the edge gave it to the wide one, as it did with every point that the narrow one sees.
        let (both, point) = (fields(40.0), at(41.0));
        assert_eq!([by_share(&both, point), by_margin(&both, point), of(&both, point)], [1, 0, 1]);
        // In the middle of both fields the share of the field gave it to the wide one as well.
        let (both, point) = (fields(0.0), at(1.0));
        assert_eq!([by_share(&both, point), by_margin(&both, point), of(&both, point)], [0, 0, 1]);
        // In neither field, 6 degrees beyond the narrow one's edge, 15 beyond the wide one's: the share of the field
        // gave it to the wide.
        let (apart, point) = (fields(86.0), at(75.0));
        assert_eq!([by_share(&apart, point), by_margin(&apart, point), of(&apart, point)], [0, 1, 1]);
        // In one field alone it is that one's, whatever the others are.
        assert_eq!([of(&apart, at(59.0)), of(&apart, at(90.5)), of(&both, at(5.5))], [0, 1, 0]);
    }
}
