//! Shots of a finished cloud that truly went elsewhere: their ranges are looked up in the cloud itself, and they keep
//! the directions that the sensor reports.

use super::FrameContext;
use super::local_plane::measure_along;
use crate::directions::{SensorScan, Sensors, Surroundings};
use crate::rig::Sensor;
use crate::scan::{Echo, Scan, dot};
use geometry::Pose;
use nalgebra::{Point3, Vector3};

/// Largest distance of a return from a true direction that the shot meets, in steps of the pattern.
const REACH_STEPS: [f32; 2] = [0.6, 0.5];

/// Gives shots the ranges of their true rays: the pose of an echo moves its reported ray to the true one, in the
/// cloud's frame. Shots without a pose stay as they are. Without scan patterns points are moved instead.
pub(super) fn reshoot(scan: &mut Scan, frame: &FrameContext, true_from_reported: impl Fn(&Echo) -> Option<Pose>) {
    let Some(sensors) = frame.sensors else {
        for echo in scan.returns_mut() {
            if let Some(pose) = true_from_reported(echo) {
                let point = pose.inverse() * Point3::from(echo.point().map(f64::from));
                echo.move_point(point.coords.map(|v| v as f32).into());
            }
        }
        return;
    };
    for (number, mount) in sensors.rig.sensors.iter().enumerate() {
        let of_sensor = |e: &Echo| usize::from(e.sensor) == number;
        if !scan.echoes.iter().any(|e| of_sensor(e) && true_from_reported(e).is_some()) {
            continue;
        }
        let seen = Seen::new(scan, sensors, number);
        let pose = mount.pose();
        let before = scan.echoes.clone();
        for (i, echo) in scan.echoes.iter_mut().enumerate().filter(|(_, e)| of_sensor(e)) {
            let Some(true_from_reported) = true_from_reported(&before[i]) else { continue };
            // The true ray in the frame of the sensor as it is reported.
            let error = pose.inverse() * true_from_reported * pose;
            let own = pose.rotation.inverse() * Vector3::from(echo.direction.map(f64::from));
            let hit = seen.meet(&(error.rotation * own), &error.translation.vector, &before[i], &pose);
            let Some(Met { range_m, on }) = hit else {
                echo.lose();
                continue;
            };
            // A shot that was lost on a surface stays lost.
            if !echo.is_return() && seen.is_hole(&own) {
                continue;
            }
            if let Some(surface) = on.and_then(|place| before.get(place)) {
                (echo.intensity, echo.reflectivity) = (surface.intensity, surface.reflectivity);
                (echo.returned, echo.material, echo.object) = (surface.returned, surface.material, surface.object);
                (echo.normal, echo.cos_incidence) = (surface.normal, surface.cos_incidence);
            }
            echo.range_m = range_m;
        }
    }
}

/// What a true ray meets.
struct Met {
    /// Its distance, m.
    range_m: f32,
    /// Place among the echoes of the return that is nearest; `None` on the surface of the shot itself.
    on: Option<usize>,
}

/// The returns of a sensor by direction.
struct Seen {
    scan: SensorScan,
    /// Places of the returns among the echoes.
    places: Vec<usize>,
    around: Surroundings,
    steps: [f32; 2],
    /// Least and largest azimuth and elevation of a return, rad.
    field: [[f32; 2]; 2],
}

