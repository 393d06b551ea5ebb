//! CenterPoint: size of the published network, checks of its configuration, learning, degenerate input.

use burn::tensor::Device;
use data::{Cloud, Frame, Object, stream};
use geometry::Box3;
use lidarshift_models as models;
use models::checkpoint::{HostTensor, HostValues};
use models::config::{DetectorConfig, NetworkConfig};
use models::{Detector, Preparer, Sample, named, parameter_count};

const PUBLISHED: &str = include_str!("../../../configs/detectors/centerpoint.toml");
const SMALL: &str = include_str!("../../../configs/detectors/centerpoint_small.toml");

fn network(config: &mut DetectorConfig) -> &mut models::centerpoint::CenterPointConfig {
    match &mut config.network {
        NetworkConfig::CenterPoint(net) => net,
        other => panic!("{other:?}"),
    }
}

#[test]
fn sizes_and_names() {
    let config = DetectorConfig::parse(PUBLISHED).unwrap();
    let detector = Detector::new(&config, 0, &Device::flex());
    assert_eq!(parameter_count(&detector.network), 5_224_011);
    let tensors = detector.to_named().unwrap();
    for (name, shape) in [
        ("vfe.pfn_layers.0.linear.weight", vec![32, 10]),
        ("vfe.pfn_layers.1.linear.weight", vec![64, 64]),
        ("vfe.pfn_layers.1.norm.running_var", vec![64]),
        ("backbone_2d.blocks.0.1.weight", vec![64, 64, 3, 3]),
        ("backbone_2d.deblocks.2.0.weight", vec![256, 128, 4, 4]),
        ("dense_head.shared_conv.0.weight", vec![64, 384, 3, 3]),
        ("dense_head.shared_conv.0.bias", vec![64]),
        ("dense_head.shared_conv.1.running_mean", vec![64]),
        ("dense_head.heads_list.0.center.0.0.bias", vec![64]),
        ("dense_head.heads_list.0.dim.0.1.weight", vec![64]),
        ("dense_head.heads_list.0.hm.1.weight", vec![3, 64, 3, 3]),
        ("dense_head.heads_list.0.center_z.1.bias", vec![1]),
    ] {
        assert_eq!(tensors.get(name).map(|t| &t.shape), Some(&shape), "{name}");
    }
    assert_eq!(tensors.len(), 178 + 1, "with global_step");
}

#[test]
fn defaults_are_the_published_sizes() {
    let mut config = DetectorConfig::parse(PUBLISHED).unwrap();
    let NetworkConfig::CenterPoint(default) = toml::from_str("kind = \"centerpoint\"").unwrap() else {
        panic!("another network")
    };
    let net = network(&mut config);
    net.pillars = default.pillars.clone();
    net.detection.center_range_m = None;
    assert_eq!(&default, net);
}

#[test]
fn one_head_a_class_and_more_layers() {
    let mut config = DetectorConfig::parse(PUBLISHED).unwrap();
    let net = network(&mut config);
    net.head.classes = vec![vec!["Cyclist".into()], vec!["Car".into(), "Pedestrian".into()]];
    net.head.bias_before_norm = false;
    net.head.layers.rot = 3;
    net.head.layers.hm = 1;
    config.check().unwrap();
    let tensors = Detector::new(&config, 0, &Device::flex()).to_named().unwrap();
    let shape = |name: &str| tensors.get(name).map(|t| t.shape.clone());
    assert_eq!(shape("dense_head.heads_list.0.hm.0.weight"), Some(vec![1, 64, 3, 3]));
    assert_eq!(shape("dense_head.heads_list.1.hm.0.bias"), Some(vec![2]));
    assert_eq!(shape("dense_head.heads_list.1.rot.1.0.weight"), Some(vec![64, 64, 3, 3]));
    assert_eq!(shape("dense_head.heads_list.1.rot.2.weight"), Some(vec![2, 64, 3, 3]));
    assert_eq!(shape("dense_head.shared_conv.0.bias"), None);
}

