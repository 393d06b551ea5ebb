//! Robotec GPU LiDAR: C++ that builds the graph of nodes of every sensor by the C API.
//!
//! Sources: `include/rgl/api/core.h` and `docs/GaussianNoise.md` of RobotecGPULidar; `optixPrograms.cu` (a ray points
//! along z of its matrix); `gaussianNoiseKernels.cu`.

use crate::frames::{Head, Made};
use crate::number::{number, numbers};
use crate::pattern::without_grid;
use crate::placement::Native;
use crate::plan::{Plan, SensorPlan};
use geometry::Pose;
use sensor::Effect;
use sensor::effects::{EgoBodyMask, RangeBias};
use std::collections::BTreeMap;
use std::fmt::Write;

pub(crate) fn take(effect: &Effect, plan: &mut Plan) -> Native {
    match effect {
        Effect::RangeNoise(e) => {
            plan.noise.push([0.0, e.std_m, 0.0]);
            Native::All("rgl_node_gaussian_noise_distance st_dev_base".into())
        }
        Effect::RangeNoiseByRange(e) if !e.quadratic => {
            plan.noise.push([0.0, e.base_m, e.per_m]);
            Native::All("rgl_node_gaussian_noise_distance st_dev_base, st_dev_rise_per_meter".into())
        }
        Effect::RangeNoiseByRange(_) => Native::Not("its two terms are added in quadrature, those of RGL are summed"),
        Effect::RangeBias(e) => {
            plan.noise.push([e.offset_m / (1.0 + e.scale), 0.0, 0.0]);
            let by = "rgl_node_gaussian_noise_distance mean".to_string();
            if e.scale == 0.0 {
                return Native::All(by);
            }
            let rest = Effect::RangeBias(RangeBias { offset_m: 0.0, scale: e.scale });
            Native::Part { by, rest, why: "noise has no scale" }
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
            Native::All("a graph per ring, each with the mean of rgl_node_gaussian_noise_distance".into())
        }
        Effect::AngularJitter(e) => {
            let [azimuth, elevation] = &mut plan.jitter_deg;
            (*azimuth, *elevation) = (azimuth.hypot(e.azimuth_std_deg), elevation.hypot(e.elevation_std_deg));
            Native::About {
                by: "rgl_node_gaussian_noise_angular_hitpoint about z (azimuth) and about x and y (elevation)".into(),
                how: "the points lie in the directions with errors; the effect reports them in the nominal ones. \
                      rgl_node_gaussian_noise_angular_ray would leave the points on the surfaces"
                    .into(),
            }
        }
        Effect::RandomDropout(e) => {
            plan.masked_share = 1.0 - (1.0 - plan.masked_share) * (1.0 - e.share);
            Native::All("rgl_node_raytrace_configure_mask, drawn anew for each frame".into())
        }
        Effect::EgoBodyMask(e) if e.returns_m.iter().any(|m| *m > 0.0) => {
            Native::Not("the part returns light itself: add its mesh to the scene instead")
        }
        Effect::EgoBodyMask(e) if !e.directions.is_empty() => {
            plan.named(&e.sensor).for_each(|s| s.hidden.extend(&e.directions));
            let by = "rgl_node_raytrace_configure_mask, drawn anew for each frame".to_string();
            if e.boxes.is_empty() {
                return Native::All(by);
            }
            let rest = Effect::EgoBodyMask(EgoBodyMask { boxes: e.boxes.clone(), ..EgoBodyMask::default() });
            Native::Part { by, rest, why: "a box is no set of directions: add its mesh to the scene instead, or this" }
        }
        Effect::RangeLimits(e) => {
            for limits in plan.sensors.iter_mut().map(|s| &mut s.limits_m) {
                *limits = [limits[0].max(e.min_m), limits[1].min(e.max_m)];
            }
            Native::All("rgl_node_rays_set_range".into())
        }
        Effect::SensorPoseError(e) => {
            plan.misplace(e);
            Native::All("rgl_node_rays_transform".into())
        }
        Effect::RollingShutter(e) if !e.deskewed && !e.only_objects && e.slide.is_none() => {
            plan.shutter = true;
            Native::About {
                by: "rgl_node_rays_set_time_offsets, rgl_node_raytrace_configure_distortion".into(),
                how: "of the ego motion alone: give rgl_node_raytrace_configure_velocity in each frame. Other objects \
                      stand still during a scan"
                    .into(),
            }
        }
        Effect::BeamDivergence(e) => {
            plan.divergence_rad = plan.divergence_rad.max(e.divergence_rad);
            Native::About {
                by: "rgl_node_raytrace_configure_beam_divergence".into(),
                how: "the return mode picks one of the ranges within a beam; they are not averaged".into(),
            }
        }
        Effect::DualReturns(_) => {
            plan.returns = 2;
            Native::All("rgl_node_raytrace_configure_return_mode".into())
        }
        _ => Native::Not("has no node"),
    }
}

