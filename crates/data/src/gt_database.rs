//! Database for ground-truth sampling: the objects of a training split with their points. Built once, in a file that
//! all runs with the same frames and settings share. Boxes are in memory; points are read when an object is pasted.

use crate::augment::GtSamplingConfig;
use crate::checksum::hex;
use crate::frame_index::FrameIndex;
use crate::output::{check_writable, write_atomic_with};
use crate::source::facts;
use crate::{DataError, Dataset, FilePart, FolderLock, Frame, GroundHeight, Object};
use geometry::{Box3, points_in_boxes};
use rayon::prelude::*;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// An object. [`GtDatabase::points`] reads its points.
#[derive(Clone, Debug, PartialEq)]
pub struct GtSample {
    /// Its box, LiDAR frame; its height above the ground if the objects are pasted so.
    pub bbox: Box3,
    /// Place of its first value among the values of all objects.
    first: u64,
    /// Number of its values.
    values: u32,
}

/// Objects by class, in the order of the frames they come from.
#[derive(Debug)]
pub struct GtDatabase {
    channels: usize,
    classes: BTreeMap<String, Vec<GtSample>>,
    points: Points,
}

/// The values of all objects.
#[derive(Debug)]
enum Points {
    Memory(Vec<f32>),
    /// In a file behind [`MAGIC`]. It stays open, so that it may be replaced by another process.
    File(PathBuf, Mutex<File>),
}

/// First bytes of a cache file. The number is increased when the format or the contents change.
///
/// Then there are the values of all objects (f32), the table of the boxes, the place of the table (u64) and the SHA-256
/// of all before it. Numbers are little-endian.
const MAGIC: &[u8; 8] = b"LSGTDB02";

/// Bytes behind the table.
const END: u64 = 8 + 32;

/// Frames that are read in parallel before their objects are written.
const AT_ONCE: usize = 256;

impl GtDatabase {
    /// Number of values per point.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// The objects of a class; empty for an unknown class.
    pub fn samples(&self, class: &str) -> &[GtSample] {
        self.classes.get(class).map_or(&[], Vec::as_slice)
    }

