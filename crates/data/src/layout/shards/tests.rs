use super::*;
use crate::convert::{Conversion, Format};
use crate::write::label_boxes;
use crate::{Dataset, Frame, Object, to_kitti_text};
use geometry::Box3;

fn frame(id: &str, points: usize) -> Frame {
    let bbox = Box3::from_array([10.5, -2.25, -0.9, 4.1, 1.7, 1.5, 0.3]);
    let object = Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None };
    let values = (0..points * 4).map(|i| i as f32 * 0.25).collect();
    Frame { id: id.into(), cloud: Cloud { values, channels: 4 }, objects: vec![object] }
}

/// A data set of five frames in KITTI's folders, and the same in shards of two.
fn made() -> (tempfile::TempDir, Dataset, Dataset) {
    let folder = tempfile::tempdir().unwrap();
    let [kitti, shards] = ["kitti", "made"].map(|name| folder.path().join(name));
    let ids = ["000000", "000001", "7", "b.c", &"n".repeat(99)].map(String::from);
    for (i, id) in ids.iter().enumerate() {
        Layout::Kitti.write_frame(&kitti, &frame(id, 3 + 50 * i)).unwrap();
    }
    crate::write::write_split(&kitti.join("ImageSets/train.txt"), &ids[1..]).unwrap();
    let kitti = Dataset::open(&kitti).unwrap();
    Conversion { dataset: &kitti, to: Format::Shards, shard_frames: 2 }.make(&shards, &|_, _| ()).unwrap();
    (folder, kitti, Dataset::open(&shards).unwrap())
}

/// A tar file of members.
fn tar_of(path: &Path, members: &[(&str, &[u8])]) {
    let mut builder = tar::Builder::new(std::fs::File::create(path).unwrap());
    for (name, bytes) in members {
        let mut header = tar::Header::new_ustar();
        header.set_size(bytes.len() as u64);
        builder.append_data(&mut header, name, *bytes).unwrap();
    }
    builder.into_inner().unwrap();
}

#[test]
fn shards_hold_the_frames_of_their_source() {
    let (_folder, kitti, shards) = made();
    assert_eq!((shards.config.layout, shards.config.classes.clone()), (Layout::Shards, vec!["Car".to_string()]));
    let ids = kitti.all_ids().unwrap();
    assert_eq!((shards.all_ids().unwrap(), shards.ids("train").unwrap()), (ids.clone(), kitti.ids("train").unwrap()));
    for id in &ids {
        assert_eq!(shards.load(id).unwrap(), kitti.load(id).unwrap());
        assert_eq!(shards.count_points(id).unwrap(), kitti.count_points(id).unwrap());
        assert_eq!(shards.cloud_part(id).unwrap().read(1 << 20).unwrap(), std::fs::read(kitti.cloud_path(id)).unwrap());
        let text = shards.labels_part(id).unwrap().read(1 << 20).unwrap();
        assert_eq!(String::from_utf8(text).unwrap(), to_kitti_text(&label_boxes(&kitti.load(id).unwrap())));
    }
    assert_ne!(shards.content_sha256(&ids[..2]).unwrap(), shards.content_sha256(&ids[1..3]).unwrap());
    let error = shards.load("000009").unwrap_err().to_string();
    assert!(error.contains("shards: has no frame \"000009\" in its .tar files"), "{error}");
    let found = DatasetConfig::of_folder(&shards.config.root).unwrap();
    assert_eq!((found.layout, found.splits.len()), (Layout::Shards, 1));
    assert!(shards.refuse_frame_folder(&shards.config.root.join("shards/new")).is_err());
}

#[test]
fn the_index_is_that_of_the_headers_and_only_a_hint() {
    let (_folder, kitti, shards) = made();
    let folder = shards.config.root.join(FOLDER);
    let (known, scanned) = (ShardIndex::open(&folder).unwrap(), ShardIndex::scan(&folder).unwrap());
    let text = std::fs::read_to_string(folder.join("index.jsonl")).unwrap();
    assert_eq!((known.to_lines(), text.clone()), (scanned.to_lines(), scanned.to_lines()));
    assert_eq!(text.lines().count(), 3);
    let ids = kitti.all_ids().unwrap();
    let read = || {
        let index = ShardIndex::open(&folder)?;
        let all = ids.iter().map(|id| index.cloud(id)?.read(MOST_CLOUD_BYTES));
        all.collect::<Result<Vec<_>, DataError>>()
    };
    let wanted = read().unwrap();
    // Lines that are torn, of another size, or with places outside are left out.
    let bytes = std::fs::metadata(folder.join(shard_name(0))).unwrap().len();
    let outside = text.replacen(",[512,", &format!(",[{bytes},"), 1);
    assert_ne!(outside, text);
    let others = [text[..text.len() - 9].to_string(), text.replace("\"bytes\":", "\"bytes\":1"), outside];
    for damaged in others.iter().map(String::as_str).chain(["", "\n{}\n"]) {
        std::fs::write(folder.join("index.jsonl"), damaged).unwrap();
        assert_eq!(read().unwrap(), wanted);
    }
    // A place inside that is not that of the member.
    std::fs::write(folder.join("index.jsonl"), text.replacen(",[512,", ",[1024,", 1)).unwrap();
    let error = read().unwrap_err().to_string();
    assert!(error.contains("shard-000000.tar") && error.contains("000000.bin is not where the index"), "{error}");
}