impl Seen {
    fn new(scan: &Scan, sensors: &Sensors, number: usize) -> Seen {
        let sensor_from_cloud = sensors.rig.sensors[number].pose().inverse();
        let (mut own, mut places) = (SensorScan::default(), Vec::new());
        for (i, echo) in scan.echoes.iter().enumerate() {
            if usize::from(echo.sensor) == number && echo.is_return() {
                let point = sensor_from_cloud * Point3::from(echo.point().map(f64::from));
                let [azimuth, elevation, range] = Sensor::spherical(&point);
                own.azimuth_rad.push(azimuth as f32);
                own.elevation_rad.push(elevation as f32);
                own.range_m.push(range as f32);
                places.push(i);
            }
        }
        let steps = sensors.patterns[number].steps;
        let ends = |angles: &[f32]| {
            angles.iter().fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], v| [low.min(*v), high.max(*v)])
        };
        Seen {
            field: [ends(&own.azimuth_rad), ends(&own.elevation_rad)],
            around: Surroundings::new(sensors, number, &own),
            scan: own,
            places,
            steps: [steps.azimuth_rad, steps.elevation_rad],
        }
    }

    /// Whether a surface lies around a direction of the sensor's frame.
    fn is_hole(&self, own: &Vector3<f64>) -> bool {
        let [azimuth, elevation, _] = Sensor::spherical(&Point3::from(*own));
        self.around.look(azimuth as f32, elevation as f32, None).surface.is_some()
    }

    /// What a true ray meets. It starts at `shift` and has a direction, both in the sensor's frame; `echo` is the shot
    /// as it is reported.
    fn meet(&self, direction: &Vector3<f64>, shift: &Vector3<f64>, echo: &Echo, pose: &Pose) -> Option<Met> {
        // Where the ray is at the range of what it meets, seen from the reported origin. Twice, since that range is
        // not known before.
        let mut range_m = if echo.is_return() { f64::from(echo.range_m) } else { 50.0 };
        let mut met = None;
        for _ in 0..2 {
            let [azimuth, elevation, _] = Sensor::spherical(&Point3::from(shift + direction * range_m));
            met = self.at(azimuth as f32, elevation as f32, direction, shift, echo, pose);
            range_m = f64::from(met.as_ref()?.range_m);
        }
        met
    }

    fn at(
        &self,
        azimuth: f32,
        elevation: f32,
        direction: &Vector3<f64>,
        shift: &Vector3<f64>,
        echo: &Echo,
        pose: &Pose,
    ) -> Option<Met> {
        let true_direction: [f32; 3] = (pose.rotation * direction).map(|v| v as f32).into();
        // The shot's own surface, met by the true ray: its own error of range is kept.
        let own_m = || {
            let mut own = *echo;
            measure_along(&mut own, true_direction);
            let shift: [f32; 3] = (pose.rotation * shift).map(|v| v as f32).into();
            own.range_m -= dot(own.normal, shift) / dot(own.normal, true_direction).min(-1e-3);
            own.range_m.max(0.01)
        };
        let on_surface = echo.is_return() && echo.normal != [0.0; 3];
        let outside = [azimuth, elevation].iter().zip(&self.field).any(|(v, [low, high])| v < low || v > high);
        let Some((nearest, near)) = self.nearest(azimuth, elevation) else {
            // Beyond the field of view surfaces go on as they are at its end.
            return (outside && on_surface).then(|| Met { range_m: own_m(), on: None });
        };
        let on = Some(self.places[nearest]);
        let whole = self.around.look(azimuth, elevation, None).surface;
        if whole.is_none() && outside && on_surface {
            return Some(Met { range_m: own_m(), on: None });
        }
        // At an edge: the surface of the nearest return.
        let Some((surface, normal)) =
            whole.or_else(|| self.around.nearest_surface(azimuth, elevation).filter(|_| near))
        else {
            // A lone return is met at its distance from the true origin.
            let reported = f64::from(self.scan.range_m[nearest]);
            return near.then_some(Met { range_m: (reported - shift.dot(direction)).max(0.01) as f32, on });
        };
        let meets = pose.rotation.inverse() * normal;
        // The plane around the true direction, met from the true origin.
        let [az, el] = [azimuth, elevation].map(f64::from);
        let seen = Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin()) * surface.range_m;
        let along = meets.dot(direction);
        if along > -1e-3 {
            return Some(Met { range_m: self.scan.range_m[nearest], on });
        }
        let range_m = meets.dot(&(seen - shift)) / along;
        // The shot's own error is what it lies off the surface around it, or else what the nearest return does. Added
        // to the surface around the true ray, it keeps its variance: the errors of planes are averages of many returns.
        let own = pose.rotation.inverse() * Vector3::from(echo.direction.map(f64::from));
        let [own_azimuth, own_elevation, _] = Sensor::spherical(&Point3::from(own)).map(|v| v as f32);
        let own = self.around.look(own_azimuth, own_elevation, None).surface.filter(|_| on_surface);
        let error_m = own.map_or(surface.bulge_m, |(own, _)| f64::from(echo.range_m) - own.range_m);
        let is_own = own.is_some() && ((f64::from(own_m()) - range_m) * along).abs() < self.around.edge_m;
        Some(Met { range_m: (range_m + error_m).max(0.01) as f32, on: on.filter(|_| !is_own) })
    }

    /// The return nearest to a direction, and whether it is so near that a shot there meets what it met.
    fn nearest(&self, azimuth: f32, elevation: f32) -> Option<(usize, bool)> {
        let mut nearest: Option<(f32, usize, bool)> = None;
        let window = self.around.window.map(|v| v as f32);
        self.around.index.around(azimuth, elevation, |e, dx, dy| {
            let (x, y) = (dx * window[0] / self.steps[0], dy * window[1] / self.steps[1]);
            let distance = x * x + y * y;
            if nearest.is_none_or(|(least, ..)| distance < least) {
                let near = x.abs() <= REACH_STEPS[0] && y.abs() <= REACH_STEPS[1];
                nearest = Some((distance, e.index as usize, near));
            }
        });
        nearest.map(|(_, index, near)| (index, near))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud_scan::{CloudReader, Surfaces};
    use crate::effects::testing::{rig, scene, with_frame};
    use nalgebra::{Translation3, UnitQuaternion};

    /// A sensor that truly looks 0.5 degrees further down and stands 10 cm further back meets the ground nearer and the
    /// wall farther; what it reports keeps its rows.
    #[test]
    fn ranges_are_those_of_the_true_rays() {
        let cloud = scene().cloud();
        let reader = CloudReader::new(&rig(), std::slice::from_ref(&cloud));
        let before = reader.scan(&cloud, &Surfaces::default());
        let error = Pose::from_parts(
            Translation3::new(-0.1, 0.0, 0.0),
            UnitQuaternion::from_euler_angles(0.0, 0.5f64.to_radians(), 0.0),
        );
        let after = with_frame(0, |frame, _| {
            let mut scan = before.clone();
            reshoot(&mut scan, &FrameContext { sensors: Some(reader.sensors()), ..*frame }, |_| Some(error));
            scan
        });
        let (mut right, mut all) = (0, 0);
        for (a, b) in after.echoes.iter().zip(&before.echoes) {
            assert_eq!((a.direction, a.row), (b.direction, b.row));
            let ray = error.rotation * Vector3::from(b.direction.map(f64::from));
            let ground = if ray.z < 0.0 { -2.0 / ray.z } else { f64::INFINITY };
            let wall = 40.1 / ray.x;
            let met = ground.min(wall);
            // Away from the foot and from the top of the wall.
            if (ground / wall - 1.0).abs() > 0.1 && (wall * ray.z - 3.0).abs() > 0.6 {
                let want = if ground < wall || wall * ray.z < 3.0 { met } else { f64::INFINITY };
                all += 1;
                right += usize::from(want == f64::from(a.range_m) || (want / f64::from(a.range_m) - 1.0).abs() < 5e-3);
            }
        }
        assert!(right * 100 > all * 97, "{right} of {all}");
    }

    #[test]
    fn without_patterns_the_points_are_moved() {
        let before = scene();
        let shift = Pose::from_parts(Translation3::new(0.0, 0.0, 0.2), UnitQuaternion::identity());
        let after = with_frame(0, |frame, _| {
            let mut scan = before.clone();
            reshoot(&mut scan, frame, |_| Some(shift));
            scan
        });
        for (a, b) in after.returns().zip(before.returns()) {
            assert!((a.point()[2] - b.point()[2] + 0.2).abs() < 1e-4);
        }
    }
}