    /// The points of an object with the columns of the cloud. x, y, z are relative to the centre of the box, m, axes of
    /// the LiDAR frame.
    ///
    /// # Errors
    /// A file that cannot be read.
    pub fn points(&self, sample: &GtSample) -> Result<Vec<f32>, DataError> {
        match &self.points {
            Points::Memory(all) => Ok(all[sample.first as usize..][..sample.values as usize].to_vec()),
            Points::File(path, file) => {
                let mut bytes = vec![0; 4 * sample.values as usize];
                let mut file = file.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                file.seek(SeekFrom::Start(MAGIC.len() as u64 + 4 * sample.first))
                    .and_then(|_| file.read_exact(&mut bytes))
                    .map_err(|e| DataError::file(path, format!("cannot be read: {e}")))?;
                Ok(bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
            }
        }
    }

    /// Collects the objects of `classes` from the frames `ids`, in their order, in memory. Frames are read in parallel.
    pub fn build(
        dataset: &Dataset,
        ids: &[String],
        classes: &[String],
        config: &GtSamplingConfig,
    ) -> Result<Self, DataError> {
        let mut all = Vec::new();
        let classes = collect(dataset, ids, classes, config, &mut |values| {
            all.extend(values);
            Ok(())
        })?;
        Ok(GtDatabase { channels: dataset.config.points.channels(), classes, points: Points::Memory(all) })
    }

    /// Opens the database in its file in `cache_folder`, or builds and writes it.
    ///
    /// The file name has a hash of everything that the contents depend on. A damaged file is built again. Of several
    /// processes that need the same file one builds it, and the others wait.
    pub fn open_or_build(
        cache_folder: &Path,
        dataset: &Dataset,
        ids: &[String],
        classes: &[String],
        config: &GtSamplingConfig,
    ) -> Result<Self, DataError> {
        let name = format!("gt_database-{}.bin", cache_key(dataset, ids, classes, config)?);
        let path = cache_folder.join(&name);
        if let Some(database) = Self::open(&path) {
            return Ok(database);
        }
        let _lock = FolderLock::wait_for(cache_folder, &format!(".{name}.lock"))?;
        if let Some(database) = Self::open(&path) {
            return Ok(database);
        }
        // Also removes old temporary files: other databases of this folder may be written now.
        check_writable(&path)?;
        let channels = dataset.config.points.channels();
        write_atomic_with(&path, |file| {
            let failed = |e: std::io::Error| DataError::file(&path, format!("cannot be written: {e}"));
            let mut out = Hashed { to: BufWriter::new(file), hash: Sha256::new(), written: 0 };
            out.write_all(MAGIC).map_err(failed)?;
            let classes = collect(dataset, ids, classes, config, &mut |values| {
                let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
                out.write_all(&bytes).map_err(failed)
            })?;
            let table_at = out.written;
            out.write_all(&table(channels, &classes)).map_err(failed)?;
            out.write_all(&table_at.to_le_bytes()).map_err(failed)?;
            let digest = out.hash.finalize();
            out.to.write_all(&digest).and_then(|()| out.to.flush()).map_err(failed)
        })?;
        Self::open(&path).ok_or_else(|| DataError::file(&path, "was written and cannot be read; is the disk sound?"))
    }

    /// Opens a file; `None` if it does not exist, is damaged or of another version.
    fn open(path: &Path) -> Option<Self> {
        let mut file = File::open(path).ok()?;
        let length = file.metadata().ok()?.len();
        let mut rest = length.checked_sub(32)?;
        // The whole file is read once and compared with its hash.
        let (mut hash, mut piece) = (Sha256::new(), vec![0; 1 << 18]);
        while rest > 0 {
            let wanted = piece.len().min(usize::try_from(rest).unwrap_or(usize::MAX));
            file.read_exact(&mut piece[..wanted]).ok()?;
            hash.update(&piece[..wanted]);
            rest -= wanted as u64;
        }
        let mut digest = [0; 32];
        file.read_exact(&mut digest).ok()?;
        if hash.finalize()[..] != digest {
            return None;
        }
        let mut magic = [0; MAGIC.len()];
        file.rewind().ok()?;
        file.read_exact(&mut magic).ok()?;
        let mut table_at = [0; 8];
        file.seek(SeekFrom::Start(length.checked_sub(END)?)).ok()?;
        file.read_exact(&mut table_at).ok()?;
        let table_at = u64::from_le_bytes(table_at);
        let table_bytes = (length - END).checked_sub(table_at)?;
        if magic != *MAGIC || table_at < MAGIC.len() as u64 {
            return None;
        }
        let mut table = vec![0; usize::try_from(table_bytes).ok()?];
        file.seek(SeekFrom::Start(table_at)).ok()?;
        file.read_exact(&mut table).ok()?;
        let (channels, classes) = parse_table(&table, (table_at - MAGIC.len() as u64) / 4)?;
        Some(GtDatabase { channels, classes, points: Points::File(path.into(), Mutex::new(file)) })
    }
}

/// Writes and hashes.
struct Hashed<W> {
    to: W,
    hash: Sha256,
    written: u64,
}

impl<W: Write> Write for Hashed<W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        let written = self.to.write(bytes)?;
        self.hash.update(&bytes[..written]);
        self.written += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.to.flush()
    }
}

/// The table of all boxes.
fn table(channels: usize, classes: &BTreeMap<String, Vec<GtSample>>) -> Vec<u8> {
    let mut out = Vec::new();
    let number = |out: &mut Vec<u8>, n: u64| out.extend(n.to_le_bytes());
    number(&mut out, channels as u64);
    number(&mut out, classes.len() as u64);
    for (class, samples) in classes {
        number(&mut out, class.len() as u64);
        out.extend(class.as_bytes());
        number(&mut out, samples.len() as u64);
        for sample in samples {
            out.extend(sample.bbox.to_array().iter().flat_map(|v| v.to_le_bytes()));
            number(&mut out, sample.first);
            number(&mut out, sample.values.into());
        }
    }
    out
}

