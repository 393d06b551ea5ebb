//! nuScenes: tables, keyframes and sweeps of the LiDAR.
//!
//! The LiDAR of nuScenes has x right and y forward. Clouds, poses and boxes are turned to x forward and y left.

use super::nuscenes_scans::read_scan;
use super::nuscenes_tables::{Annotation, Keyframe, Scan, Tables, tables, tables_folder};
use super::{DataLayout, Moment, PointDetails, Sequence, TrackedObject};
use crate::{Cloud, DataError, DatasetConfig, LabelBox, Layout, PointColumns};
use geometry::{Box3, Pose, limit_period, move_box, upright_pose};
use std::f64::consts::{FRAC_PI_2, PI};
use std::path::{Path, PathBuf};

/// The layout of nuScenes. Frames are the keyframes and the sweeps whose clouds exist; the id of a frame is
/// `SCENE_STAMP` with the time stamp in us. Read-only.
pub(super) struct Nuscenes;

impl DataLayout for Nuscenes {
    fn name(&self) -> &'static str {
        "nuscenes"
    }

    fn markers(&self) -> &'static [&'static str] {
        &["v1.0-*/sample_data.json (nuScenes)"]
    }

    fn recognise(&self, folder: &Path) -> Option<DatasetConfig> {
        let config = DatasetConfig { layout: Layout::Nuscenes, root: folder.into(), ..DatasetConfig::default() };
        tables_folder(folder).map(|_| config)
    }

    fn check_root(&self, root: &Path) -> Result<(), DataError> {
        let message = "has no folder v1.0-* with sample_data.json: check `root` and `layout` of the data set";
        tables_folder(root).map(|_| ()).ok_or_else(|| DataError::file(root, message))
    }

    fn frame_ids(&self, root: &Path) -> Result<Vec<String>, DataError> {
        let tables = tables(root)?;
        let there = |(id, scan): (&String, &Scan)| root.join(&scan.file).is_file().then(|| id.clone());
        let ids: Vec<String> = tables.scans.iter().filter_map(there).collect();
        if ids.is_empty() {
            return Err(DataError::file(root, "has no cloud of the tables: samples/LIDAR_TOP is missing"));
        }
        Ok(ids)
    }

    fn sequences(&self, root: &Path) -> Result<Vec<Sequence>, DataError> {
        let tables = tables(root)?;
        let mut sequences: Vec<Sequence> = Vec::new();
        for id in self.frame_ids(root)? {
            let scene = &tables.scans[&id].scene;
            match sequences.last_mut().filter(|last| last.name == *scene) {
                Some(last) => last.ids.push(id),
                None => sequences.push(Sequence { name: scene.clone(), ids: vec![id] }),
            }
        }
        Ok(sequences)
    }

    fn cloud_path(&self, root: &Path, id: &str) -> PathBuf {
        let scan = tables(root).ok().and_then(|tables| tables.scans.get(id).map(|scan| root.join(&scan.file)));
        scan.unwrap_or_else(|| root.join("samples/LIDAR_TOP").join(id))
    }

    fn labels_path(&self, root: &Path, _id: &str) -> PathBuf {
        tables_folder(root).unwrap_or_else(|| root.into()).join("sample_annotation.json")
    }

    fn has_labels(&self, root: &Path) -> bool {
        self.labels_path(root, "").is_file()
    }

    fn read_cloud(&self, root: &Path, id: &str, columns: PointColumns) -> Result<Cloud, DataError> {
        Ok(read_scan(&root.join(&scan(&*tables(root)?, root, id)?.file))?.0.with_channels(columns.channels()))
    }

    fn read_labels(&self, root: &Path, id: &str) -> Result<Vec<LabelBox>, DataError> {
        let tables = tables(root)?;
        let objects = objects_at(&tables, scan(&tables, root, id)?);
        Ok(objects.iter().map(TrackedObject::label_box).collect())
    }

    fn moments(&self, root: &Path, ids: &[String]) -> Result<Vec<Moment>, DataError> {
        let tables = tables(root)?;
        let mut scenes: Option<&str> = None;
        let mut start_us = 0;
        let mut moments = Vec::with_capacity(ids.len());
        for id in ids {
            let scan = scan(&tables, root, id)?;
            if *scenes.get_or_insert(&scan.scene) != scan.scene {
                let message =
                    format!("frame {id} is of another scene than {}: list the frames of one scene in a split", ids[0]);
                return Err(DataError::file(root, message));
            }
            if moments.is_empty() {
                let of_scene = tables.scans.values().filter(|other| other.scene == scan.scene);
                start_us = of_scene.map(|other| other.stamp_us).min().unwrap_or(0);
            }
            moments.push(Moment {
                id: id.clone(),
                stamp_s: Some(scan.stamp_us.wrapping_sub(start_us) as f64 / 1e6),
                world_from_lidar: Some(map_from_lidar(scan)),
                objects: objects_at(&tables, scan),
            });
        }
        Ok(moments)
    }

    fn read_point_details(&self, root: &Path, id: &str) -> Result<PointDetails, DataError> {
        let ring = read_scan(&root.join(&scan(&*tables(root)?, root, id)?.file))?.1;
        Ok(PointDetails { ring: Some(ring), ..PointDetails::default() })
    }
}

