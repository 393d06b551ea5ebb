//! Writes a synthetic street data set.

use crate::SimulateError;
use crate::street::config::RoadConfig;
use crate::street::scene::Scene;
use crate::street::sensor::scan;
use data::{DatasetConfig, Frame, LabelFrame, Layout, NewDataset, Object, PointColumns, stream};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::path::Path;

/// Schema version of the manifest.
pub const MANIFEST_SCHEMA: &str = "lidarshift/simulated-dataset/1";

/// Cars with fewer points are not labelled, as they could not be detected.
const LEAST_POINTS: usize = 5;

/// Content of the `manifest.json` written by [`make_road_dataset`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// [`MANIFEST_SCHEMA`].
    pub schema: String,
    /// Whether all frames exist. An interrupted run leaves `false` and can be resumed.
    pub complete: bool,
    /// Random seed of the scenes.
    pub seed: u64,
    /// SHA-256 of configuration, seed, numbers of frames and program version.
    pub config_sha256: String,
    /// The whole configuration.
    pub config: RoadConfig,
    /// Counts by split.
    pub splits: BTreeMap<String, SplitCounts>,
    /// SHA-256 of `frames.jsonl`, which has those of the files of each frame.
    #[serde(default)]
    pub frames_sha256: String,
    /// Builds of the program that wrote the frames; several if one of them was interrupted.
    #[serde(default)]
    pub builds: Vec<String>,
}

data::manifest!(Manifest, "from another configuration or version");

/// What a split holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct SplitCounts {
    /// Frames.
    pub frames: usize,
    /// Labelled cars.
    pub cars: usize,
    /// Points.
    pub points: usize,
}

impl SplitCounts {
    /// Sums over the frames of each split.
    pub(crate) fn of_splits<'a>(frames: impl IntoIterator<Item = (&'a str, SplitCounts)>) -> BTreeMap<String, Self> {
        let mut splits = BTreeMap::<String, SplitCounts>::new();
        for (split, counts) in frames {
            let sum = splits.entry(split.into()).or_default();
            sum.frames += counts.frames;
            sum.cars += counts.cars;
            sum.points += counts.points;
        }
        splits
    }
}

/// One frame: its cloud and the cars with at least five points on them, in the LiDAR frame.
pub fn make_road_frame(config: &RoadConfig, split: &str, index: usize) -> Frame {
    let random = |purpose: &str| stream(config.seed, &format!("road/{split}/{purpose}"), 0, index as u64);
    let scene = Scene::make(&config.scene, &config.sensor, &mut random("scene"));
    let scan = scan(&scene, &config.sensor, &mut random("sensor"));
    let seen = scene.cars.iter().zip(&scan.cars).filter(|(_, sight)| sight.points >= LEAST_POINTS);
    let objects = seen.map(|(bbox, sight)| Object {
        class: "Car".into(),
        bbox: *bbox,
        truncation: Some(0.0),
        occlusion: Some(sight.occlusion()),
        image_box: None,
    });
    Frame { id: frame_id(split, index), objects: objects.collect(), cloud: scan.cloud }
}

fn frame_id(split: &str, index: usize) -> String {
    format!("{split}_{index:06}")
}

/// Writes a data set to the folder `out`: `dataset.toml`, `velodyne/`, `label_2/` (label frame "lidar"), `ImageSets/`,
/// `manifest.json`.
///
/// `progress(done, total)` is called with the number of frames, from several threads. Frames finished by an earlier
/// run with the same configuration are kept; a folder with other content is an error. The files do not depend on the
/// number of threads.
pub fn make_road_dataset(
    config: &RoadConfig,
    out: &Path,
    progress: &(dyn Fn(usize, usize) + Sync),
) -> Result<Manifest, SimulateError> {
    config.check()?;
    let mut manifest = Manifest {
        schema: MANIFEST_SCHEMA.into(),
        complete: false,
        seed: config.seed,
        config_sha256: config_sha256(config),
        config: config.clone(),
        splits: BTreeMap::new(),
        frames_sha256: String::new(),
        builds: Vec::new(),
    };
    let set = NewDataset::begin(out, Layout::Kitti, &[], &mut manifest)?;
    let splits = config.frames.splits();
    let ids = splits.map(|(split, n)| (split, (0..n).map(|i| frame_id(split, i)).collect()));
    set.describe(dataset_config(), ids)?;
    let frames: Vec<(&str, usize)> =
        splits.into_iter().flat_map(|(split, n)| (0..n).map(move |i| (split, i))).collect();
    let counts = set.make_frames(&frames, progress, |_, (split, index)| {
        Ok::<_, SimulateError>((*split, make_frame_file(config, &set, split, *index)?))
    })?;
    manifest.splits = SplitCounts::of_splits(counts);
    let ids: Vec<String> = frames.iter().map(|(split, index)| frame_id(split, *index)).collect();
    set.finish(&mut manifest, &ids)?;
    Ok(manifest)
}

/// Writes one frame unless it is there; returns its counts.
fn make_frame_file(
    config: &RoadConfig,
    set: &NewDataset,
    split: &str,
    index: usize,
) -> Result<SplitCounts, SimulateError> {
    let id = frame_id(split, index);
    let (layout, root) = (set.layout(), set.root());
    let files = || vec![layout.cloud_path(root, &id), layout.labels_path(root, &id)];
    set.frame(&id, None, files, || layout.write_frame(root, &make_road_frame(config, split, index)))?;
    let [points, cars] = set.count(&id, PointColumns::Xyzi)?;
    Ok(SplitCounts { frames: 1, cars, points })
}

