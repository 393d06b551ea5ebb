use super::*;
use crate::write::{write_dataset_toml, write_split};
use crate::{Frame, Object, PointColumns, verify_frames};
use geometry::Box3;

const FORMATS: [Format; 6] =
    [Format::Kitti, Format::Pcd, Format::OpenPcdet, Format::Carla, Format::Mcap, Format::Shards];

fn frame(id: &str, shift: f32) -> Frame {
    let object = |class: &str, yaw_rad: f64| Object {
        class: class.into(),
        bbox: Box3::from_array([10.5, -2.25, -0.9, 4.1, 1.7, 1.5, yaw_rad]),
        truncation: None,
        occlusion: None,
        image_box: None,
    };
    let values = (0..40).map(|i| (i as f32).mul_add(0.37, shift)).collect();
    Frame {
        id: id.into(),
        cloud: Cloud { values, channels: 4 },
        objects: vec![object("Car", 0.3), object("Van", -2.0)],
    }
}

fn source(folder: &Path) -> Dataset {
    let ids = ["a", "b", "c"];
    for (i, id) in ids.iter().enumerate() {
        Layout::Kitti.write_frame(folder, &frame(id, i as f32)).unwrap();
    }
    write_split(&folder.join("ImageSets/train.txt"), &["c", "a"]).unwrap();
    let config = DatasetConfig { name: "source".into(), points: PointColumns::Xyzi, ..DatasetConfig::default() };
    write_dataset_toml(&folder.join("dataset.toml"), &config).unwrap();
    Dataset::open(folder).unwrap()
}

fn convert(dataset: &Dataset, to: Format, out: &Path) -> Result<ConvertManifest, String> {
    Conversion { dataset, to, shard_frames: 2 }.make(out, &|_, _| ()).map_err(|e| e.to_string())
}

#[test]
fn every_format_is_read_back_equal() {
    let folder = tempfile::tempdir().unwrap();
    let dataset = source(&folder.path().join("source"));
    for to in FORMATS {
        let out = folder.path().join(format!("{to:?}"));
        let manifest = convert(&dataset, to, &out).unwrap();
        assert_eq!((manifest.frames, manifest.points, manifest.labels), (3, 30, 6));
        assert!(verify_frames(&out).unwrap() >= 1);
        let made = Dataset::open(&out).unwrap();
        assert_eq!((made.config.layout, made.config.name.as_str()), (to.layout(), "source"));
        let [old, new] = [&dataset, &made].map(|set| set.all_ids().unwrap());
        let split = made.ids("train").unwrap();
        if to == Format::Mcap {
            assert_eq!(
                (new.as_slice(), split.as_slice()),
                (&["000000", "000001", "000002"].map(String::from)[..], &["000002", "000000"].map(String::from)[..])
            );
        } else {
            assert_eq!((&new, split), (&old, dataset.ids("train").unwrap()));
        }
        for (a, b) in old.iter().zip(&new) {
            let (a, b) = (dataset.load(a).unwrap(), made.load(b).unwrap());
            assert_eq!(a.cloud, b.cloud);
            for (a, b) in a.objects.iter().zip(&b.objects) {
                assert_eq!((&a.class, a.bbox), (&b.class, b.bbox), "{to:?}");
            }
            assert_eq!(b.objects.len(), 2);
        }
    }
}

#[test]
fn the_same_bytes_again_and_other_folders_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("source");
    let dataset = source(&root);
    for (to, cloud) in [(Format::Mcap, "data.mcap"), (Format::OpenPcdet, "points/b.npy")] {
        let out = folder.path().join(format!("{to:?}"));
        let manifest = convert(&dataset, to, &out).unwrap();
        let file = out.join(cloud);
        let (bytes, written) = (std::fs::read(&file).unwrap(), std::fs::metadata(&file).unwrap().modified().unwrap());
        assert_eq!(convert(&dataset, to, &out).unwrap(), manifest);
        assert_eq!(std::fs::metadata(&file).unwrap().modified().unwrap(), written);
        std::fs::write(&file, &bytes[..20]).unwrap();
        convert(&dataset, to, &out).unwrap();
        assert!(std::fs::read(&file).unwrap() == bytes);
        let error = convert(&dataset, Format::Carla, &out).unwrap_err();
        assert!(error.contains("in another format"), "{error}");
        // A source that changed is written anew.
        Layout::Kitti.write_frame(&root, &frame("b", 9.0)).unwrap();
        convert(&dataset, to, &out).unwrap();
        assert!(std::fs::read(&file).unwrap() != bytes);
        Layout::Kitti.write_frame(&root, &frame("b", 1.0)).unwrap();
    }
}

