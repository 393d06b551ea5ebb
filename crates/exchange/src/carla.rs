//! CARLA: attributes of `sensor.lidar.ray_cast` and a transform per sensor, as JSON, with a script that spawns them.
//!
//! Sources: `RayCastLidar.cpp`, `RayCastSemanticLidar.cpp` and `ActorBlueprintFunctionLibrary.cpp` of CARLA 0.9
//! (`MakeLidarDefinition` has the names and types of all attributes).

use crate::fit::{DropOff, FIT_RANGES_M, fit_drop_off, ranges};
use crate::frames::{Head, Made, carla_transform};
use crate::number::{number, rounded};
use crate::pattern::without_grid;
use crate::placement::{FitError, Native};
use crate::plan::{Plan, SensorPlan};
use sensor::Effect;
use sensor::effects::RangeLimits;
use sensor::rig::RowBlock;
use serde_json::{Map, Value, json};

pub(crate) fn take(effect: &Effect, plan: &mut Plan) -> Native {
    match effect {
        Effect::RangeNoise(e) => {
            plan.noise.push([0.0, e.std_m, 0.0]);
            Native::All("noise_stddev".into())
        }
        Effect::RandomDropout(_) | Effect::RangeDropout(_) => {
            plan.loss.add(effect);
            Native::All(
                "dropoff_general_rate, dropoff_zero_intensity, dropoff_intensity_limit, \
                         atmosphere_attenuation_rate (fitted, see fits)"
                    .into(),
            )
        }
        Effect::Empirical(e) if e.mean_m.is_empty() && e.std_m.is_empty() && plan.loss.add(effect) => {
            Native::All("the four parameters of the drop-off (fitted, see fits)".into())
        }
        Effect::SignalDropout(_) => {
            plan.loss.add(effect);
            Native::About {
                by: "the four parameters of the drop-off (fitted, see fits)".into(),
                how: "the part that depends on range, at normal incidence and one reflectivity; incidence and \
                      reflectivity have no effect on CARLA's drop-off"
                    .into(),
            }
        }
        Effect::RangeLimits(e) => {
            plan.sensors.iter_mut().for_each(|s| s.limits_m[1] = s.limits_m[1].min(e.max_m));
            if e.min_m <= 0.0 {
                return Native::All("range".into());
            }
            let rest = Effect::RangeLimits(RangeLimits { min_m: e.min_m, ..RangeLimits::default() });
            Native::Part { by: "range".into(), rest, why: "there is no least range" }
        }
        Effect::SensorPoseError(e) => {
            plan.misplace(e);
            Native::All("transform".into())
        }
        _ => Native::Not("has no attribute"),
    }
}

pub(crate) fn files(head: &Head, plan: &Plan) -> Made {
    let mut made = Made::default();
    let drop_off = match plan.loss.is_empty() {
        true => DropOff::none(),
        false => fitted(plan, &mut made),
    };
    let mut sensors = Vec::new();
    for sensor in &plan.sensors {
        made.not_expressed.extend(without_grid(sensor));
        match sensor.blocks.len() {
            0 => sensors.push(one(sensor, None, &sensor.name, plan, &drop_off)),
            1 => sensors.push(one(sensor, Some(&sensor.blocks[0]), &sensor.name, plan, &drop_off)),
            _ => sensors.extend(
                sensor
                    .blocks
                    .iter()
                    .enumerate()
                    .map(|(i, block)| one(sensor, Some(block), &format!("{}_{i}", sensor.name), plan, &drop_off)),
            ),
        }
        if sensor.blocks.len() > 1 {
            made.notes.push(format!(
                "{:?} has {} blocks of rows with steps of their own. A sensor of CARLA has one step, so that each block \
                 is a sensor; put their clouds together.",
                sensor.name,
                sensor.blocks.len()
            ));
        }
    }
    let comments: Vec<String> = head.lines().into_iter().chain(COMMENTS.iter().map(|c| c.to_string())).collect();
    made.notes.extend(COMMENTS.iter().map(|c| c.to_string()));
    let all = json!({ "comments": comments, "sensors": sensors });
    let mut text = serde_json::to_string_pretty(&all).expect("JSON of plain data");
    text.push('\n');
    made.files.push(("carla_sensors.json".into(), text));
    made.files.push(("spawn_carla.py".into(), SPAWN.replace("@HEAD@", head.comment("#", &[]).trim_end())));
    made
}

