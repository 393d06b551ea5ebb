//! Shots of a finished cloud that truly went elsewhere: their ranges are looked up in the cloud itself, and they keep
//! the directions that the sensor reports.

mod seen;

use super::local_plane::measure_along;
use super::{Draws, FrameContext};
use crate::directions::LEAST_COS;
use crate::scan::{Echo, Scan, dot};
use geometry::Pose;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use seen::{Met, Seen, towards};
use std::collections::BTreeMap;

/// Cosine of the angle between two normals of one surface, at least: 20 degrees.
const SAME_COS: f32 = 0.94;

/// Shots that truly go farther from where they are reported than this share of the way to the next row may leave their
/// surface.
const FAR: f32 = 0.1;

/// Gives shots the ranges in their true directions: on a surface that of its plane, as long as it cannot end between;
/// at edges, and farther away, that of the surface that the true ray meets, where the scan patterns are known.
pub(super) fn reaim(
    scan: &mut Scan,
    frame: &FrameContext,
    draws: &Draws,
    mut true_direction: impl FnMut(&Echo) -> [f32; 3],
) {
    let mut at_edges = BTreeMap::new();
    let far_rad = |echo: &Echo| {
        let pattern = frame.sensors.and_then(|sensors| sensors.patterns.get(usize::from(echo.sensor)));
        pattern.map_or(f32::INFINITY, |pattern| FAR * pattern.steps.elevation_rad)
    };
    for (i, echo) in scan.echoes.iter_mut().enumerate() {
        let direction = true_direction(echo);
        let off = (0..3).map(|k| (direction[k] - echo.direction[k]).powi(2)).sum::<f32>().sqrt();
        if off > far_rad(echo) || echo.is_return() && echo.normal == [0.0; 3] && off > 0.0 {
            at_edges.insert(i, direction);
        } else if echo.is_return() {
            measure_along(echo, direction);
        }
    }
    let Some(sensors) = frame.sensors.filter(|_| !at_edges.is_empty()) else { return };
    let origins: Vec<Vector3<f64>> = sensors.rig.sensors.iter().map(|s| Vector3::from(s.position)).collect();
    let turned = |i: usize, echo: &Echo| {
        let [from, to] = [echo.direction, *at_edges.get(&i)?].map(|d| Vector3::from(d.map(f64::from)));
        let turn = UnitQuaternion::rotation_between(&from, &to)?;
        let origin = origins.get(usize::from(echo.sensor))?;
        Some(Pose::from_parts((origin - turn * origin).into(), turn))
    };
    reshoot(scan, frame, draws, turned);
}

/// Gives shots the ranges of their true rays: the pose of an echo, of which the place in the scan is given as well,
/// moves its reported ray to the true one, in the cloud's frame. Shots without a pose stay as they are. Without scan
/// patterns points are moved instead.
pub(super) fn reshoot(
    scan: &mut Scan,
    frame: &FrameContext,
    draws: &Draws,
    true_from_reported: impl Fn(usize, &Echo) -> Option<Pose>,
) {
    let Some(sensors) = frame.sensors else {
        for (i, echo) in scan.echoes.iter_mut().enumerate().filter(|(_, e)| e.is_return()) {
            if let Some(pose) = true_from_reported(i, echo) {
                let point = pose.inverse() * Point3::from(echo.point().map(f64::from));
                echo.move_point(point.coords.map(|v| v as f32).into());
            }
        }
        return;
    };
    let mut random = draws.of_edges();
    if !scan.echoes.iter().enumerate().any(|(i, echo)| true_from_reported(i, echo).is_some()) {
        return;
    }
    let sensor_numbers = 0..sensors.rig.sensors.len();
    let all: Vec<Seen> = sensor_numbers.map(|number| Seen::new(scan, sensors, number, &mut random)).collect();
    let before = scan.echoes.clone();
    for (i, echo) in scan.echoes.iter_mut().enumerate() {
        let Some(true_from_reported) = true_from_reported(i, &before[i]) else { continue };
        let Some(seen) = all.get(usize::from(echo.sensor)) else { continue };
        let own = seen.pose.rotation.inverse() * Vector3::from(echo.direction.map(f64::from));
        // The true ray in the frame of a sensor.
        let in_frame_of = |other: &Seen| other.pose.inverse() * true_from_reported * seen.pose;
        let met = seen.meet(&own, &in_frame_of(seen), &before[i]);
        // Beyond the field of view of the sensor another one may show what the ray meets.
        let beyond = met.as_ref().is_none_or(|met| met.beyond) && seen.is_left(&own, &in_frame_of(seen), echo);
        let mut others = all.iter().filter(|other| beyond && !std::ptr::eq(*other, seen));
        let shown = others.find_map(|other| other.meet_of_another(&own, &in_frame_of(other), &before[i]));
        let Some(Met { range_m, on, .. }) = shown.or(met) else {
            echo.lose();
            continue;
        };
        // A shot that was lost on a surface stays lost.
        if !echo.is_return() && seen.is_hole(towards(&own)) {
            continue;
        }
        let true_ray = true_from_reported.rotation.cast::<f32>() * Vector3::from(echo.direction);
        let beside = on.and_then(|place| before.get(place));
        if let Some(surface) = beside.filter(|surface| !is_lit_alike(echo, surface, range_m, true_ray.into())) {
            (echo.intensity, echo.reflectivity) = (surface.intensity, surface.reflectivity);
            (echo.returned, echo.material, echo.object) = (surface.returned, surface.material, surface.object);
            echo.normal = surface.normal;
        }
        let cos = -dot(echo.normal, true_ray.into());
        if cos > LEAST_COS {
            echo.cos_incidence = cos;
        }
        echo.range_m = range_m;
    }
}

