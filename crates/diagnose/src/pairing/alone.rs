//! One side by itself: each return against the surface of its own neighbours, and the shots of smooth surfaces with and
//! without a return. Two sides that show different streets are compared by these.

use super::prediction::Predictor;
use super::ray::{Ray, Surface};
use super::recordings::SideFrame;
use super::row_edges::{RowEdges, edges_of};
use geometry::Box3;
use sensor::directions::{LocalSurface, Neighbour, SensorScan, Sensors};

/// One frame of one side by itself.
#[derive(Clone, Debug, Default)]
pub struct FrameAlone {
    /// Its returns, each predicted from the others.
    pub returns: Vec<Ray>,
    /// Shots onto smooth surfaces; [`Ray::matched`] says whether the shot has a return. Empty for sensors without known
    /// rows.
    pub shots: Vec<Ray>,
    /// Edges in its rows.
    pub edges: RowEdges,
}

/// Longest gap of a row that is filled with shots, in shots.
const LONGEST_GAP: i32 = 8;

/// Largest difference of a gap from a whole number of steps, in steps.
const OFF_STEP: f32 = 0.3;

/// The returns and shots of one side of a frame.
pub fn frame_alone(side: &SideFrame, sensors: &Sensors) -> FrameAlone {
    let boxes: Vec<Box3> = side.objects.iter().map(|o| o.bbox).collect();
    let mut out = FrameAlone { edges: edges_of(&side.scans, sensors), ..FrameAlone::default() };
    for (sensor, scan) in side.scans.iter().enumerate() {
        let predictor = Predictor::new(sensors, sensor, scan, &boxes);
        let mut neighbours = Vec::new();
        let alone = |i| alone(&predictor, scan, i, &mut neighbours);
        let (returns, surfaces): (Vec<Ray>, Vec<Option<LocalSurface>>) = (0..scan.len()).map(alone).unzip();
        out.shots.extend(shots(&predictor, scan, (&returns, &surfaces), sensors.patterns[sensor].steps.azimuth_rad));
        out.returns.extend(returns);
    }
    out
}

/// A return with what the others of its side say, and their surface. `neighbours` is overwritten.
fn alone(
    predictor: &Predictor,
    scan: &SensorScan,
    i: usize,
    neighbours: &mut Vec<Neighbour>,
) -> (Ray, Option<LocalSurface>) {
    let (mut ray, surface) = predictor.own_ray(scan, i, neighbours);
    ray.matched = true;
    // In the open a far post is as lone as a false alarm.
    if ray.surface == Surface::Open {
        ray.row = u16::MAX;
    }
    (ray, surface)
}

/// Shots of the rows onto smooth surfaces: returns, and places between two returns of a row. The neighbours of a shot
/// in its row lie on the surface as well, so that shots beside the end of a surface are none.
fn shots(
    predictor: &Predictor,
    scan: &SensorScan,
    (returns, surfaces): (&[Ray], &[Option<LocalSurface>]),
    step_rad: f32,
) -> Vec<Ray> {
    let rows = returns.iter().map(|r| r.row).filter(|row| *row != u16::MAX).max().map_or(0, |row| usize::from(row) + 1);
    let mut by_row: Vec<Vec<usize>> = vec![Vec::new(); rows];
    for (i, ray) in returns.iter().enumerate().filter(|(_, r)| r.row != u16::MAX) {
        by_row[usize::from(ray.row)].push(i);
    }
    let edge_m = predictor.edge_m();
    let mut out = Vec::new();
    for row in &mut by_row {
        row.sort_by(|a, b| scan.azimuth_rad[*a].total_cmp(&scan.azimuth_rad[*b]));
        for three in row.windows(3) {
            let [before, at, after] = [three[0], three[1], three[2]];
            let near = [(before, at), (at, after)].iter().all(|(a, b)| gap(scan, *a, *b, step_rad).is_some());
            let place = [scan.azimuth_rad[at], scan.elevation_rad[at]];
            if near && between(scan, surfaces[at].as_ref(), place, [before, after], edge_m) {
                out.push(Ray { matched: true, ..returns[at] });
            }
        }
        for pair in row.windows(2) {
            let [before, after] = [pair[0], pair[1]];
            let Some(steps) = gap(scan, before, after, step_rad).filter(|n| *n > 1) else { continue };
            let missed = (1..steps).map(|k| {
                let of = |values: &[f32]| values[before] + (values[after] - values[before]) * k as f32 / steps as f32;
                [of(&scan.azimuth_rad), of(&scan.elevation_rad)]
            });
            out.extend(missed.filter_map(|place| {
                let (ray, surface) = missed_shot(predictor, place);
                between(scan, surface.as_ref(), place, [before, after], edge_m).then_some(ray)
            }));
        }
    }
    out
}