fn scan<'a>(tables: &'a Tables, root: &Path, id: &str) -> Result<&'a Scan, DataError> {
    tables.scans.get(id).ok_or_else(|| DataError::file(root, format!("the tables have no scan of the frame {id}")))
}

/// The pose of the LiDAR frame. Its x axis is the y axis of nuScenes, its y axis the negative x axis.
fn map_from_lidar(scan: &Scan) -> Pose {
    scan.map_from_sensor * upright_pose([0.0; 3], FRAC_PI_2)
}

/// The objects at a scan, in its LiDAR frame, in the order of their tracks. Those of a sweep lie between its keyframes
/// before and after it, if they are annotated at both. Before the first and after the last keyframe there is none.
fn objects_at(tables: &Tables, scan: &Scan) -> Vec<TrackedObject> {
    let lidar_from_map = map_from_lidar(scan).inverse();
    let Some(keyframes) = tables.keyframes.get(&scan.scene) else { return Vec::new() };
    let before = keyframes.range(..=scan.stamp_us).next_back();
    let after = keyframes.range(scan.stamp_us..).next();
    let (Some((before_us, before)), Some((after_us, after))) = (before, after) else { return Vec::new() };
    let span_us = after_us - before_us;
    let share = if span_us == 0 { 0.0 } else { (scan.stamp_us - before_us) as f64 / span_us as f64 };
    let mut objects: Vec<TrackedObject> = between(before, after, share)
        .map(|(track, class, box_map)| {
            let bbox = move_box(&lidar_from_map, &box_map);
            TrackedObject { track: track.into(), class: class.into(), bbox }
        })
        .collect();
    objects.sort_by(|a, b| a.track.cmp(&b.track));
    objects
}

fn between<'a>(
    before: &'a Keyframe,
    after: &'a Keyframe,
    share: f64,
) -> impl Iterator<Item = (&'a str, &'a str, Box3)> {
    let mix = move |a: f64, b: f64| a + share * (b - a);
    before.iter().filter_map(move |(track, Annotation { class, box_map: from })| {
        let to = &after.get(track)?.box_map;
        let turn = limit_period(to.yaw_rad - from.yaw_rad, 0.5, 2.0 * PI);
        let center = [0, 1, 2].map(|axis| mix(from.center[axis], to.center[axis]));
        let size = [0, 1, 2].map(|axis| mix(from.size[axis], to.size[axis]));
        Some((&**track, &**class, Box3 { center, size, yaw_rad: from.yaw_rad + share * turn }))
    })
}

#[cfg(test)]
mod tests {
    use super::super::nuscenes_scans::bytes;
    use super::*;
    use crate::Dataset;