pub(crate) fn files(head: &Head, plan: &Plan) -> Made {
    let mut made = Made::default();
    made.not_expressed.extend(plan.sensors.iter().filter_map(without_grid));
    made.notes.extend(COMMENTS.iter().map(|c| c.to_string()));
    let mut text = head.comment("//", &made.notes);
    text.push_str(PROLOGUE);
    for sensor in &plan.sensors {
        one(&mut text, sensor, plan);
    }
    text.push_str("}  // namespace lidarshift\n");
    made.files.push(("lidarshift_rgl.hpp".into(), text));
    made
}

const COMMENTS: &[&str] = &[
    "Language: C++17, a header that calls the C API of Robotec GPU LiDAR.",
    "Frame: that of the rig, x forward, y left, z up, m, right-handed. For AWSIM (Unity, left-handed, z forward, y up) \
     give the values to its nodes instead: NoiseDistance, NoiseAngularHitpoint, the ring's rays.",
    "vehicle_from_sensor is the true pose. The sensor reports its points by its nominal pose: move the points of a graph \
     with nominal_NAME.",
    "Call draw_mask for each graph before each frame.",
];

const PROLOGUE: &str = r#"#pragma once

#include <rgl/api/core.h>

#include <cmath>
#include <cstdint>
#include <random>
#include <stdexcept>
#include <vector>

