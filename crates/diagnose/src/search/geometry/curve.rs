//! Plots of linear hypotheses: displacement of surfaces along the covariate of the cause.

use super::Search;
use crate::catalogue::Cause;
use crate::channels::mean::{Column, Levers, usable, usual_noise_m};
use crate::channels::moments::Moment;
use crate::channels::own_poses::{OWN_NUMBERS, mounts, own_poses, own_row};
use crate::curve::{Curve, CurvePoint};
use crate::inference::linear::LinearFit;
use crate::pairing::Ray;
use nalgebra::SVector;
use rayon::prelude::*;
use sensor::Sensor;

/// Points of a plot.
const BINS: usize = 16;

/// Fewest rays of a point.
const FEWEST: f64 = 30.0;

/// Largest distance of a return from the displaced surface, m.
const STRAY_M: f64 = 0.5;

/// Name of the horizontal axis, and its value for a ray.
type Axis = (&'static str, fn(&Ray, &Sensor, &Moment) -> f64);

/// The horizontal axis of a cause: range for a bias, time for a drift, speed or distance along the vehicle for a tilt,
/// phase for motion distortion, azimuth for a sensor.
fn axis(cause: Cause) -> Axis {
    match cause {
        Cause::RangeBias => ("range, m", |r, _, _| f64::from(r.range_m)),
        Cause::RangeDrift => ("time since the first frame, s", |_, _, moment| moment.time_s),
        Cause::EgoAttitude => ("ego speed, m/s", |_, _, moment| moment.own.speed_m_s().abs()),
        Cause::PitchRoll => ("distance along the car, m", |r, _, _| f64::from(r.direction[0] * r.range_m)),
        Cause::RollingShutter => {
            ("phase of the scan", |r, mount, _| mount.scan_phase(f64::from(r.azimuth_rad), f64::from(r.elevation_rad)))
        }
        _ => ("azimuth of the sensor, degrees", |r, _, _| f64::from(r.azimuth_rad).to_degrees()),
    }
}

/// Displacement of surfaces in the direction in which `columns` of a fit move them, along the covariate of the cause.
/// Rays that the columns do not move are left out.
pub(super) fn linear_curve(search: &Search, fitted: &LinearFit, columns: &[usize], cause: Cause) -> Curve {
    let (context, sums) = (search.context, &search.sums);
    let (x, value) = axis(cause);
    let theta = |c: usize| fitted.columns.iter().position(|x| *x == c).map_or(0.0, |i| fitted.theta[i]);
    let moving: Vec<(Column, f64)> = columns.iter().map(|&c| (sums.columns[c], theta(c))).collect();
    let mounts = mounts(context.rig);
    let displaced = moving.iter().find_map(|(c, _)| if let Column::SensorPose(s, _) = c { Some(*s) } else { None });
    let noise_m = usual_noise_m(context.frames);
    let of_frame = |&f: &usize| {
        let frame = &context.frames[f];
        let moment = &sums.moments.of_frames[f];
        // The pose error of the whole frame is that of the other sensors.
        let mut pose = SVector::zeros();
        if let Some(s) = displaced {
            let own = own_poses(frame, &mounts, noise_m);
            let others: Vec<_> = (0..own.len()).filter(|k| *k != s).map(|k| own[k]).collect();
            pose = others.iter().sum::<SVector<f64, OWN_NUMBERS>>() / others.len().max(1) as f64;
        }
        let place = |ray: &Ray| {
            let sensor = ray.sensor as usize;
            let mount = &context.rig.sensors[sensor];
            let levers = Levers::new(ray, &mounts[sensor].origin, mount, moment);
            let expected: f64 = moving.iter().filter_map(|(c, theta)| Some(levers.of(*c)? * theta)).sum();
            let y = ray.across_nearest_m() - own_row(ray, &mounts[sensor]).dot(&pose);
            (expected != 0.0 && (y - expected).abs() < STRAY_M)
                .then(|| [value(ray, mount, moment), y * expected.signum(), expected.abs()])
        };
        frame.measured.iter().filter(|r| usable(r)).filter_map(place).collect::<Vec<[f64; 3]>>()
    };
    let mut places: Vec<[f64; 3]> = search.estimate.par_iter().flat_map_iter(of_frame).collect();
    places.sort_by(|a, b| a[0].total_cmp(&b[0]));
    let points = places.chunks(places.len().div_ceil(BINS).max(1)).filter(|c| c.len() as f64 >= FEWEST).map(|chunk| {
        let n = chunk.len() as f64;
        let [x, measured, after] = [0, 1, 2].map(|k: usize| chunk.iter().map(|p| p[k]).sum::<f64>() / n);
        let variance = chunk.iter().map(|p| (p[1] - measured).powi(2)).sum::<f64>() / n;
        CurvePoint { sensor: 0, x, measured, before: 0.0, after, error: (variance / n).sqrt() }
    });
    Curve { x: x.into(), y: "surfaces stand off by, m".into(), by_sensor: false, points: points.collect() }
}
