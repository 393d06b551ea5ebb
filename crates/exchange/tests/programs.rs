//! Files for every program, against the names and rules that the program itself documents.

use lidarshift_exchange::{Export, Program, Remedy, export};
use roxmltree::{Document, Node};
use sensor::{EffectList, Rig};
use serde_json::Value;
use std::path::Path;

const RIG: &str = r#"
[[sensor]]
name = "roof"
position = [1.2, 0.4, 1.8]
yaw_deg = 10.0
pitch_deg = 2.0
rate_hz = 10.0
min_range_m = 0.9
max_range_m = 120.0
pattern = { blocks = [{ rows = 4, top_deg = 2.0, bottom_deg = -4.0 }, { rows = 2, top_deg = -5.0, bottom_deg = -9.0 }], columns = 360, sweep = "columns" }

[[sensor]]
name = "front"
position = [3.0, 0.0, 0.5]
horizontal_fov_deg = 120.0
rate_hz = 20.0
max_range_m = 200.0
pattern = { blocks = [{ rows = 8, top_deg = 3.0, bottom_deg = -4.0 }], columns = 240, sweep = "columns" }
"#;

const MODEL: &str = r#"
[[effect]]
kind = "range_noise"
std_m = 0.03
[[effect]]
kind = "range_noise"
std_m = 0.04
[[effect]]
kind = "range_noise_by_range"
base_m = 0.01
per_m = 0.0005
[[effect]]
kind = "range_bias"
offset_m = 0.02
scale = 0.001
[[effect]]
kind = "beam_range_offset"
sensor = "front"
rows_deg = [-4.0, -3.0]
offsets_m = [0.05, -0.01]
[[effect]]
kind = "range_dropout"
range_m = [0.0, 100.0]
share = [0.05, 0.35]
[[effect]]
kind = "random_dropout"
share = 0.1
[[effect]]
kind = "signal_dropout"
threshold = 0.0
steepness = 3.0
[[effect]]
kind = "angular_jitter"
azimuth_std_deg = 0.02
elevation_std_deg = 0.03
[[effect]]
kind = "sensor_pose_error"
sensor = "front"
translation_m = [0.1, 0.0, 0.0]
rotation_deg = [0.0, 0.0, 1.0]
[[effect]]
kind = "range_limits"
min_m = 1.0
max_m = 90.0
[[effect]]
kind = "label_offset"
forward_m = 0.15
[[effect]]
kind = "ghosts"
probability = 0.02
[[effect]]
kind = "range_quantisation"
step_m = 0.01
"#;

fn rig() -> Rig {
    Rig::parse(RIG, Path::new("rig.toml")).unwrap()
}

fn exported(program: Program, model: &str) -> Export {
    let list = EffectList::parse(model, Path::new("model.toml")).unwrap();
    export(program, &list, &rig(), "model.toml", Some("rig.toml"))
}

fn file<'a>(export: &'a Export, name: &str) -> &'a str {
    &export.files.iter().find(|(n, _)| n == name).unwrap_or_else(|| panic!("no {name}")).1
}

/// Indices of the effects that are expressed, and of those that are not or in part.
fn indices(export: &Export) -> (Vec<usize>, Vec<usize>) {
    let expressed = export.summary.expressed.iter().map(|e| e.index).collect();
    (expressed, export.summary.not_expressed.iter().filter_map(|e| e.index).collect())
}

#[test]
fn every_effect_is_expressed_or_listed() {
    let count = EffectList::parse(MODEL, Path::new("m")).unwrap().effects.len();
    for program in Program::ALL {
        let export = exported(program, MODEL);
        let (expressed, not) = indices(&export);
        for index in 0..count {
            assert!(expressed.contains(&index) || not.contains(&index), "{program:?}: effect {index} is nowhere");
        }
        // Effects on labels and those that need new rays are tasks for the scenario, everywhere.
        for index in [11, 12] {
            let entry = export.summary.not_expressed.iter().find(|e| e.index == Some(index)).unwrap();
            assert!(matches!(entry.remedy, Remedy::Scenario { .. }), "{program:?}: {entry:?}");
        }
        // What is post-processed is exactly the list of post_process.toml, which the program reads again.
        let list = EffectList::parse(file(&export, "post_process.toml"), Path::new("p")).unwrap();
        let listed = export.summary.not_expressed.iter().filter(|e| matches!(e.remedy, Remedy::PostProcess { .. }));
        let kinds: Vec<&str> = list.effects.iter().map(sensor::Effect::kind).collect();
        assert_eq!(kinds, listed.map(|e| e.kind).collect::<Vec<_>>(), "{program:?}");
        assert!(file(&export, "post_process.py").contains("apply_effects"));
    }
}

