//! PointRCNN: size, names and shapes of the published network, and degenerate input.

use burn::tensor::Device;
use data::{Cloud, Frame, Object, stream};
use geometry::Box3;
use lidarshift_models as models;
use models::checkpoint::HostValues;
use models::config::{DetectorConfig, NetworkConfig};
use models::{Detector, NetworkSample, Preparer, Sample, named, parameter_count};
use rand::RngExt;
use std::collections::BTreeMap;
use std::path::PathBuf;

const PUBLISHED: &str = include_str!("../../../configs/detectors/pointrcnn.toml");
const SMALL: &str = include_str!("../../../configs/detectors/pointrcnn_small.toml");
const RACE: &str = include_str!("../../../configs/detectors/pointrcnn_race.toml");

fn shared(path: &str) -> Option<PathBuf> {
    let found = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared")).join(path);
    if !found.exists() {
        eprintln!("skipped: there is no {}", found.display());
        return None;
    }
    Some(found)
}

fn network(config: &mut DetectorConfig) -> &mut models::pointrcnn::PointRcnnConfig {
    match &mut config.network {
        NetworkConfig::PointRcnn(net) => net,
        other => panic!("{other:?}"),
    }
}

/// The network with three classes and intensity, and with cars and coordinates only.
fn published() -> [(DetectorConfig, usize, &'static str); 2] {
    let kitti = DetectorConfig::parse(PUBLISHED).unwrap();
    let mut car = kitti.clone();
    car.classes = vec!["Car".into()];
    car.channels = 3;
    network(&mut car).point_head.mean_sizes.truncate(1);
    car.check().unwrap();
    [(kitti, 4_038_819, "kitti"), (car, 4_038_129, "car_xyz")]
}

#[test]
fn sizes_names_and_shapes() {
    for (config, parameters, name) in published() {
        let detector = Detector::new(&config, 0, &Device::flex());
        assert_eq!(parameter_count(&detector.network), parameters, "{name}");
        assert_eq!(named::trainable(&detector.network).len(), 161, "{name}");
        let found: BTreeMap<String, String> =
            detector.to_named().unwrap().into_iter().map(|(tensor, t)| (tensor, format!("{:?}", t.shape))).collect();
        assert_eq!(found.len(), 309, "{name}");
        let Some(list) = shared(&format!("reference/state_dict_pointrcnn_{name}.txt")) else { continue };
        let mut wanted = BTreeMap::new();
        for line in std::fs::read_to_string(list).unwrap().lines().filter(|l| !l.trim().is_empty()) {
            let (tensor, shape) = line.split_once(' ').unwrap();
            wanted.insert(tensor.to_string(), shape.trim().to_string());
        }
        assert_eq!(found, wanted, "{name}");
    }
}

#[test]
fn defaults_are_the_published_sizes() {
    let mut config = DetectorConfig::parse(PUBLISHED).unwrap();
    let text = "kind = \"pointrcnn\"\npoint_head = { mean_sizes = [] }";
    let NetworkConfig::PointRcnn(mut default) = toml::from_str(text).unwrap() else { panic!("another network") };
    default.point_head.mean_sizes = network(&mut config).point_head.mean_sizes.clone();
    assert_eq!(&default, network(&mut config));
}

/// A network that runs in milliseconds.
fn tiny() -> DetectorConfig {
    let mut config = DetectorConfig::parse(SMALL).unwrap();
    let net = network(&mut config);
    net.sampling.points = 256;
    for (level, centers) in net.levels.iter_mut().zip([64, 16, 8]) {
        level.centers = centers;
    }
    net.proposals.train.post = 16;
    net.proposals.test.post = 8;
    net.roi_head.points = 32;
    net.roi_head.levels[0].centers = 8;
    net.roi_head.levels[1].centers = 4;
    net.roi_sampling.regions = 8;
    config.check().unwrap();
    config
}

fn car(x: f64, y: f64) -> Object {
    let bbox = Box3::from_array([x, y, -0.9, 3.9, 1.6, 1.56, 0.3]);
    Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None }
}