const COMMENTS: &[&str] = &[
    "Transforms are in CARLA's left-handed frame: x forward, y right, z up, m; yaw clockwise, degrees. y, yaw and pitch \
     of the rig are negated.",
    "Transforms are true poses. The sensor reports its points by its nominal pose: move them to the vehicle with \
     nominal_transform.",
    "noise_stddev is along the ray, m. One tick is a full turn only if fixed_delta_seconds = 1 / rotation_frequency.",
    "atmosphere_attenuation_rate is a part of the fitted drop-off. It changes the intensities as well: \
     intensity = exp(-rate * range).",
];

/// One actor of CARLA.
fn one(sensor: &SensorPlan, block: Option<&RowBlock>, name: &str, plan: &Plan, drop_off: &DropOff) -> Value {
    let mut attributes = Map::new();
    let mut set = |key: &str, value: String| attributes.insert(key.into(), Value::String(value));
    if let Some(block) = block {
        set("channels", block.rows.to_string());
        set("upper_fov", number(block.top_deg));
        set("lower_fov", number(block.bottom_deg));
        set("points_per_second", format!("{:.0}", sensor.points_per_second(block.rows as usize)));
    }
    set("range", number(sensor.limits_m[1]));
    set("rotation_frequency", number(sensor.rate_hz));
    set("horizontal_fov", number(sensor.fov_deg));
    set("atmosphere_attenuation_rate", number(drop_off.attenuation_per_m));
    set("dropoff_general_rate", number(drop_off.general));
    set("dropoff_intensity_limit", number(drop_off.limit));
    set("dropoff_zero_intensity", number(drop_off.zero));
    set("noise_stddev", number(plan.constant_noise_m()));
    set("noise_seed", "0".into());
    let transform = |pose| {
        let [x, y, z, pitch, yaw, roll] = carla_transform(pose).map(rounded);
        json!({ "x": x, "y": y, "z": z, "pitch": pitch, "yaw": yaw, "roll": roll })
    };
    json!({
        "name": name,
        "blueprint": "sensor.lidar.ray_cast",
        "transform": transform(&sensor.mount),
        "nominal_transform": transform(&sensor.nominal),
        "attributes": attributes,
    })
}

fn fitted(plan: &Plan, made: &mut Made) -> DropOff {
    let law = |range_m: f64| plan.loss.at(range_m);
    let drop_off = fit_drop_off(law);
    let errors: Vec<f64> = ranges().map(|range_m| drop_off.loss(range_m) - law(range_m)).collect();
    made.fits.push(FitError {
        what: "share of lost returns: CARLA's drop-off to the losses of the list that depend on range".into(),
        range_m: FIT_RANGES_M,
        largest: errors.iter().fold(0.0, |most, e| e.abs().max(most)),
        rms: (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt(),
    });
    drop_off
}

const SPAWN: &str = r#"#!/usr/bin/env python3
@HEAD@
"""Spawns the sensors of carla_sensors.json on a vehicle: `sensors = spawn(world, vehicle)`."""

import json
import pathlib

FILE = pathlib.Path(__file__).with_name("carla_sensors.json")


def spawn(world, vehicle):
    """The sensors by name. The vehicle's frame has to be that of the rig: move the transforms if it is not."""
    import carla

    library = world.get_blueprint_library()
    actors = {}
    for sensor in json.loads(FILE.read_text())["sensors"]:
        blueprint = library.find(sensor["blueprint"])
        for name, value in sensor["attributes"].items():
            blueprint.set_attribute(name, value)
        at = sensor["transform"]
        transform = carla.Transform(
            carla.Location(x=at["x"], y=at["y"], z=at["z"]),
            carla.Rotation(pitch=at["pitch"], yaw=at["yaw"], roll=at["roll"]),
        )
        actors[sensor["name"]] = world.spawn_actor(blueprint, transform, attach_to=vehicle)
    return actors
"#;
