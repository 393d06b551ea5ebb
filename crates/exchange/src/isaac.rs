//! Isaac Sim: attributes of `OmniLidar` prims as JSON, with a script that makes the prims.
//!
//! Sources: NVIDIA's reference of `OmniSensorGenericLidarCoreAPI` and `OmniSensorGenericLidarCoreEmitterStateAPI`
//! (extension `omni.usd.schema.omni_sensors`), and `Velodyne_Alpha_Prime_Rev4.usda` of `omni.sensors.nv.lidar`, which
//! uses them for a spinning sensor.

use crate::frames::{Head, Made, angles_deg, position_m};
use crate::number::rounded;
use crate::pattern::without_grid;
use crate::placement::Native;
use crate::plan::{Plan, SensorPlan};
use sensor::Effect;
use sensor::effects::RangeBias;
use serde_json::{Map, Value, json};

/// The namespace of the attributes.
const CORE: &str = "omni:sensor:Core";

pub(crate) fn take(effect: &Effect, plan: &mut Plan) -> Native {
    match effect {
        Effect::RangeNoise(e) => {
            plan.noise.push([0.0, e.std_m, 0.0]);
            Native::About {
                by: "rangeAccuracyM".into(),
                how: "NVIDIA does not document the distribution of rangeAccuracyM: measure it on a wall and scale it"
                    .into(),
            }
        }
        Effect::RangeBias(e) => {
            let offset_m = e.offset_m / (1.0 + e.scale);
            let known = plan.sensors.iter().all(|s| !s.rows_deg.is_empty());
            if !known {
                return Native::Not("distanceCorrectionM is a value per emitter, and the rig has no rows");
            }
            plan.sensors.iter_mut().flat_map(|s| &mut s.row_offsets_m).for_each(|o| *o += offset_m);
            let by = "emitterState distanceCorrectionM on all emitters (its sign is not documented: test it)".into();
            if e.scale == 0.0 {
                return Native::All(by);
            }
            let rest = Effect::RangeBias(RangeBias { offset_m: 0.0, scale: e.scale });
            Native::Part { by, rest, why: "distanceCorrectionM has no scale" }
        }
        Effect::BeamRangeOffset(e) if !e.rows_deg.is_empty() => {
            let all = plan.named(&e.sensor).all(|s| e.rows_deg.iter().all(|deg| s.row_near(*deg).is_some()));
            if !all {
                return Native::Not("the rig has no rows at some of these elevations");
            }
            for sensor in plan.named(&e.sensor) {
                for (deg, offset_m) in e.rows_deg.iter().zip(&e.offsets_m) {
                    if let Some(row) = sensor.row_near(*deg) {
                        sensor.row_offsets_m[row] += offset_m;
                    }
                }
            }
            Native::All("emitterState distanceCorrectionM (its sign is not documented: test it)".into())
        }
        Effect::AngularJitter(e) => {
            let [azimuth, elevation] = &mut plan.jitter_deg;
            (*azimuth, *elevation) = (azimuth.hypot(e.azimuth_std_deg), elevation.hypot(e.elevation_std_deg));
            Native::All("azimuthErrorStd, elevationErrorStd (degrees)".into())
        }
        Effect::RangeQuantisation(e) => {
            plan.step_m = plan.step_m.max(e.step_m);
            Native::All("rangeResolutionM".into())
        }
        Effect::RangeLimits(e) => {
            for limits in plan.sensors.iter_mut().map(|s| &mut s.limits_m) {
                *limits = [limits[0].max(e.min_m), limits[1].min(e.max_m)];
            }
            Native::All("nearRangeM, farRangeM".into())
        }
        Effect::SensorPoseError(e) => {
            plan.misplace(e);
            Native::All("xformOp:translate, xformOp:orient".into())
        }
        Effect::RollingShutter(e) if !e.only_objects && e.slide.is_none() => {
            plan.shutter = true;
            let how = "a ROTARY sensor fires its columns one after the other; moving objects need the motion BVH \
                       (enable_motion_bvh), and deskewing is outputMotionCompensationState";
            Native::About { by: "scanType ROTARY, outputMotionCompensationState".into(), how: how.into() }
        }
        Effect::BeamDivergence(e) => {
            plan.divergence_rad = plan.divergence_rad.max(e.divergence_rad);
            Native::About {
                by: "divergenceHorDeg, divergenceVerDeg".into(),
                how: "how ranges within a beam are put together is the program's own".into(),
            }
        }
        Effect::DualReturns(_) => {
            plan.returns = 2;
            Native::All("maxReturns".into())
        }
        _ => Native::Not("has no attribute"),
    }
}

pub(crate) fn files(head: &Head, plan: &Plan) -> Made {
    let mut made = Made::default();
    made.not_expressed.extend(plan.sensors.iter().filter_map(without_grid));
    made.notes.extend(COMMENTS.iter().map(|c| c.to_string()));
    let comments: Vec<String> = head.lines().into_iter().chain(made.notes.clone()).collect();
    let sensors: Vec<Value> = plan.sensors.iter().map(|s| one(s, plan)).collect();
    let all = json!({ "comments": comments, "sensors": sensors });
    let mut text = serde_json::to_string_pretty(&all).expect("JSON of plain data");
    text.push('\n');
    made.files.push(("isaac_lidars.json".into(), text));
    made.files.push(("make_isaac_lidars.py".into(), MAKE.replace("@HEAD@", head.comment("#", &[]).trim_end())));
    made
}

