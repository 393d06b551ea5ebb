//! Sampling, neighbours and regions of points against reference values, and on real scans against brute force.

use lidarshift_geometry::{Box3, TieRule, ball_query, farthest_point_sampling, roi_points, three_nearest};
use safetensors::SafeTensors;
use std::path::{Path, PathBuf};

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/../.."))
}

fn operator(name: &str) -> Vec<u8> {
    std::fs::read(root().join(format!("tests/golden/operators/{name}.safetensors"))).unwrap()
}

fn f32s(file: &SafeTensors, name: &str) -> Vec<f32> {
    let bytes = file.tensor(name).unwrap().data().to_vec();
    bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect()
}

fn points(file: &SafeTensors, name: &str) -> Vec<[f32; 3]> {
    f32s(file, name).as_chunks::<3>().0.to_vec()
}

fn indices(file: &SafeTensors, name: &str) -> Vec<u32> {
    let bytes = file.tensor(name).unwrap().data().to_vec();
    bytes.as_chunks::<8>().0.iter().map(|b| i64::from_le_bytes(*b) as u32).collect()
}

#[test]
fn farthest_point_sampling_operator() {
    let bytes = operator("furthest_point_sampling");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    for cloud in ["random", "small", "grid_ties", "duplicates", "all_equal", "near_origin"] {
        let points = points(&file, &format!("{cloud}.xyz"));
        for (rule, name) in [(TieRule::ReferenceKernel, "kernel"), (TieRule::LowestIndex, "lowest")] {
            let want = indices(&file, &format!("{cloud}.index_{name}_tie"));
            assert_eq!(farthest_point_sampling(&points, want.len(), rule), want, "{cloud}, {rule:?}");
        }
    }
}

#[test]
fn ball_query_operator() {
    let bytes = operator("ball_query");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let (cloud, centers) = (points(&file, "xyz"), points(&file, "new_xyz"));
    for (name, samples) in [("r0.3_n16", 16), ("r0.8_n32", 32)] {
        let radius_m = f32s(&file, &format!("{name}.radius"))[0];
        let want = indices(&file, &format!("{name}.index"));
        assert_eq!(ball_query(&cloud, &centers, radius_m, samples), want, "{name}");
    }
    let on_border = ball_query(&points(&file, "boundary.xyz"), &points(&file, "boundary.new_xyz"), 1.0, 4);
    assert_eq!(on_border, indices(&file, "boundary.r1_n4.index"));
}

#[test]
fn three_nearest_operator() {
    let bytes = operator("three_nn_interpolate");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let found = three_nearest(&points(&file, "unknown"), &points(&file, "known"));
    assert_eq!(found.index.as_flattened(), indices(&file, "index"));
    assert_eq!(found.distance2.as_flattened(), f32s(&file, "squared_distance"));
}

#[test]
fn roi_points_operator() {
    let bytes = operator("roipoint_pool3d");
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let rois: Vec<Box3> =
        f32s(&file, "rois").as_chunks::<7>().0.iter().map(|roi| Box3::from_array(roi.map(f64::from))).collect();
    let found = roi_points(&f32s(&file, "points"), 3, &rois, 64);
    assert_eq!(found.index, indices(&file, "index"));
    let empty: Vec<u32> = found.count.iter().map(|&count| u32::from(count == 0)).collect();
    assert_eq!(empty, indices(&file, "empty"));
}

/// Scans that may not be copied into the repository.
fn scans() -> Vec<PathBuf> {
    let folder = root().join("../shared/data/kitti/training/velodyne");
    let Ok(entries) = std::fs::read_dir(&folder) else {
        eprintln!("skipped: there is no {}", folder.display());
        return Vec::new();
    };
    let mut scans: Vec<PathBuf> = entries.map(|e| e.unwrap().path()).collect();
    scans.sort();
    scans
}

fn distance2(a: [f32; 3], b: [f32; 3]) -> f32 {
    let apart = [0, 1, 2].map(|axis| a[axis] - b[axis]);
    apart[0] * apart[0] + apart[1] * apart[1] + apart[2] * apart[2]
}

#[test]
fn real_scans_equal_plain_searches() {
    for scan in scans() {
        let bytes = std::fs::read(&scan).unwrap();
        let values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
        let cloud: Vec<[f32; 3]> = values.as_chunks::<4>().0.iter().step_by(7).map(|p| [p[0], p[1], p[2]]).collect();

        let picks = farthest_point_sampling(&cloud, 300, TieRule::LowestIndex);
        let mut nearest = vec![1e10f32; cloud.len()];
        for pair in picks.windows(2) {
            for (nearest, &p) in nearest.iter_mut().zip(&cloud) {
                *nearest = nearest.min(distance2(p, cloud[pair[0] as usize]));
            }
            let farthest = nearest.iter().copied().fold(0.0, f32::max);
            assert_eq!(nearest.iter().position(|&d| d == farthest), Some(pair[1] as usize), "{}", scan.display());
        }

        let centers: Vec<[f32; 3]> = picks.iter().map(|&i| cloud[i as usize]).collect();
        let neighbours = ball_query(&cloud, &centers, 0.5, 32);
        for (c, got) in centers.iter().zip(neighbours.chunks_exact(32)) {
            let near = (0..cloud.len()).filter(|&i| distance2(*c, cloud[i]) < 0.25).take(32);
            let mut want: Vec<u32> = near.map(|i| i as u32).collect();
            want.resize(32, want[0]);
            assert_eq!(got, want, "{}", scan.display());
        }

        let found = three_nearest(&cloud[..2000], &centers);
        for (i, p) in cloud[..2000].iter().enumerate() {
            let mut order: Vec<u32> = (0..centers.len() as u32).collect();
            order.sort_by(|&a, &b| distance2(*p, centers[a as usize]).total_cmp(&distance2(*p, centers[b as usize])));
            assert_eq!(found.index[i], order[..3], "{}", scan.display());
        }
    }
}
