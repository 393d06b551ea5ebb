//! Gazebo: `gpu_lidar` sensors of a model in SDF 1.11.
//!
//! Source: `sensor.sdf`, `lidar.sdf` and `pose.sdf` of the folder `sdf/1.11` of sdformat.

use crate::frames::{Head, Made, sdf_pose};
use crate::number::number;
use crate::pattern::{first_and_last_deg, without_grid};
use crate::placement::Native;
use crate::plan::{Plan, SensorPlan, xml_text};
use sensor::Effect;
use sensor::effects::RangeBias;
use sensor::rig::RowBlock;
use std::fmt::Write;

pub(crate) fn take(effect: &Effect, plan: &mut Plan) -> Native {
    match effect {
        Effect::RangeNoise(e) => {
            plan.noise.push([0.0, e.std_m, 0.0]);
            Native::All("noise/stddev".into())
        }
        Effect::RangeBias(e) => {
            plan.noise.push([e.offset_m / (1.0 + e.scale), 0.0, 0.0]);
            if e.scale == 0.0 {
                return Native::All("noise/mean".into());
            }
            let rest = Effect::RangeBias(RangeBias { offset_m: 0.0, scale: e.scale });
            Native::Part { by: "noise/mean".into(), rest, why: "noise has no scale" }
        }
        Effect::RangeLimits(e) => {
            for limits in plan.sensors.iter_mut().map(|s| &mut s.limits_m) {
                *limits = [limits[0].max(e.min_m), limits[1].min(e.max_m)];
            }
            Native::All("range/min, range/max".into())
        }
        Effect::SensorPoseError(e) => {
            plan.misplace(e);
            Native::All("pose".into())
        }
        Effect::RangeQuantisation(_) => Native::Not(
            "range/resolution is not applied by gz-sensors, so that it would be rounded twice or not at all",
        ),
        _ => Native::Not("has no element"),
    }
}

pub(crate) fn files(head: &Head, plan: &Plan) -> Made {
    let mut made = Made::default();
    let mut text = String::from("<?xml version=\"1.0\"?>\n<!--\n");
    let comments = [
        "Poses: x forward, y left, z up, m; roll, pitch, yaw in degrees, as in the rig. Angles of rays are in radians.",
        "Poses are true poses. The sensor reports its points by its nominal pose, which stands above each sensor.",
        "A gpu_lidar has one step between rows: each block of rows of a pattern is a sensor.",
    ];
    for line in head.lines().iter().map(String::as_str).chain(comments) {
        let _ = writeln!(text, "  {}", xml_text(line));
    }
    text.push_str("-->\n<sdf version=\"1.11\">\n  <model name=\"lidars\">\n    <link name=\"rig\">\n");
    for sensor in &plan.sensors {
        made.not_expressed.extend(without_grid(sensor));
        match sensor.blocks.len() {
            0 => one(&mut text, sensor, None, &sensor.xml_name(), plan),
            1 => one(&mut text, sensor, Some(&sensor.blocks[0]), &sensor.xml_name(), plan),
            _ => sensor.blocks.iter().enumerate().for_each(|(i, block)| {
                one(&mut text, sensor, Some(block), &format!("{}_{i}", sensor.xml_name()), plan);
            }),
        }
    }
    text.push_str("    </link>\n  </model>\n</sdf>\n");
    made.notes.extend(comments.map(str::to_owned));
    made.files.push(("lidars.sdf".into(), text));
    made
}

fn one(text: &mut String, sensor: &SensorPlan, block: Option<&RowBlock>, name: &str, plan: &Plan) {
    let radians = |deg: f64| number(deg.to_radians());
    let [left, right] = first_and_last_deg(sensor);
    let columns = sensor.columns.max(1);
    let _ = write!(
        text,
        "      <!-- nominal pose (degrees): {} -->\n      <sensor name=\"{name}\" type=\"gpu_lidar\">\n\
         \u{20}       <pose degrees=\"true\">{}</pose>\n        <topic>lidar/{name}</topic>\n        \
         <update_rate>{}</update_rate>\n        <lidar>\n          <scan>\n            <horizontal>\n              \
         <samples>{columns}</samples>\n              <resolution>1</resolution>\n              \
         <min_angle>{}</min_angle>\n              <max_angle>{}</max_angle>\n            </horizontal>\n",
        sdf_pose(&sensor.nominal),
        sdf_pose(&sensor.mount),
        number(sensor.rate_hz),
        radians(right),
        radians(left),
    );
    if let Some(block) = block {
        let _ = write!(
            text,
            "            <vertical>\n              <samples>{}</samples>\n              \
             <resolution>1</resolution>\n              <min_angle>{}</min_angle>\n              \
             <max_angle>{}</max_angle>\n            </vertical>\n",
            block.rows,
            radians(block.bottom_deg),
            radians(block.top_deg),
        );
    }
    let _ = write!(
        text,
        "          </scan>\n          <range>\n            <min>{}</min>\n            <max>{}</max>\n          \
         </range>\n          <noise>\n            <type>gaussian</type>\n            <mean>{}</mean>\n            \
         <stddev>{}</stddev>\n          </noise>\n        </lidar>\n        <always_on>true</always_on>\n      \
         </sensor>\n",
        number(sensor.limits_m[0]),
        number(sensor.limits_m[1]),
        number(plan.offset_m()),
        number(plan.constant_noise_m()),
    );
}