#[test]
fn rounding_follows_what_changes_ranges() {
    // Isaac rounds itself, unless something is still added to the ranges of finished clouds.
    let rounds = |model: &str| indices(&exported(Program::Isaac, model)).0;
    let quantised = "[[effect]]\nkind = \"range_quantisation\"\nstep_m = 0.01\n";
    let dropped = "[[effect]]\nkind = \"random_dropout\"\nshare = 0.1\n";
    let tails = "[[effect]]\nkind = \"heavy_tails\"\nprobability = 0.01\nstd_m = 0.1\n";
    assert_eq!(rounds(&format!("{dropped}{quantised}")), [1]);
    assert_eq!(rounds(&format!("{tails}{quantised}")), [0usize; 0]);
}

#[test]
fn carla_gets_attributes_that_it_knows() {
    // UActorBlueprintFunctionLibrary::MakeLidarDefinition of CARLA 0.9, "ray_cast".
    const ATTRIBUTES: [&str; 13] = [
        "channels",
        "range",
        "points_per_second",
        "rotation_frequency",
        "upper_fov",
        "lower_fov",
        "atmosphere_attenuation_rate",
        "noise_seed",
        "dropoff_general_rate",
        "dropoff_intensity_limit",
        "dropoff_zero_intensity",
        "noise_stddev",
        "horizontal_fov",
    ];
    let export = exported(Program::Carla, MODEL);
    let all: Value = serde_json::from_str(file(&export, "carla_sensors.json")).unwrap();
    let sensors = all["sensors"].as_array().unwrap();
    let names: Vec<&str> = sensors.iter().map(|s| s["name"].as_str().unwrap()).collect();
    assert_eq!(names, ["roof_0", "roof_1", "front"]);
    for sensor in sensors {
        let attributes = sensor["attributes"].as_object().unwrap();
        let mut known: Vec<&str> = attributes.keys().map(String::as_str).collect();
        let mut want = ATTRIBUTES.to_vec();
        known.sort_unstable();
        want.sort_unstable();
        assert_eq!(known, want);
        for key in ["channels", "points_per_second", "noise_seed"] {
            attributes[key].as_str().unwrap().parse::<i32>().unwrap_or_else(|_| panic!("{key} is an int"));
        }
    }
    let roof = &sensors[0]["attributes"];
    assert_eq!([&roof["channels"], &roof["upper_fov"], &roof["lower_fov"]], ["4", "2", "-4"]);
    assert_eq!(roof["points_per_second"], "14400");
    assert_eq!([&roof["noise_stddev"], &roof["range"]], ["0.05", "90"]);
    let at = &sensors[0]["transform"];
    let number = |v: &Value| v.as_f64().unwrap();
    assert_eq!([number(&at["x"]), number(&at["y"]), number(&at["z"])], [1.2, -0.4, 1.8]);
    assert!((number(&at["yaw"]) + 10.0).abs() < 1e-6 && (number(&at["pitch"]) + 2.0).abs() < 1e-6);
    // The front sensor stands at its true pose and reports by the nominal one.
    let front = &sensors[2];
    assert!((number(&front["transform"]["x"]) - 3.1).abs() < 1e-6);
    assert!((number(&front["transform"]["yaw"]) + 1.0).abs() < 1e-6);
    assert_eq!((number(&front["nominal_transform"]["x"]), number(&front["nominal_transform"]["yaw"])), (3.0, 0.0));
    // The fit says what remains.
    let fit = &export.summary.fits[0];
    assert_eq!(fit.range_m, [5.0, 100.0]);
    assert!(fit.rms <= fit.largest && fit.largest < 0.01, "{fit:?}");
}

