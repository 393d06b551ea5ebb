//! Finished clouds as scans: sensor, place in the pattern, surface and angle of incidence of each point, recovered as
//! the diagnosis recovers them.

use crate::directions::{
    DirectionIndex, FarSurfaces, LEAST_COS, SensorScan, Sensors, Surroundings, split_by_sensor, split_with_places,
};
use crate::effects::{Need, Reads};
use crate::rig::{Rig, Sensor};
use crate::scan::{Echo, Incidence, Scan, dot};
use data::Cloud;
use geometry::Pose;
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;

/// Cosine of incidence that is assumed where no surface can be fitted: on edges and curved parts of objects.
pub const ROUND_COS: f32 = 0.6;

/// Difference in range up to which a point at an edge belongs to a surface beside it, m and as a share of the range.
const BESIDE: [f32; 2] = [0.3, 0.03];

/// What the intensity column of a finished cloud means.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Intensity {
    /// Not known: effects do not use it.
    #[default]
    Unknown,
    /// Reflectivity at normal incidence, relative to a white plate.
    Reflectivity,
    /// Returned light: reflectivity times the cosine of incidence, without a decrease with range.
    ReturnedLight,
}

/// What a list of effects says of the surfaces of a finished cloud.
#[derive(Clone, Copy, Debug, PartialEq, Default)]
pub struct Surfaces {
    /// Meaning of the intensity column.
    pub intensity: Intensity,
    /// Reflectivity of all surfaces where the intensity does not tell it.
    pub reflectivity: Option<f64>,
}

impl Surfaces {
    /// Whether the reflectivity of a cloud's surfaces is known.
    fn tell(&self, channels: usize) -> bool {
        self.reflectivity.is_some() || channels > 3 && self.intensity != Intensity::Unknown
    }
}

/// Makes scans of the finished clouds of one data set.
#[derive(Clone, Debug)]
pub struct CloudReader {
    sensors: Sensors,
    reads: Reads,
}

impl CloudReader {
    /// For clouds of a rig. The scan patterns are found in some of its clouds, or of all, where they are few.
    pub fn new(rig: &Rig, some: &[Cloud]) -> CloudReader {
        CloudReader::of(rig, some, Reads::ALL)
    }

    /// The same for effects that read no more than this. Without anything to read no pattern is looked for, and none is
    /// [known](Self::known).
    pub fn of(rig: &Rig, some: &[Cloud], reads: Reads) -> CloudReader {
        let some = if reads == Reads::NOTHING { &[] } else { some };
        let scans: Vec<Vec<SensorScan>> = some.iter().map(|cloud| split_by_sensor(cloud, rig)).collect();
        let frames: Vec<&[SensorScan]> = scans.iter().map(Vec::as_slice).collect();
        CloudReader { sensors: Sensors::find(rig, &frames), reads }
    }

    /// The reader with the same patterns for effects that read no more than this.
    pub fn reading(self, reads: Reads) -> CloudReader {
        CloudReader { reads, ..self }
    }

    /// The sensors.
    pub fn sensors(&self) -> &Sensors {
        &self.sensors
    }

    /// What is known of the points of a cloud with so many channels.
    pub fn known(&self, channels: usize, surfaces: &Surfaces) -> BTreeSet<Need> {
        let mut known = BTreeSet::from([Need::Incidence, Need::Cars]);
        let rig = &self.sensors.rig;
        let patterned = rig.sensors.iter().all(|s| s.pattern.as_ref().is_some_and(|p| !p.blocks.is_empty()));
        if patterned || self.sensors.patterns.iter().all(|p| !p.rows_rad.is_empty()) {
            known.extend([Need::Row, Need::Grid]);
        }
        if patterned {
            known.insert(Need::Time);
        }
        if surfaces.tell(channels) {
            known.insert(Need::Reflectivity);
        }
        known
    }

    /// The cloud as a scan: one echo for each point in its order, then the shots without a return. What is not read is
    /// not known: rows and columns are [`Echo::UNKNOWN`], normals are 0.
    pub fn scan(&self, cloud: &Cloud, surfaces: &Surfaces) -> Scan {
        let (scans, places) = split_with_places(cloud, &self.sensors.rig);
        let nowhere = Echo::nothing([0.0; 3], [1.0, 0.0, 0.0]);
        let mut echoes = vec![nowhere; cloud.len()];
        for (i, (echo, point)) in echoes.iter_mut().zip(cloud.points()).enumerate() {
            (echo.source, echo.range_m) = (i as u32, 1.0);
            echo.intensity = point.get(3).copied().unwrap_or(0.0);
            echo.move_point([point[0], point[1], point[2]]);
        }
        for (sensor, (scan, places)) in scans.iter().zip(&places).enumerate() {
            self.read_sensor(sensor, scan, places, cloud, &mut echoes);
        }
        for echo in &mut echoes {
            set_light(echo, cloud.channels, surfaces);
        }
        if self.reads.empty_shots {
            echoes.extend(self.empty_shots(&scans));
        }
        Scan { echoes }
    }