const COMMENTS: &[&str] = &[
    "Frames are those of the rig: x forward, y left, z up, m; right-handed. orientation is a quaternion w, x, y, z.",
    "Poses are true poses. The sensor reports its points by its nominal pose.",
    "All sensors are ROTARY: a column of emitters turns. A raster scan has other times of its shots.",
    "distanceCorrectionM has the offset that the diagnosis found. NVIDIA does not document its sign: look at a wall with \
     0.5 m before you use it.",
];

fn one(sensor: &SensorPlan, plan: &Plan) -> Value {
    let mut attributes = Map::new();
    let mut set = |key: &str, kind: &str, value: Value| {
        attributes.insert(format!("{CORE}:{key}"), json!({ "type": kind, "value": value }));
    };
    let float = |v: f64| json!(rounded(v));
    set("scanType", "token", json!("ROTARY"));
    set("rotationDirection", "token", json!("CW"));
    set("scanRateBaseHz", "uint", json!(sensor.rate_hz.round() as u32));
    set("nearRangeM", "float", float(sensor.limits_m[0]));
    set("farRangeM", "float", float(sensor.limits_m[1]));
    set("rangeAccuracyM", "float", float(plan.constant_noise_m()));
    set("azimuthErrorMean", "float", float(0.0));
    set("azimuthErrorStd", "float", float(plan.jitter_deg[0]));
    set("elevationErrorMean", "float", float(0.0));
    set("elevationErrorStd", "float", float(plan.jitter_deg[1]));
    set("maxReturns", "uint", json!(plan.returns));
    if plan.step_m > 0.0 {
        set("rangeResolutionM", "float", float(plan.step_m));
    }
    if plan.divergence_rad > 0.0 {
        set("divergenceHorDeg", "float", float(plan.divergence_rad.to_degrees()));
        set("divergenceVerDeg", "float", float(plan.divergence_rad.to_degrees()));
    }
    let half = sensor.fov_deg / 2.0;
    let full = sensor.fov_deg >= 360.0;
    set("validStartAzimuthDeg", "float", float(if full { 0.0 } else { 360.0 - half }));
    set("validEndAzimuthDeg", "float", float(if full { 360.0 } else { half }));
    let rows = sensor.rows_deg.len();
    if rows > 0 {
        // A sensor that sees a part of the circle turns through all of it at the same step.
        let turn = f64::from(sensor.columns) * 360.0 / sensor.fov_deg.max(0.1);
        set("patternFiringRateHz", "uint", json!((turn * sensor.rate_hz).round() as u32));
        set("numberOfEmitters", "uint", json!(rows));
        set("numberOfChannels", "uint", json!(rows));
        let each = |value: &dyn Fn(usize) -> Value| Value::Array((0..rows).map(value).collect());
        let mut emitters = |key: &str, kind: &str, value: Value| set(&format!("emitterState:s001:{key}"), kind, value);
        emitters("azimuthDeg", "float[]", each(&|_| json!(0.0)));
        emitters("elevationDeg", "float[]", each(&|row| float(sensor.rows_deg[row])));
        emitters("fireTimeNs", "uint[]", each(&|_| json!(0)));
        // Channels are counted from 1.
        emitters("channelId", "uint[]", each(&|row| json!(row + 1)));
        if sensor.row_offsets_m.iter().any(|o| *o != 0.0) {
            emitters("distanceCorrectionM", "float[]", each(&|row| float(sensor.row_offsets_m[row])));
        }
    }
    let pose = |pose: &geometry::Pose| {
        let q = pose.rotation.coords;
        let orientation = [q.w, q.x, q.y, q.z].map(rounded);
        json!({
            "translation": position_m(pose).map(rounded),
            "orientation": orientation,
            "roll_pitch_yaw_deg": angles_deg(pose).map(rounded),
        })
    };
    json!({
        "name": sensor.name,
        "schemas": ["OmniSensorGenericLidarCoreAPI"],
        "pose": pose(&sensor.mount),
        "nominal_pose": pose(&sensor.nominal),
        "attributes": attributes,
    })
}

const MAKE: &str = r#"#!/usr/bin/env python3
@HEAD@
"""Makes the OmniLidar prims of isaac_lidars.json: `make(stage, "/World/Car")`."""

import json
import pathlib

FILE = pathlib.Path(__file__).with_name("isaac_lidars.json")


def make(stage, parent):
    """The prims below the prim `parent`, whose frame has to be that of the rig. Returns them by name."""
    from pxr import Gf, Sdf, UsdGeom, Vt

    types = {
        "token": (Sdf.ValueTypeNames.Token, str),
        "uint": (Sdf.ValueTypeNames.UInt, int),
        "float": (Sdf.ValueTypeNames.Float, float),
        "uint[]": (Sdf.ValueTypeNames.UIntArray, Vt.UIntArray),
        "float[]": (Sdf.ValueTypeNames.FloatArray, Vt.FloatArray),
    }
    prims = {}
    for sensor in json.loads(FILE.read_text())["sensors"]:
        name = "".join(c if c.isalnum() else "_" for c in sensor["name"])
        prim = stage.DefinePrim(f"{parent}/{name}", "OmniLidar")
        for schema in sensor["schemas"]:
            prim.ApplyAPI(schema)
        for key, attribute in sensor["attributes"].items():
            kind, convert = types[attribute["type"]]
            prim.CreateAttribute(key, kind, custom=False).Set(convert(attribute["value"]))
        moved = UsdGeom.Xformable(prim)
        moved.ClearXformOpOrder()
        moved.AddTranslateOp().Set(Gf.Vec3d(*sensor["pose"]["translation"]))
        moved.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*sensor["pose"]["orientation"]))
        prims[sensor["name"]] = prim
    return prims
"#;
