//! Writes a case: `measured/`, `simulated/`, `sensor.toml`. The truth is returned and not written next to them.

use crate::case::Case;
use crate::effect::Effect;
use crate::frame::Frame;
use crate::oracle::judge;
use crate::response::walk_of_m;
use crate::sensor::rig_toml;
use crate::side::Side;
use crate::world::REACH_M;
use data::{Cloud, DataError, Layout, write_atomic};
use rayon::prelude::*;
use score::{Hidden, Truth};
use std::collections::BTreeMap;
use std::path::Path;

/// Writes both sides and the rig into `folder`; returns the truth.
pub fn write_case(case: &Case, folder: &Path) -> Result<Truth, DataError> {
    let setting = &case.measured.setting;
    let rig = rig_toml(&case.measured.mounts, setting.rate_hz, setting.pattern_known);
    write_atomic(&folder.join("sensor.toml"), rig.as_bytes())?;
    for side in [&case.measured, &case.simulated] {
        let root = folder.join(side.name);
        let written = (0..case.size.frames).into_par_iter().map(|i| write_frame(side, i, &root));
        written.collect::<Vec<_>>().into_iter().collect::<Result<(), DataError>>()?;
        let columns = if setting.intensity.channels() == 3 { "xyz" } else { "xyzi" };
        let text = format!("points = \"{columns}\"\nlabel_frame = \"lidar\"\nclasses = [\"Car\", \"Pedestrian\"]\n");
        write_atomic(&root.join("dataset.toml"), text.as_bytes())?;
    }
    Ok(truth(case))
}

fn write_frame(side: &Side, index: usize, root: &Path) -> Result<(), DataError> {
    let scan = Frame::new(side, index).scan();
    let intensity = side.setting.intensity;
    let rng = &mut side.stream("intensity", index);
    let mut values = Vec::with_capacity(scan.points.len() * intensity.channels());
    for (point, light) in scan.points.iter().zip(&scan.lights) {
        values.extend(point);
        values.extend(intensity.value(light.reflectivity, light.cos_incidence, light.range_m, light.gain, rng));
    }
    // Ids count scans, including those that are not kept.
    let frame = data::Frame {
        id: format!("{:06}", index * side.setting.every),
        cloud: Cloud { values, channels: intensity.channels() },
        objects: scan.labels,
    };
    Layout::Kitti.write_frame(root, &frame)
}

/// The truth of a case.
pub fn truth(case: &Case) -> Truth {
    let hidden = case.hidden().iter().zip(judge(case)).map(|(effect, judgement)| {
        let mut parameters = effect.parameters();
        parameters.extend(grown(case, effect));
        parameters.extend(sprayed(case, effect));
        let mut bound = judgement.bound;
        if let Some((walk_m, of_effect)) = walked_m(case, effect) {
            parameters.insert("walk_m".into(), walk_m);
            bound.iter_mut().for_each(|(_, by)| *by *= (walk_m / of_effect).abs());
        }
        Hidden {
            cause: effect.cause().into(),
            in_catalogue: effect.in_catalogue(),
            parameters,
            bound,
            touched: judgement.touched,
            ..Hidden::default()
        }
        .with_strength(judgement.strength)
    });
    Truth { seed: case.seed, kind: case.kind.name().into(), setting: setting(case), hidden: hidden.collect() }
}

/// The setting of a case, with the effects that both sides have.
fn setting(case: &Case) -> String {
    let setting = case.measured.setting.describe();
    let alike: Vec<&str> = case.simulated.effects.iter().map(Effect::cause).collect();
    if alike.is_empty() { setting } else { format!("{setting}, on both sides {}", alike.join(", ")) }
}

