//! Applies sensor effects to existing data sets, of this simulator or any other.

use crate::SimulateError;
use data::Presence as _;
use data::checksum::files_sha256;
use data::limits::{MOST_TEXT_BYTES, read_file};
use data::toml_text::wrong;
use data::write::{TRUE_LABELS, true_labels_path};
use data::{DataError, Dataset, DatasetConfig, FilePart, Frame, Layout, NewDataset, write_atomic};
use schemars::JsonSchema;
use sensor::attributes;
use sensor::effects::EffectList;
use sensor::finished::{FinishedDataset, Refusal};
use sensor::rig::Rig;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::path::{Path, PathBuf};

/// Schema version of the manifest.
pub const RESIM_MANIFEST_SCHEMA: &str = "lidarshift/resim-dataset/1";

/// Content of the `manifest.json` of a data set with effects applied.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
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
    /// SHA-256 of `frames.jsonl`, which has those of the files of each frame and of what the frame was made from.
    #[serde(default)]
    pub frames_sha256: String,
    /// Builds of the program that wrote the frames; several if one of them was interrupted.
    #[serde(default)]
    pub builds: Vec<String>,
}

data::manifest!(ResimManifest, "with other effects, another seed or version");

/// The layout in which a data set of a layout is written.
fn written_layout(of: Layout) -> Layout {
    if of.folders().is_empty() { Layout::Kitti } else { of }
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
    /// Writes the data set to the folder `out`, in the layout and label frame of the source. Of a layout that is only
    /// read, in that of KITTI.
    ///
    /// `progress(done, total)` is called with the number of frames, from several threads. Frames finished by an
    /// earlier run with the same arguments are kept if neither their files nor those that they were made from have
    /// changed; a folder with other content is an error. The files do not depend on the number of threads.
    pub fn make(&self, out: &Path, progress: &(dyn Fn(usize, usize) + Sync)) -> Result<ResimManifest, SimulateError> {
        self.effects.check()?;
        let finished = self.finished()?.for_effects(self.effects);
        if let Some(refusal) = finished.refusals(self.effects).into_iter().next() {
            let why = format!("{} {}", refusal.kind, refusal.why);
            return Err(wrong(format!("effect[{}]", refusal.index), why).into());
        }
        self.check_source(finished.rig())?;
        let source = &self.dataset.config;
        let mut manifest = ResimManifest {
            schema: RESIM_MANIFEST_SCHEMA.into(),
            complete: false,
            source: source.name.clone(),
            seed: self.seed,
            config_sha256: self.fingerprint(finished.rig()),
            frames: finished.ids().len(),
            points: [0; 2],
            frames_sha256: String::new(),
            builds: Vec::new(),
        };
        let new =
            NewDataset::begin(out, written_layout(source.layout), &[attributes::FOLDER, TRUE_LABELS], &mut manifest)?;
        self.write_descriptions(&new, finished.rig())?;
        if finished.is_described() {
            attributes::write_names(out, finished.rig(), finished.materials())?;
        }
        let counts = new.make_frames(finished.ids(), progress, |_, id| self.make_frame_file(&new, &finished, id))?;
        for [before, after] in counts {
            manifest.points[0] += before;
            manifest.points[1] += after;
        }
        new.finish(&mut manifest, finished.ids())?;
        Ok(manifest)
    }

    fn finished(&self) -> Result<FinishedDataset<'_>, SimulateError> {
        if let Some(rig) = &self.rig {
            rig.check()?;
        }
        Ok(FinishedDataset::open(self.dataset, self.rig.as_ref(), self.effects)?)
    }

    /// Effects of the list that cannot be applied to this data set.
    pub fn refused(&self) -> Result<Vec<Refusal>, SimulateError> {
        Ok(self.finished()?.refusals(self.effects))
    }

    /// Refuses a list on the measured data that it was made from, on data to which it was applied already, and for
    /// another rig.
    fn check_source(&self, rig: &Rig) -> Result<(), SimulateError> {
        let Some(made) = &self.effects.made_from else { return Ok(()) };
        let root = &self.dataset.config.root;
        let same = |path: &Path| matches!((path.canonicalize(), root.canonicalize()), (Ok(a), Ok(b)) if a == b);
        if same(&made.measured) && !same(&made.simulated) {
            let why = "is the measured data set that the list was made from; it is for the simulated one";
            return Err(DataError::file(root, format!("{why}: {}", made.simulated.display())).into());
        }
        let already = root.join("effects.toml");
        if already.may_be_file() && EffectList::read(&already)? == *self.effects {
            return Err(DataError::file(&already, "the data set was made with this list: it would act twice").into());
        }
        let own: Vec<&str> = rig.sensors.iter().map(|s| s.name.as_str()).collect();
        if own != made.sensors {
            let why = format!(
                "the list was made for the sensors {}, but the rig has {}; give that rig (--sensor)",
                made.sensors.join(", "),
                own.join(", ")
            );
            return Err(wrong("made_from.sensors", why).into());
        }
        Ok(())
    }

    /// Writes one frame unless it is there; returns its number of points before and after.
    fn make_frame_file(
        &self,
        new: &NewDataset,
        finished: &FinishedDataset,
        id: &str,
    ) -> Result<[usize; 2], SimulateError> {
        let (layout, out) = (new.layout(), new.root());
        let (beside, described) = (attributes::path(out, id), finished.is_described());
        let labelled = self.dataset.has_labels();
        let calibrations = self.dataset.calibration_path(id).zip(layout.calibration_path(out, id));
        let calibrations = calibrations.filter(|(from, _)| from.may_be_file());
        let files = || {
            let labels = labelled.then(|| layout.labels_path(out, id));
            let truth = self.dataset.true_labels_path(id).map(|_| true_labels_path(out, id));
            let calibration = calibrations.as_ref().map(|(_, to)| to.clone());
            let beside = described.then(|| beside.clone());
            [Some(layout.cloud_path(out, id)), labels, truth, calibration, beside].into_iter().flatten().collect()
        };
        new.frame(id, Some(&self.source_sha256(id)?), files, || {
            let (frame, scan) = finished.frame(self.effects, self.seed, id)?;
            if frame.cloud.is_empty() {
                let message = "would be empty: the effects leave no point";
                return Err(DataError::file(&layout.cloud_path(out, id), message).into());
            }
            if labelled {
                self.write_labels(new, &frame)?;
            }
            if let Some(truth) = self.dataset.true_labels_path(id) {
                write_atomic(&true_labels_path(out, id), &read_file(&truth, MOST_TEXT_BYTES)?)?;
            }
            if let Some((from, to)) = &calibrations {
                write_atomic(to, &read_file(from, MOST_TEXT_BYTES)?)?;
            }
            if described {
                write_atomic(&beside, &attributes::encode(&scan))?;
            }
            Ok::<(), SimulateError>(layout.write_cloud(out, id, &frame.cloud)?)
        })?;
        Ok([self.dataset.count_points(id)?, layout.count_points(out, id, self.dataset.config.points)?])
    }

    /// SHA-256 of all files of a frame of the source.
    fn source_sha256(&self, id: &str) -> Result<String, DataError> {
        let source = self.dataset;
        let labels = source.has_labels().then(|| source.labels_part(id)).transpose()?;
        let beside = attributes::path(&source.config.root, id);
        let files = source.true_labels_path(id).into_iter().chain(source.calibration_path(id)).chain([beside]);
        files_sha256([source.cloud_part(id)?].into_iter().chain(labels).chain(files.map(FilePart::from)))
    }

    /// Copies labels byte by byte if no effect changed them; otherwise writes them in the label frame of the source.
    fn write_labels(&self, new: &NewDataset, frame: &Frame) -> Result<(), SimulateError> {
        let source = self.dataset.labels(&frame.id)?;
        let boxes = self.dataset.objects(&frame.id, &source)?;
        if boxes.iter().zip(&frame.objects).all(|(a, b)| a.bbox == b.bbox) {
            let layouts = [self.dataset.config.layout, new.layout()];
            if layouts[0] != layouts[1] && layouts[0] != Layout::Shards {
                return Ok(new.layout().write_labels(new.root(), &frame.id, &source)?);
            }
            let path = new.layout().labels_path(new.root(), &frame.id);
            return Ok(write_atomic(&path, &self.dataset.labels_part(&frame.id)?.read(MOST_TEXT_BYTES)?)?);
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
            labels: None,
            true_labels: source.true_labels.as_ref().map(|_| TRUE_LABELS.into()),
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
        for (effect, want) in [
            ("kind = \"ghosts\"", "effect[0]: ghosts changes what rays meet"),
            (
                "kind = \"packet_loss\"",
                "packet_loss needs the time of each shot, which this data set does not tell; give",
            ),
            ("kind = \"material_dropout\"\nmaterials = [\"rubber\"]", "needs the material of surfaces"),
            ("kind = \"label_time_offset\"", "needs the motion of the cars"),
            ("kind = \"rain\"", "say what its intensities mean (`intensity = \"returned_light\"`"),
            ("kind = \"sensor_pose_error\"\nsensor = \"left\"", "acts on the sensor \"left\", but the rig has lidar"),
        ] {
            let list = effects(&format!("[[effect]]\n{effect}\n"));
            let error = make(&dataset, &list, None, &folder.path().join("refused")).unwrap_err();
            assert!(error.contains(want), "{error}");
        }
        let list = effects("intensity = \"returned_light\"\n[[effect]]\nkind = \"rain\"\nrate_mm_per_h = 5.0\n");
        make(&dataset, &list, None, &folder.path().join("rain")).unwrap();
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

    #[test]
    fn points_that_no_effect_touches_keep_their_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let dataset = street(&folder.path().join("street"));
        let out = folder.path().join("out");
        let list = "[[effect]]\nkind = \"range_noise\"\n[[effect]]\nkind = \"range_limits\"\nmax_m = 30.0\n";
        make(&dataset, &effects(list), None, &out).unwrap();
        let (before, after) = (
            dataset.load_cloud("train_000000").unwrap(),
            Dataset::open(&out).unwrap().load_cloud("train_000000").unwrap(),
        );
        let near = before.points().filter(|p| p[0].hypot(p[1]).hypot(p[2]) <= 30.0);
        assert!(near.flatten().copied().map(f32::to_bits).eq(after.values.iter().map(|v| v.to_bits())));
        assert!(after.len() < before.len());
    }

    #[test]
    fn a_list_of_a_diagnosis_is_for_its_simulated_data_alone() {
        let folder = tempfile::tempdir().unwrap();
        let [sim, real] = ["sim", "real"].map(|name| street(&folder.path().join(name)));
        let of = |sensors: &[&str]| {
            let made = sensor::effects::MadeFrom {
                measured: real.config.root.clone(),
                simulated: sim.config.root.clone(),
                sensors: sensors.iter().map(|s| (*s).to_owned()).collect(),
            };
            let noise = effects("[[effect]]\nkind = \"range_noise\"\nstd_m = 0.02\n").effects;
            EffectList { made_from: Some(made), ..EffectList::of(noise) }
        };
        let list = of(&["lidar"]);
        let error = make(&real, &list, None, &folder.path().join("a")).unwrap_err();
        assert!(error.contains("is the measured data set that the list was made from"), "{error}");
        let error = make(&sim, &of(&["front", "left"]), None, &folder.path().join("b")).unwrap_err();
        assert!(error.contains("made for the sensors front, left, but the rig has lidar"), "{error}");
        let once = folder.path().join("once");
        make(&sim, &list, None, &once).unwrap();
        let error = make(&Dataset::open(&once).unwrap(), &list, None, &folder.path().join("c")).unwrap_err();
        assert!(error.contains("it would act twice"), "{error}");
    }
}
