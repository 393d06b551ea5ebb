use super::*;
use crate::convert::{Conversion, Format};
use crate::{Cloud, Frame};
use std::fs::{File, FileTimes};

/// A data set whose files seem to be an hour old, as far as a program can make them so.
fn data_set() -> (tempfile::TempDir, Vec<String>) {
    let folder = tempfile::tempdir().unwrap();
    let ids = ["a", "b", "c"].map(String::from).to_vec();
    for id in &ids {
        let cloud = Cloud { values: vec![1.0; 8], channels: 4 };
        Layout::Kitti.write_frame(folder.path(), &Frame { id: id.clone(), cloud, objects: vec![] }).unwrap();
        write_label(folder.path(), id, "Car");
    }
    (folder, ids)
}

fn write_label(folder: &Path, id: &str, class: &str) {
    std::fs::write(folder.join(format!("label_2/{id}.txt")), format!("{class} 0 0 0 0 0 0 0 1 2 4 5 0 -1 0\n"))
        .unwrap();
}

/// An index in `cache` as a program sees it that starts an hour later, without what this process remembers.
fn later<'a>(cache: &Path, dataset: &'a Dataset) -> FrameIndex<'a> {
    open().retain(|path, _| !path.starts_with(cache));
    let mut index = FrameIndex::within(Some(cache), dataset);
    index.began += Duration::from_secs(3600);
    index
}

#[test]
fn known_frames_are_not_read_and_changed_ones_are() {
    let ((folder, ids), cache) = (data_set(), tempfile::tempdir().unwrap());
    let dataset = Dataset::open(folder.path()).unwrap();
    let read = |index: FrameIndex| {
        let mut classes = BTreeSet::new();
        ids.iter().for_each(|id| index.add_classes(id, &mut classes));
        let hashes: Vec<_> = ids.iter().map(|id| (index.cloud(id).unwrap(), index.labels(id).unwrap())).collect();
        let read = index.found.lock().unwrap().entries.len();
        index.finish(true);
        (classes.into_iter().collect::<Vec<_>>(), hashes, read)
    };
    let plain = read(FrameIndex::within(None, &dataset));
    assert_eq!((&plain.0[..], plain.2), (&["Car".to_string()][..], 0), "without a folder nothing is kept");
    // Files of this moment may change again within a tick of the clock.
    assert_eq!(read(FrameIndex::within(Some(cache.path()), &dataset)).2, 0);
    // Labels are found twice: for the classes, and for the hash before the index has them.
    let first = read(later(cache.path(), &dataset));
    assert_eq!((&first.0, &first.1, first.2), (&plain.0, &plain.1, 9));
    assert_eq!(read(later(cache.path(), &dataset)), (plain.0.clone(), plain.1.clone(), 0));
    // Another class of the same length with the old time of change: the time of status change tells.
    let path = folder.path().join("label_2/b.txt");
    let times = std::fs::metadata(&path).unwrap();
    write_label(folder.path(), "b", "Van");
    let file = File::options().write(true).open(&path).unwrap();
    file.set_times(FileTimes::new().set_modified(times.modified().unwrap())).unwrap();
    drop(file);
    let (classes, hashes, count) = read(later(cache.path(), &dataset));
    assert_eq!((&classes[..], count), (&["Car".to_string(), "Van".to_string()][..], 2));
    assert_eq!((hashes[0], hashes[1].0, hashes[2]), (plain.1[0], plain.1[1].0, plain.1[2]));
    assert_ne!(hashes[1].1, plain.1[1].1);
    // Labels that are gone, and a damaged index.
    std::fs::remove_file(&path).unwrap();
    assert_eq!(read(later(cache.path(), &dataset)).0, ["Car"]);
    let file = std::fs::read_dir(cache.path()).unwrap().next().unwrap().unwrap().path();
    let whole = std::fs::read(&file).unwrap();
    for damaged in [whole[..whole.len() / 2].to_vec(), Vec::new(), whole.iter().map(|b| b ^ 1).collect()] {
        std::fs::write(&file, damaged).unwrap();
        assert_eq!(read(later(cache.path(), &dataset)).2, 9);
        assert_eq!(read(later(cache.path(), &dataset)).2, 0);
    }
    // A folder that cannot be written is no error.
    let taken = folder.path().join("label_2/a.txt/cache");
    assert_eq!(read(later(&taken, &dataset)).2, 9);
}

#[test]
fn frames_in_shards_are_known_by_their_shard() {
    let ((folder, ids), cache) = (data_set(), tempfile::tempdir().unwrap());
    let (source, out) = (Dataset::open(folder.path()).unwrap(), folder.path().join("shards"));
    let to_shards = Conversion { dataset: &source, to: Format::Shards, shard_frames: 2 };
    to_shards.make(&out, &|_, _| ()).unwrap();
    let dataset = Dataset::open(&out).unwrap();
    let read = |index: FrameIndex| {
        let hashes: Vec<_> = ids.iter().map(|id| (index.cloud(id).unwrap(), index.labels(id).unwrap())).collect();
        let read = index.found.lock().unwrap().entries.len();
        index.finish(true);
        (hashes, read)
    };
    let first = read(later(cache.path(), &dataset));
    assert_eq!((first.1, read(later(cache.path(), &dataset))), (6, (first.0, 0)));
    let shard = std::fs::read_dir(out.join("shards")).unwrap().map(|f| f.unwrap().path());
    let shard = shard.filter(|path| path.extension().is_some_and(|e| e == "tar")).min().unwrap();
    let bytes = std::fs::read(&shard).unwrap();
    std::fs::write(&shard, bytes).unwrap();
    assert_eq!(read(later(cache.path(), &dataset)).1, 4, "the two frames of this shard");
}