/// By how much the labelled cars are larger, on average, m.
fn grown(case: &Case, effect: &Effect) -> BTreeMap<String, f64> {
    let Effect::WrongShape { length, height } = *effect else { return BTreeMap::new() };
    let world = &case.measured.world;
    let labelled = world.vehicles.iter().filter(|v| v.labelled && world.models[v.model].class == "Car");
    let sizes: Vec<[f64; 3]> = labelled.map(|v| world.models[v.model].size_m).collect();
    let mean = |k: usize| sizes.iter().map(|s| s[k]).sum::<f64>() / sizes.len().max(1) as f64;
    [("longer_m", length * mean(0)), ("higher_m", height * mean(2))].map(|(k, v)| (k.to_owned(), v)).into()
}

/// What a range walk changes ranges by for each factor e of the intensity that the column has, or of reflectivity where
/// there is none: the line through its law over the surfaces that shots meet; and the number of the effect, m.
fn walked_m(case: &Case, effect: &Effect) -> Option<(f64, f64)> {
    let Effect::ReflectivityWalk { walk_m } = *effect else { return None };
    let side = &case.measured;
    let column = side.setting.intensity;
    let mut met: Vec<[f64; 3]> = Vec::new();
    for index in (0..case.size.frames).step_by(ONE_IN[0]) {
        let frame = Frame::new(side, index);
        for sensor in 0..side.mounts.len() {
            for shot in side.shots(sensor, index).iter().step_by(ONE_IN[1]) {
                let Some(echo) = frame.trace(shot, [0.0; 2]).first else { continue };
                let value = |times: f64| {
                    let rng = &mut data::stream(case.seed, "walk", 0, 0);
                    column.value(times * echo.reflectivity, echo.cos_incidence, echo.range_m, 1.0, rng)
                };
                // How the logarithm of the column follows that of reflectivity there.
                let by = 1.2f64;
                let follows = match [value(1.0), value(by)].map(|v| v.filter(|_| column.is_of_surface())) {
                    [Some(one), Some(more)] if one > 0.0 => f64::from(more / one).ln() / by.ln(),
                    _ => 1.0,
                };
                met.push([echo.reflectivity.ln(), walk_of_m(walk_m, echo.reflectivity), follows]);
            }
        }
    }
    let n = met.len().max(1) as f64;
    let mean = |of: &dyn Fn(&[f64; 3]) -> f64| met.iter().map(of).sum::<f64>() / n;
    let [x, y, follows] = [0, 1, 2].map(|k: usize| mean(&|m| m[k]));
    let slope = mean(&|m| (m[0] - x) * (m[1] - y)) / mean(&|m| (m[0] - x).powi(2)).max(1e-12);
    Some((slope / follows.max(1e-3), walk_m))
}

/// One of so many frames, and of so many shots, that tell the mean of what an effect does.
const ONE_IN: [usize; 2] = [4, 7];

/// Mean density of the plumes of labelled vehicles that shots pass before they meet a surface, 1/m: the effect's own
/// number is that behind a car at 8 m/s.
fn sprayed(case: &Case, effect: &Effect) -> BTreeMap<String, f64> {
    let Effect::Spray { per_m } = *effect else { return BTreeMap::new() };
    let side = &case.measured;
    let [frames, shots] = ONE_IN;
    let of_frame = |index: usize| {
        let frame = Frame::new(side, index);
        let mut sum = [0.0; 2];
        for sensor in 0..side.mounts.len() {
            for shot in side.shots(sensor, index).iter().step_by(shots) {
                let until_m = frame.trace(shot, [0.0; 2]).first.map_or(REACH_M, |echo| echo.range_m);
                let plume = frame.plume_m(shot, until_m).filter(|(v, ..)| side.world.vehicles[*v].labelled);
                if let Some((_, [from, to], times)) = plume {
                    sum = [sum[0] + (to - from), sum[1] + times * (to - from)];
                }
            }
        }
        sum
    };
    let sums: Vec<[f64; 2]> = (0..case.size.frames).step_by(frames).map(of_frame).collect();
    let [path, weighed] = [0, 1].map(|k| sums.iter().map(|s| s[k]).sum::<f64>());
    if path > 0.0 { [("density_per_m".to_owned(), per_m * weighed / path)].into() } else { BTreeMap::new() }
}