#[test]
fn wrong_sizes_are_named() {
    for (from, to, named) in [
        ("vfe_filters = [64, 64]", "vfe_filters = [63, 64]", "network.vfe_filters: 63 is odd"),
        ("vfe_filters = [64, 64]", "vfe_filters = []", "network.vfe_filters needs at least one layer"),
        ("vfe_filters = [64, 64]", "vfe_filters = [64, 0]", "network.vfe_filters must be above 0"),
        ("upsample_strides = [1, 2, 4]", "upsample_strides = [1, 2, 2]", "upsample_strides"),
        ("upsample_strides = [1, 2, 4]", "upsample_strides = [1, 1.5, 4]", "1.5 is neither"),
        ("size_m = [0.32, 0.32, 4.0]", "size_m = [0.32, 0.34, 4.0]", "both must be multiples of 4"),
        ("size_m = [0.32, 0.32, 4.0]", "size_m = [0.32, 0.32, 1.0]", "4 pillars along z"),
        ("[network.detection]", "[network.head]\nclasses = [[\"Car\"]]\n[network.detection]", "network.head.classes"),
        ("[network.detection]", "[network.head]\nfilters = 0\n[network.detection]", "network.head"),
        ("[network.detection]", "[network.head]\nlayers = { dim = 0 }\n[network.detection]", "network.head"),
        (
            "[network.detection]",
            "[network.targets]\ngaussian_overlap = 1.0\n[network.detection]",
            "network.targets.gaussian_overlap = 1",
        ),
        ("[network.detection]", "[network.detection]\nnms_iou = 1.5", "network.detection"),
        ("center_range_m = [-5.0,", "center_range_m = [85.0,", "network.detection.center_range_m"),
        ("[network.detection]", "[network.detection]\nscore = 0.1", "score"),
    ] {
        let text = PUBLISHED.replacen(from, to, 1);
        assert_ne!(text, PUBLISHED, "{from}");
        let message = DetectorConfig::parse(&text).unwrap_err();
        assert!(message.contains(named), "{to}: {message}");
    }
}

/// A network that runs in milliseconds.
fn tiny() -> DetectorConfig {
    let mut config = DetectorConfig::parse(SMALL).unwrap();
    config.range_m = [0.0, -10.24, -3.0, 20.48, 10.24, 1.0];
    config.check().unwrap();
    config
}

fn car(x: f64, y: f64) -> Object {
    let bbox = Box3::from_array([x, y, -0.9, 3.9, 1.6, 1.56, 0.3]);
    Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None }
}

/// Points in rows on the ground and on the boxes.
fn frame(id: &str, objects: Vec<Object>) -> Frame {
    let mut cloud = Cloud::new(4);
    for i in 0..900 {
        let (x, y) = (0.1 + (i % 30) as f32 * 0.67, -10.0 + (i / 30) as f32 * 0.66);
        cloud.values.extend([x, y, -1.7, 0.1]);
    }
    for object in &objects {
        for i in 0..120 {
            let local = [(i % 12) as f64 / 11.0 - 0.5, (i / 12) as f64 / 9.0 - 0.5, 0.4];
            let local = [0, 1, 2].map(|k| local[k] * 0.98 * object.bbox.size[k]);
            cloud.values.extend(object.bbox.from_local(local).map(|v| v as f32));
            cloud.values.push(0.9);
        }
    }
    Frame { id: id.into(), cloud, objects }
}

fn training(config: &DetectorConfig, frame: &Frame) -> Sample {
    Preparer::new(config).training(frame, &mut stream(1, "augment", 0, 0)).unwrap()
}

fn zeros(tensor: &HostTensor) -> bool {
    matches!(&tensor.values, HostValues::F32(v) if v.iter().all(|&g| g == 0.0))
}

#[test]
fn every_parameter_learns_but_the_biases_before_a_norm() {
    let config = tiny();
    let detector = Detector::new(&config, 3, &Device::flex().autodiff());
    let batch = [training(&config, &frame("a", vec![car(6.0, 1.0), car(14.0, -4.0), car(13.0, 6.0)]))];
    let losses = detector.loss(&batch).unwrap();
    assert_eq!(losses.parts.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["hm", "box"]);
    let gradients = named::gradients(&detector.network, &losses.total.backward()).unwrap();
    let before_a_norm = |name: &str| name.ends_with("shared_conv.0.bias") || name.ends_with(".0.0.bias");
    for (name, gradient) in &gradients {
        let HostValues::F32(values) = &gradient.values else { panic!("{name}") };
        assert!(values.iter().all(|v| v.is_finite()), "{name}");
        assert_eq!(zeros(gradient), before_a_norm(name), "{name}");
    }
    assert_eq!(gradients.keys().filter(|name| before_a_norm(name)).count(), 6);
}

