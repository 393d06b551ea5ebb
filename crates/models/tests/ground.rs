//! Detectors whose heights count from the ground.

use burn::tensor::Device;
use data::{Cloud, Frame, GroundConfig, Object, stream};
use geometry::Box3;
use lidarshift_models as models;
use models::config::{DetectorConfig, NetworkConfig};
use models::suggest::{LabelledBoxes, suggest};
use models::{Detector, NetworkSample, Preparer};
use rand::RngExt;

/// PointPillars for the race with few channels, and a score threshold that lets every box pass.
fn detector(ground: Option<GroundConfig>) -> DetectorConfig {
    let mut config =
        DetectorConfig::parse(include_str!("../../../configs/detectors/pointpillars_race_small.toml")).unwrap();
    assert!(config.ground.is_some() && config.augmentation.gt_sampling.ground.is_some(), "on in the race");
    config.ground = ground;
    config.range_m = [-25.6, -12.8, -3.0, 25.6, 12.8, 3.0];
    let NetworkConfig::PointPillars(net) = &mut config.network else { panic!("another network") };
    net.pillars.size_m[2] = 6.0;
    net.vfe_filters = 8;
    net.backbone.filters = vec![8, 8, 8];
    net.backbone.upsample_filters = vec![8, 8, 8];
    net.detection.score_threshold = 0.0;
    config.check().unwrap();
    config
}

/// A road with cars at these heights above it.
fn frame(road: impl Fn(f64, f64) -> f64) -> Frame {
    let mut random = stream(3, "road", 0, 0);
    let mut frame = Frame { id: "road".into(), cloud: Cloud::new(4), objects: Vec::new() };
    // Wider than the range of the detectors: at the border of what is seen slopes are damped.
    for _ in 0..16_000 {
        let (x, y): (f64, f64) = (random.random_range(-50.0..50.0), random.random_range(-24.0..24.0));
        frame.cloud.values.extend([x as f32, y as f32, road(x, y) as f32, 0.0]);
    }
    for (x, y) in [(-15.0, 6.0), (3.0, -7.0), (18.0, 8.0)] {
        let bbox = Box3::from_array([x, y, road(x, y) + 0.6, 4.88, 1.9, 1.18, 0.0]);
        for _ in 0..200 {
            let local = [0, 1, 2].map(|k| random.random_range(-0.49..0.49) * bbox.size[k]);
            frame.cloud.values.extend(bbox.from_local(local).map(|v| v as f32));
            frame.cloud.values.push(0.0);
        }
        frame.objects.push(Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None });
    }
    frame
}

#[test]
fn detections_follow_the_ground() {
    let config = detector(Some(GroundConfig::default()));
    let (network, preparer) = (Detector::new(&config, 4, &Device::flex()), Preparer::new(&config));
    let found = |frame: &Frame| network.predict(&[preparer.inference(frame).unwrap()]).unwrap().remove(0);
    let (low, high) = (found(&frame(|_, _| 0.0)), found(&frame(|_, _| 20.0)));
    assert!(low.len() > 10 && low.len() == high.len());
    for (low, high) in low.iter().zip(&high) {
        let [a, b] = [low, high].map(|found| found.bbox);
        assert!((b.center[2] - a.center[2] - 20.0).abs() < 1e-3 && (low.score - high.score).abs() < 1e-4);
        assert!((a.center[0] - b.center[0]).abs() < 1e-3 && (a.yaw_rad - b.yaw_rad).abs() < 1e-3);
    }
    // Without it the high road is out of range.
    let config = detector(None);
    assert!(Preparer::new(&config).inference(&frame(|_, _| 20.0)).unwrap().is_empty());
}

#[test]
fn targets_count_from_the_ground() {
    let config = detector(Some(GroundConfig::default()));
    let residuals = |road: &dyn Fn(f64, f64) -> f64| -> Vec<f32> {
        let sample = Preparer::new(&config).training(&frame(road), &mut stream(0, "", 0, 0)).unwrap();
        let NetworkSample::PointPillars(sample) = sample.network else { panic!("another network") };
        sample.targets.unwrap().reg.iter().map(|reg| reg[2]).collect()
    };
    let (level, banked) = (residuals(&|_, _| 0.0), residuals(&|x, y| 5.0 + 0.02 * x + 0.15 * y));
    assert!(level.len() > 6 && level.len() == banked.len());
    // In heights of the anchor, 1.18 m.
    assert!(level.iter().zip(&banked).all(|(a, b)| (a - b).abs() < 0.1), "{level:?} {banked:?}");
    let without = detector(None);
    let high = Preparer::new(&without).training(&frame(|_, _| 2.0), &mut stream(0, "", 0, 0)).unwrap();
    let NetworkSample::PointPillars(high) = high.network else { panic!("another network") };
    assert!(high.targets.unwrap().reg.iter().all(|reg| reg[2] > 1.5));
}

#[test]
fn a_suggestion_counts_heights_from_the_ground() {
    let folder = tempfile::tempdir().unwrap();
    for k in 0..12 {
        let frame = Frame { id: format!("{k:06}"), ..frame(|x, y| 1.5 + 0.05 * x + 0.1 * y) };
        data::Layout::Kitti.write_frame(folder.path(), &frame).unwrap();
    }
    let dataset = data::Dataset::open(folder.path()).unwrap();
    let ids = dataset.all_ids().unwrap();
    let bottom = |ground: Option<GroundConfig>| {
        let config = detector(ground.clone());
        let boxes = LabelledBoxes::read(&dataset, &ids, 100, ground.as_ref()).unwrap();
        suggest(&config, &boxes).unwrap().detector.network.anchors()[0].bottom_m
    };
    let (by_z, above_ground) = (bottom(None), bottom(Some(GroundConfig::default())));
    assert!(by_z > 0.7 && above_ground.abs() < 0.15, "{by_z} {above_ground}");
}

#[test]
fn impossible_grounds_are_refused() {
    let mut config = detector(None);
    config.ground = Some(GroundConfig { cell_m: 0.0, reach_m: 9.0 });
    assert!(config.check().unwrap_err().contains("ground.cell_m = 0"));
}