/// Random points on the ground and in the boxes.
fn frame(id: u64, points: usize, objects: Vec<Object>) -> Frame {
    let mut random = stream(id, "scene", 0, 0);
    let mut cloud = Cloud::new(4);
    for i in 0..points {
        let at = match objects.get(i % (objects.len() + 1)) {
            Some(object) => {
                let local = [0, 1, 2].map(|k| random.random_range(-0.49..0.49) * object.bbox.size[k]);
                object.bbox.from_local(local)
            }
            None => [random.random_range(1.0..60.0), random.random_range(-30.0..30.0), -1.7],
        };
        cloud.values.extend(at.map(|v| v as f32));
        cloud.values.push(random.random());
    }
    Frame { id: id.to_string(), cloud, objects }
}

fn training(config: &DetectorConfig, frame: &Frame) -> Sample {
    Preparer::new(config).training(frame, &mut stream(1, "augment", 0, 0)).unwrap()
}

/// Asserts that losses and gradients are finite; returns the losses and the parameters without gradient.
#[track_caller]
fn learn(config: &DetectorConfig, batch: &[Sample]) -> (Vec<(&'static str, f32)>, Vec<String>) {
    let detector = Detector::new(config, 3, &Device::flex().autodiff());
    let losses = detector.loss(batch).unwrap();
    let parts: Vec<(&'static str, f32)> =
        losses.parts.iter().map(|(name, part)| (*name, part.clone().into_scalar::<f32>())).collect();
    assert!(parts.iter().all(|(_, part)| part.is_finite() && *part >= 0.0), "{parts:?}");
    let gradients = named::gradients(&detector.network, &losses.total.backward()).unwrap();
    let mut missed = Vec::new();
    for (name, tensor) in &gradients {
        let HostValues::F32(values) = &tensor.values else { panic!("{name}") };
        assert!(values.iter().all(|g| g.is_finite()), "{name}");
        if values.iter().all(|g| *g == 0.0) {
            missed.push(name.clone());
        }
    }
    let tensors = detector.to_named().unwrap();
    let finite = |values: &HostValues| !matches!(values, HostValues::F32(v) if v.iter().any(|v| !v.is_finite()));
    assert!(tensors.values().all(|t| finite(&t.values)), "running statistics");
    (parts, missed)
}

#[track_caller]
fn predict(config: &DetectorConfig, frames: &[Frame]) -> Vec<usize> {
    let detector = Detector::new(config, 3, &Device::flex());
    let samples: Vec<Sample> = frames.iter().map(|f| Preparer::new(config).inference(f).unwrap()).collect();
    let found = detector.predict(&samples).unwrap();
    for detection in found.iter().flatten() {
        assert!(detection.bbox.to_array().iter().all(|v| v.is_finite()) && detection.class == "Car");
    }
    let features = detector.frame_features(&samples).unwrap();
    assert!(features.iter().all(|f| f.len() == features[0].len() && f.iter().all(|v| v.is_finite())));
    found.iter().map(Vec::len).collect()
}

#[test]
fn every_parameter_gets_a_gradient() {
    let config = tiny();
    let frames = [frame(1, 600, vec![car(10.0, 2.0), car(20.0, -4.0)]), frame(2, 600, vec![car(15.0, 0.0)])];
    let batch: Vec<Sample> = frames.iter().map(|f| training(&config, f)).collect();
    let (parts, missed) = learn(&config, &batch);
    assert_eq!(
        parts.iter().map(|p| p.0).collect::<Vec<_>>(),
        ["point_cls", "point_box", "rcnn_cls", "rcnn_reg", "rcnn_corner"]
    );
    // Untrained proposals rarely overlap an object enough for box regression.
    assert!(missed.iter().all(|name| name.starts_with("roi_head.reg_layers")), "{missed:?}");
    assert_eq!(predict(&config, &frames).len(), 2);
}

#[test]
fn degenerate_input() {
    let config = tiny();
    let equal = |value: f32, points: usize| Frame {
        id: "equal".into(),
        cloud: Cloud { values: [value, 1.0, -1.0, 0.5].repeat(points), channels: 4 },
        objects: vec![car(10.0, 1.0)],
    };
    let broken = Frame {
        id: "broken".into(),
        cloud: Cloud { values: vec![f32::NAN, 0.0, 0.0, 0.5, 10.0, f32::INFINITY, 0.0, 0.1], channels: 4 },
        objects: vec![car(10.0, 1.0)],
    };
    let empty = Frame { id: "empty".into(), cloud: Cloud::new(4), objects: vec![car(10.0, 1.0)] };
    let behind = equal(-50.0, 30);
    let cases = [
        ("three points", equal(10.0, 3)),
        ("all points equal", equal(10.0, 500)),
        ("no ground truth", frame(4, 400, vec![])),
        ("empty", empty),
        ("nothing in range", behind),
        ("no finite point", broken),
    ];
    for (name, frame) in &cases {
        eprintln!("{name}");
        learn(&config, &[training(&config, frame)]);
        predict(&config, std::slice::from_ref(frame));
    }
    // A frame without points does not change the losses of another one.
    let full = frame(1, 600, vec![car(10.0, 2.0)]);
    let alone = learn(&config, &[training(&config, &full)]).0;
    assert_eq!(learn(&config, &[training(&config, &cases[3].1), training(&config, &full)]).0, alone);
    let found = predict(&config, &[cases[3].1.clone(), full.clone()]);
    assert_eq!((found[0], found[1]), (0, predict(&config, &[full])[0]));
}

#[test]
fn no_proposal_left() {
    let mut config = tiny();
    network(&mut config).detection.score_threshold = 1.1;
    let frame = frame(1, 300, vec![car(10.0, 2.0)]);
    assert_eq!(predict(&config, std::slice::from_ref(&frame)), [0]);
    // NMS keeps one region; the others are boxes without extent.
    network(&mut config).proposals.train.iou = 0.0;
    learn(&config, &[training(&config, &frame)]);
}

#[test]
fn the_same_stream_draws_the_same_points() {
    let config = tiny();
    let frame = frame(1, 900, vec![car(10.0, 2.0)]);
    let points = |sample: Sample| match sample.network {
        NetworkSample::PointRcnn(sample) => sample.points,
        other => panic!("{other:?}"),
    };
    let drawn = |seed| points(Preparer::new(&config).training(&frame, &mut stream(seed, "augment", 0, 0)).unwrap());
    assert_eq!(drawn(1), drawn(1));
    assert_ne!(drawn(1), drawn(2));
    let looked = || points(Preparer::new(&config).inference(&frame).unwrap());
    assert_eq!(looked(), looked());
}

#[test]
fn wrong_sizes_are_named() {
    for (from, to, want) in [
        ("centers = 1024", "centers = 5000", "network.levels[1].centers"),
        ("points = 16384", "points = 0", "network.levels[0].centers"),
        ("class = \"Car\"", "class = \"Truck\"", "network.point_head.mean_sizes"),
        ("size_m = [3.9, 1.6, 1.56]", "size_m = [3.9, 0.0, 1.56]", "mean_sizes must be above 0"),
        ("far_m = 40.0", "far_m = -1.0", "sampling.far_m"),
        ("far_m = 40.0", "far = 40.0", "far"),
        ("kind = \"pointrcnn\"", "kind = \"pointrcnn\"\npropagation = [[64]]", "network.propagation"),
    ] {
        assert!(PUBLISHED.contains(from), "{from}");
        let message = DetectorConfig::parse(&PUBLISHED.replacen(from, to, 1)).unwrap_err();
        assert!(message.contains(want), "{to}: {message}");
    }
    DetectorConfig::parse(RACE).unwrap();
}
