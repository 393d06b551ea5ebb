//! The published PointPillars: its size, parameter names, and one step on a real scan.

use burn::tensor::Device;
use data::{Dataset, stream};
use lidarshift_tests::shared;
use models::checkpoint::HostValues;
use models::config::{DetectorConfig, NetworkConfig};
use models::{Detector, Preparer, find_detector, parameter_count};
use std::collections::BTreeMap;

/// With three classes and intensity, and with cars and coordinates only.
fn published() -> [(DetectorConfig, usize, &'static str); 2] {
    let kitti = find_detector("pointpillars").unwrap();
    let mut car = kitti.clone();
    car.classes = vec!["Car".into()];
    car.channels = 3;
    if let NetworkConfig::PointPillars(net) = &mut car.network {
        net.anchors.retain(|a| a.class == "Car");
    }
    [(kitti, 4_834_888, "kitti"), (car, 4_814_804, "car_xyz")]
}

#[test]
fn sizes_names_and_shapes() {
    for (config, parameters, name) in published() {
        let detector = Detector::new(&config, 0, &Device::flex());
        assert_eq!(parameter_count(&detector.network), parameters, "{name}");
        let Some(list) = shared(&format!("reference/state_dict_pointpillars_{name}.txt")) else { continue };
        let mut wanted = BTreeMap::new();
        for line in fs_err::read_to_string(list).unwrap().lines().filter(|l| !l.trim().is_empty()) {
            let (tensor, shape) = line.split_once(' ').unwrap();
            wanted.insert(tensor.to_string(), shape.trim().to_string());
        }
        let found: BTreeMap<String, String> =
            detector.to_named().unwrap().into_iter().map(|(tensor, t)| (tensor, format!("{:?}", t.shape))).collect();
        assert_eq!(found, wanted, "{name}");
    }
}

#[test]
fn one_step_on_a_real_scan() {
    let Some(folder) = shared("data/kitti/training") else { return };
    let [(config, ..), _] = published();
    let set = Dataset::open(&folder).unwrap();
    let frame = set.load("000007").unwrap();
    let sample = Preparer::new(&config).training(&frame, &mut stream(0, "test", 0, 0)).unwrap();
    let detector = Detector::new(&config, 0, &Device::flex().autodiff());
    let losses = detector.loss(&[sample]).unwrap();
    let total: f32 = losses.total.clone().into_scalar();
    assert!(total.is_finite() && total > 0.0);
    let gradients = losses.total.backward();
    let gradients = models::named::gradients(&detector.network, &gradients).unwrap();
    let reached = |name: &str| match &gradients[name].values {
        HostValues::F32(v) => v.iter().all(|g| g.is_finite()) && v.iter().any(|g| *g != 0.0),
        _ => false,
    };
    let missed: Vec<_> = gradients.keys().filter(|name| !reached(name)).collect();
    assert!(missed.is_empty(), "no gradient, or one that is not finite: {missed:?}");
}