    /// Sets what the points of one sensor tell.
    fn read_sensor(&self, number: usize, scan: &SensorScan, places: &[u32], cloud: &Cloud, echoes: &mut [Echo]) {
        let (sensor, pattern) = (&self.sensors.rig.sensors[number], &self.sensors.patterns[number]);
        let pose = sensor.pose();
        for &place in places {
            let echo = &mut echoes[place as usize];
            (echo.sensor, echo.origin, echo.range_m) = (number as u8, sensor.position.map(|v| v as f32), 1.0);
            let at = place as usize * cloud.channels;
            echo.move_point([cloud.values[at], cloud.values[at + 1], cloud.values[at + 2]]);
        }
        if self.reads.pattern {
            for (i, &place) in places.iter().enumerate() {
                let echo = &mut echoes[place as usize];
                if let Some(row) = pattern.row(scan.elevation_rad[i], scan.range_m[i]) {
                    echo.row = (pattern.rows_rad.len() - 1 - row) as u16;
                    let column = (scan.azimuth_rad[i] + std::f32::consts::PI) / pattern.steps.azimuth_rad;
                    echo.column = column.round().clamp(0.0, 65_534.0) as u16;
                }
                place_in_pattern(echo, sensor, &pose);
            }
        }
        if self.reads.surfaces {
            self.read_surfaces(number, scan, places, echoes);
        }
    }

    /// Sets normals and angles of incidence of the points of one sensor.
    fn read_surfaces(&self, number: usize, scan: &SensorScan, places: &[u32], echoes: &mut [Echo]) {
        let around = Surroundings::new(&self.sensors, number, scan);
        for (i, &place) in places.iter().enumerate() {
            let (azimuth, elevation) = (scan.azimuth_rad[i], scan.elevation_rad[i]);
            let echo = &mut echoes[place as usize];
            echo.cos_incidence = f32::NAN;
            if let Some((surface, normal)) = around.look(azimuth, elevation, Some(i as u32)).surface {
                echo.normal = normal.map(|v| v as f32).into();
                (echo.incidence, echo.cos_incidence) = (Incidence::Estimated, surface.cos_incidence as f32);
            }
        }
        // Points at edges and on lone rows take the surface that goes on through them.
        let smooth: Vec<bool> = places.iter().map(|p| echoes[*p as usize].cos_incidence.is_finite()).collect();
        let surfaces = FarSurfaces::new(places.iter().zip(&smooth).filter(|(_, s)| **s).map(|(p, _)| {
            let echo = &echoes[*p as usize];
            (echo.point(), echo.normal)
        }));
        for (i, &place) in places.iter().enumerate().filter(|(i, _)| !smooth[*i]) {
            let (point, direction) = (echoes[place as usize].point(), echoes[place as usize].direction);
            let (incidence, normal, cos) = match surfaces.through(point, direction, scan.range_m[i]) {
                Some((normal, cos)) => (Incidence::Continued, normal, cos),
                None => {
                    let beside = nearest(&around.index, scan, i, &smooth);
                    let normal = beside.map(|k| echoes[places[k] as usize].normal).unwrap_or_default();
                    let cos = -dot(normal, direction);
                    (Incidence::Assumed, normal, if cos > LEAST_COS { cos } else { ROUND_COS })
                }
            };
            let echo = &mut echoes[place as usize];
            (echo.incidence, echo.normal, echo.cos_incidence) = (incidence, normal, cos);
        }
    }