/// Number of steps between two returns of a row; `None` where it is not whole, or too large.
fn gap(scan: &SensorScan, a: usize, b: usize, step_rad: f32) -> Option<i32> {
    let steps = (scan.azimuth_rad[b] - scan.azimuth_rad[a]) / step_rad;
    let whole = steps.round();
    ((steps - whole).abs() < OFF_STEP && (1.0..=LONGEST_GAP as f32).contains(&whole)).then_some(whole as i32)
}

/// Whether the surface of a direction is a smooth one on which two returns beside it lie as well.
fn between(
    scan: &SensorScan,
    surface: Option<&LocalSurface>,
    [azimuth_rad, elevation_rad]: [f32; 2],
    beside: [usize; 2],
    edge_m: f64,
) -> bool {
    let Some(surface) = surface else { return false };
    beside.iter().all(|&i| {
        let off = [scan.azimuth_rad[i] - azimuth_rad, scan.elevation_rad[i] - elevation_rad].map(f64::from);
        off_surface_m(surface, off, f64::from(elevation_rad), f64::from(scan.range_m[i])) < edge_m
    })
}

/// Distance of a return from a surface, across it, m: in a direction that differs by azimuth and elevation, rad.
fn off_surface_m(surface: &LocalSurface, [azimuth, elevation]: [f64; 2], at_elevation: f64, range_m: f64) -> f64 {
    // The inverse range of a plane is linear in the angles.
    let inverse = 1.0 / surface.range_m;
    let slope = surface.slope_m_per_rad.map(|s| -s * inverse * inverse);
    let there = inverse + slope[0] * azimuth * at_elevation.cos() + slope[1] * elevation;
    if there > 0.0 { (range_m - 1.0 / there).abs() * surface.cos_incidence } else { f64::INFINITY }
}

/// A shot without a return, and the surface that it meets.
fn missed_shot(predictor: &Predictor, [azimuth_rad, elevation_rad]: [f32; 2]) -> (Ray, Option<LocalSurface>) {
    let place = SensorScan {
        azimuth_rad: vec![azimuth_rad],
        elevation_rad: vec![elevation_rad],
        range_m: vec![1.0],
        intensity: vec![],
    };
    let (ray, surface) = predictor.seen(&place, 0, None, &mut Vec::new());
    // Nothing came back: it has no range of its own.
    (Ray { matched: false, residual_m: 0.0, ..ray }, surface)
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use sensor::Rig;
    use sensor::directions::{ScanPattern, Steps};

    const ROWS: [f32; 8] = [-0.07, -0.06, -0.05, -0.04, -0.03, -0.02, -0.01, 0.0];
    const STEP: f32 = 0.004;

    /// A wall 20 m ahead that ends on both sides; of its shots a share is lost.
    fn wall(lost: f64) -> SideFrame {
        let mut rng = data::stream(1, "alone test", 0, 0);
        let mut scan = SensorScan::default();
        for el in ROWS {
            for k in -150i16..=150 {
                if rng.random::<f64>() >= lost {
                    let az = f32::from(k) * STEP;
                    scan.azimuth_rad.push(az);
                    scan.elevation_rad.push(el);
                    scan.range_m.push(20.0 / az.cos() / el.cos());
                }
            }
        }
        SideFrame { scans: vec![scan], objects: vec![], second: 0 }
    }

    fn seen(side: &SideFrame) -> FrameAlone {
        let steps = Steps { azimuth_rad: STEP, elevation_rad: 0.01 };
        let pattern = ScanPattern { rows_rad: ROWS.to_vec(), steps, ..ScanPattern::default() };
        frame_alone(side, &Sensors { rig: Rig::single(), patterns: vec![pattern], edge_m: 0.12 })
    }

    #[test]
    fn lost_shots_of_a_wall_are_counted_and_its_ends_are_none() {
        let whole = seen(&wall(0.0));
        assert!(whole.shots.len() > 1500 && whole.shots.iter().all(|s| s.matched), "{}", whole.shots.len());
        for lost in [0.05, 0.3] {
            let shots = seen(&wall(lost)).shots;
            let share = shots.iter().filter(|s| !s.matched).count() as f64 / shots.len() as f64;
            assert!((share - lost).abs() < 0.03 && shots.len() > 1000, "{lost}: {share} of {}", shots.len());
        }
    }

    #[test]
    fn returns_lie_on_the_surface_of_the_others() {
        let returns = seen(&wall(0.0)).returns;
        let smooth: Vec<&Ray> = returns.iter().filter(|r| r.roughness_m.is_finite()).collect();
        // A plane is exact up to the second order of the window.
        let most = smooth.iter().map(|r| r.roughness_m.abs()).fold(0.0, f32::max);
        assert!(smooth.len() > 1500 && most < 5e-3, "{} {most}", smooth.len());
    }
}