namespace lidarshift {

/// A direction in which returns are hidden: azimuth and elevation from and to, degrees, and the share that is lost.
struct Hidden { float azimuth_from, azimuth_to, elevation_from, elevation_to, share; };

/// A graph of nodes for rays with the same range offset.
struct Graph {
    rgl_node_t rays = nullptr, transform = nullptr, raytrace = nullptr, last = nullptr;
    std::vector<float> lost;  // probability of a loss of each ray
};

inline void check(rgl_status_t status) {
    if (status == RGL_SUCCESS) { return; }
    const char* text = nullptr;
    rgl_get_last_error_string(&text);
    throw std::runtime_error(text ? text : "Robotec GPU LiDAR");
}

/// Azimuth counter-clockwise from x, elevation upwards, radians. A ray points along z of its matrix.
inline rgl_mat3x4f ray_of(float azimuth, float elevation) {
    const float sa = std::sin(azimuth), ca = std::cos(azimuth), se = std::sin(elevation), ce = std::cos(elevation);
    return {{{sa, -ca * se, ca * ce, 0}, {-ca, -sa * se, sa * ce, 0}, {0, ce, se, 0}}};
}

/// Draws which rays return nothing in this frame.
inline void draw_mask(Graph& graph, std::mt19937& random) {
    std::uniform_real_distribution<float> uniform(0, 1);
    std::vector<int8_t> mask(graph.lost.size());
    for (size_t i = 0; i < mask.size(); ++i) { mask[i] = uniform(random) >= graph.lost[i]; }
    check(rgl_node_raytrace_configure_mask(graph.raytrace, mask.data(), static_cast<int32_t>(mask.size())));
}
"#;

fn matrix(pose: &Pose) -> String {
    let m = pose.to_homogeneous();
    let rows: Vec<String> =
        (0..3).map(|r| format!("{{{}}}", numbers(&[m[(r, 0)], m[(r, 1)], m[(r, 2)], m[(r, 3)]], ", "))).collect();
    format!("{{{{{}}}}}", rows.join(", "))
}

fn one(text: &mut String, sensor: &SensorPlan, plan: &Plan) {
    let id = sensor.identifier();
    // Rows with the same offset share a graph.
    let mut groups: BTreeMap<i64, Vec<usize>> = BTreeMap::new();
    for (row, offset_m) in sensor.row_offsets_m.iter().enumerate() {
        groups.entry((offset_m * 1e9).round() as i64).or_default().push(row);
    }
    let hidden: String = sensor.hidden.iter().map(|h| format!("        {{{}}},\n", numbers(h, ", "))).collect();
    let _ = write!(
        text,
        "\n/// Graphs of the sensor {id}: one for the rows of each range offset.\n\
         inline const rgl_mat3x4f vehicle_from_{id} = {};\n\
         inline const rgl_mat3x4f nominal_{id} = {};\n\n\
         inline std::vector<Graph> make_{id}(rgl_scene_t scene) {{\n    \
         const float degree = 3.14159265358979f / 180, fov = {}, rate_hz = {};\n    \
         const std::vector<float> elevations = {{{}}};  // of the rows from the top, degrees\n    \
         const int columns = {};\n    const std::vector<Hidden> hidden = {{\n{hidden}    }};\n    \
         struct Group {{ float offset_m; std::vector<int> rows; }};\n    const std::vector<Group> groups = {{\n",
        matrix(&sensor.mount),
        matrix(&sensor.nominal),
        number(sensor.fov_deg),
        number(sensor.rate_hz),
        numbers(&sensor.rows_deg, ", "),
        sensor.columns,
    );
    for (offset, rows) in &groups {
        let rows: Vec<String> = rows.iter().map(usize::to_string).collect();
        let _ = writeln!(text, "        {{{}f, {{{}}}}},", decimal(*offset as f64 / 1e9), rows.join(", "));
    }
    let [near, far] = sensor.limits_m.map(number);
    let _ = write!(
        text,
        "    }};\n    std::vector<Graph> graphs;\n    for (const Group& group : groups) {{\n        Graph graph;\n        \
         std::vector<rgl_mat3x4f> rays;\n        std::vector<int32_t> rings;\n        std::vector<float> times_ms;\n        \
         for (int row : group.rows) {{\n            for (int c = 0; c < columns; ++c) {{\n                \
         const float azimuth = fov * (0.5f * (columns - 1) - c) / columns, elevation = elevations[row];\n                \
         rays.push_back(ray_of(azimuth * degree, elevation * degree));\n                rings.push_back(row);\n                \
         times_ms.push_back(1000 * ((c + 0.5f) / columns - 0.5f) / rate_hz);\n                float kept = 1 - {}f;\n                \
         for (const Hidden& h : hidden) {{\n                    const bool inside = azimuth >= h.azimuth_from && azimuth <= h.azimuth_to &&\n                                        elevation >= h.elevation_from && elevation <= h.elevation_to;\n                    \
         if (inside) {{ kept *= 1 - h.share; }}\n                }}\n                graph.lost.push_back(1 - kept);\n            \
         }}\n        }}\n        const auto count = static_cast<int32_t>(rays.size());\n        \
         check(rgl_node_rays_from_mat3x4f(&graph.rays, rays.data(), count));\n        \
         rgl_node_t set_rings = nullptr, set_range = nullptr;\n        \
         check(rgl_node_rays_set_ring_ids(&set_rings, rings.data(), count));\n        \
         const rgl_vec2f range = {{{{{near}, {far}}}}};  // m\n        \
         check(rgl_node_rays_set_range(&set_range, &range, 1));\n        \
         check(rgl_node_rays_transform(&graph.transform, &vehicle_from_{id}));\n        \
         check(rgl_node_raytrace(&graph.raytrace, scene));\n        std::vector<rgl_node_t> chain = {{graph.rays, set_rings, set_range}};\n",
        decimal(plan.masked_share),
    );
    if plan.shutter {
        text.push_str(
            "        rgl_node_t set_times = nullptr;\n        \
             check(rgl_node_rays_set_time_offsets(&set_times, times_ms.data(), count));\n        \
             chain.push_back(set_times);\n        \
             check(rgl_node_raytrace_configure_distortion(graph.raytrace, true));\n",
        );
    }
    if plan.divergence_rad > 0.0 {
        let d = decimal(plan.divergence_rad);
        let _ = writeln!(
            text,
            "        check(rgl_node_raytrace_configure_beam_divergence(graph.raytrace, {d}f, {d}f));  // rad"
        );
    }
    if plan.returns > 1 {
        text.push_str(
            "        check(rgl_node_raytrace_configure_return_mode(graph.raytrace, RGL_RETURN_FIRST_LAST));\n",
        );
    }
    text.push_str("        chain.insert(chain.end(), {graph.transform, graph.raytrace});\n");
    let [azimuth, elevation] = plan.jitter_deg.map(f64::to_radians);
    for (std, axis) in [(azimuth, "Z"), (elevation, "X"), (elevation, "Y")] {
        if std > 0.0 {
            node(
                text,
                &format!("rgl_node_gaussian_noise_angular_hitpoint(&node, 0, {}f, RGL_AXIS_{axis})", decimal(std)),
            );
        }
    }
    let noises = plan.noise.iter().filter(|n| n.iter().any(|v| *v != 0.0));
    for [mean, base, rise] in noises {
        let [mean, base, rise] = [mean, base, rise].map(|v| decimal(*v));
        node(text, &format!("rgl_node_gaussian_noise_distance(&node, {mean}f, {base}f, {rise}f)"));
    }
    if groups.len() > 1 {
        node(text, "rgl_node_gaussian_noise_distance(&node, group.offset_m, 0, 0)");
    }
    text.push_str(
        "        for (size_t i = 1; i < chain.size(); ++i) { check(rgl_graph_node_add_child(chain[i - 1], chain[i])); }\n        \
         graph.last = chain.back();\n        graphs.push_back(graph);\n    }\n    return graphs;\n}\n",
    );
}

/// A number as a decimal of C++, which needs a point before the suffix `f`.
fn decimal(value: f64) -> String {
    let text = number(value);
    if text.contains('.') { text } else { format!("{text}.0") }
}

/// A node at the end of the chain.
fn node(text: &mut String, call: &str) {
    let _ = writeln!(
        text,
        "        {{\n            rgl_node_t node = nullptr;\n            check({call});\n            chain.push_back(node);\n        }}"
    );
}
