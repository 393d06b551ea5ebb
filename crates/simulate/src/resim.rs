//! Applies sensor effects to existing data sets, of this simulator or any other.

use crate::SimulateError;
use crate::scenario::FRAME_S;
use data::toml_text::wrong;
use data::{DataError, Dataset, DatasetConfig, Frame, Manifest, NewDataset, PointColumns, write_atomic};
use sensor::attributes;
use sensor::cloud_scan::scan_of_cloud;
use sensor::effects::{EffectList, FrameContext, LabelledCar, Need};
use sensor::material::MaterialTable;
use sensor::rig::Rig;
use sensor::scan::Scan;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

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

impl Manifest for ResimManifest {
    const DIFFERENCE: &'static str = "with other effects, another seed or version";

    fn identity(&self) -> [&str; 2] {
        [&self.schema, &self.config_sha256]
    }

    fn set_complete(&mut self, complete: bool) {
        self.complete = complete;
    }
}

/// A data set, and what acts on it.
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
            return Err(wrong(format!("effect[{i}]"), why).into());
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
        let new = NewDataset::begin(out, source.layout, &[attributes::FOLDER], &mut manifest)?;
        self.write_descriptions(&new, &rig)?;
        if described {
            attributes::write_names(out, &rig, &materials)?;
        }
        let counts = new.make_frames(&ids, progress, |index, id| {
            self.make_frame_file(&new, index, id, &rig, &materials, described)
        })?;
        for [before, after] in counts {
            manifest.points[0] += before;
            manifest.points[1] += after;
        }
        new.finish(&mut manifest)?;
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
                    let missing: Vec<&str> =
                        needs.iter().filter(|n| !known.contains(n)).map(|n| n.description()).collect();
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
        new: &NewDataset,
        index: usize,
        id: &str,
        rig: &Rig,
        materials: &MaterialTable,
        described: bool,
    ) -> Result<[usize; 2], SimulateError> {
        let (layout, out) = (new.layout(), new.root());
        let beside = attributes::path(out, id);
        let labelled = self.dataset.has_labels();
        if !(new.has_frame(id, labelled) && (!described || beside.is_file())) {
            let (frame, scan) = self.frame(index, id, rig, materials)?;
            if frame.cloud.is_empty() {
                let message = "would be empty: the effects leave no point";
                return Err(DataError::file(&layout.cloud_path(out, id), message).into());
            }
            if labelled {
                self.write_labels(new, &frame)?;
            }
            if let (Some(from), Some(to)) = (self.dataset.calibration_path(id), layout.calibration_path(out, id))
                && from.is_file()
            {
                write_atomic(&to, &fs_err::read(from)?)?;
            }
            if described {
                write_atomic(&beside, &attributes::encode(&scan))?;
            }
            layout.write_cloud(out, id, &frame.cloud)?;
        }
        Ok([self.dataset.count_points(id)?, layout.count_points(out, id, self.dataset.config.points)?])
    }

    /// Copies labels byte by byte if no effect changed them; otherwise writes them in the label frame of the source.
    fn write_labels(&self, new: &NewDataset, frame: &Frame) -> Result<(), SimulateError> {
        let source = self.dataset.labels(&frame.id)?;
        let boxes = self.dataset.objects(&frame.id, &source)?;
        if boxes.iter().zip(&frame.objects).all(|(a, b)| a.bbox == b.bbox) {
            let path = new.layout().labels_path(new.root(), &frame.id);
            return Ok(write_atomic(&path, &fs_err::read(self.dataset.labels_path(&frame.id))?)?);
        }
        let mut labels = self.dataset.label_boxes(frame)?;
        labels.extend(source.into_iter().filter(|label| label.is_dont_care() || !label.has_box()));
        Ok(new.layout().write_labels(new.root(), &frame.id, &labels)?)
    }

    fn write_descriptions(&self, new: &NewDataset, rig: &Rig) -> Result<(), SimulateError> {
        let (source, out) = (&self.dataset.config, new.root());
        let splits = source.splits.keys().map(|name| Ok((name, self.dataset.ids(name)?)));
        let rig_path = (*rig != Rig::single()).then(|| PathBuf::from("rig.toml"));
        let config = DatasetConfig {
            name: format!("{}-resim", source.name),
            rig: rig_path.clone(),
            // Clouds were already cropped when they were read.
            fov_crop: false,
            ..source.clone()
        };
        new.describe(config, splits.collect::<Result<Vec<_>, DataError>>()?)?;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::street::{FrameCounts, RoadConfig, make_road_dataset};
    use data::LabelFrame;

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
        let list = effects(concat!(
            "[[effect]]\nkind = \"heavy_tails\"\nprobability = 0.01\nstd_m = 0.15\n",
            "[[effect]]\nkind = \"label_offset\"\nforward_m = 0.5\n"
        ));
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
        let list = effects("[[effect]]\nkind = \"beam_range_offset\"\nstd_m = 0.015\n");
        make(&dataset, &list, Some(rig), &folder.path().join("rows")).unwrap();
        let made = Dataset::open(&folder.path().join("rows")).unwrap();
        assert!(made.config.rig.is_some());
        let all = effects("[[effect]]\nkind = \"random_dropout\"\nshare = 1.0\n");
        let error = make(&dataset, &all, None, &folder.path().join("empty")).unwrap_err();
        assert!(error.contains("leave no point"), "{error}");
    }
}