#[test]
fn two_heads_learn_and_detect() {
    let mut config = tiny();
    config.classes = vec!["Car".into(), "Pedestrian".into()];
    network(&mut config).head.classes = vec![vec!["Pedestrian".into()], vec!["Car".into()]];
    network(&mut config).detection.score_threshold = 0.0;
    config.check().unwrap();
    let detector = Detector::new(&config, 3, &Device::flex().autodiff());
    let mut one = frame("a", vec![car(6.0, 1.0), car(14.0, -4.0)]);
    one.objects[1].class = "Pedestrian".into();
    let losses = detector.loss(&[training(&config, &one)]).unwrap();
    let gradients = named::gradients(&detector.network, &losses.total.backward()).unwrap();
    for head in 0..2 {
        let weight = format!("dense_head.heads_list.{head}.hm.1.weight");
        assert!(!zeros(&gradients[&weight]), "{weight}");
    }
    let found = &detector.predict(&[Preparer::new(&config).inference(&one).unwrap()]).unwrap()[0];
    assert!(found.windows(2).all(|pair| pair[0].score >= pair[1].score), "by falling score");
    for class in ["Car", "Pedestrian"] {
        assert!(found.iter().any(|detection| detection.class == class), "{class}");
    }
}

#[test]
fn frames_without_boxes_or_points() {
    let config = tiny();
    let detector = Detector::new(&config, 3, &Device::flex().autodiff());
    let empty = frame("empty", vec![]);
    let far = frame("far", vec![car(60.0, 0.0)]);
    let value =
        |batch: &[Sample], part: usize| -> f32 { detector.loss(batch).unwrap().parts[part].1.clone().into_scalar() };
    for frame in [&empty, &far] {
        let batch = [training(&config, frame)];
        assert_eq!(value(&batch, 1), 0.0, "{}: there is no box to learn", frame.id);
        assert!(value(&batch, 0) > 0.0 && value(&batch, 0).is_finite());
    }
    let nothing = Frame { id: "nothing".into(), cloud: Cloud::new(4), objects: vec![car(6.0, 1.0)] };
    let batch = [training(&config, &nothing), training(&config, &empty)];
    assert!(value(&batch, 0).is_finite() && value(&batch, 1).is_finite());
    let sample = Preparer::new(&config).inference(&nothing).unwrap();
    assert!(sample.is_empty());
    let found = models::predict_samples(&detector, &[sample, Preparer::new(&config).inference(&empty).unwrap()]);
    assert!(found.unwrap()[0].detections.is_empty());
}

#[test]
fn damaged_weights_are_an_error() {
    let config = tiny();
    let detector = Detector::new(&config, 3, &Device::flex());
    let mut tensors = detector.to_named().unwrap();
    let HostValues::F32(bias) = &mut tensors.get_mut("dense_head.heads_list.0.hm.1.bias").unwrap().values else {
        panic!("f32")
    };
    bias[0] = f32::NAN;
    let detector = detector.load_named(&tensors).unwrap();
    let sample = Preparer::new(&config).inference(&frame("seven", vec![])).unwrap();
    let message = detector.predict(&[sample]).unwrap_err().to_string();
    assert!(message.contains("frame seven") && message.contains("heat map"), "{message}");
}

#[test]
fn features_of_a_frame() {
    let config = tiny();
    let detector = Detector::new(&config, 3, &Device::flex());
    let sample = Preparer::new(&config).inference(&frame("a", vec![car(6.0, 1.0)])).unwrap();
    assert_eq!(detector.frame_features(std::slice::from_ref(&sample)).unwrap()[0].len(), 96);
    let layers = detector.layer_features(&sample).unwrap();
    let names: Vec<&str> = layers.iter().map(|layer| layer.layer.as_str()).collect();
    assert_eq!(names, ["pillar features", "block 1", "block 2", "block 3", "neck"]);
}
