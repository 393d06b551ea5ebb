//! Applies sensor effects to existing data sets, of this simulator or any other.

use crate::SimulateError;
use crate::attributes;
use crate::cloud_scan::scan_of_cloud;
use crate::effects::{EffectList, FrameContext, LabelledCar, Need};
use crate::error::wrong;
use crate::mesh::MaterialTable;
use crate::rig::Rig;
use crate::scan::Scan;
use crate::scenario::FRAME_S;
use data::write::{label_lines, write_bin, write_dataset_toml, write_kitti_text, write_pcd, write_split};
use data::{
    DataError, Dataset, DatasetConfig, Frame, KittiLine, LabelFrame, Layout, PcdEncoding, PointColumns, write_atomic,
    write_json,
};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Schema version of the manifest.
pub const RESIM_MANIFEST_SCHEMA: &str = "lidarshift/resim-dataset/1";

/// Content of the `manifest.json` of a data set with effects applied.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ResimManifest {
    /// [`RESIM_MANIFEST_SCHEMA`].
    pub schema: String,
    /// Whether all frames exist. An interrupted run leaves `false` and can be resumed.
    pub complete: bool,
    /// Name of the source data set.
    pub source: String,
    /// Random seed of the effects.
    pub seed: u64,
    /// SHA-256 of effects, rig, seed, and program version.
    pub config_sha256: String,
    /// Number of frames.
    pub frames: usize,
    /// Points of all frames, before and after.
    pub points: [usize; 2],
}

/// A data set and the effects applied to it.
pub struct Resim<'a> {
    /// The data set.
    pub dataset: &'a Dataset,
    /// The effects.
    pub effects: &'a EffectList,
    /// Its sensor rig; `None`: the rig referenced by the data set, or a single sensor at the cloud origin.
    pub rig: Option<Rig>,
    /// Random seed.
    pub seed: u64,
}