    /// Shots of known rows without a return: between the returns of a row, and up to the outermost azimuths of the
    /// sensor's returns.
    pub fn empty_shots(&self, scans: &[SensorScan]) -> Vec<Echo> {
        let mut empty = Vec::new();
        for (number, scan) in scans.iter().enumerate() {
            let (sensor, pattern) = (&self.sensors.rig.sensors[number], &self.sensors.patterns[number]);
            if pattern.rows_rad.is_empty() || scan.is_empty() {
                continue;
            }
            let (pose, step) = (sensor.pose(), pattern.steps.azimuth_rad);
            let origin = sensor.position.map(|v| v as f32);
            let mut rows: Vec<Vec<f32>> = vec![Vec::new(); pattern.rows_rad.len()];
            for i in 0..scan.len() {
                if let Some(row) = pattern.row(scan.elevation_rad[i], scan.range_m[i]) {
                    rows[row].push(scan.azimuth_rad[i]);
                }
            }
            let least = scan.azimuth_rad.iter().copied().fold(f32::INFINITY, f32::min) - step;
            let most = scan.azimuth_rad.iter().copied().fold(f32::NEG_INFINITY, f32::max) + step;
            for (row, mut azimuths) in rows.into_iter().enumerate() {
                azimuths.extend([least, most]);
                azimuths.sort_by(f32::total_cmp);
                let elevation = pattern.rows_rad[row];
                for pair in azimuths.windows(2) {
                    let missing = ((pair[1] - pair[0]) / step).round() as usize;
                    for k in 1..missing {
                        let azimuth = pair[0] + (pair[1] - pair[0]) * k as f32 / missing as f32;
                        let own = crate::rig::direction(azimuth.into(), elevation.into());
                        let direction = pose.rotation * Vector3::from(own);
                        let mut echo = Echo::nothing(origin, direction.map(|v| v as f32).into());
                        (echo.sensor, echo.row) = (number as u8, (pattern.rows_rad.len() - 1 - row) as u16);
                        place_in_pattern(&mut echo, sensor, &pose);
                        empty.push(echo);
                    }
                }
            }
        }
        empty
    }
}

/// Of the returns around a return of a scan the nearest in direction on a smooth surface at about its range.
fn nearest(index: &DirectionIndex, scan: &SensorScan, i: usize, smooth: &[bool]) -> Option<usize> {
    let range = scan.range_m[i];
    let mut best: Option<(f32, usize)> = None;
    index.around(scan.azimuth_rad[i], scan.elevation_rad[i], |e, dx, dy| {
        let other = e.index as usize;
        let distance = dx * dx + dy * dy;
        let beside = (e.range_m - range).abs() < BESIDE[0] + BESIDE[1] * range;
        if smooth[other] && beside && best.is_none_or(|(least, _)| distance < least) {
            best = Some((distance, other));
        }
    });
    best.map(|(_, other)| other)
}

/// Sets reflectivity and returned light from the intensity, or as they are assumed.
fn set_light(echo: &mut Echo, channels: usize, surfaces: &Surfaces) {
    let cos = echo.cos_incidence.max(0.05);
    let assumed = surfaces.reflectivity.map_or(0.0, |v| v as f32);
    let reflectivity = match surfaces.intensity {
        Intensity::Reflectivity if channels > 3 => echo.intensity,
        Intensity::ReturnedLight if channels > 3 => echo.intensity / cos,
        _ => assumed,
    };
    echo.reflectivity = reflectivity.clamp(0.0, 10.0);
    echo.returned = echo.reflectivity * echo.cos_incidence;
}