    /// Two keyframes with a sweep between them, and a keyframe of another scene.
    fn nuscenes() -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| {
            let path = folder.path().join("v1.0-mini").join(format!("{name}.json"));
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        write("scene", r#"[{"token": "s1", "name": "scene-0001", "x": 1}, {"token": "s2", "name": "scene-0002"}]"#);
        let sample = |token: &str, at: i64, scene: &str| {
            format!(r#"{{"token": "{token}", "timestamp": {at}, "scene_token": "{scene}", "prev": ""}}"#)
        };
        let samples = [sample("k1", 1_000_000, "s1"), sample("k2", 1_500_000, "s1"), sample("k3", 9_000_000, "s2")];
        write("sample", &format!("[{}]", samples.join(",")));
        let mut data = vec![
            r#"{"token": "c", "sample_token": "k1", "ego_pose_token": "none", "timestamp": 1,
            "calibrated_sensor_token": "none", "filename": "samples/CAM_FRONT/a.jpg"}"#
                .to_string(),
        ];
        let mut poses = Vec::new();
        for (at, sample, kind, x) in [
            (1_000_000, "k1", "samples", 10.0),
            (1_200_000, "k2", "sweeps", 12.0),
            (1_500_000, "k2", "samples", 15.0),
            (9_000_000, "k3", "samples", 0.0),
        ] {
            let file = format!("{kind}/LIDAR_TOP/a__LIDAR_TOP__{at}.pcd.bin");
            std::fs::create_dir_all(folder.path().join(&file).parent().unwrap()).unwrap();
            std::fs::write(folder.path().join(&file), bytes(&[[1.0, 2.0, 3.0, 255.0, 7.0]])).unwrap();
            data.push(format!(
                r#"{{"token": "d", "sample_token": "{sample}", "ego_pose_token": "p{at}", "timestamp": {at},
                "calibrated_sensor_token": "l", "filename": "{file}", "is_key_frame": true}}"#
            ));
            poses.push(format!(
                r#"{{"token": "p{at}", "timestamp": {at}, "translation": [{x}, 5, 0], "rotation": [1, 0, 0, 0]}}"#
            ));
        }
        write("sample_data", &format!("[{}]", data.join(",")));
        write("ego_pose", &format!("[{}]", poses.join(",")));
        // The sensor is 1 m before the origin of the car, and its y axis is the x axis of the car.
        let half = (0.5f64).sqrt();
        write(
            "calibrated_sensor",
            &format!(
                r#"[{{"token": "l", "translation": [1, 0, 1.8], "rotation": [{half}, 0, 0, -{half}], "camera_intrinsic": []}}]"#
            ),
        );
        write("category", r#"[{"token": "v", "name": "vehicle.car", "description": ""}]"#);
        write("instance", r#"[{"token": "i1", "category_token": "v"}, {"token": "i2", "category_token": "v"}]"#);
        let annotation = |sample: &str, instance: &str, x: f64, yaw: f64| {
            let (w, z) = ((yaw / 2.0).cos(), (yaw / 2.0).sin());
            format!(
                r#"{{"token": "a", "sample_token": "{sample}", "instance_token": "{instance}",
                "translation": [{x}, 5, 1.8], "size": [2, 4, 1.5], "rotation": [{w}, 0, 0, {z}], "attribute_tokens": []}}"#
            )
        };
        let annotations =
            [annotation("k1", "i1", 31.0, 3.0), annotation("k2", "i1", 36.0, -3.0), annotation("k2", "i2", 20.0, 0.0)];
        write("sample_annotation", &format!("[{}]", annotations.join(",")));
        folder
    }

    #[test]
    fn tables_give_poses_and_boxes_between_keyframes() {
        let folder = nuscenes();
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(
            (dataset.config.layout, &dataset.config.classes[..]),
            (Layout::Nuscenes, &["vehicle.car".to_string()][..])
        );
        let sequences = dataset.sequences().unwrap();
        assert_eq!(sequences[0].ids, ["scene-0001_1000000", "scene-0001_1200000", "scene-0001_1500000"]);
        assert_eq!((sequences.len(), sequences[1].name.as_str()), (2, "scene-0002"));
        assert_eq!(dataset.load("scene-0001_1200000").unwrap().cloud.values, [2.0, -1.0, 3.0, 1.0]);
        let moments = dataset.moments(&sequences[0].ids).unwrap();
        assert_eq!(moments.iter().map(|m| m.stamp_s.unwrap()).collect::<Vec<_>>(), [0.0, 0.2, 0.5]);
        for (moment, x) in moments.iter().zip([11.0, 13.0, 16.0]) {
            let pose = moment.world_from_lidar.unwrap();
            assert!((pose.translation.vector - nalgebra::Vector3::new(x, 5.0, 1.8)).norm() < 1e-9);
            assert!(pose.rotation.angle() < 1e-7, "x of the LiDAR frame is x of the car");
        }
        let boxes: Vec<Vec<Box3>> = moments.iter().map(|m| m.objects.iter().map(|o| o.bbox).collect()).collect();
        assert_eq!(boxes.iter().map(Vec::len).collect::<Vec<_>>(), [1, 1, 2], "one car appears at the second keyframe");
        // 31 m + 0.4 * 5 m in the map, seen from 13 m; the yaw goes the short way over pi.
        assert!((boxes[1][0].center[0] - 20.0).abs() < 1e-9 && boxes[1][0].size == [4.0, 2.0, 1.5]);
        let turn = 0.4 * (std::f64::consts::TAU - 6.0);
        assert!((limit_period(boxes[1][0].yaw_rad - 3.0 - turn, 0.5, 2.0 * PI)).abs() < 1e-7, "{:?}", boxes[1][0]);
        let frame = dataset.load("scene-0001_1200000").unwrap();
        assert!((frame.objects[0].bbox.center[0] - 20.0).abs() < 1e-9);
        let error = dataset.moments(&dataset.all_ids().unwrap()).unwrap_err().to_string();
        assert!(error.contains("scene-0002_9000000 is of another scene than scene-0001_1000000"), "{error}");
        assert!(dataset.load("scene-0003_1").unwrap_err().to_string().contains("no scan of the frame scene-0003_1"));
    }

    #[test]
    fn bad_tables_are_refused_by_name() {
        for (table, from, to, want) in [
            ("ego_pose", "p1000000", "p7", "ego_pose.json: has no row with the token p1000000"),
            ("scene", "s1", "s9", "scene.json: has no row with the token s1"),
            (
                "calibrated_sensor",
                "\"rotation\": [0",
                "\"rotation\": [7",
                "calibrated_sensor.json: token l: the quaternion",
            ),
            ("sample_annotation", "[2, 4, 1.5]", "[2, 0, 1.5]", "sample_annotation.json: token a: the sizes of a box"),
            ("sample_data", "\"timestamp\": 1,", "\"timestamp\": \"noon\",", "sample_data.json:1: "),
        ] {
            let folder = nuscenes();
            let path = folder.path().join(format!("v1.0-mini/{table}.json"));
            std::fs::write(&path, std::fs::read_to_string(&path).unwrap().replacen(from, to, 1)).unwrap();
            let error = Nuscenes.frame_ids(folder.path()).unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }
}
