//! KITTI's calibration between the left colour camera and the LiDAR, in f64.
//!
//! The camera frame is KITTI's rectified one: x right, y down, z forward. Conventions are those of OpenPCDet's
//! `calibration_kitti.py` and `box_utils.py`.

use crate::{DataError, LabelBox};
use geometry::{Box3, limit_period};
use std::f64::consts::{FRAC_PI_2, PI};
use std::path::Path;

type Rows3x4 = [[f64; 4]; 3];

/// Calibration of one frame: camera intrinsics and the pose of the LiDAR in the camera frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Calibration {
    /// Projection matrix `P2`: from the rectified camera frame, m, to homogeneous pixel coordinates.
    pub image_from_cam: Rows3x4,
    /// `R0_rect * Tr_velo_to_cam`: from the LiDAR frame to the rectified camera frame, m.
    pub cam_from_lidar: Rows3x4,
    lidar_from_cam: Rows3x4,
}

impl Calibration {
    /// Reads a file of KITTI's `calib` folder.
    pub fn read(path: &Path) -> Result<Self, DataError> {
        Self::parse(&crate::limits::read_text(path)?, path)
    }

    /// Parses lines of the form `KEY: numbers`. `P2`, `R0_rect` and `Tr_velo_to_cam` are required, other keys are
    /// ignored. `path` is used in error messages.
    pub fn parse(text: &str, path: &Path) -> Result<Self, DataError> {
        let p2 = entry::<12>(text, path, "P2")?;
        let r0 = entry::<9>(text, path, "R0_rect")?;
        let tr = entry::<12>(text, path, "Tr_velo_to_cam")?;
        let image_from_cam = rows(&p2);
        if image_from_cam[0][0] <= 0.0 || image_from_cam[1][1] <= 0.0 {
            return Err(DataError::file(path, "P2: both focal lengths must be positive"));
        }
        let tr = rows(&tr);
        let rect = [[r0[0], r0[1], r0[2]], [r0[3], r0[4], r0[5]], [r0[6], r0[7], r0[8]]];
        for (name, r) in [("R0_rect", rect), ("Tr_velo_to_cam", tr.map(|row| [row[0], row[1], row[2]]))] {
            if !is_rotation(&r) {
                return Err(DataError::file(path, format!("{name} is not a rotation matrix")));
            }
        }
        if tr.iter().any(|row| row[3].abs() > 100.0) {
            return Err(DataError::file(path, "Tr_velo_to_cam has a translation of more than 100 m"));
        }
        let cam_from_lidar = rect.map(|row| std::array::from_fn(|c| (0..3).map(|k| row[k] * tr[k][c]).sum()));
        let lidar_from_cam = inverse(&cam_from_lidar);
        Ok(Calibration { image_from_cam, cam_from_lidar, lidar_from_cam })
    }

    /// Transforms a point from the LiDAR frame to the camera frame, m.
    pub fn cam_point(&self, point_lidar: [f64; 3]) -> [f64; 3] {
        apply(&self.cam_from_lidar, point_lidar)
    }

    /// Transforms a point from the camera frame to the LiDAR frame, m.
    pub fn lidar_point(&self, point_cam: [f64; 3]) -> [f64; 3] {
        apply(&self.lidar_from_cam, point_cam)
    }

    /// Projects a point of the camera frame to pixel coordinates `[u, v]`. Divides by z of the rectified frame, as
    /// OpenPCDet does.
    pub fn image_point(&self, point_cam: [f64; 3]) -> [f64; 2] {
        let [u, v, _] = apply(&self.image_from_cam, point_cam);
        [u / point_cam[2], v / point_cam[2]]
    }

    /// Whether a point of the LiDAR frame projects into an image of `[width, height]` px. Occlusion is not considered.
    pub fn sees(&self, point_lidar: [f64; 3], image_size: [u32; 2]) -> bool {
        let point_cam = self.cam_point(point_lidar);
        let [u, v] = self.image_point(point_cam);
        point_cam[2] >= 0.0 && u >= 0.0 && u < image_size[0].into() && v >= 0.0 && v < image_size[1].into()
    }