fn config_sha256(config: &RoadConfig) -> String {
    let text = serde_json::to_string(config).expect("a configuration is plain data");
    let digest = Sha256::digest(format!("{}\n{text}", env!("CARGO_PKG_VERSION")));
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn dataset_config() -> DatasetConfig {
    DatasetConfig {
        name: "synthetic-road".into(),
        points: PointColumns::Xyzi,
        label_frame: LabelFrame::Lidar,
        classes: vec!["Car".into()],
        ..DatasetConfig::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::FrameCounts;
    use data::Dataset;

    fn small(seed: u64) -> RoadConfig {
        RoadConfig { seed, frames: FrameCounts { train: 4, val: 2, test: 2 }, ..RoadConfig::default() }
    }

    /// All files below a folder with their bytes, by path.
    fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
        let (mut open, mut found) = (vec![root.to_owned()], BTreeMap::new());
        while let Some(folder) = open.pop() {
            for entry in std::fs::read_dir(folder).unwrap() {
                let path = entry.unwrap().path();
                if path.is_dir() {
                    open.push(path);
                } else {
                    let name = path.strip_prefix(root).unwrap().display().to_string();
                    found.insert(name, std::fs::read(path).unwrap());
                }
            }
        }
        found
    }

    fn make(config: &RoadConfig, out: &Path, threads: usize) -> Result<Manifest, SimulateError> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| make_road_dataset(config, out, &|_, _| ()))
    }

    #[test]
    fn same_bytes_for_any_number_of_threads_and_after_a_stop() {
        let folder = tempfile::tempdir().unwrap();
        let [one, four, resumed] = ["one", "four", "resumed"].map(|name| folder.path().join(name));
        let manifest = make(&small(3), &one, 1).unwrap();
        assert_eq!(make(&small(3), &four, 4).unwrap(), manifest);
        make(&small(3), &resumed, 2).unwrap();
        for lost in ["velodyne/train_000001.bin", "label_2/test_000000.txt", "dataset.toml", "ImageSets/val.txt"] {
            std::fs::remove_file(resumed.join(lost)).unwrap();
        }
        assert_eq!(make(&small(3), &resumed, 2).unwrap(), manifest);
        assert_eq!(files(&one), files(&four));
        assert_eq!(files(&one), files(&resumed));
        // Clouds and labels, splits, dataset.toml, manifest.json and frames.jsonl.
        assert_eq!(files(&one).len(), 2 * 8 + 3 + 3);
        assert!(manifest.complete && manifest.splits["train"].frames == 4 && manifest.splits["test"].cars > 0);

        let mut clouds: Vec<_> =
            files(&one).into_iter().filter(|(name, _)| name.ends_with(".bin")).map(|(_, b)| b).collect();
        clouds.sort();
        clouds.dedup();
        assert_eq!(clouds.len(), 8, "every frame is a scene of its own");
    }

    #[test]
    fn what_is_written_reads_back() {
        let folder = tempfile::tempdir().unwrap();
        make(&small(4), folder.path(), 2).unwrap();
        let dataset = Dataset::open(folder.path()).unwrap();
        assert_eq!(dataset.config.classes, ["Car"]);
        for split in ["train", "val", "test"] {
            for (index, id) in dataset.ids(split).unwrap().iter().enumerate() {
                let (read, made) = (dataset.load(id).unwrap(), make_road_frame(&small(4), split, index));
                assert_eq!(read.cloud, made.cloud);
                assert_eq!(read.objects.len(), made.objects.len());
                for (a, b) in read.objects.iter().zip(&made.objects) {
                    let (a_box, b_box) = (a.bbox.to_array(), b.bbox.to_array());
                    assert!((0..7).all(|k| (a_box[k] - b_box[k]).abs() < 0.011), "{a_box:?} {b_box:?}");
                    assert_eq!(a.occlusion, b.occlusion);
                }
            }
        }
    }

    #[test]
    fn another_folder_is_not_touched() {
        let folder = tempfile::tempdir().unwrap();
        make(&small(5), folder.path(), 2).unwrap();
        let before = files(folder.path());
        let error = make(&small(6), folder.path(), 2).unwrap_err().to_string();
        assert!(error.contains("another configuration"), "{error}");
        assert_eq!(files(folder.path()), before);

        let foreign = tempfile::tempdir().unwrap();
        std::fs::write(foreign.path().join("thesis.txt"), "").unwrap();
        assert!(make(&small(5), foreign.path(), 2).unwrap_err().to_string().contains("not empty"));
    }

    #[test]
    fn another_seed_is_another_world() {
        let config = small(7);
        assert_eq!(make_road_frame(&config, "train", 0), make_road_frame(&config, "train", 0));
        assert_ne!(make_road_frame(&config, "train", 0).cloud, make_road_frame(&small(8), "train", 0).cloud);
        assert_ne!(make_road_frame(&config, "train", 0).cloud, make_road_frame(&config, "test", 0).cloud);
    }
}
