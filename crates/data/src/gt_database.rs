//! Database for ground-truth sampling: the objects of a training split with their points. Built once and cached.

use crate::augment::GtSamplingConfig;
use crate::{DataError, Dataset, Frame, GroundHeight, Object, write_atomic};
use geometry::{Box3, points_in_boxes};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::Path;

/// An object and its points.
#[derive(Clone, Debug, PartialEq)]
pub struct GtSample {
    /// Its box, LiDAR frame; its height above the ground if the objects are pasted so.
    pub bbox: Box3,
    /// Its points with the columns of the cloud. x, y, z are relative to the centre of the box, m, axes of the LiDAR
    /// frame.
    pub points: Vec<f32>,
}

/// Objects by class, in the order of the frames they come from.
#[derive(Clone, Debug, PartialEq)]
pub struct GtDatabase {
    channels: usize,
    classes: BTreeMap<String, Vec<GtSample>>,
}

/// First bytes of a cache file. The number is increased when the format or the contents change.
const MAGIC: &[u8; 8] = b"LSGTDB01";

impl GtDatabase {
    /// Number of values per point.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// The objects of a class; empty for an unknown class.
    pub fn samples(&self, class: &str) -> &[GtSample] {
        self.classes.get(class).map_or(&[], Vec::as_slice)
    }

    /// Collects the objects of `classes` from the frames `ids`, in their order. Frames are read in parallel.
    pub fn build(
        dataset: &Dataset,
        ids: &[String],
        classes: &[String],
        config: &GtSamplingConfig,
    ) -> Result<Self, DataError> {
        let frames: Vec<Vec<(String, GtSample)>> = ids
            .par_iter()
            .map(|id| Ok(samples_of(&dataset.load(id)?, classes, config)))
            .collect::<Result<_, DataError>>()?;
        let mut database = GtDatabase { channels: dataset.config.points.channels(), classes: BTreeMap::new() };
        for (class, sample) in frames.into_iter().flatten() {
            database.classes.entry(class).or_default().push(sample);
        }
        Ok(database)
    }

    /// Reads the database from its file in `cache_folder`, or builds and writes it.
    ///
    /// The file name has a hash of everything that the contents depend on. A damaged file is built again.
    pub fn open_or_build(
        cache_folder: &Path,
        dataset: &Dataset,
        ids: &[String],
        classes: &[String],
        config: &GtSamplingConfig,
    ) -> Result<Self, DataError> {
        let path = cache_folder.join(format!("gt_database-{}.bin", cache_key(dataset, ids, classes, config)));
        if let Some(database) = std::fs::read(&path).ok().and_then(|bytes| Self::from_bytes(&bytes)) {
            return Ok(database);
        }
        let database = Self::build(dataset, ids, classes, config)?;
        write_atomic(&path, &database.to_bytes())?;
        Ok(database)
    }

    fn to_bytes(&self) -> Vec<u8> {
        let mut out = MAGIC.to_vec();
        let number = |out: &mut Vec<u8>, n: usize| out.extend((n as u64).to_le_bytes());
        number(&mut out, self.channels);
        number(&mut out, self.classes.len());
        for (class, samples) in &self.classes {
            number(&mut out, class.len());
            out.extend(class.as_bytes());
            number(&mut out, samples.len());
            for sample in samples {
                out.extend(sample.bbox.to_array().iter().flat_map(|v| v.to_le_bytes()));
                number(&mut out, sample.points.len());
                out.extend(sample.points.iter().flat_map(|v| v.to_le_bytes()));
            }
        }
        let digest = Sha256::digest(&out);
        out.extend(digest);
        out
    }

    /// The inverse of [`GtDatabase::to_bytes`]; `None` if the bytes are damaged or of another version.
    fn from_bytes(bytes: &[u8]) -> Option<Self> {
        let (body, digest) = bytes.split_at_checked(bytes.len().checked_sub(32)?)?;
        if Sha256::digest(body)[..] != *digest {
            return None;
        }
        let mut rest = body.strip_prefix(MAGIC)?;
        let channels = number(&mut rest)?;
        let mut classes = BTreeMap::new();
        for _ in 0..number(&mut rest)? {
            let length = number(&mut rest)?;
            let class = std::str::from_utf8(take(&mut rest, length)?).ok()?.to_string();
            let mut samples = Vec::new();
            for _ in 0..number(&mut rest)? {
                let values: Vec<f64> =
                    take(&mut rest, 56)?.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
                let length = number(&mut rest)?.checked_mul(4)?;
                let points =
                    take(&mut rest, length)?.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
                samples.push(GtSample { bbox: Box3::from_array(values.try_into().ok()?), points });
            }
            classes.insert(class, samples);
        }
        rest.is_empty().then_some(GtDatabase { channels, classes })
    }
}

fn take<'a>(rest: &mut &'a [u8], length: usize) -> Option<&'a [u8]> {
    let (head, tail) = rest.split_at_checked(length)?;
    *rest = tail;
    Some(head)
}

fn number(rest: &mut &[u8]) -> Option<usize> {
    u64::from_le_bytes(take(rest, 8)?.try_into().ok()?).try_into().ok()
}