    /// The box of a label in [`crate::LabelFrame::Camera`], converted to the LiDAR frame.
    pub fn lidar_box(&self, line: &LabelBox) -> Box3 {
        let [h, w, l] = line.size_hwl;
        let [x, y, z] = self.lidar_point(line.location);
        let yaw_rad = limit_period(-(line.rotation_y + FRAC_PI_2), 0.5, 2.0 * PI);
        Box3 { center: [x, y, z + h / 2.0], size: [l, w, h], yaw_rad }
    }

    /// The inverse of [`Calibration::lidar_box`]: a label in [`crate::LabelFrame::Camera`].
    ///
    /// Alpha is computed; the image box is the projection clipped to an image of `[width, height]` px. Truncation and
    /// occlusion are -1 for a detection (with a score) and 0 for a label.
    pub fn camera_from_lidar_box(
        &self,
        class: &str,
        bbox: &Box3,
        score: Option<f32>,
        image_size: [u32; 2],
    ) -> LabelBox {
        let [l, w, h] = bbox.size;
        let [x, y, z] = bbox.center;
        let location = self.cam_point([x, y, z - h / 2.0]);
        let rotation_y = limit_period(-bbox.yaw_rad - FRAC_PI_2, 0.5, 2.0 * PI);
        let mut line = LabelBox::from_box(class, bbox, score);
        line.alpha = limit_period(rotation_y - (-y).atan2(x), 0.5, 2.0 * PI);
        line.size_hwl = [h, w, l];
        line.location = location;
        line.rotation_y = rotation_y;
        line.image_box = self.image_box(&line, image_size);
        line
    }

    /// Left, top, right, bottom of the projected corners of a camera-frame box, px, clipped to the image. The depth of
    /// a corner is at least 0.1 m.
    fn image_box(&self, line: &LabelBox, image_size: [u32; 2]) -> [f64; 4] {
        let [h, w, l] = line.size_hwl;
        let (s, c) = line.rotation_y.sin_cos();
        let mut bounds = [f64::INFINITY, f64::INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY];
        for corner in 0..8 {
            let half = |bit: usize, size: f64| if corner >> bit & 1 == 0 { size / 2.0 } else { -size / 2.0 };
            let (dx, dz, dy) = (half(0, l), half(1, w), if corner < 4 { 0.0 } else { -h });
            let [x, y, z] = line.location;
            let [u, v] = self.image_point([x + dx * c + dz * s, y + dy, (z - dx * s + dz * c).max(0.1)]);
            bounds = [bounds[0].min(u), bounds[1].min(v), bounds[2].max(u), bounds[3].max(v)];
        }
        let (right, bottom) = (f64::from(image_size[0]) - 1.0, f64::from(image_size[1]) - 1.0);
        [
            bounds[0].clamp(0.0, right),
            bounds[1].clamp(0.0, bottom),
            bounds[2].clamp(0.0, right),
            bounds[3].clamp(0.0, bottom),
        ]
    }
}

fn entry<const N: usize>(text: &str, path: &Path, key: &str) -> Result<[f64; N], DataError> {
    let mut found = None;
    for (i, line) in text.lines().enumerate() {
        let Some((name, numbers)) = line.split_once(':') else { continue };
        if name.trim() != key {
            continue;
        }
        let wrong = |message: String| DataError::line(path, i + 1, message);
        let values: Vec<f64> = numbers
            .split_whitespace()
            .map(|t| {
                t.parse::<f64>()
                    .ok()
                    .filter(|v| v.is_finite())
                    .ok_or_else(|| wrong(format!("{key}: {t:?} is not a number")))
            })
            .collect::<Result<_, _>>()?;
        let count = values.len();
        let values = values.try_into().map_err(|_| wrong(format!("{key} has {count} numbers, not {N}")))?;
        if found.replace(values).is_some() {
            return Err(wrong(format!("{key} occurs twice")));
        }
    }
    found.ok_or_else(|| DataError::file(path, format!("has no entry {key} (required: P2, R0_rect, Tr_velo_to_cam)")))
}

fn rows(v: &[f64; 12]) -> Rows3x4 {
    std::array::from_fn(|r| std::array::from_fn(|c| v[r * 4 + c]))
}

