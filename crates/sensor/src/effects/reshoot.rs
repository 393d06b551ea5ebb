//! Shots of a finished cloud that truly went elsewhere: their ranges are looked up in the cloud itself, and they keep
//! the directions that the sensor reports.

use super::local_plane::measure_along;
use super::{Draws, FrameContext};
use crate::directions::{DirectionIndex, Entry, LEAST_COS, SensorScan, Sensors, Surroundings};
use crate::rig::Sensor;
use crate::scan::{Echo, Scan, dot};
use data::Stream;
use geometry::Pose;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use rand::RngExt;
use std::collections::BTreeMap;

/// Largest distance of a return from a true direction that the shot meets, in steps of the pattern.
const REACH_STEPS: [f32; 2] = [0.6, 0.5];

/// Difference of two directions in which the same surface is met, in steps of the pattern: a fiftieth of the distance
/// at which shots see different returns.
const SAME_STEPS: f32 = 0.02;

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
        let beyond = met.as_ref().is_none_or(|met| met.on.is_none()) && seen.is_left(&own, &in_frame_of(seen), echo);
        let mut others = all.iter().filter(|other| beyond && !std::ptr::eq(*other, seen));
        let shown = others.find_map(|other| other.meet_of_another(&own, &in_frame_of(other), &before[i]));
        let Some(Met { range_m, on }) = shown.or(met) else {
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

/// Range of a shot, m, or one at which shots without a return are looked up.
fn about_m(echo: &Echo) -> f64 {
    if echo.is_return() { f64::from(echo.range_m) } else { 50.0 }
}

/// Azimuth and elevation of a point in a sensor's frame, rad.
fn towards(point: &Vector3<f64>) -> [f32; 2] {
    let [azimuth, elevation, _] = Sensor::spherical(&Point3::from(*point));
    [azimuth as f32, elevation as f32]
}

/// Number of the step of an angle from the lower end of the field of view.
fn bin(angle: f32, [low, high]: [f32; 2], step: f32) -> usize {
    if low < high { ((angle - low) / step + 0.5).max(0.0) as usize } else { 0 }
}

/// Place of an elevation among ascending rows: 1.5 half-way from the second to the third; beyond the ends as far as the
/// last two rows are apart.
fn row_place(rows: &[f32], elevation: f32) -> f32 {
    let next = rows.partition_point(|r| *r < elevation).clamp(1, rows.len().max(2) - 1);
    match rows {
        [_, _, ..] => (next - 1) as f32 + (elevation - rows[next - 1]) / (rows[next] - rows[next - 1]),
        _ => 0.0,
    }
}

/// What a true ray meets.
struct Met {
    /// Its distance, m.
    range_m: f32,
    /// Place among the echoes of the return that is nearest; `None` on the surface of the shot itself.
    on: Option<usize>,
}

/// The true ray of a shot.
struct TrueRay<'a> {
    /// Direction and start, m, in the sensor's frame.
    direction: &'a Vector3<f64>,
    shift: &'a Vector3<f64>,
    /// Azimuth and elevation of the reported ray, rad.
    reported: [f32; 2],
    /// The shot where it is reported on a surface.
    on_surface: Option<&'a Echo>,
    /// What its range is off the surface around it, m; `None` where surfaces meet.
    error_m: Option<f64>,
}

impl TrueRay<'_> {
    /// Range at which the ray meets the plane of the surface on which the shot is reported, m. `pose` is that of the
    /// sensor in the cloud's frame.
    fn on_own_surface_m(&self, pose: &Pose) -> Option<f32> {
        let [direction, shift] = [self.direction, self.shift].map(|v| (pose.rotation * v).map(|x| x as f32).into());
        let mut own = *self.on_surface?;
        measure_along(&mut own, direction);
        Some((own.range_m - dot(own.normal, shift) / dot(own.normal, direction).min(-1e-3)).max(0.01))
    }
}

/// The returns of a sensor by direction.
struct Seen<'a> {
    /// Pose of the sensor in the cloud's frame.
    pose: Pose,
    scan: SensorScan,
    /// Places of the returns among the echoes.
    places: Vec<usize>,
    around: Surroundings,
    steps: [f32; 2],
    /// Elevations of the rows, rad; empty where they are not known.
    rows_rad: &'a [f32],
    /// The shots without a return, where they are known: by direction, and azimuth and elevation of each, rad.
    empty: DirectionIndex,
    empty_shots: Vec<[f32; 2]>,
    /// Where between two shots an edge lies, from -1/2 to 1/2 about the middle: of each column, and of each row.
    edges: [Vec<f32>; 2],
    /// Least and largest azimuth and elevation of a return, rad.
    field: [[f32; 2]; 2],
}