#[test]
fn isaac_gets_attributes_that_it_knows() {
    // OmniSensorGenericLidarCoreAPI and OmniSensorGenericLidarCoreEmitterStateAPI, with the types of
    // Velodyne_Alpha_Prime_Rev4.usda (uint rates, float ranges).
    const KNOWN: [&str; 23] = [
        "scanType",
        "rotationDirection",
        "scanRateBaseHz",
        "patternFiringRateHz",
        "nearRangeM",
        "farRangeM",
        "rangeAccuracyM",
        "rangeResolutionM",
        "azimuthErrorMean",
        "azimuthErrorStd",
        "elevationErrorMean",
        "elevationErrorStd",
        "maxReturns",
        "divergenceHorDeg",
        "divergenceVerDeg",
        "validStartAzimuthDeg",
        "validEndAzimuthDeg",
        "numberOfEmitters",
        "numberOfChannels",
        "emitterState:s001:azimuthDeg",
        "emitterState:s001:elevationDeg",
        "emitterState:s001:fireTimeNs",
        "emitterState:s001:channelId",
    ];
    let export = exported(Program::Isaac, MODEL);
    let all: Value = serde_json::from_str(file(&export, "isaac_lidars.json")).unwrap();
    let sensors = all["sensors"].as_array().unwrap();
    assert_eq!(sensors.len(), 2);
    for (sensor, rows) in sensors.iter().zip([6, 8]) {
        let attributes = sensor["attributes"].as_object().unwrap();
        for (key, attribute) in attributes {
            let name = key.strip_prefix("omni:sensor:Core:").unwrap_or_else(|| panic!("{key}"));
            assert!(KNOWN.contains(&name) || name == "emitterState:s001:distanceCorrectionM", "{name}");
            // Emitter states have numberOfEmitters elements.
            if name.starts_with("emitterState") {
                assert_eq!(attribute["value"].as_array().unwrap().len(), rows, "{name}");
            }
        }
        assert_eq!(attributes["omni:sensor:Core:numberOfEmitters"]["value"], rows);
    }
    let front = &sensors[1]["attributes"];
    let corrections = front["omni:sensor:Core:emitterState:s001:distanceCorrectionM"]["value"].as_array().unwrap();
    let number = |v: &Value| v.as_f64().unwrap();
    let common = 0.02 / 1.001;
    assert!((number(&corrections[7]) - 0.05 - common).abs() < 1e-6, "{corrections:?}");
    assert!((number(&corrections[6]) + 0.01 - common).abs() < 1e-6);
    assert!((number(&corrections[0]) - common).abs() < 1e-6);
    assert!((number(&front["omni:sensor:Core:azimuthErrorStd"]["value"]) - 0.02).abs() < 1e-9);
    // 240 columns over 120 degrees at 20 Hz: 720 columns a turn.
    assert_eq!(front["omni:sensor:Core:patternFiringRateHz"]["value"], 14_400);
}

