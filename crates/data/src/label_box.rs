//! A labelled or detected box in the convention of its label frame, and that convention.
//!
//! Evaluation compares these boxes as they are labelled. [`crate::Object`] and [`crate::Detection`] are the same boxes in the LiDAR frame.

use geometry::Box3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The class of regions in which nothing was labelled. They have an image box, but no 3D box.
pub const DONT_CARE: &str = "DontCare";

/// The sizes of an object that has no 3D box.
const NO_SIZE: [f64; 3] = [-1.0; 3];

/// The frame of labelled boxes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LabelFrame {
    /// KITTI's own convention: x right, y down, z forward; the location is the centre of the bottom; rotation about y.
    Camera,
    /// KITTI's columns, but the location is the centre of the box in the cloud's frame and the rotation is the yaw,
    /// counter-clockwise from +x.
    Lidar,
}

/// A labelled or detected box in the numbers of its label frame: see [`LabelFrame`], which holds for all boxes of a data set.
#[derive(Clone, Debug, PartialEq)]
pub struct LabelBox {
    /// Class, in the letters of the label.
    pub class: String,
    /// 0 (all of it in the image) to 1; -1 where not known.
    pub truncation: f64,
    /// 0 (visible), 1, 2 (largely occluded), 3 (unknown); -1 where not known.
    pub occlusion: f64,
    /// Direction of the object relative to the ray from the camera, rad; -10 where not known.
    pub alpha: f64,
    /// Left, top, right, bottom, px.
    pub image_box: [f64; 4],
    /// Height, width, length, m; all -1 where there is no 3D box.
    pub size_hwl: [f64; 3],
    /// Camera frame: bottom centre. LiDAR frame: centre. m; -1000 where there is no 3D box.
    pub location: [f64; 3],
    /// Camera frame: rotation about y. LiDAR frame: yaw. rad; -10 where there is no 3D box.
    pub rotation_y: f64,
    /// Confidence of a detection; larger is surer. `None` for labels.
    pub score: Option<f64>,
    /// Number of the object, the same in all frames of a recording; `None` where not known.
    pub track: Option<u64>,
}

impl LabelBox {
    /// A box of the LiDAR frame for [`LabelFrame::Lidar`]: a label without a score, a detection with one.
    ///
    /// There is no image, so the image box is 0 0 50 50 as OpenPCDet writes it then, and alpha is -10 (unknown). Truncation and
    /// occlusion are 0 for labels and -1 for detections.
    pub fn from_box(class: &str, bbox: &Box3, score: Option<f32>) -> Self {
        let seen = if score.is_some() { -1.0 } else { 0.0 };
        let [dx, dy, dz] = bbox.size;
        LabelBox {
            class: class.into(),
            truncation: seen,
            occlusion: seen,
            alpha: -10.0,
            image_box: [0.0, 0.0, 50.0, 50.0],
            size_hwl: [dz, dy, dx],
            location: bbox.center,
            rotation_y: bbox.yaw_rad,
            score: score.map(f64::from),
            track: None,
        }
    }

    /// The box of a label in [`LabelFrame::Lidar`]; the inverse of [`LabelBox::from_box`].
    pub fn lidar_box(&self) -> Box3 {
        let [h, w, l] = self.size_hwl;
        Box3 { center: self.location, size: [l, w, h], yaw_rad: self.rotation_y }
    }

    /// Whether this is a region in which nothing was labelled.
    pub fn is_dont_care(&self) -> bool {
        self.class == DONT_CARE
    }

    /// Whether there is a 3D box, not only an image box.
    pub fn has_box(&self) -> bool {
        self.size_hwl != NO_SIZE
    }
}