impl Resim<'_> {
    /// Writes the data set to the folder `out`, in the layout and label frame of the source.
    ///
    /// `progress(done, total)` is called with the number of frames, from several threads. Frames finished by an
    /// earlier run with the same arguments are kept; a folder with other content is an error. The files do not depend
    /// on the number of threads.
    pub fn make(&self, out: &Path, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<ResimManifest, SimulateError> {
        self.effects.check()?;
        let source = &self.dataset.config;
        let rig = self.rig()?;
        let ids = self.dataset.all_ids()?;
        let described = attributes::path(&source.root, &ids[0]).is_file();
        let materials = if described { attributes::read_materials(&source.root)? } else { MaterialTable::default() };
        if let Some((i, why)) = self.refusals(&known_of(self.dataset, &rig, &ids[0], described)?).into_iter().next() {
            return Err(wrong(format!("effect[{i}]"), why));
        }

        let mut manifest = ResimManifest {
            schema: RESIM_MANIFEST_SCHEMA.into(),
            complete: false,
            source: source.name.clone(),
            seed: self.seed,
            config_sha256: self.fingerprint(&rig),
            frames: ids.len(),
            points: [0; 2],
        };
        let manifest_path = out.join("manifest.json");
        check_folder(out, &manifest_path, &manifest)?;
        write_json(&manifest_path, &manifest)?;
        self.write_descriptions(out, &rig)?;
        if described {
            attributes::write_names(out, &rig, &materials)?;
        }
        let done = AtomicUsize::new(0);
        progress(0, ids.len());
        let counts = ids.par_iter().enumerate().map(|(index, id)| {
            let points = self.make_frame_file(out, index, id, &rig, &materials, described)?;
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, ids.len());
            Ok(points)
        });
        for [before, after] in counts.collect::<Result<Vec<_>, SimulateError>>()? {
            manifest.points[0] += before;
            manifest.points[1] += after;
        }
        manifest.complete = true;
        write_json(&manifest_path, &manifest)?;
        Ok(manifest)
    }

    fn rig(&self) -> Result<Rig, SimulateError> {
        let rig = match (&self.rig, &self.dataset.config.rig) {
            (Some(rig), _) => rig.clone(),
            (None, Some(path)) => Rig::read(path)?,
            (None, None) => Rig::single(),
        };
        rig.check()?;
        Ok(rig)
    }

    /// Effects of the list that cannot be applied to this data set: index and reason.
    pub fn refused(&self) -> Result<Vec<(usize, String)>, SimulateError> {
        let ids = self.dataset.all_ids()?;
        let described = attributes::path(&self.dataset.config.root, &ids[0]).is_file();
        Ok(self.refusals(&known_of(self.dataset, &self.rig()?, &ids[0], described)?))
    }

    /// One frame with the effects applied; `index` is its position in name order. Returns its points and what is known
    /// about them.
    pub fn frame(
        &self,
        index: usize,
        id: &str,
        rig: &Rig,
        materials: &MaterialTable,
    ) -> Result<(Frame, Scan), SimulateError> {
        let source = self.dataset.load(id)?;
        let beside = attributes::path(&self.dataset.config.root, id);
        let mut scan = if beside.is_file() {
            let mut scan = attributes::read(&beside, rig)?;
            if scan.echoes.len() != source.cloud.len() {
                let message =
                    format!("has {} rows, but the cloud has {} points", scan.echoes.len(), source.cloud.len());
                return Err(DataError::file(&beside, message).into());
            }
            for (echo, point) in scan.echoes.iter_mut().zip(source.cloud.points()) {
                echo.intensity = point.get(3).copied().unwrap_or(0.0);
            }
            scan
        } else {
            scan_of_cloud(&source.cloud, rig).0
        };
        let car = |(number, object): (usize, &data::Object)| LabelledCar {
            number,
            true_box: object.bbox,
            label: object.bbox,
            velocity: [0.0; 3],
        };
        let mut cars: Vec<LabelledCar> = source.objects.iter().enumerate().map(car).collect();
        let before = cars.clone();
        let context = FrameContext {
            seed: self.seed,
            set: "resim",
            index: index as u64,
            time_s: index as f64 * FRAME_S,
            rig,
            materials,
            ego_velocity: [0.0; 3],
            ego_turn_rate: [0.0; 3],
            cars: &before,
            scene: None,
            world_x_rad: 0.0,
        };
        self.effects.on_cloud(&mut scan, &context);
        self.effects.on_labels(&mut cars, &context);
        let mut frame = source;
        let channels = frame.cloud.channels;
        frame.cloud = scan.cloud().with_channels(channels);
        for (object, car) in frame.objects.iter_mut().zip(&cars) {
            object.bbox = car.label;
        }
        Ok((frame, scan))
    }

    fn refusals(&self, known: &BTreeSet<Need>) -> Vec<(usize, String)> {
        let mut refused = Vec::new();
        for (i, effect) in self.effects.effects.iter().enumerate() {
            let why = match effect.model().needs() {
                None => {
                    "changes what rays meet, which a finished cloud does not tell: use it with `simulate`".to_owned()
                }
                Some(needs) => {
                    let missing: Vec<&str> = needs.iter().filter(|n| !known.contains(n)).map(|n| n.words()).collect();
                    if missing.is_empty() {
                        continue;
                    }
                    format!(
                        "needs {}, of which this data set says nothing; name its sensors with their patterns (`rig` in its TOML), or write \
                         attributes with `simulate`",
                        missing.join(" and ")
                    )
                }
            };
            refused.push((i, format!("{} {why}", effect.kind())));
        }
        refused
    }

    /// Writes one frame unless it exists; returns its number of points before and after.
    fn make_frame_file(
        &self,
        out: &Path,
        index: usize,
        id: &str,
        rig: &Rig,
        materials: &MaterialTable,
        described: bool,
    ) -> Result<[usize; 2], SimulateError> {
        let config = &self.dataset.config;
        let cloud = out.join(config.layout.cloud_folder()).join(match config.layout {
            Layout::Kitti => format!("{id}.bin"),
            Layout::S2rDad => format!("{id}.pcd"),
        });
        let label = out.join(config.layout.label_folder()).join(format!("{id}.txt"));
        let beside = attributes::path(out, id);
        let labelled = self.dataset.has_labels();
        let there = cloud.is_file() && (!labelled || label.is_file()) && (!described || beside.is_file());
        if !there {
            let (frame, scan) = self.frame(index, id, rig, materials)?;
            if frame.cloud.is_empty() {
                return Err(DataError::file(&cloud, "would be empty: the effects leave no point").into());
            }
            if labelled {
                self.write_labels(&label, id, &frame)?;
            }
            let calibration = self.dataset.calibration_path(id);
            if calibration.is_file() {
                write_atomic(&out.join("calib").join(format!("{id}.txt")), &fs_err::read(calibration)?)?;
            }
            if described {
                write_atomic(&beside, &attributes::encode(&scan))?;
            }
            match config.layout {
                Layout::Kitti => write_bin(&cloud, &frame.cloud)?,
                Layout::S2rDad => write_pcd(&cloud, &frame.cloud, PcdEncoding::Binary)?,
            }
        }
        let points = |set: &Path, columns| Ok::<usize, DataError>(data::read_cloud(set, columns)?.len());
        Ok([points(&self.dataset.cloud_path(id), config.points)?, points(&cloud, config.points)?])
    }

    /// Copies labels byte by byte if no effect changed them; otherwise writes them in the label frame of the source.
    fn write_labels(&self, path: &Path, id: &str, frame: &Frame) -> Result<(), SimulateError> {
        let source = self.dataset.labels(id)?;
        let boxes = self.dataset.objects(id, &source)?;
        if boxes.iter().zip(&frame.objects).all(|(a, b)| a.bbox == b.bbox) {
            write_atomic(path, &fs_err::read(self.dataset.labels_path(id))?)?;
            return Ok(());
        }
        let mut lines: Vec<KittiLine> = match self.dataset.config.label_frame {
            LabelFrame::Lidar => label_lines(frame),
            LabelFrame::Camera => {
                let (calibration, size) = (self.dataset.calibration(id)?, self.dataset.config.image_size);
                let line = |object: &data::Object| {
                    let mut line = calibration.camera_from_lidar_box(&object.class, &object.bbox, None, size);
                    line.truncation = object.truncation.unwrap_or(-1.0);
                    line.occlusion = object.occlusion.map_or(-1.0, f64::from);
                    line
                };
                frame.objects.iter().map(line).collect()
            }
        };
        lines.extend(source.into_iter().filter(|line| line.is_dont_care() || !line.has_box()));
        Ok(write_kitti_text(path, &lines)?)
    }

    fn write_descriptions(&self, out: &Path, rig: &Rig) -> Result<(), SimulateError> {
        let source = &self.dataset.config;
        let mut splits = std::collections::BTreeMap::new();
        for name in source.splits.keys() {
            let list = PathBuf::from(format!("ImageSets/{name}.txt"));
            write_split(&out.join(&list), &self.dataset.ids(name)?)?;
            splits.insert(name.clone(), list);
        }
        let rig_path = (*rig != Rig::single()).then(|| PathBuf::from("rig.toml"));
        let config = DatasetConfig {
            name: format!("{}-resim", source.name),
            root: ".".into(),
            splits,
            rig: rig_path.clone(),
            // Clouds were already cropped when they were read.
            fov_crop: false,
            ..source.clone()
        };
        write_dataset_toml(&out.join("dataset.toml"), &config)?;
        let to_toml = |text: Result<String, toml::ser::Error>| text.map_err(|e| wrong("", e.to_string()));
        if let Some(path) = rig_path {
            write_atomic(&out.join(path), to_toml(toml::to_string_pretty(rig))?.as_bytes())?;
        }
        Ok(write_atomic(&out.join("effects.toml"), to_toml(toml::to_string_pretty(self.effects))?.as_bytes())?)
    }

    fn fingerprint(&self, rig: &Rig) -> String {
        let text = serde_json::to_string(&(
            env!("CARGO_PKG_VERSION"),
            self.effects,
            rig,
            self.seed,
            &self.dataset.config.name,
        ))
        .expect("a configuration is plain data");
        Sha256::digest(text).iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

/// What is known about the points of a data set.
fn known_of(dataset: &Dataset, rig: &Rig, id: &str, described: bool) -> Result<BTreeSet<Need>, SimulateError> {
    if described {
        use Need::{Cars, Grid, Incidence, Material, Reflectivity, Row, Time};
        return Ok([Cars, Grid, Incidence, Material, Reflectivity, Row, Time].into());
    }
    let mut cloud = dataset.load_cloud(id)?;
    // What is known depends on the rig only; a few points are enough to check.
    cloud.values.truncate(cloud.channels);
    if dataset.config.points == PointColumns::Xyz {
        cloud = cloud.with_channels(3);
    }
    Ok(scan_of_cloud(&cloud, rig).1)
}

/// Checks that the folder is empty or was started with the same arguments.
fn check_folder(out: &Path, manifest_path: &Path, wanted: &ResimManifest) -> Result<(), SimulateError> {
    if manifest_path.is_file() {
        let text = fs_err::read_to_string(manifest_path)?;
        let found: ResimManifest =
            serde_json::from_str(&text).map_err(|e| DataError::line(manifest_path, e.line(), e.to_string()))?;
        if found.config_sha256 != wanted.config_sha256 || found.schema != wanted.schema {
            let message =
                "was made with other effects, another seed or version; choose another folder, or remove this one";
            return Err(DataError::file(out, message).into());
        }
    } else if out.is_dir() && fs_err::read_dir(out)?.next().is_some() {
        return Err(DataError::file(out, "is not empty and has no manifest.json; choose another folder").into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::{FrameCounts, RoadConfig, make_road_dataset};

    fn street(folder: &Path) -> Dataset {
        let config = RoadConfig { frames: FrameCounts { train: 2, val: 1, test: 1 }, ..RoadConfig::default() };
        make_road_dataset(&config, folder, &|_, _| ()).unwrap();
        Dataset::open(folder).unwrap()
    }

    fn effects(text: &str) -> EffectList {
        EffectList::parse(text, Path::new("e.toml")).unwrap()
    }

    fn make(dataset: &Dataset, list: &EffectList, rig: Option<Rig>, out: &Path) -> Result<ResimManifest, String> {
        Resim { dataset, effects: list, rig, seed: 5 }.make(out, &|_, _| ()).map_err(|e| e.to_string())
    }

    #[test]
    fn noise_and_dropout_on_the_clouds_of_another_simulator() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = street(&folder.path().join("street"));
        let list = effects(
            "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n[[effect]]\nkind = \"random_dropout\"\nshare = 0.25\n",
        );
        let out = folder.path().join("out");
        let manifest = make(&dataset, &list, None, &out).unwrap();
        let share = manifest.points[1] as f64 / manifest.points[0] as f64;
        assert!((share - 0.75).abs() < 0.01, "{share}");
        let made = Dataset::open(&out).unwrap();
        assert_eq!(
            (made.ids("train").unwrap(), made.config.label_frame),
            (dataset.ids("train").unwrap(), LabelFrame::Lidar)
        );
        for id in made.all_ids().unwrap() {
            assert_eq!(made.load(&id).unwrap().objects, dataset.load(&id).unwrap().objects);
        }
        // Noise only, to compare points one by one: they move along their ray.
        let noisy = folder.path().join("noisy");
        make(&dataset, &effects("[[effect]]\nkind = \"range_noise\"\nstd_m = 0.05\n"), None, &noisy).unwrap();
        let (a, b) = (
            dataset.load("train_000000").unwrap().cloud,
            Dataset::open(&noisy).unwrap().load("train_000000").unwrap().cloud,
        );
        let range = |p: &[f32]| f64::from(p[0]).hypot(p[1].into()).hypot(p[2].into());
        let off: Vec<f64> = a.points().zip(b.points()).map(|(p, q)| range(q) - range(p)).collect();
        let rms = (off.iter().map(|v| v * v).sum::<f64>() / off.len() as f64).sqrt();
        assert!((rms - 0.05).abs() < 2e-3, "{rms}");
        for (p, q) in a.points().zip(b.points()) {
            let (r, s) = (range(p), range(q));
            assert!((0..3).all(|k| (f64::from(p[k]) / r - f64::from(q[k]) / s).abs() < 1e-4) && p[3] == q[3]);
        }
    }

    #[test]
    fn the_same_bytes_again_and_after_a_stop() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = street(&folder.path().join("street"));
        let list =
            effects("[[effect]]\nkind = \"heavy_tails\"\n[[effect]]\nkind = \"label_offset\"\nforward_m = 0.5\n");
        let [one, two] = ["one", "two"].map(|n| folder.path().join(n));
        let manifest = make(&dataset, &list, None, &one).unwrap();
        make(&dataset, &list, None, &two).unwrap();
        let cloud = "velodyne/train_000001.bin";
        std::fs::remove_file(two.join(cloud)).unwrap();
        assert_eq!(make(&dataset, &list, None, &two).unwrap(), manifest);
        assert!(std::fs::read(one.join(cloud)).unwrap() == std::fs::read(two.join(cloud)).unwrap());
        let error = make(&dataset, &effects(""), None, &two).unwrap_err();
        assert!(error.contains("was made with other effects"), "{error}");
        let (before, after) =
            (dataset.load("test_000000").unwrap(), Dataset::open(&one).unwrap().load("test_000000").unwrap());
        for (a, b) in before.objects.iter().zip(&after.objects) {
            let [x, y, _] = a.bbox.to_local(b.bbox.center);
            assert!((x - 0.5).abs() < 1e-6 && y.abs() < 1e-6);
        }
    }

    #[test]
    fn what_a_cloud_does_not_tell_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = street(&folder.path().join("street"));
        for (kind, want) in [
            ("beam_divergence", "effect[0]: beam_divergence changes what rays meet"),
            ("beam_range_offset", "needs the row of each point"),
            ("material_dropout", "needs the material of surfaces"),
            ("label_time_offset", "needs the motion of the cars"),
        ] {
            let list = effects(&format!("[[effect]]\nkind = \"{kind}\"\n"));
            let error = make(&dataset, &list, None, &folder.path().join(kind)).unwrap_err();
            assert!(error.contains(want), "{error}");
        }
        // With the sensor's pattern, rows are known.
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../configs/sensors/hdl64e.toml");
        let rig = Rig::read(Path::new(path)).unwrap();
        let list = effects("[[effect]]\nkind = \"beam_range_offset\"\n");
        make(&dataset, &list, Some(rig), &folder.path().join("rows")).unwrap();
        let made = Dataset::open(&folder.path().join("rows")).unwrap();
        assert!(made.config.rig.is_some());
        let all = effects("[[effect]]\nkind = \"random_dropout\"\nshare = 1.0\n");
        let error = make(&dataset, &all, None, &folder.path().join("empty")).unwrap_err();
        assert!(error.contains("leave no point"), "{error}");
    }
}
