//! Data sets in an object store.
#![cfg(feature = "store")]

mod bucket;

use bucket::Server;
use geometry::Box3;
use lidarshift_data::augment::GtSamplingConfig;
use lidarshift_data::convert::{Conversion, Format};
use lidarshift_data::doctor::doctor;
use lidarshift_data::{Cloud, Dataset, Frame, GtDatabase, Layout, Object};
use std::path::{Path, PathBuf};
use std::sync::atomic::Ordering::Relaxed;

/// A data set in shards of two frames.
fn shards(folder: &Path) -> PathBuf {
    let kitti = folder.join("kitti");
    for i in 0..7u8 {
        let bbox = Box3::from_array([10.0, f64::from(i), -0.9, 4.0, 1.8, 1.5, 0.3]);
        let object = Object { class: "Car".into(), bbox, truncation: None, occlusion: None, image_box: None };
        let inside = (0..20).flat_map(|k| [10.0, f32::from(i), -0.9 + 0.01 * k as f32, 0.5]);
        let ground = (0..4000).flat_map(|k| [(k % 60) as f32, (k / 60) as f32 - 30.0, -1.7, 0.1]);
        let cloud = Cloud { values: inside.chain(ground).collect(), channels: 4 };
        Layout::Kitti.write_frame(&kitti, &Frame { id: format!("{i:06}"), cloud, objects: vec![object] }).unwrap();
    }
    let ids: Vec<String> = (0..5).map(|i| format!("{i:06}")).collect();
    lidarshift_data::write::write_split(&kitti.join("ImageSets/train.txt"), &ids).unwrap();
    let out = folder.join("shards");
    let source = Dataset::open(&kitti).unwrap();
    Conversion { dataset: &source, to: Format::Shards, shard_frames: 2 }.make(&out, &|_, _| ()).unwrap();
    out
}

// One test: the environment belongs to the process.
#[test]
fn data_sets_in_stores() {
    let folder = tempfile::tempdir().unwrap();
    let local_path = shards(folder.path());
    let (server, address) = Server::start();
    server.put_folder(&local_path, "town/set");
    // Without `dataset.toml` and index.
    server.put_folder(&local_path.join("shards"), "plain");
    server.objects.lock().unwrap().remove("plain/index.jsonl").unwrap();

    let open = |url: &str| Dataset::open(Path::new(url));
    let error_of = |url: &str| open(url).unwrap_err().to_string();
    let error = error_of("s3://drives/town/set");
    assert!(error.contains("s3://drives/town/set: needs credentials: set AWS_ACCESS_KEY_ID"), "{error}");
    // SAFETY: no other thread of this process reads or writes the environment now.
    unsafe {
        std::env::set_var("AWS_ACCESS_KEY_ID", "key");
        std::env::set_var("AWS_SECRET_ACCESS_KEY", "secret");
        std::env::set_var("AWS_ENDPOINT_URL", &address);
    }

    let local = Dataset::open(&local_path).unwrap();
    let (ids, classes) = (local.all_ids().unwrap(), vec!["Car".to_string()]);
    for url in ["s3://drives/town/set", "s3://drives/plain", &format!("{address}/drives/town/set")] {
        let set = open(url).unwrap();
        assert_eq!((set.config.layout, &set.config.classes), (Layout::Shards, &classes), "{url}");
        assert_eq!(set.all_ids().unwrap(), ids);
        for id in &ids {
            assert_eq!(set.load(id).unwrap(), local.load(id).unwrap(), "{url}");
        }
        assert_eq!(set.content_sha256(&ids).unwrap(), local.content_sha256(&ids).unwrap());
        let report = doctor(&set, None).unwrap();
        assert_eq!((report.frames, report.findings.len()), (7, doctor(&local, None).unwrap().findings.len()), "{url}");
    }
    let set = open("s3://drives/town/set").unwrap();
    assert_eq!(set.ids("train").unwrap(), local.ids("train").unwrap());
    let config = GtSamplingConfig::default();
    let built = GtDatabase::open_or_build(&folder.path().join("cache"), &set, &ids, &classes, &config).unwrap();
    assert_eq!(built.samples("Car").len(), 7);

    // What goes wrong for a while is repeated, and bodies that break off are continued.
    for failures in [&server.busy, &server.cut] {
        failures.store(3, Relaxed);
        assert_eq!(set.load("000003").unwrap(), local.load("000003").unwrap());
        assert_eq!(failures.load(Relaxed), 0);
    }
    // What goes wrong for ever is an error that names the object.
    server.busy.store(usize::MAX, Relaxed);
    let error = set.load("000003").unwrap_err().to_string();
    server.busy.store(0, Relaxed);
    assert!(
        error.contains("s3://drives/town/set/./shards/shard-000001.tar: cannot be read, also when repeated"),
        "{error}"
    );
    server.cut.store(usize::MAX, Relaxed);
    let error = set.load("000003").unwrap_err().to_string();
    server.cut.store(0, Relaxed);
    assert!(error.contains("shard-000001.tar: cannot be read, also when repeated"), "{error}");
    server.refused.store(403, Relaxed);
    let error = set.load("000003").unwrap_err().to_string();
    server.refused.store(0, Relaxed);
    assert!(error.contains("shard-000001.tar: the store refuses access: check AWS_ACCESS_KEY_ID"), "{error}");

    // A shard that is replaced is no mixture of both.
    let key = "town/set/shards/shard-000001.tar";
    let whole = server.objects.lock().unwrap().get(key).unwrap().clone();
    let mut other = whole.clone();
    other[600] ^= 1;
    server.objects.lock().unwrap().insert(key.into(), other);
    let error = set.load("000003").unwrap_err().to_string();
    assert!(error.contains("shard-000001.tar: was changed in the store since the data set was opened"), "{error}");
    assert_eq!(set.load("000000").unwrap(), local.load("000000").unwrap());
    let again = open("s3://drives/town/set").unwrap();
    assert_ne!(again.content_sha256(&ids).unwrap(), local.content_sha256(&ids).unwrap());
    server.objects.lock().unwrap().insert(key.into(), whole);

    for (url, wanted) in [
        ("s3://nowhere/set", "the bucket does not exist: check its name"),
        ("s3://drives/absent", "does not exist; give the folder or the TOML of a data set"),
        ("s3://", "names no bucket or server"),
        (&format!("{address}/drives/absent"), "absent/index.jsonl: does not exist in the store"),
    ] {
        let error = error_of(url);
        assert!(error.contains(wanted), "{error}, not {wanted}");
    }
}