#[test]
fn shards_of_other_programs_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let cloud: Vec<u8> = [1f32, 2.0, 3.0, 0.5].iter().flat_map(|v| v.to_le_bytes()).collect();
    let pcd = crate::encode_pcd(&Cloud { values: vec![1.0, 2.0, 3.0], channels: 3 }, crate::PcdEncoding::Binary);
    let members: [(&str, &[u8]); 5] = [
        ("./a/b.txt", b""),
        ("./a/b.jpg", b"picture"),
        ("./a/b.bin", &cloud),
        ("without_cloud.txt", b""),
        ("._b.bin", b"note of a system"),
    ];
    tar_of(&at("0.tar"), &members);
    tar_of(&at("1.tar"), &[("c.pcd", &pcd), ("c.txt", b"")]);
    let dataset = Dataset::open(folder.path()).unwrap();
    assert_eq!((dataset.config.layout, dataset.all_ids().unwrap()), (Layout::Shards, vec!["b".into(), "c".into()]));
    assert_eq!(dataset.load("b").unwrap().cloud.values, [1.0, 2.0, 3.0, 0.5]);
    assert!(dataset.load("c").unwrap_err().to_string().contains("1.tar/c.pcd: has no intensity"));
    // A shard that is replaced is read anew when the data set is opened again.
    tar_of(&at("1.tar"), &[("d.bin", &cloud)]);
    assert!(dataset.load("c").unwrap_err().to_string().contains("the file was changed"));
    assert_eq!(Dataset::open(folder.path()).unwrap().all_ids().unwrap(), ["b", "d"]);
    assert!(dataset.load("d").unwrap_err().to_string().contains("1.tar: has no member d.txt with the labels"));
}

#[test]
fn bad_shards_are_refused_by_name() {
    let cloud = [0u8; 16];
    let open = |prepare: &dyn Fn(&Path)| {
        let folder = tempfile::tempdir().unwrap();
        prepare(folder.path());
        let set = DatasetConfig { layout: Layout::Shards, root: folder.path().into(), ..DatasetConfig::default() };
        Layout::Shards.check_root(&set.root).unwrap_err().to_string()
    };
    let twice = |folder: &Path| {
        tar_of(&folder.join("0.tar"), &[("a.bin", &cloud)]);
        tar_of(&folder.join("1.tar"), &[("a.bin", &cloud)]);
    };
    let cut = |folder: &Path| {
        let path = folder.join("0.tar");
        tar_of(&path, &[("a.bin", &[0; 5000])]);
        std::fs::File::options().write(true).open(path).unwrap().set_len(2000).unwrap();
    };
    type Prepare<'a> = &'a dyn Fn(&Path);
    let cases: [(Prepare, &str); 7] = [
        (&|_| (), "has no .tar file with members"),
        (&|folder| tar_of(&folder.join("0.tar"), &[("a.txt", b"")]), "has no .tar file with members"),
        (
            &|folder| std::fs::write(folder.join("0.tar"), "no tar at all").unwrap(),
            "0.tar: is no tar file that can be read",
        ),
        (&|folder| std::fs::write(folder.join("0.tar"), [7; 4096]).unwrap(), "0.tar: is no tar file that can be read"),
        (
            &|folder| tar_of(&folder.join("0.tar"), &[("a.bin", &cloud), ("b/a.bin", &cloud)]),
            "has the member a.bin twice",
        ),
        (&twice, "0.tar: has the frame a, which"),
        (&cut, "ends within its member a.bin: it is truncated"),
    ];
    for (prepare, wanted) in cases {
        let error = open(prepare);
        assert!(error.contains(wanted), "{error}, not {wanted}");
    }
    let folder = tempfile::tempdir().unwrap();
    let error = Layout::Shards.check_root(&folder.path().join("absent")).unwrap_err().to_string();
    assert!(error.contains("does not exist: check `root`"), "{error}");
}
