//! A finished cloud as a scan: sensor, place in the pattern and angle of incidence of each point.

use crate::assignment::Assignment;
use crate::effects::Need;
use crate::rig::{Rig, Sensor};
use crate::scan::{Echo, Scan, dot};
use crate::signal::CLOUD_REFLECTIVITY;
use data::Cloud;
use geometry::Pose;
use nalgebra::{Matrix3, Point3, Vector3};
use std::collections::{BTreeMap, BTreeSet};

/// Side of the angular cells in which neighbours of a point are searched, seen from the sensor, rad.
const CELL_RAD: f32 = 0.01;
/// Maximum distance of neighbours relative to the range.
const MAX_NEIGHBOUR_DISTANCE: f32 = 0.03;
/// Minimum number of points of a plane fit.
const MIN_PLANE_POINTS: usize = 5;

/// The cloud as a scan, and the quantities known of it.
///
/// Points are assigned to sensors by [`Assignment`]. Row and column are the nearest ones of the sensor's pattern, if it
/// has one. The angle of incidence is that of the plane through the neighbouring points of the same sensor.
/// Reflectivity is the intensity over the cosine of incidence, or [`CLOUD_REFLECTIVITY`] in clouds without intensity.
pub fn scan_of_cloud(cloud: &Cloud, rig: &Rig) -> (Scan, BTreeSet<Need>) {
    let assignment = Assignment::new(rig);
    let poses: Vec<Pose> = rig.sensors.iter().map(Sensor::pose).collect();
    let intensity = |p: &[f32]| p.get(3).copied();
    let echo = |p: &[f32]| {
        let point = Point3::new(p[0], p[1], p[2]).cast();
        let number = assignment.of_point(point).map_or(0, |assigned| assigned.sensor);
        let mut echo = Echo {
            sensor: number as u8,
            range_m: 1.0,
            reflectivity: CLOUD_REFLECTIVITY,
            intensity: intensity(p).unwrap_or(0.0),
            ..Echo::nothing(rig.sensors[number].position.map(|v| v as f32), [1.0, 0.0, 0.0])
        };
        echo.move_point([p[0], p[1], p[2]]);
        place_in_pattern(&mut echo, &rig.sensors[number], &poses[number]);
        echo
    };
    let mut scan = Scan { echoes: cloud.points().map(echo).collect() };
    estimate_normals(&mut scan);
    for echo in &mut scan.echoes {
        let light = if cloud.channels > 3 { echo.intensity / echo.cos_incidence.max(0.05) } else { echo.reflectivity };
        echo.reflectivity = light.clamp(0.0, 10.0);
        echo.returned = echo.reflectivity * echo.cos_incidence;
    }
    let mut known = BTreeSet::from([Need::Incidence, Need::Reflectivity, Need::Cars]);
    if rig.sensors.iter().all(|s| s.pattern.as_ref().is_some_and(|p| !p.blocks.is_empty())) {
        known.extend([Need::Row, Need::Grid, Need::Time]);
    }
    (scan, known)
}

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

/// Sets normals and cosines of incidence from the plane through the neighbours of each point.
fn estimate_normals(scan: &mut Scan) {
    let cell = |echo: &Echo| {
        let [x, y, z] = echo.direction;
        ((y.atan2(x) / CELL_RAD).floor() as i32, (z.clamp(-1.0, 1.0).asin() / CELL_RAD).floor() as i32)
    };
    let mut cells: BTreeMap<(u8, (i32, i32)), Vec<u32>> = BTreeMap::new();
    for (i, echo) in scan.echoes.iter().enumerate() {
        cells.entry((echo.sensor, cell(echo))).or_default().push(i as u32);
    }
    let normals: Vec<Option<[f32; 3]>> = scan
        .echoes
        .iter()
        .map(|echo| {
            let (column, row) = cell(echo);
            let here = Vector3::from(echo.point());
            let reach = MAX_NEIGHBOUR_DISTANCE * echo.range_m;
            let mut near = Vec::new();
            for (c, r) in (column - 1..=column + 1).flat_map(|c| (row - 1..=row + 1).map(move |r| (c, r))) {
                let found = cells.get(&(echo.sensor, (c, r))).into_iter().flatten();
                near.extend(found.map(|i| Vector3::from(scan.echoes[*i as usize].point()) - here));
            }
            near.retain(|v| v.norm() <= reach);
            plane(&near).map(|n| if dot(n, echo.direction) > 0.0 { n.map(|v| -v) } else { n })
        })
        .collect();
    for (echo, normal) in scan.echoes.iter_mut().zip(normals) {
        if let Some(normal) = normal {
            echo.normal = normal;
            echo.cos_incidence = -dot(normal, echo.direction);
        }
    }
}

/// Unit normal of the plane through these points; `None` if they are collinear or not planar.
fn plane(points: &[Vector3<f32>]) -> Option<[f32; 3]> {
    if points.len() < MIN_PLANE_POINTS {
        return None;
    }
    let mean = points.iter().sum::<Vector3<f32>>() / points.len() as f32;
    let scatter: Matrix3<f32> = points.iter().map(|p| (p - mean) * (p - mean).transpose()).sum();
    let eigen = scatter.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|a, b| eigen.eigenvalues[*a].total_cmp(&eigen.eigenvalues[*b]));
    let [least, middle, _] = order.map(|i| eigen.eigenvalues[i].max(0.0));
    (middle > 1e-9 && least < 0.1 * middle).then(|| eigen.eigenvectors.column(order[0]).into_owned().into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::effects::testing::{rig, scene};
    use std::path::Path;

    #[test]
    fn a_scan_is_recovered_from_its_points() {
        let scan = scene();
        let (found, known) = scan_of_cloud(&scan.cloud().with_channels(3), &rig());
        assert!(known.contains(&Need::Grid) && !known.contains(&Need::Material));
        let returns: Vec<&Echo> = scan.returns().collect();
        assert_eq!(found.echoes.len(), returns.len());
        let (mut same, mut planes) = (0, 0);
        for (a, b) in found.echoes.iter().zip(&returns) {
            assert!((a.range_m - b.range_m).abs() < 1e-3);
            same += usize::from((a.row, a.column) == (b.row, b.column) && (a.time_s - b.time_s).abs() < 1e-6);
            planes += usize::from((a.cos_incidence - b.cos_incidence).abs() < 0.05);
        }
        assert!(same * 1000 > returns.len() * 999, "{same} of {}", returns.len());
        assert!(planes * 10 > returns.len() * 7, "{planes} of {}", returns.len());
    }

    #[test]
    fn points_belong_to_the_sensor_whose_field_contains_them() {
        let text = "[[sensor]]\nname = \"front\"\nhorizontal_fov_deg = 120\n[[sensor]]\nname = \"left\"\nyaw_deg = 120\nhorizontal_fov_deg = 120\n\
                    [[sensor]]\nname = \"right\"\nyaw_deg = -120\nhorizontal_fov_deg = 120\n";
        let rig = Rig::parse(text, Path::new("r.toml")).unwrap();
        let cloud = Cloud { values: vec![10.0, 1.0, 0.0, -5.0, 5.0, 0.0, -5.0, -5.0, 0.0], channels: 3 };
        let (scan, known) = scan_of_cloud(&cloud, &rig);
        assert_eq!(scan.echoes.iter().map(|e| e.sensor).collect::<Vec<_>>(), [0, 1, 2]);
        assert!(!known.contains(&Need::Row));
    }
}