fn apply(m: &Rows3x4, p: [f64; 3]) -> [f64; 3] {
    m.map(|r| r[0] * p[0] + r[1] * p[1] + r[2] * p[2] + r[3])
}

fn is_rotation(r: &[[f64; 3]; 3]) -> bool {
    let dot = |a: usize, b: usize| (0..3).map(|k| r[a][k] * r[b][k]).sum::<f64>();
    let orthonormal = (0..3).all(|a| (0..3).all(|b| (dot(a, b) - if a == b { 1.0 } else { 0.0 }).abs() < 1e-2));
    orthonormal && determinant(r) > 0.0
}

fn determinant(r: &[[f64; 3]; 3]) -> f64 {
    (0..3).map(|c| r[0][c] * (r[1][(c + 1) % 3] * r[2][(c + 2) % 3] - r[1][(c + 2) % 3] * r[2][(c + 1) % 3])).sum()
}

/// Inverse of an affine transform. The left 3 x 3 part is inverted, not transposed: rotations with rounded digits are
/// not exactly orthonormal.
fn inverse(m: &Rows3x4) -> Rows3x4 {
    let a = m.map(|row| [row[0], row[1], row[2]]);
    let det = determinant(&a);
    let cofactor = |r: usize, c: usize| {
        let (r1, r2, c1, c2) = ((r + 1) % 3, (r + 2) % 3, (c + 1) % 3, (c + 2) % 3);
        a[r1][c1] * a[r2][c2] - a[r1][c2] * a[r2][c1]
    };
    std::array::from_fn(|r| {
        let row: [f64; 3] = std::array::from_fn(|c| cofactor(c, r) / det);
        let shift = -(0..3).map(|k| row[k] * m[k][3]).sum::<f64>();
        [row[0], row[1], row[2], shift]
    })
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use proptest::prelude::*;

    pub(crate) const MADE_UP: &str = "P0: 1 0 0 0 0 1 0 0 0 0 1 0\nP2: 700 0 600 45 0 700 180 0.2 0 0 1 0.003\n\
        R0_rect: 1 0 0 0 1 0 0 0 1\nTr_velo_to_cam: 0 -1 0 0.02 0 0 -1 -0.08 1 0 0 -0.27\n";

    #[test]
    fn bad_calibration_is_refused_by_name() {
        let path = Path::new("calib/000003.txt");
        let cases = [
            (MADE_UP.replace("R0_rect", "R_rect"), "000003.txt: has no entry R0_rect"),
            (MADE_UP.replace("0.27", "zero"), "000003.txt:4: Tr_velo_to_cam: \"-zero\" is not a number"),
            (MADE_UP.replace("P2: 700 ", "P2: "), "000003.txt:2: P2 has 11 numbers, not 12"),
            (MADE_UP.replace("P2: 700", "P2: nan"), "is not a number"),
            (MADE_UP.replace("R0_rect: 1", "R0_rect: 7"), "R0_rect is not a rotation matrix"),
            (format!("{MADE_UP}{MADE_UP}"), "twice"),
        ];
        for (text, want) in cases {
            let error = Calibration::parse(&text, path).unwrap_err().to_string();
            assert!(error.contains(want), "{error}");
        }
    }

    proptest! {
        #[test]
        fn boxes_round_trip_through_the_camera_frame(x in 2.0..70.0, y in -30.0..30.0, z in -2.0..2.0, yaw in -3.1..3.1) {
            let calibration = Calibration::parse(MADE_UP, Path::new("c.txt")).unwrap();
            let bbox = Box3::from_array([x, y, z, 4.0, 1.7, 1.5, yaw]);
            let line = calibration.camera_from_lidar_box("Car", &bbox, Some(0.5), [1242, 375]);
            let back = calibration.lidar_box(&line).to_array();
            for (a, b) in bbox.to_array().iter().zip(back) {
                prop_assert!((a - b).abs() < 1e-9, "{bbox:?} {back:?}");
            }
            let [left, top, right, bottom] = line.image_box;
            prop_assert!(0.0 <= left && left <= right && right <= 1241.0 && 0.0 <= top && top <= bottom && bottom <= 374.0);
        }
    }
}