impl<'a> Seen<'a> {
    fn new(scan: &Scan, sensors: &'a Sensors, number: usize, random: &mut Stream) -> Self {
        let pose = sensors.rig.sensors[number].pose();
        let sensor_from_cloud = pose.inverse();
        let (mut own, mut empty, mut places) = (SensorScan::default(), SensorScan::default(), Vec::new());
        for (i, echo) in scan.echoes.iter().enumerate().filter(|(_, e)| usize::from(e.sensor) == number) {
            if echo.is_return() {
                let point = sensor_from_cloud * Point3::from(echo.point().map(f64::from));
                let [azimuth, elevation, range] = Sensor::spherical(&point);
                own.azimuth_rad.push(azimuth as f32);
                own.elevation_rad.push(elevation as f32);
                own.range_m.push(range as f32);
                places.push(i);
            } else {
                let [azimuth, elevation] =
                    towards(&(pose.rotation.inverse() * Vector3::from(echo.direction.map(f64::from))));
                empty.azimuth_rad.push(azimuth);
                empty.elevation_rad.push(elevation);
                empty.range_m.push(f32::INFINITY);
            }
        }
        let steps = sensors.patterns[number].steps;
        let ends = |angles: &[f32]| {
            angles.iter().fold([f32::INFINITY, f32::NEG_INFINITY], |[low, high], v| [low.min(*v), high.max(*v)])
        };
        let steps = [steps.azimuth_rad, steps.elevation_rad];
        let field = [ends(&own.azimuth_rad), ends(&own.elevation_rad)];
        let mut of_axis = |axis: usize| {
            let shots = bin(field[axis][1], field[axis], steps[axis]) + 1;
            (0..shots).map(|_| random.random_range(-0.5..0.5)).collect()
        };
        Seen {
            pose,
            edges: [of_axis(0), of_axis(1)],
            rows_rad: &sensors.patterns[number].rows_rad,
            field,
            empty: DirectionIndex::new(&empty, sensors.window(number), sensors.rig.sensors[number].is_full_circle()),
            empty_shots: empty.azimuth_rad.into_iter().zip(empty.elevation_rad).map(|(az, el)| [az, el]).collect(),
            around: Surroundings::new(sensors, number, &own),
            scan: own,
            places,
            steps,
        }
    }

    /// Whether a shot without a return was lost on a surface: one lies around its direction, or the shots to its left
    /// and right in its row returned.
    fn is_hole(&self, [azimuth, elevation]: [f32; 2]) -> bool {
        if self.around.look(azimuth, elevation, None).surface.is_some() {
            return true;
        }
        let mut beside = [false; 2];
        self.around(&self.around.index, [azimuth, elevation], |_, x, y| {
            if y.abs() <= REACH_STEPS[1] && x.abs() <= 1.0 + REACH_STEPS[0] {
                beside[usize::from(x > 0.0)] = true;
            }
        });
        beside == [true; 2] && !self.rows_rad.is_empty()
    }

    /// Calls `visit` with the shots around a direction, and with their distances along and across the rows in steps of
    /// the pattern.
    fn around(&self, shots: &DirectionIndex, [azimuth, elevation]: [f32; 2], mut visit: impl FnMut(&Entry, f32, f32)) {
        let window = self.around.window.map(|v| v as f32);
        let in_steps = [window[0] / self.steps[0], window[1] / self.steps[1]];
        shots.around(azimuth, elevation, |entry, dx, dy| visit(entry, dx * in_steps[0], dy * in_steps[1]));
    }

    /// What the true ray of a shot meets. The shot is reported as `echo`, in the direction `own`; `error` moves that
    /// ray to the true one, both in the sensor's frame.
    fn meet(&self, own: &Vector3<f64>, error: &Pose, echo: &Echo) -> Option<Met> {
        let (direction, shift) = (&(error.rotation * own), &error.translation.vector);
        let [azimuth, elevation] = towards(own);
        let on_surface = echo.is_return() && echo.normal != [0.0; 3];
        let surface = on_surface.then(|| self.around.look(azimuth, elevation, None).surface).flatten();
        let ray = TrueRay {
            direction,
            shift,
            reported: [azimuth, elevation],
            on_surface: on_surface.then_some(echo),
            error_m: surface.map(|(own, _)| f64::from(echo.range_m) - own.range_m),
        };
        self.along(&ray, about_m(echo), |towards| self.at(towards, &ray))
    }

    /// What the true ray of a shot of another sensor meets within the field of view of this one. `own` is its direction
    /// in the frame of its sensor, from which `true_ray` leads to the true ray in the frame of this one.
    fn meet_of_another(&self, own: &Vector3<f64>, true_ray: &Pose, echo: &Echo) -> Option<Met> {
        let (direction, shift) = (&(true_ray.rotation * own), &true_ray.translation.vector);
        let reported = towards(direction);
        let ray = TrueRay { direction, shift, reported, on_surface: None, error_m: None };
        self.along(&ray, about_m(echo), |towards| if self.is_outside(towards) { None } else { self.at(towards, &ray) })
    }

    /// What `at` says where a ray is at the range of what it meets, seen from the reported origin. Twice, since that
    /// range is not known before.
    fn along(&self, ray: &TrueRay, about_m: f64, at: impl Fn([f32; 2]) -> Option<Met>) -> Option<Met> {
        let towards_at = |range_m: f64| towards(&(ray.shift + ray.direction * range_m));
        let first = towards_at(about_m);
        let met = at(first)?;
        let again = towards_at(f64::from(met.range_m));
        // The direction only says which surface is met; the range on that is exact.
        let same = (0..2).all(|k| (again[k] - first[k]).abs() <= SAME_STEPS * self.steps[k]);
        if same { Some(met) } else { at(again) }
    }