/// Row, column and time of an echo by the sensor's pattern, where the rig has one.
fn place_in_pattern(echo: &mut Echo, sensor: &Sensor, pose: &Pose) {
    let Some(pattern) = sensor.pattern.as_ref().filter(|p| !p.blocks.is_empty()) else { return };
    let local = pose.rotation.inverse() * Vector3::from(echo.direction.map(f64::from));
    let (azimuth, elevation) = (local.y.atan2(local.x), local.z.clamp(-1.0, 1.0).asin());
    let elevations = pattern.row_elevations_rad();
    let off = |row: &usize| (elevations[*row] - elevation).abs();
    let row = (0..elevations.len()).min_by(|a, b| off(a).total_cmp(&off(b))).unwrap_or(0);
    let step = sensor.horizontal_fov_deg.to_radians() / f64::from(pattern.columns);
    let left = step * (f64::from(pattern.columns) - 1.0) / 2.0;
    let column = ((left - azimuth) / step).round().clamp(0.0, f64::from(pattern.columns - 1)) as usize;
    (echo.row, echo.column) = (row as u16, column as u16);
    echo.time_s = pattern.shots()[row * pattern.grid_columns() + column].time_s as f32;
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::testing::{rig, scene};
    use std::path::Path;

    #[test]
    fn a_scan_is_recovered_from_its_points() {
        let scan = scene();
        let cloud = scan.cloud();
        let mut bare = rig();
        for patterned in [true, false] {
            if !patterned {
                bare.sensors[0].pattern = None;
            }
            let reader = CloudReader::new(&bare, std::slice::from_ref(&cloud));
            let surfaces = Surfaces::default();
            let known = reader.known(4, &surfaces);
            assert!(known.contains(&Need::Grid) && !known.contains(&Need::Material));
            assert!(known.contains(&Need::Time) == patterned && !known.contains(&Need::Reflectivity));
            let found = reader.scan(&cloud, &surfaces);
            let returns: Vec<&Echo> = scan.returns().collect();
            assert_eq!(found.returns().count(), returns.len());
            let (mut same, mut planes) = (0, 0);
            let mut least = u16::MAX;
            for (i, (a, b)) in found.echoes.iter().zip(&returns).enumerate() {
                assert!((a.range_m - b.range_m).abs() < 1e-3 && a.source == i as u32);
                least = least.min(b.row);
                same += usize::from(!patterned || (a.row, a.column, a.time_s) == (b.row, b.column, b.time_s));
                planes += usize::from((a.cos_incidence - b.cos_incidence).abs() < 0.05);
            }
            assert!(same * 1000 > returns.len() * 999, "{same} of {}", returns.len());
            assert!(planes * 10 > returns.len() * 9, "{planes} of {}", returns.len());
            // Rows that have a return, from the top; the empty shots are those between and beside returns.
            let off: BTreeSet<i32> =
                found.echoes.iter().zip(&returns).map(|(a, b)| i32::from(b.row) - i32::from(a.row)).collect();
            assert_eq!(off.into_iter().collect::<Vec<_>>(), [if patterned { 0 } else { i32::from(least) }]);
            let empty = found.echoes.len() - returns.len();
            let rows = scan.returns().map(|e| e.row).collect::<BTreeSet<_>>().len();
            assert!(empty.abs_diff(rows * 360 - returns.len()) <= 2 * rows, "{empty} of {rows} rows");
        }
    }

    #[test]
    fn points_of_a_lone_far_row_are_met_as_the_road_before_them_is() {
        // Ground 2 m below the sensor up to 19 m away, then a single row of it, and what is above the wall.
        let scan = scene();
        let is_lone = |e: &Echo| e.object == 1 && (24.0..27.0).contains(&e.range_m);
        let row = scan.returns().find(|e| is_lone(e)).unwrap().row;
        let kept = scan.returns().filter(|e| e.object == 1 && (e.range_m < 19.0 || e.row == row));
        let cloud = Scan { echoes: kept.copied().collect() }.cloud();
        let found = CloudReader::new(&rig(), &[scene().cloud()]).scan(&cloud, &Surfaces::default());
        let far: Vec<&Echo> = found.returns().filter(|e| e.range_m > 20.0).collect();
        assert!(far.len() > 50, "{}", far.len());
        for echo in far {
            assert!((echo.cos_incidence * echo.range_m / 2.0 - 1.0).abs() < 0.1, "{echo:?}");
        }
    }

    #[test]
    fn the_intensity_means_what_the_list_says() {
        let cloud = scene().cloud();
        let reader = CloudReader::new(&rig(), std::slice::from_ref(&cloud));
        let scan = |intensity, reflectivity| reader.scan(&cloud, &Surfaces { intensity, reflectivity });
        let at = |scan: &Scan| {
            let e = scan.echoes[2000];
            (e.reflectivity, e.intensity, e.cos_incidence)
        };
        let (value, intensity, cos) = at(&scan(Intensity::ReturnedLight, None));
        assert!((value - intensity / cos).abs() < 1e-6);
        assert_eq!(at(&scan(Intensity::Reflectivity, None)).0, intensity);
        assert_eq!(at(&scan(Intensity::Unknown, Some(0.1))).0, 0.1);
    }

    #[test]
    fn points_belong_to_the_sensor_whose_field_contains_them() {
        let text = "[[sensor]]\nname = \"front\"\nhorizontal_fov_deg = 120\n[[sensor]]\nname = \"left\"\nyaw_deg = 120\nhorizontal_fov_deg = 120\n\
                    [[sensor]]\nname = \"right\"\nyaw_deg = -120\nhorizontal_fov_deg = 120\n";
        let rig = Rig::parse(text, Path::new("r.toml")).unwrap();
        let cloud = Cloud { values: vec![10.0, 1.0, 0.0, -5.0, 5.0, 0.0, -5.0, -5.0, 0.0], channels: 3 };
        let reader = CloudReader::new(&rig, std::slice::from_ref(&cloud));
        let scan = reader.scan(&cloud, &Surfaces::default());
        assert_eq!(scan.echoes.iter().map(|e| e.sensor).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(!reader.known(3, &Surfaces::default()).contains(&Need::Row));
    }
}