#[test]
fn a_recording_keeps_stamps_and_poses() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("drive");
    for i in 0..3 {
        let path = root.join(format!("velodyne/00000{i}.bin"));
        crate::write::write_bin(&path, &frame("x", i as f32).cloud).unwrap();
    }
    std::fs::write(root.join("times.txt"), "5.0\n5.1\n5.25\n").unwrap();
    let poses = "1 0 0 0 0 1 0 0 0 0 1 0\n0 -1 0 3 1 0 0 4 0 0 1 5\n0 -1 0 6 1 0 0 7 0 0 1 8\n";
    std::fs::write(root.join("poses.txt"), poses).unwrap();
    let dataset = Dataset::open(&root).unwrap();
    let out = folder.path().join("mcap");
    convert(&dataset, Format::Mcap, &out).unwrap();
    let made = Dataset::open(&out).unwrap();
    assert!(!made.has_labels());
    let [old, new] = [&dataset, &made].map(|set| set.moments(&set.all_ids().unwrap()).unwrap());
    assert_eq!(new.len(), 3);
    for (a, b) in old.iter().zip(&new) {
        assert!((a.stamp_s.unwrap() - b.stamp_s.unwrap()).abs() < 2e-9);
        let (a, b) = (a.world_from_lidar.unwrap(), b.world_from_lidar.unwrap());
        assert!((a.translation.vector - b.translation.vector).norm() < 1e-9);
        assert!(a.rotation.angle_to(&b.rotation) < 1e-7);
    }
    // From one MCAP file to the next nothing is lost.
    let again = folder.path().join("again");
    convert(&made, Format::Mcap, &again).unwrap();
    assert!(std::fs::read(out.join("data.mcap")).unwrap() == std::fs::read(again.join("data.mcap")).unwrap());
}

#[test]
fn camera_labels_move_to_the_lidar_except_for_kitti() {
    let folder = tempfile::tempdir().unwrap();
    let root = folder.path().join("kitti");
    let mut whole = frame("000000", 1.0).cloud;
    whole.values.extend([-20.0, 0.0, 0.0, 0.5, 20.0, 1.0, 0.25, 0.75]); // behind the camera, and in its image
    crate::write::write_bin(&root.join("velodyne/000000.bin"), &whole).unwrap();
    let line = "Car 0.10 1 -1.5 100 150 200 250 1.5 1.7 4.1 2.0 1.6 12.0 -1.2\nDontCare -1 -1 -10 1 2 3 4 -1 -1 -1 -1000 -1000 -1000 -10\n";
    std::fs::create_dir_all(root.join("label_2")).unwrap();
    std::fs::write(root.join("label_2/000000.txt"), line).unwrap();
    let calibration = "P2: 700 0 620 0 0 700 180 0 0 0 1 0\nR0_rect: 1 0 0 0 1 0 0 0 1\n\
                       Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0\n";
    std::fs::create_dir_all(root.join("calib")).unwrap();
    std::fs::write(root.join("calib/000000.txt"), calibration).unwrap();
    let dataset = Dataset::open(&root).unwrap();
    for to in FORMATS {
        let out = folder.path().join(format!("{to:?}"));
        convert(&dataset, to, &out).unwrap();
        let made = Dataset::open(&out).unwrap();
        let id = &made.all_ids().unwrap()[0];
        let (a, b) = (dataset.load("000000").unwrap(), made.load(id).unwrap());
        assert_eq!(a.cloud, b.cloud, "{to:?}");
        assert_eq!(b.objects.len(), 1);
        let (a, b) = (a.objects[0].bbox.to_array(), b.objects[0].bbox.to_array());
        assert!(a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-9), "{to:?}: {a:?} {b:?}");
        let camera = made.config.label_frame == LabelFrame::Camera;
        assert_eq!((camera, made.labels(id).unwrap().len()), (to == Format::Kitti, if camera { 2 } else { 1 }));
    }
    let copied = |path: &str| std::fs::read(folder.path().join("Kitti").join(path)).unwrap();
    assert!(copied("velodyne/000000.bin") == std::fs::read(root.join("velodyne/000000.bin")).unwrap());
    assert!(copied("calib/000000.txt") == calibration.as_bytes());
}