fn samples_of(frame: &Frame, classes: &[String], config: &GtSamplingConfig) -> Vec<(String, GtSample)> {
    let wanted = |o: &&Object| classes.contains(&o.class) && !(config.drop_too_hard && is_too_hard(o));
    let objects: Vec<&Object> = frame.objects.iter().filter(wanted).collect();
    let boxes: Vec<Box3> = objects.iter().map(|o| o.bbox).collect();
    let members = points_in_boxes(&frame.cloud.values, frame.cloud.channels, &boxes, 1e-2);
    let ground = config.ground.as_ref().filter(|_| !objects.is_empty()).map(|g| GroundHeight::of(&frame.cloud, g));
    let sample = |(object, members): (&&Object, Vec<u32>)| {
        let mut points = Vec::with_capacity(members.len() * frame.cloud.channels);
        for k in &members {
            let p = &frame.cloud.values[*k as usize * frame.cloud.channels..][..frame.cloud.channels];
            points.extend((0..3).map(|i| (f64::from(p[i]) - object.bbox.center[i]) as f32));
            points.extend(&p[3..]);
        }
        let mut bbox = object.bbox;
        let [x, y, z] = &mut bbox.center;
        *z -= ground.as_ref().map_or(0.0, |ground| ground.at(*x, *y));
        (members.len() >= config.min_points.max(1)).then(|| (object.class.clone(), GtSample { bbox, points }))
    };
    objects.iter().zip(members).filter_map(sample).collect()
}

/// Whether an object is in none of KITTI's difficulty levels: image box lower than 25 px, occlusion above 2 or
/// truncation above 0.5. `false` if there is no image box.
fn is_too_hard(object: &Object) -> bool {
    let low = object.image_box.is_some_and(|b| b[3] - b[1] + 1.0 < 25.0);
    let hidden = object.occlusion.is_some_and(|o| o > 2) || object.truncation.is_some_and(|t| t > 0.5);
    object.image_box.is_some() && (low || hidden)
}

