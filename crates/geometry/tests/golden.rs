//! Reference values: overlaps computed with 50 digits, and the golden tensors of the operators.

use lidarshift_geometry::{Box3, bev_intersection, bev_iou, iou_3d, rotated_nms};
use safetensors::SafeTensors;
use std::path::{Path, PathBuf};

fn golden(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden").join(path)
}

/// A box from KITTI's h w l x y z ry (camera frame, bottom centre), with the camera's x-z plane as the ground plane.
fn standing(v: &[f64]) -> Box3 {
    let [h, w, l, x, y, z, ry] = v else { panic!("seven numbers") };
    Box3 { center: [*x, *z, -y + h / 2.0], size: [*l, *w, *h], yaw_rad: -ry }
}

#[test]
fn overlap_pairs() {
    let text = std::fs::read_to_string(golden("evaluation/overlap_pairs.csv")).unwrap();
    let mut pairs = 0;
    for line in text.lines().skip(1) {
        let fields: Vec<&str> = line.split(',').collect();
        let v: Vec<f64> = fields[1..18].iter().map(|f| f.parse().unwrap()).collect();
        let (a, b) = (standing(&v[..7]), standing(&v[7..14]));
        let limit = if fields[0] == "kilometres_away" { 1e-10 } else { 1e-12 };
        for (name, got, want) in [
            ("bev_intersection", bev_intersection(&a, &b), v[14]),
            ("bev_iou", bev_iou(&a, &b), v[15]),
            ("iou_3d", iou_3d(&a, &b), v[16]),
        ] {
            assert!((got - want).abs() <= limit, "{line}\n{name}: {got} instead of {want}");
        }
        pairs += 1;
    }
    assert_eq!(pairs, 318);
}

fn f32s(file: &SafeTensors, name: &str) -> Vec<f32> {
    let bytes = file.tensor(name).unwrap().data().to_vec();
    bytes.chunks_exact(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect()
}

fn eight_byte_values(file: &SafeTensors, name: &str) -> Vec<[u8; 8]> {
    let bytes = file.tensor(name).unwrap().data().to_vec();
    bytes.chunks_exact(8).map(|b| b.try_into().unwrap()).collect()
}

fn boxes(file: &SafeTensors, name: &str) -> Vec<Box3> {
    let box3 = |v: &[f32]| Box3::from_array(std::array::from_fn(|i| f64::from(v[i])));
    f32s(file, name).chunks_exact(7).map(box3).collect()
}

#[test]
fn rotated_iou_operator() {
    let bytes = std::fs::read(golden("operators/rotated_iou.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let (a, b) = (boxes(&file, "boxes_a"), boxes(&file, "boxes_b"));
    assert_eq!(a.len(), 2000);
    let columns = ["bev_overlap", "bev_iou", "iou3d"].map(|name| eight_byte_values(&file, name));
    for i in 0..a.len() {
        let got = [bev_intersection(&a[i], &b[i]), bev_iou(&a[i], &b[i]), iou_3d(&a[i], &b[i])];
        for (got, column) in got.iter().zip(&columns) {
            let want = f64::from_le_bytes(column[i]);
            assert!((got - want).abs() <= 1e-9, "pair {i}: {got} instead of {want}\n{:?}\n{:?}", a[i], b[i]);
        }
    }
}

#[test]
fn rotated_nms_operator() {
    let bytes = std::fs::read(golden("operators/rotated_nms.safetensors")).unwrap();
    let file = SafeTensors::deserialize(&bytes).unwrap();
    let (boxes, scores) = (boxes(&file, "boxes"), f32s(&file, "scores"));
    for threshold in [0.01, 0.1, 0.5, 0.7, 0.8, 0.85] {
        let want = eight_byte_values(&file, &format!("thresh{threshold}.keep"));
        let want: Vec<usize> = want.into_iter().map(|w| u64::from_le_bytes(w) as usize).collect();
        assert_eq!(rotated_nms(&boxes, &scores, threshold), want, "threshold {threshold}");
    }
}