/// The inverse of [`table`], for a file with `values` values; `None` if the bytes are no such table.
fn parse_table(mut rest: &[u8], values: u64) -> Option<(usize, BTreeMap<String, Vec<GtSample>>)> {
    let rest = &mut rest;
    let channels = number(rest)?;
    let mut classes = BTreeMap::new();
    for _ in 0..number(rest)? {
        let length = usize::try_from(number(rest)?).ok()?;
        let class = std::str::from_utf8(take(rest, length)?).ok()?.to_string();
        let mut samples = Vec::new();
        for _ in 0..number(rest)? {
            let box_values: Vec<f64> =
                take(rest, 56)?.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
            let (first, count) = (number(rest)?, u32::try_from(number(rest)?).ok()?);
            if first.checked_add(count.into())? > values {
                return None;
            }
            samples.push(GtSample { bbox: Box3::from_array(box_values.try_into().ok()?), first, values: count });
        }
        classes.insert(class, samples);
    }
    rest.is_empty().then_some((channels.try_into().ok()?, classes))
}

fn take<'a>(rest: &mut &'a [u8], length: usize) -> Option<&'a [u8]> {
    let (head, tail) = rest.split_at_checked(length)?;
    *rest = tail;
    Some(head)
}

fn number(rest: &mut &[u8]) -> Option<u64> {
    Some(u64::from_le_bytes(take(rest, 8)?.try_into().ok()?))
}

/// Passes the values of the objects of all frames to `write`, in the order of the frames; returns the objects by class.
fn collect(
    dataset: &Dataset,
    ids: &[String],
    wanted: &[String],
    config: &GtSamplingConfig,
    write: &mut dyn FnMut(&[f32]) -> Result<(), DataError>,
) -> Result<BTreeMap<String, Vec<GtSample>>, DataError> {
    let mut classes: BTreeMap<String, Vec<GtSample>> = BTreeMap::new();
    let mut first = 0;
    let index = FrameIndex::of(dataset, ids.len());
    for some in ids.chunks(AT_ONCE) {
        let of_frame = |id: &String| {
            let frame = dataset.load(id)?;
            // For the hash of the content, while the file is at hand.
            index.cloud(id)?;
            Ok(objects_of(&frame, wanted, config))
        };
        let frames: Vec<Result<Vec<Found>, DataError>> = some.par_iter().map(of_frame).collect();
        for frame in frames {
            for Found { class, bbox, points } in frame? {
                write(&points)?;
                let sample = GtSample { bbox, first, values: points.len() as u32 };
                first += points.len() as u64;
                classes.entry(class).or_default().push(sample);
            }
        }
    }
    index.finish(false);
    Ok(classes)
}

/// An object of a frame.
struct Found {
    class: String,
    bbox: Box3,
    points: Vec<f32>,
}