    /// Whether the true ray of a shot is outside of the field of view where its return is.
    fn is_left(&self, own: &Vector3<f64>, error: &Pose, echo: &Echo) -> bool {
        self.is_outside(towards(&(error.translation.vector + error.rotation * own * about_m(echo))))
    }

    /// Whether a direction is outside of the field of view.
    fn is_outside(&self, towards: [f32; 2]) -> bool {
        towards.iter().zip(&self.field).any(|(v, [low, high])| v < low || v > high)
    }

    /// What a true ray meets if it meets it in a direction from the reported origin.
    fn at(&self, [azimuth, elevation]: [f32; 2], ray: &TrueRay) -> Option<Met> {
        let outside = self.is_outside([azimuth, elevation]);
        // Beyond the field of view surfaces go on as they are at its end.
        let beyond_m = if outside { ray.on_own_surface_m(&self.pose) } else { None };
        let beyond = beyond_m.map(|range_m| Met { range_m, on: None });
        let side = self.on_the_side_of(ray.reported, [azimuth, elevation]);
        let Some((nearest, distance, near)) = self.nearest(&self.around.index, side) else { return beyond };
        // A shot that returned nothing shows that nothing is there, unless it was lost on a surface.
        let empty = self.nearest(&self.empty, side).filter(|(_, other, _)| *other < distance);
        let hole = empty.map(|(shot, ..)| self.is_hole(self.empty_shots[shot]));
        if hole == Some(false) && !outside {
            return None;
        }
        let near = near || hole == Some(true);
        let on = Some(self.places[nearest]);
        let whole = self.around.look(azimuth, elevation, None).surface;
        if whole.is_none() && beyond.is_some() {
            return beyond;
        }
        // Beyond an edge with nothing behind it. Shots that were lost on a surface leave no such gap.
        if !near && self.around.look(side[0], side[1], None).surface.is_none() {
            return None;
        }
        // At an edge: the surface of the return on the same side of it.
        let of_side = || self.around.surface_of(azimuth, elevation, nearest as u32).filter(|_| near);
        let nearest_m = f64::from(self.scan.range_m[nearest]);
        let Some((surface, normal)) = whole.or_else(of_side) else {
            // A lone return is met at its distance from the true origin.
            let range_m = (nearest_m - ray.shift.dot(ray.direction)).max(0.01) as f32;
            return near.then_some(Met { range_m, on });
        };
        let meets = self.pose.rotation.inverse() * normal;
        // The plane around the true direction, met from the true origin.
        let [az, el] = [azimuth, elevation].map(f64::from);
        let seen = Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin()) * surface.range_m;
        let along = meets.dot(ray.direction);
        if along > -1e-3 {
            return Some(Met { range_m: nearest_m as f32, on });
        }
        // The shot's own error is what it lies off the surface around it, or else what the nearest return does. Added
        // to the surface around the true ray, it keeps its variance: the errors of planes are averages of many returns.
        let range_m = meets.dot(&(seen - ray.shift)) / along + ray.error_m.unwrap_or(surface.bulge_m);
        Some(Met { range_m: range_m.max(0.01) as f32, on })
    }

    /// A direction whose nearest return lies on the side of an edge that a true ray meets. Of two returns an edge lies
    /// anywhere between: in a share of the rows and columns that is the share of the way from one to the other the ray
    /// meets what the other one met. Neighbours of a shot see the same edge.
    fn on_the_side_of(&self, own: [f32; 2], [azimuth, elevation]: [f32; 2]) -> [f32; 2] {
        let [by_column, by_row] = [0, 1].map(|axis| {
            let place = bin(own[axis], self.field[axis], self.steps[axis]);
            self.edges[axis].get(place).copied().unwrap_or(0.0)
        });
        let above = match self.rows_rad {
            [] => elevation + by_row * self.steps[1],
            rows => rows[(row_place(rows, elevation) + by_row).round().clamp(0.0, rows.len() as f32 - 1.0) as usize],
        };
        [azimuth + by_column * self.steps[0], above]
    }

    /// The shot nearest to a direction, the square of its distance in steps of the pattern, and whether it is so near
    /// that a shot there meets what it met.
    fn nearest(&self, shots: &DirectionIndex, direction: [f32; 2]) -> Option<(usize, f32, bool)> {
        let mut nearest: Option<(usize, f32, bool)> = None;
        self.around(shots, direction, |entry, x, y| {
            let distance = x * x + y * y;
            if nearest.is_none_or(|(_, least, _)| distance < least) {
                let near = x.abs() <= REACH_STEPS[0] && y.abs() <= REACH_STEPS[1];
                nearest = Some((entry.index as usize, distance, near));
            }
        });
        nearest
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::cloud_scan::{CloudReader, Surfaces};
    use crate::effects::testing::{rig, scene, with_frame};
    use crate::rig::Rig;
    use data::Cloud;
    use nalgebra::Translation3;
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
