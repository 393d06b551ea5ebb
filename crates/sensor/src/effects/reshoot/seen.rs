//! What the true rays of shots meet in a finished cloud, looked up by direction among the returns of a sensor.

use super::super::local_plane::measure_along;
use super::SAME_COS;
use crate::directions::{DirectionIndex, EDGE_M, Entry, LocalSurface, SensorScan, Sensors, Surroundings};
use crate::rig::Sensor;
use crate::scan::{Echo, Scan, dot};
use data::Stream;
use geometry::Pose;
use nalgebra::{Matrix3, Point3, Vector3};
use rand::RngExt;

/// Largest distance of a return from a true direction that the shot meets, in steps of the pattern.
const REACH_STEPS: [f32; 2] = [0.6, 0.5];

/// Difference of two directions in which the same surface is met, in steps of the pattern: a fiftieth of the distance
/// at which shots see different returns.
const SAME_STEPS: f32 = 0.02;

/// Looks to either side, in windows, by which the plane at an end of the field of view is widened, and the fewest that
/// must show it.
const WIDENED: i32 = 2;
const FEWEST_LOOKS: usize = 8;

/// Range of a shot, m, or one at which shots without a return are looked up.
fn about_m(echo: &Echo) -> f64 {
    if echo.is_return() { f64::from(echo.range_m) } else { 50.0 }
}

/// Azimuth and elevation of a point in a sensor's frame, rad.
pub(super) fn towards(point: &Vector3<f64>) -> [f32; 2] {
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
pub(super) struct Met {
    /// Its distance, m.
    pub range_m: f32,
    /// Place among the echoes of the return that is nearest; `None` on the surface of the shot itself.
    pub on: Option<usize>,
    /// Whether that surface goes on beyond the field of view.
    pub beyond: bool,
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

/// A plane in a sensor's frame, its unit normal towards the sensor.
struct Plane {
    point: Vector3<f64>,
    normal: Vector3<f64>,
}

impl Plane {
    /// Range at which a ray meets it, m.
    fn meets_m(&self, ray: &TrueRay) -> Option<f64> {
        let along = self.normal.dot(ray.direction);
        (along < -1e-3).then(|| self.normal.dot(&(self.point - ray.shift)) / along)
    }
}

/// The returns of a sensor by direction.
pub(super) struct Seen<'a> {
    /// Pose of the sensor in the cloud's frame.
    pub pose: Pose,
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
    pub(super) fn new(scan: &Scan, sensors: &'a Sensors, number: usize, random: &mut Stream) -> Self {
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
    pub(super) fn is_hole(&self, [azimuth, elevation]: [f32; 2]) -> bool {
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
    pub(super) fn meet(&self, own: &Vector3<f64>, error: &Pose, echo: &Echo) -> Option<Met> {
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
    pub(super) fn meet_of_another(&self, own: &Vector3<f64>, true_ray: &Pose, echo: &Echo) -> Option<Met> {
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
    pub(super) fn is_left(&self, own: &Vector3<f64>, error: &Pose, echo: &Echo) -> bool {
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
        let own = || Some(Met { range_m: ray.on_own_surface_m(&self.pose)?, on: None, beyond: true });
        let beyond = || self.beyond_the_end([azimuth, elevation], ray).or_else(own);
        let beyond = outside.then(beyond).flatten();
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
        let Some(met) = whole.or_else(of_side) else {
            // A lone return is met at its distance from the true origin.
            let range_m = (nearest_m - ray.shift.dot(ray.direction)).max(0.01) as f32;
            return near.then_some(Met { range_m, on, beyond: false });
        };
        let Some(range_m) = self.plane(&met, [azimuth, elevation]).meets_m(ray) else {
            return Some(Met { range_m: nearest_m as f32, on, beyond: false });
        };
        // The shot's own error is what it lies off the surface around it, or else what the nearest return does. Added
        // to the surface around the true ray, it keeps its variance: the errors of planes are averages of many returns.
        let range_m = range_m + ray.error_m.unwrap_or(met.0.bulge_m);
        Some(Met { range_m: range_m.max(0.01) as f32, on, beyond: false })
    }

    /// The plane of a surface that was looked up in a direction.
    fn plane(&self, (surface, normal): &(LocalSurface, Vector3<f64>), [azimuth, elevation]: [f32; 2]) -> Plane {
        let [az, el] = [azimuth, elevation].map(f64::from);
        let towards = Vector3::new(el.cos() * az.cos(), el.cos() * az.sin(), el.sin());
        Plane { point: towards * surface.range_m, normal: self.pose.rotation.inverse() * normal }
    }

    /// What a shot meets that truly goes to a direction beyond the field of view: the surface at its end.
    fn beyond_the_end(&self, towards: [f32; 2], ray: &TrueRay) -> Option<Met> {
        let own = ray.on_surface?;
        let end = [0, 1].map(|axis| towards[axis].clamp(self.field[axis][0], self.field[axis][1]));
        let surface = self.around.look(end[0], end[1], None).surface?;
        if dot(own.normal, surface.1.map(|v| v as f32).into()) < SAME_COS {
            return None;
        }
        let plane = self.plane(&surface, end);
        let range_m = self.widened(end, &plane).unwrap_or(plane).meets_m(ray)?;
        let range_m = (range_m + ray.error_m.unwrap_or(0.0)).max(0.01) as f32;
        let on = self.nearest(&self.around.index, end).map(|(nearest, ..)| self.places[nearest]);
        Some(Met { range_m, on, beyond: true })
    }

    /// The plane at an end of the field of view by what lies farther inside as well. Far beyond the end the error of a
    /// normal counts for more than noise of range, and shots of neighbouring rows must meet the same plane.
    fn widened(&self, end: [f32; 2], plane: &Plane) -> Option<Plane> {
        let window = self.around.window.map(|v| v as f32);
        let reach = WIDENED as f32;
        let middle = [0, 1].map(|axis| {
            let [low, high] = self.field[axis];
            end[axis].max(low + reach * window[axis]).min(high - reach * window[axis])
        });
        let places = (-WIDENED..=WIDENED).flat_map(|i| (-WIDENED..=WIDENED).map(move |j| [i, j]));
        let looked = places.filter_map(|[i, j]| {
            let at = [middle[0] + i as f32 * window[0], middle[1] + j as f32 * window[1]];
            let other = self.plane(&self.around.look(at[0], at[1], None).surface?, at);
            let same = other.normal.dot(&plane.normal) > f64::from(SAME_COS);
            (same && plane.normal.dot(&(other.point - plane.point)).abs() < EDGE_M).then_some(other.point)
        });
        let points: Vec<Vector3<f64>> = looked.collect();
        if points.len() < FEWEST_LOOKS {
            return None;
        }
        let point = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
        let spread: Matrix3<f64> = points.iter().map(|p| (p - point) * (p - point).transpose()).sum();
        let axes = spread.symmetric_eigen();
        let normal: Vector3<f64> = axes.eigenvectors.column(axes.eigenvalues.imin()).into();
        Some(Plane { point, normal: normal * normal.dot(&plane.normal).signum() })
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