fn objects_of(frame: &Frame, classes: &[String], config: &GtSamplingConfig) -> Vec<Found> {
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
        (members.len() >= config.min_points.max(1)).then(|| Found { class: object.class.clone(), bbox, points })
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

/// Hash of everything that the database depends on; of files their sizes and times of change.
fn cache_key(
    dataset: &Dataset,
    ids: &[String],
    classes: &[String],
    config: &GtSamplingConfig,
) -> Result<String, DataError> {
    let mut key = Sha256::new();
    let root = dataset.config.root.canonicalize().unwrap_or_else(|_| dataset.config.root.clone());
    // The root may be written in several ways.
    let described = crate::DatasetConfig { root: PathBuf::new(), rig: None, ..dataset.config.clone() };
    let mut text =
        format!("{MAGIC:?} {root:?} {described:?} {classes:?} {} {}\n", config.min_points, config.drop_too_hard);
    if let Some(ground) = &config.ground {
        writeln!(text, "{ground:?}").expect("writing to a String cannot fail");
    }
    key.update(text);
    let of_frame = |id: &String| {
        let parts = [dataset.cloud_place(id)?, dataset.labels_place(id)?].into_iter();
        let parts = parts.chain(dataset.calibration_path(id).map(FilePart::from));
        let state = |part: FilePart| {
            let facts = facts(&part.path).ok();
            let tag = facts.as_ref().and_then(|facts| facts.tag.clone());
            (facts.map(|facts| (facts.bytes, facts.changed)), part.range, tag)
        };
        let states: Vec<_> = parts.map(state).collect();
        Ok(format!("{id} {states:?}\n"))
    };
    for some in ids.chunks(1 << 14) {
        let lines: Vec<Result<String, DataError>> = some.par_iter().map(of_frame).collect();
        for line in lines {
            key.update(line?);
        }
    }
    Ok(hex(&key.finalize()[..16]))
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
        let assert_built = |opened: GtDatabase| {
            assert!(matches!(opened.points, Points::File(..)));
            assert_eq!((opened.channels, &opened.classes), (built.channels, &built.classes));
            for sample in built.samples("Car") {
                assert_eq!(opened.points(sample).unwrap(), built.points(sample).unwrap());
                assert_eq!(opened.points(sample).unwrap().len(), 12 * 4);
            }
        };
        // Of several that need it at once one writes it.
        std::thread::scope(|scope| {
            let opened: Vec<_> = (0..4).map(|_| scope.spawn(open)).collect();
            opened.into_iter().for_each(|opened| assert_built(opened.join().unwrap()));
        });
        let files: Vec<_> = std::fs::read_dir(&cache).unwrap().map(|f| f.unwrap().path()).collect();
        let whole = std::fs::read(&files[0]).unwrap();
        assert_eq!(files.len(), 1);
        for damaged in [whole[..whole.len() / 2].to_vec(), Vec::new(), whole.iter().map(|b| b ^ 1).collect()] {
            std::fs::write(&files[0], damaged).unwrap();
            // A file that is open stays as it is.
            assert_built(open());
            assert_eq!(std::fs::read(&files[0]).unwrap(), whole);
        }
        let fewer = GtSamplingConfig { min_points: 13, ..config.clone() };
        let key = |dataset: &Dataset, config| cache_key(dataset, &ids, &classes, config).unwrap();
        assert_ne!(key(&dataset, &fewer), key(&dataset, &config));
        // The same folder by another name, and another label of one frame.
        let other_name = Dataset::open(&folder.path().join("velodyne/..")).unwrap();
        let named =
            |root: &Dataset| Dataset { config: crate::DatasetConfig { name: "same".into(), ..root.config.clone() } };
        assert_eq!(key(&named(&other_name), &config), key(&named(&dataset), &config));
        let before = key(&dataset, &config);
        std::fs::write(dataset.labels_path(&ids[3]), "").unwrap();
        assert_ne!(key(&dataset, &config), before);
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
            let out = sample_gt(scene.clone(), &config, &database, &mut stream(1, "gt", 0, sample)).unwrap();
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
            assert_eq!(out, sample_gt(scene.clone(), &config, &database, &mut stream(1, "gt", 0, sample)).unwrap());
        }
        assert!(pasted_ever > 40, "{pasted_ever}");
        let limited = GtSamplingConfig { limit_whole_scene: true, per_class: [("Car".into(), 1)].into(), ..config };
        let out = sample_gt(scene.clone(), &limited, &database, &mut stream(1, "gt", 0, 0)).unwrap();
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
            let out = sample_gt(scene, &config, &database, &mut stream(1, "gt", 0, 0)).unwrap();
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