fn cache_key(dataset: &Dataset, ids: &[String], classes: &[String], config: &GtSamplingConfig) -> String {
    let mut key = Sha256::new();
    let root = dataset.config.root.canonicalize().unwrap_or_else(|_| dataset.config.root.clone());
    let mut text =
        format!("{MAGIC:?} {root:?} {:?} {classes:?} {} {}\n", dataset.config, config.min_points, config.drop_too_hard);
    if let Some(ground) = &config.ground {
        writeln!(text, "{ground:?}").expect("writing to a String cannot fail");
    }
    for id in ids {
        write!(text, "{id}").expect("writing to a String cannot fail");
        for path in [Some(dataset.cloud_path(id)), Some(dataset.labels_path(id)), dataset.calibration_path(id)] {
            let state = path.and_then(|path| std::fs::metadata(path).ok()).map(|m| (m.len(), m.modified().ok()));
            write!(text, " {state:?}").expect("writing to a String cannot fail");
        }
        text.push('\n');
    }
    key.update(text);
    key.finalize()[..16].iter().map(|b| format!("{b:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::augment::sample_gt;
    use crate::{Cloud, Layout, stream};
    use geometry::bev_intersection;

    /// A row of cars with twelve points each. The row is at another y in every frame.
    fn frame(row: usize, cars: usize) -> Frame {
        let mut frame = Frame { id: format!("{row:06}"), cloud: Cloud::new(4), objects: Vec::new() };
        for k in 0..cars {
            let bbox =
                Box3::from_array([6.0 * k as f64 + 8.0, 3.0 * row as f64 - 9.0, -1.0, 4.0, 1.8, 1.5, 0.1 * row as f64]);
            for i in 0..12 {
                let at = bbox.from_local([-1.8 + 0.3 * f64::from(i), 0.05 * f64::from(i), 0.02 * f64::from(i)]);
                frame.cloud.values.extend(at.map(|v| v as f32));
                frame.cloud.values.push(row as f32);
            }
            frame.objects.push(Object {
                class: "Car".into(),
                bbox,
                truncation: Some(0.0),
                occlusion: Some(0),
                image_box: None,
            });
        }
        frame
    }

    fn data_set() -> (tempfile::TempDir, Dataset, Vec<String>) {
        let folder = tempfile::tempdir().unwrap();
        for row in 0..5 {
            Layout::Kitti.write_frame(folder.path(), &frame(row, 6)).unwrap();
        }
        let dataset = Dataset::open(folder.path()).unwrap();
        let ids = dataset.all_ids().unwrap();
        (folder, dataset, ids)
    }

    #[test]
    fn the_cache_equals_the_built_database_and_damaged_files_are_rebuilt() {
        let (folder, dataset, ids) = data_set();
        let (config, classes) = (GtSamplingConfig::default(), vec!["Car".to_string()]);
        let cache = folder.path().join("cache");
        let built = GtDatabase::build(&dataset, &ids, &classes, &config).unwrap();
        assert_eq!((built.samples("Car").len(), built.samples("Van").len()), (30, 0));
        let open = || GtDatabase::open_or_build(&cache, &dataset, &ids, &classes, &config).unwrap();
        assert_eq!(open(), built);
        assert_eq!(open(), built);
        let files: Vec<_> = std::fs::read_dir(&cache).unwrap().map(|f| f.unwrap().path()).collect();
        let whole = std::fs::read(&files[0]).unwrap();
        assert_eq!(files.len(), 1);
        for damaged in [whole[..whole.len() / 2].to_vec(), Vec::new(), whole.iter().map(|b| b ^ 1).collect()] {
            std::fs::write(&files[0], damaged).unwrap();
            assert_eq!(open(), built);
            assert_eq!(std::fs::read(&files[0]).unwrap(), whole);
        }
        let fewer = GtSamplingConfig { min_points: 13, ..config.clone() };
        assert_ne!(cache_key(&dataset, &ids, &classes, &fewer), cache_key(&dataset, &ids, &classes, &config));
        assert!(GtDatabase::build(&dataset, &ids, &classes, &fewer).unwrap().samples("Car").is_empty());
    }

    #[test]
    fn pasted_objects_do_not_overlap_and_contain_only_their_points() {
        let (_folder, dataset, ids) = data_set();
        let (config, classes) = (GtSamplingConfig::default(), vec!["Car".to_string()]);
        let database = GtDatabase::build(&dataset, &ids, &classes, &config).unwrap();
        let mut scene = frame(2, 2);
        scene.objects[1].class = "Truck".into(); // objects of other classes also collide
        for x in 0..200 {
            scene.cloud.values.extend([0.3 * x as f32, -9.0, -1.0, 77.0]);
        }
        let mut pasted_ever = 0;
        for sample in 0..20 {
            let out = sample_gt(scene.clone(), &config, &database, &mut stream(1, "gt", 0, sample));
            let pasted = &out.objects[2..];
            pasted_ever += pasted.len();
            assert_eq!(out.objects[..2], scene.objects[..]);
            for (i, object) in out.objects.iter().enumerate() {
                assert!(out.objects[..i].iter().all(|o| bev_intersection(&o.bbox, &object.bbox) <= 0.0));
            }
            let boxes: Vec<_> = pasted.iter().map(|o| o.bbox).collect();
            for members in points_in_boxes(&out.cloud.values, 4, &boxes, 1e-3) {
                assert_eq!(members.len(), 12);
                assert!(
                    members
                        .iter()
                        .all(|k| (*k as usize) < 12 * pasted.len() && out.cloud.values[*k as usize * 4 + 3] != 77.0)
                );
            }
            assert_eq!(out, sample_gt(scene.clone(), &config, &database, &mut stream(1, "gt", 0, sample)));
        }
        assert!(pasted_ever > 40, "{pasted_ever}");
        let limited = GtSamplingConfig { limit_whole_scene: true, per_class: [("Car".into(), 1)].into(), ..config };
        let out = sample_gt(scene.clone(), &limited, &database, &mut stream(1, "gt", 0, 0));
        assert_eq!(out, scene);
    }

    /// The cars of the data set are 0.1 m above level ground, the scene is banked.
    #[test]
    fn pasted_objects_stand_on_the_ground() {
        let banked = |x: f64, y: f64| 3.0 + 0.02 * x + 0.2 * y;
        let with_ground = |mut frame: Frame, z: &dyn Fn(f64, f64) -> f64| {
            for i in 0..6000 {
                let (x, y) = (f64::from(i % 100) * 0.8 - 20.0, f64::from(i / 100) - 30.0);
                frame.cloud.values.extend([x as f32, y as f32, z(x, y) as f32, 0.0]);
            }
            frame
        };
        let folder = tempfile::tempdir().unwrap();
        for row in 0..5 {
            let frame = with_ground(frame(row, 6), &|_, _| -1.85);
            Layout::Kitti.write_frame(folder.path(), &frame).unwrap();
        }
        let dataset = Dataset::open(folder.path()).unwrap();
        let (ids, classes) = (dataset.all_ids().unwrap(), vec!["Car".to_string()]);
        let above = |ground: Option<crate::GroundConfig>| {
            let config = GtSamplingConfig { ground, ..GtSamplingConfig::default() };
            let database = GtDatabase::build(&dataset, &ids, &classes, &config).unwrap();
            let scene = with_ground(Frame { id: "s".into(), cloud: Cloud::new(4), objects: Vec::new() }, &banked);
            let out = sample_gt(scene, &config, &database, &mut stream(1, "gt", 0, 0));
            assert!(out.objects.len() > 3);
            let boxes: Vec<Box3> = out.objects.iter().map(|o| o.bbox).collect();
            let inside = points_in_boxes(&out.cloud.values, 4, &boxes, 1e-3);
            assert!(inside.iter().all(|members| members.len() == 12), "the points move with their boxes");
            boxes.iter().map(|b| b.z_range().0 - banked(b.center[0], b.center[1])).collect::<Vec<_>>()
        };
        assert!(above(None).iter().any(|z| z.abs() > 2.0));
        let on_ground = above(Some(crate::GroundConfig::default()));
        assert!(on_ground.iter().all(|z| (z - 0.1).abs() < 0.05), "{on_ground:?}");
    }
}