/// Whether a shot that truly meets a surface at a range keeps its own light: it was reported on a surface with the same
/// normal as the return beside the true ray, at a range and an angle of incidence that send back what the true ones do,
/// more nearly than those of that return.
fn is_lit_alike(own: &Echo, beside: &Echo, range_m: f32, true_ray: [f32; 3]) -> bool {
    let of = |cos: f32, range_m: f32| cos.max(LEAST_COS).ln() - 2.0 * range_m.ln();
    let met = of(-dot(beside.normal, true_ray), range_m);
    let off = |echo: &Echo| (of(echo.cos_incidence, echo.range_m) - met).abs();
    own.is_return() && dot(own.normal, beside.normal) > SAME_COS && off(own) < off(beside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud_scan::{CloudReader, Surfaces};
    use crate::effects::testing::{rig, scene, with_frame};
    use crate::rig::Rig;
    use data::Cloud;
    use nalgebra::Translation3;
    use rand::RngExt;
    use std::path::Path;

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
        let after = with_frame(0, |frame, draws| {
            let mut scan = before.clone();
            reshoot(&mut scan, &FrameContext { sensors: Some(reader.sensors()), ..*frame }, draws, |_, _| Some(error));
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

    /// The upper end of the wall lies anywhere between two rows: of rays higher by three tenths of their distance
    /// three tenths look over it, whole rows at a time. The others are on the wall still.
    #[test]
    fn the_share_of_rays_beyond_an_edge_is_that_of_the_way_to_the_next_row() {
        let mut higher_on_the_left = scene();
        for echo in higher_on_the_left.echoes.iter_mut().filter(|e| !e.is_return() && e.direction[1] > 0.4) {
            echo.range_m = 40.0 / echo.direction[0];
        }
        let cloud = higher_on_the_left.cloud();
        let reader = CloudReader::new(&rig(), std::slice::from_ref(&cloud));
        let before = reader.scan(&cloud, &Surfaces::default());
        let height = |e: &Echo| e.direction[2] / e.direction[0].hypot(e.direction[1]);
        let right = before.returns().filter(|e| e.direction[1] < 0.2);
        let top = right.max_by(|a, b| height(a).total_cmp(&height(b))).unwrap().row;
        let up = UnitQuaternion::from_euler_angles(0.0, -(0.3 * 25.0 / 31.0f64).to_radians(), 0.0);
        let ahead = |e: &Echo| e.row == top && e.direction[1].abs() < 0.1;
        let frames = 300;
        let mut over = 0;
        for index in 0..frames {
            let mut scan = before.clone();
            with_frame(index, |frame, draws| {
                let frame = FrameContext { sensors: Some(reader.sensors()), ..*frame };
                let higher = Pose::from_parts(Translation3::identity(), up);
                reshoot(&mut scan, &frame, draws, |_, e| ahead(e).then_some(higher));
            });
            let row: Vec<&Echo> = scan.echoes.iter().filter(|e| ahead(e)).collect();
            let returns: Vec<&&Echo> = row.iter().filter(|e| e.is_return()).collect();
            assert!(returns.is_empty() || returns.len() == row.len(), "{} of {}", returns.len(), row.len());
            assert!(returns.iter().all(|e| (e.point()[0] - 40.0).abs() < 0.4));
            over += usize::from(returns.is_empty());
        }
        let share = over as f64 / frames as f64;
        assert!((share - 0.3).abs() < 0.08, "{share}");
    }

    /// Two sensors share a corner of two walls: what rays of the first one meet beyond its field of view is what the
    /// second one shows.
    #[test]
    fn beyond_the_field_of_view_another_sensor_shows_what_a_ray_meets() {
        let text = "[[sensor]]\nname = \"ahead\"\nhorizontal_fov_deg = 60\n\
                    [[sensor]]\nname = \"left\"\nyaw_deg = 60\nhorizontal_fov_deg = 60\n";
        let rig = Rig::parse(text, Path::new("rig.toml")).unwrap();
        // Range of the wall at an azimuth, degrees: 20 m ahead, and 12 m to the left of 30 degrees.
        let wall_m = |azimuth: f64| {
            if azimuth < 30.0 { 20.0 / azimuth.to_radians().cos() } else { 12.0 / (azimuth - 60.0).to_radians().cos() }
        };
        let mut cloud = Cloud::new(4);
        for (row, column) in (0..20).flat_map(|row| (0..239).map(move |column| (row, column))) {
            let (azimuth, up) = (-29.7 + 0.5 * f64::from(column), (-5.0 + 0.5 * f64::from(row)).to_radians().tan());
            let (range, (s, c)) = (wall_m(azimuth), azimuth.to_radians().sin_cos());
            cloud.values.extend([range * c, range * s, range * up, 0.5].map(|v| v as f32));
        }
        let reader = CloudReader::new(&rig, std::slice::from_ref(&cloud));
        let before = reader.scan(&cloud, &Surfaces::default());
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 4f64.to_radians());
        let to_the_left = Pose::from_parts(Translation3::identity(), turn);
        let after = with_frame(0, |frame, draws| {
            let mut scan = before.clone();
            let frame = FrameContext { rig: &rig, sensors: Some(reader.sensors()), ..*frame };
            reshoot(&mut scan, &frame, draws, |_, e| (e.sensor == 0).then_some(to_the_left));
            scan
        });
        let mut beyond = 0;
        for echo in after.returns().filter(|e| e.sensor == 0) {
            let [x, y, z] = echo.direction.map(f64::from);
            let true_deg = y.atan2(x).to_degrees() + 4.0;
            // Away from the corner.
            if (true_deg - 30.0).abs() > 1.0 {
                let want = wall_m(true_deg) / z.asin().cos();
                let range_m = f64::from(echo.range_m);
                assert!((range_m / want - 1.0).abs() < 2e-3, "{range_m} {want} at {true_deg}");
                beyond += usize::from(true_deg > 30.0);
            }
        }
        assert!(beyond > 60, "{beyond}");
    }

    /// A rig of one sensor that does not look all around.
    const ONE: &str = "[[sensor]]\nname = \"ahead\"\nhorizontal_fov_deg = 60\n";

    /// Beyond the field of view of the only sensor a wall goes on as it is at the end, without more scatter.
    #[test]
    fn beyond_the_field_of_view_surfaces_go_on_without_more_noise() {
        let rig = Rig::parse(ONE, Path::new("rig.toml")).unwrap();
        let wall_m = |azimuth_deg: f64| 20.0 / azimuth_deg.to_radians().cos();
        let (mut cloud, mut random) = (Cloud::new(4), data::stream(1, "wall", 0, 0));
        for (row, column) in (0..20).flat_map(|row| (0..119).map(move |column| (row, column))) {
            let (azimuth, up) = (-29.5 + 0.5 * f64::from(column), (-5.0 + 0.5 * f64::from(row)).to_radians().tan());
            let noise: f64 = random.sample(rand_distr::StandardNormal);
            let (range, (s, c)) = (wall_m(azimuth) + 0.01 * noise, azimuth.to_radians().sin_cos());
            cloud.values.extend([range * c, range * s, range * up, 0.5].map(|v| v as f32));
        }
        let reader = CloudReader::new(&rig, std::slice::from_ref(&cloud));
        let mut scan = reader.scan(&cloud, &Surfaces::default());
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), 6f64.to_radians());
        with_frame(0, |frame, draws| {
            let frame = FrameContext { rig: &rig, sensors: Some(reader.sensors()), ..*frame };
            let to_the_left = Pose::from_parts(Translation3::identity(), turn);
            reshoot(&mut scan, &frame, draws, |_, _| Some(to_the_left));
        });
        let off = |echo: &Echo| {
            let [x, y, z] = echo.direction.map(f64::from);
            let true_deg = y.atan2(x).to_degrees() + 6.0;
            (true_deg > 29.5).then(|| f64::from(echo.range_m) - wall_m(true_deg) / z.asin().cos())
        };
        let beyond: Vec<f64> = scan.returns().filter_map(off).collect();
        assert!(beyond.len() > 200, "{}", beyond.len());
        let rms_m = (beyond.iter().map(|v| v * v).sum::<f64>() / beyond.len() as f64).sqrt();
        assert!(rms_m < 0.016, "{rms_m}");
    }

    /// A cloud with lost returns on the ground and on the wall, and with a gap in the wall: true rays that are as they
    /// are reported meet what they met, and nothing where they met nothing.
    #[test]
    fn true_rays_that_are_as_reported_change_nothing() {
        let mut with_gaps = scene();
        for (i, echo) in with_gaps.echoes.iter_mut().enumerate() {
            let gap = echo.direction[0] > 0.95 && (0.1..0.14).contains(&echo.direction[1]) && echo.direction[2] > -0.03;
            if gap || i % 41 == 0 {
                echo.lose();
            }
        }
        let cloud = with_gaps.cloud();
        let reader = CloudReader::new(&rig(), std::slice::from_ref(&cloud));
        let before = reader.scan(&cloud, &Surfaces::default());
        assert!(before.echoes.iter().filter(|e| !e.is_return()).count() > 200);
        for index in 0..20 {
            let mut after = before.clone();
            with_frame(index, |frame, draws| {
                let frame = FrameContext { sensors: Some(reader.sensors()), ..*frame };
                reshoot(&mut after, &frame, draws, |_, _| Some(Pose::identity()));
            });
            for (a, b) in after.echoes.iter().zip(&before.echoes) {
                assert_eq!(a.is_return(), b.is_return(), "{b:?}");
                assert!(!b.is_return() || (a.range_m / b.range_m - 1.0).abs() < 0.01, "{a:?} {b:?}");
            }
        }
    }

    /// A sensor that is truly 1 m further ahead meets level ground at the range and the angle of incidence that it
    /// reports: as much light comes back.
    #[test]
    fn near_ground_keeps_its_light() {
        let mut lit = scene();
        let light = |echo: &Echo| echo.cos_incidence * (20.0 / echo.range_m).powi(2);
        lit.echoes.iter_mut().filter(|e| e.is_return()).for_each(|echo| echo.intensity = light(echo));
        let cloud = lit.cloud();
        let reader = CloudReader::new(&rig(), std::slice::from_ref(&cloud));
        let mut after = reader.scan(&cloud, &Surfaces::default());
        let ahead = Pose::from_parts(Translation3::new(1.0, 0.0, 0.0), UnitQuaternion::identity());
        with_frame(0, |frame, draws| {
            let frame = FrameContext { sensors: Some(reader.sensors()), ..*frame };
            reshoot(&mut after, &frame, draws, |_, _| Some(ahead));
        });
        let near_ground = after.returns().filter(|e| e.direction[2] < -0.1);
        let off: Vec<f32> = near_ground.map(|e| (e.intensity / light(e)).ln().abs()).collect();
        assert!(off.len() > 500);
        let mean = off.iter().sum::<f32>() / off.len() as f32;
        assert!(mean < 0.02, "{mean}");
    }

    #[test]
    fn without_patterns_the_points_are_moved() {
        let before = scene();
        let shift = Pose::from_parts(Translation3::new(0.0, 0.0, 0.2), UnitQuaternion::identity());
        let after = with_frame(0, |frame, draws| {
            let mut scan = before.clone();
            reshoot(&mut scan, frame, draws, |_, _| Some(shift));
            scan
        });
        for (a, b) in after.returns().zip(before.returns()) {
            assert!((a.point()[2] - b.point()[2] + 0.2).abs() < 1e-4);
        }
    }
}