/// Children and attributes that an element may have, and children that it must have.
type Rule = (&'static str, &'static [&'static str], &'static [&'static str], &'static [&'static str]);

fn follows(node: Node, rules: &[Rule]) {
    let name = node.tag_name().name();
    let (_, children, attributes, required) =
        rules.iter().find(|(n, ..)| *n == name).unwrap_or_else(|| panic!("element {name} is not in the schema"));
    for attribute in node.attributes() {
        assert!(attributes.contains(&attribute.name()), "{name} has no attribute {}", attribute.name());
    }
    let own: Vec<&str> = node.children().filter(Node::is_element).map(|c| c.tag_name().name()).collect();
    for child in &own {
        assert!(children.contains(child), "{child} is no child of {name}");
    }
    for child in *required {
        assert!(own.contains(child), "{name} lacks {child}");
    }
    node.children().filter(Node::is_element).for_each(|child| follows(child, rules));
}

fn text<'a>(node: Node<'a, 'a>, path: &[&str]) -> &'a str {
    let child = |node: Node<'a, 'a>, name: &&str| {
        node.children().find(|c| c.has_tag_name(*name)).unwrap_or_else(|| panic!("no {name}"))
    };
    path.iter().fold(node, child).text().unwrap()
}

#[test]
fn gazebo_gets_sdf_by_its_schema() {
    // sdf/1.11/{root,model,link,sensor,pose,lidar}.sdf of sdformat.
    const GRID: &[&str] = &["samples", "resolution", "min_angle", "max_angle"];
    const RULES: [Rule; 21] = [
        ("sdf", &["model", "world"], &["version"], &[]),
        ("model", &["link", "pose", "static"], &["name"], &[]),
        ("link", &["sensor", "pose"], &["name"], &[]),
        ("sensor", &["pose", "topic", "update_rate", "always_on", "visualize", "lidar"], &["name", "type"], &[]),
        ("pose", &[], &["relative_to", "rotation_format", "degrees"], &[]),
        ("lidar", &["scan", "range", "noise", "visibility_mask"], &[], &["scan", "range"]),
        ("scan", &["horizontal", "vertical"], &[], &["horizontal"]),
        ("horizontal", GRID, &[], GRID),
        ("vertical", GRID, &[], &["samples", "min_angle", "max_angle"]),
        ("range", &["min", "max", "resolution"], &[], &["min", "max"]),
        ("noise", &["type", "mean", "stddev"], &[], &["type"]),
        ("topic", &[], &[], &[]),
        ("update_rate", &[], &[], &[]),
        ("always_on", &[], &[], &[]),
        ("samples", &[], &[], &[]),
        ("resolution", &[], &[], &[]),
        ("min_angle", &[], &[], &[]),
        ("max_angle", &[], &[], &[]),
        ("min", &[], &[], &[]),
        ("max", &[], &[], &[]),
        ("type", &[], &[], &[]),
    ];
    let rules: Vec<Rule> =
        RULES.into_iter().chain([("mean", &[][..], &[][..], &[][..]), ("stddev", &[], &[], &[])]).collect();
    let export = exported(Program::Gazebo, MODEL);
    let document = Document::parse(file(&export, "lidars.sdf")).unwrap();
    follows(document.root_element(), &rules);
    let sensors: Vec<Node> = document.descendants().filter(|n| n.has_tag_name("sensor")).collect();
    assert_eq!(sensors.len(), 3);
    let roof = sensors[0];
    assert_eq!((roof.attribute("name"), roof.attribute("type")), (Some("roof_0"), Some("gpu_lidar")));
    let number = |path: &[&str]| text(roof, path).parse::<f64>().unwrap();
    assert!((number(&["lidar", "scan", "vertical", "max_angle"]).to_degrees() - 2.0).abs() < 1e-6);
    assert!((number(&["lidar", "scan", "horizontal", "max_angle"]).to_degrees() - 179.5).abs() < 1e-6);
    assert_eq!(number(&["lidar", "scan", "horizontal", "samples"]), 360.0);
    assert_eq!([number(&["lidar", "range", "min"]), number(&["lidar", "range", "max"])], [1.0, 90.0]);
    assert!((number(&["lidar", "noise", "stddev"]) - 0.05).abs() < 1e-9);
    assert!((number(&["lidar", "noise", "mean"]) - 0.02 / 1.001).abs() < 1e-9);
}

#[test]
fn helios_gets_scanners_and_platforms_by_its_schemas() {
    // python/pyhelios/util/xsd/{scanner,platform}.xsd of HELIOS++.
    const SCANNER: &[&str] = &[
        "id",
        "accuracy_m",
        "beamDivergence_rad",
        "name",
        "optics",
        "pulseFreqs_Hz",
        "pulseLength_ns",
        "rangeMin_m",
        "rangeMax_m",
        "scanAngleMax_deg",
        "scanAngleEffectiveMax_deg",
        "scanFreqMin_Hz",
        "scanFreqMax_Hz",
        "maxNOR",
        "wavelength_nm",
        "headRotatePerSecMax_deg",
    ];
    const RULES: [Rule; 9] = [
        ("document", &["scanner", "platform"], &[], &[]),
        ("scanner", &["FWFSettings", "beamOrigin", "headRotateAxis", "channels"], SCANNER, &[]),
        ("FWFSettings", &[], &["beamSampleQuality", "binSize_ns", "maxFullwaveRange_ns", "winSize_ns"], &[]),
        ("beamOrigin", &["rot"], &["x", "y", "z", "rotations"], &[]),
        ("headRotateAxis", &[], &["x", "y", "z"], &[]),
        ("channels", &["channel"], &[], &["channel"]),
        ("channel", &["FWFSettings", "beamOrigin", "headRotateAxis", "incidentBeam"], SCANNER, &[]),
        ("rot", &[], &["axis", "angle_deg"], &[]),
        ("platform", &["scannerMount"], &["id", "name", "type", "drag"], &[]),
    ];
    let mount: Rule = ("scannerMount", &["rot"], &["x", "y", "z", "rotations"], &[]);
    let rules: Vec<Rule> = RULES.into_iter().chain([mount]).collect();
    let export = exported(Program::Helios, MODEL);
    for name in ["scanners.xml", "platforms.xml"] {
        let document = Document::parse(file(&export, name)).unwrap();
        follows(document.root_element(), &rules);
    }
    let document = Document::parse(file(&export, "scanners.xml")).unwrap();
    let roof = document.descendants().find(|n| n.attribute("id") == Some("roof")).unwrap();
    assert_eq!((roof.attribute("optics"), roof.attribute("accuracy_m")), (Some("rotating"), Some("0.05")));
    assert_eq!(
        (roof.attribute("pulseFreqs_Hz"), roof.attribute("headRotatePerSecMax_deg")),
        (Some("3600"), Some("3600"))
    );
    let elevations: Vec<&str> = roof.descendants().filter_map(|n| n.attribute("angle_deg")).collect();
    assert_eq!(elevations, ["2", "0", "-2", "-4", "-5", "-9"]);
    let platforms = Document::parse(file(&export, "platforms.xml")).unwrap();
    let mount = platforms.descendants().find(|n| n.has_tag_name("scannerMount")).unwrap();
    assert_eq!(["x", "y", "z"].map(|k| mount.attribute(k).unwrap()), ["-0.4", "1.2", "1.8"]);
}

#[test]
fn rgl_gets_calls_that_its_header_has() {
    // include/rgl/api/core.h of RobotecGPULidar: the functions with their numbers of arguments.
    const CALLS: [(&str, usize); 13] = [
        ("rgl_get_last_error_string", 1),
        ("rgl_graph_node_add_child", 2),
        ("rgl_node_gaussian_noise_angular_hitpoint", 4),
        ("rgl_node_gaussian_noise_distance", 4),
        ("rgl_node_rays_from_mat3x4f", 3),
        ("rgl_node_rays_set_range", 3),
        ("rgl_node_rays_set_ring_ids", 3),
        ("rgl_node_rays_set_time_offsets", 3),
        ("rgl_node_rays_transform", 2),
        ("rgl_node_raytrace", 2),
        ("rgl_node_raytrace_configure_beam_divergence", 3),
        ("rgl_node_raytrace_configure_distortion", 2),
        ("rgl_node_raytrace_configure_mask", 3),
    ];
    let model = format!(
        "{MODEL}[[effect]]\nkind = \"rolling_shutter\"\ndeskewed = false\n[[effect]]\nkind = \"beam_divergence\"\n\
         divergence_rad = 0.002\n"
    );
    let export = exported(Program::Rgl, &model);
    let text = file(&export, "lidarshift_rgl.hpp");
    let code: String = text.lines().map(|line| line.split("//").next().unwrap_or("")).collect::<Vec<_>>().join("\n");
    let mut found = std::collections::BTreeSet::new();
    for (at, _) in code.match_indices("rgl_") {
        let name: String = code[at..].chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
        let Some(inside) = code[at + name.len()..].strip_prefix('(') else { continue };
        let (mut depth, mut arguments) = (1, 1);
        for c in inside.chars() {
            match c {
                '(' | '[' | '{' => depth += 1,
                ')' | ']' | '}' => depth -= 1,
                ',' if depth == 1 => arguments += 1,
                _ => {}
            }
            if depth == 0 {
                break;
            }
        }
        let (_, want) = CALLS.iter().find(|(n, _)| *n == name).unwrap_or_else(|| panic!("{name} is not in core.h"));
        assert_eq!(arguments, *want, "{name}");
        found.insert(name);
    }
    assert_eq!(found.len(), CALLS.len(), "{found:?}");
    assert_eq!(code.matches('{').count(), code.matches('}').count());
    // Both noises are nodes of their own, and rows with an offset are a graph of their own.
    assert!(code.contains("rgl_node_gaussian_noise_distance(&node, 0.0f, 0.01f, 0.0005f)"), "{code}");
    assert!(code.contains("{0.05f, {7}}") && code.contains("{-0.01f, {6}}"), "{code}");
    assert!(code.contains("kept = 1 - 0.1f"));
}

#[test]
fn a_rig_without_a_pattern_is_listed() {
    let list = EffectList::parse("[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n", Path::new("m")).unwrap();
    let folder = tempfile::tempdir().unwrap();
    for program in Program::ALL {
        let export = export(program, &list, &Rig::single(), "m", None);
        let entry = &export.summary.not_expressed.iter().find(|e| e.kind == "pattern").unwrap();
        assert!(entry.why.contains("no pattern"), "{program:?}: {entry:?}");
        assert!(!export.files.iter().any(|(name, _)| name.starts_with("post_process")), "{program:?}");
        let out = folder.path().join(program.name());
        export.write(&out).unwrap();
        let summary: Value =
            serde_json::from_slice(&std::fs::read(out.join(lidarshift_exchange::NOT_EXPRESSED)).unwrap()).unwrap();
        assert_eq!(summary["program"], program.name());
        assert_eq!(summary["schema"], "lidarshift/not-expressed/1");
    }
}
