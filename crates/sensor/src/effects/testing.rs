//! Scans and statistics for tests of effects.

use super::{Draws, FrameContext, LabelledCar, SensorEffect};
use crate::material::{MaterialId, MaterialTable};
use crate::rig::{Pattern, Rig, RowBlock};
use crate::scan::{Echo, Scan};
use geometry::Box3;
use std::path::Path;

/// Rows and columns of the test scans.
pub(crate) const GRID: (usize, usize) = (32, 360);

/// A rig of one sensor at the origin, 120 degrees wide.
pub(crate) fn rig() -> Rig {
    let mut rig = Rig::parse("[[sensor]]\nname = \"front\"\nhorizontal_fov_deg = 120\n", Path::new("r.toml")).unwrap();
    let block = RowBlock { rows: GRID.0 as u32, top_deg: 10.0, bottom_deg: -15.0 };
    rig.sensors[0].pattern = Some(Pattern::grid(block, GRID.1 as u32, 120.0, 20.0));
    rig
}

/// Flat ground 2 m below the sensor, a wall 40 m ahead and up to 3 m above the sensor, with a bright board on it.
pub(crate) fn scene() -> Scan {
    let rig = rig();
    let echoes = rig.sensors[0].pattern.as_ref().unwrap().shots().iter().map(|shot| {
        let direction = shot.direction().map(|v| v as f32);
        let mut echo = Echo {
            row: shot.row,
            column: shot.column,
            time_s: shot.time_s as f32,
            ..Echo::nothing([0.0; 3], direction)
        };
        let (ground, wall) = (-2.0 / direction[2], 40.0 / direction[0]);
        if direction[2] < 0.0 && ground < wall {
            echo = Echo { range_m: ground, normal: [0.0, 0.0, 1.0], reflectivity: 0.2, object: 1, ..echo };
        } else if wall * direction[2] < 3.0 {
            let bright = (wall * direction[1]).abs() < 1.0 && (wall * direction[2]).abs() < 1.0;
            let (reflectivity, material) = if bright { (20.0, "reflector") } else { (0.5, "wall") };
            let material = MaterialTable::built_in(material);
            echo = Echo { range_m: wall, normal: [-1.0, 0.0, 0.0], reflectivity, material, object: 4, ..echo };
        }
        echo.cos_incidence = -crate::scan::dot(echo.normal, direction);
        echo.returned = echo.reflectivity * echo.cos_incidence;
        echo.intensity = echo.returned.min(1.0);
        echo
    });
    Scan { echoes: echoes.collect() }
}

/// `n` echoes at one range and reflectivity, at normal incidence.
pub(crate) fn plate(n: usize, range_m: f32, reflectivity: f32) -> Scan {
    let echo = Echo {
        range_m,
        normal: [-1.0, 0.0, 0.0],
        reflectivity,
        returned: reflectivity,
        material: MaterialId(0),
        ..Echo::nothing([0.0; 3], [1.0, 0.0, 0.0])
    };
    let place = |i: usize| Echo { row: (i / 1000) as u16, column: (i % 1000) as u16, ..echo };
    Scan { echoes: (0..n).map(place).collect() }
}

/// One other car 20 m ahead, with a velocity of 60 m/s.
pub(crate) fn cars() -> Vec<LabelledCar> {
    let bbox = Box3::from_array([20.0, 2.0, -1.0, 4.88, 1.9, 1.18, 0.1]);
    let (s, c) = 0.1_f64.sin_cos();
    vec![LabelledCar { number: 0, true_box: bbox, label: bbox, velocity: [60.0 * c, 60.0 * s, 0.0] }]
}

/// Calls `work` with the context of a frame and random streams.
pub(crate) fn with_frame<T>(index: u64, work: impl FnOnce(&FrameContext, &Draws) -> T) -> T {
    let (rig, materials, cars) = (rig(), MaterialTable::default(), cars());
    let frame = FrameContext {
        seed: 1,
        set: "test",
        index,
        time_s: index as f64 * 0.05,
        rig: &rig,
        materials: &materials,
        ego_velocity: [50.0, 0.0, 0.0],
        ego_turn_rate: [0.0, 0.0, 0.2],
        cars: &cars,
        sensors: None,
        scene: None,
        world_x_rad: 0.0,
    };
    work(&frame, &Draws::new(1, "test".into(), index))
}

/// The scan after an effect in frame 0.
pub(crate) fn applied(effect: &dyn SensorEffect, scan: &Scan) -> Scan {
    applied_in(0, effect, scan)
}

/// The scan after an effect in frame `index`.
pub(crate) fn applied_in(index: u64, effect: &dyn SensorEffect, scan: &Scan) -> Scan {
    effect.check().unwrap();
    let mut scan = scan.clone();
    with_frame(index, |frame, draws| effect.on_scan(&mut scan, frame, draws));
    scan
}

/// Changes of range of echoes that are returns in both scans, m.
pub(crate) fn residuals(before: &Scan, after: &Scan) -> Vec<f64> {
    let both = before.echoes.iter().zip(&after.echoes).filter(|(a, b)| a.is_return() && b.is_return());
    both.map(|(a, b)| f64::from(b.range_m) - f64::from(a.range_m)).collect()
}

/// Mean and standard deviation.
pub(crate) fn moments(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt())
}

/// Fraction of the returns of `before` that are lost in `after`.
pub(crate) fn lost(before: &Scan, after: &Scan) -> f64 {
    let both = || before.echoes.iter().zip(&after.echoes).filter(|(a, _)| a.is_return());
    both().filter(|(_, b)| !b.is_return()).count() as f64 / both().count() as f64
}
