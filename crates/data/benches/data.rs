//! Time to read and to augment one frame of 120,000 points. Files are in the page cache; one core is used.

use criterion::{Criterion, criterion_group, criterion_main};
use geometry::Box3;
use lidarshift_data::augment::{AugmentConfig, augment, crop_to_range};
use lidarshift_data::write::{write_bin, write_pcd};
use lidarshift_data::{Cloud, Frame, Object, PcdEncoding, PointColumns, read_cloud, stream};
use rand::RngExt;
use std::hint::black_box;

fn frame() -> Frame {
    let mut rng = stream(1, "bench", 0, 0);
    let point =
        |_| [rng.random_range(-80.0..80.0), rng.random_range(-80.0..80.0), rng.random_range(-3.0..1.0), rng.random()];
    let values: Vec<f32> = (0..120_000).flat_map(point).collect();
    let object = |i: u32| Object {
        class: "Car".into(),
        bbox: Box3::from_array([5.0 + 3.0 * f64::from(i), 0.0, -1.0, 3.9, 1.6, 1.5, 1.5]),
        truncation: None,
        occlusion: None,
        image_box: None,
    };
    Frame { id: "bench".into(), cloud: Cloud { values, channels: 4 }, objects: (0..20).map(object).collect() }
}

fn reading(c: &mut Criterion) {
    let (folder, frame) = (tempfile::tempdir().expect("a temporary folder"), frame());
    let path = |name: &str| folder.path().join(name);
    write_bin(&path("a.bin"), &frame.cloud).expect("writes");
    let encodings = [PcdEncoding::Ascii, PcdEncoding::Binary, PcdEncoding::BinaryCompressed];
    for encoding in encodings {
        write_pcd(&path(&format!("{}.pcd", encoding.keyword())), &frame.cloud, encoding).expect("writes");
    }
    for name in ["a.bin", "binary.pcd", "binary_compressed.pcd", "ascii.pcd"] {
        let path = path(name);
        c.bench_function(&format!("read {name}, 120k points"), |b| {
            b.iter(|| read_cloud(black_box(&path), PointColumns::Xyzi).expect("reads"));
        });
    }
}

fn augmenting(c: &mut Criterion) {
    let frame = frame();
    c.bench_function("augment and crop, 120k points, 20 boxes", |b| {
        let mut sample = 0;
        b.iter(|| {
            sample += 1;
            let out =
                augment(frame.clone(), &AugmentConfig::default(), None, &mut stream(1, "augment", 0, sample)).unwrap();
            crop_to_range(out, &[0.0, -39.68, -3.0, 69.12, 39.68, 1.0])
        });
    });
}

criterion_group!(benches, reading, augmenting);
criterion_main!(benches);
