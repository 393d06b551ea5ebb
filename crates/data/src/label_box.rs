//! Labelled and detected boxes in the label frame of their data set.
//!
//! Evaluation compares boxes in the label frame. [`crate::Object`] and [`crate::Detection`] are boxes in the LiDAR
//! frame.

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
    /// KITTI's convention: x right, y down, z forward; the location is the centre of the bottom face; rotation about y.
    Camera,
    /// KITTI's columns with other meanings: the location is the centre of the box in the LiDAR frame, the rotation is
    /// the yaw, counter-clockwise from +x.
    Lidar,
}

/// A labelled or detected box in the label frame of its data set, see [`LabelFrame`].
#[derive(Clone, Debug, PartialEq)]
pub struct LabelBox {
    /// Class as in the label file.
    pub class: String,
    /// Truncation, 0 (completely in the image) to 1; -1 if not known.
    pub truncation: f64,
    /// Occlusion, 0 (visible), 1, 2 (largely occluded), 3 (unknown); -1 if not labelled.
    pub occlusion: f64,
    /// Observation angle: heading of the object relative to the ray from the camera, rad; -10 if not known.
    pub alpha: f64,
    /// Left, top, right, bottom in the image, px.
    pub image_box: [f64; 4],
    /// Height, width, length, m; all -1 if there is no 3D box.
    pub size_hwl: [f64; 3],
    /// Camera frame: centre of the bottom face; LiDAR frame: centre of the box; m. -1000 if there is no 3D box.
    pub location: [f64; 3],
    /// Camera frame: rotation about y; LiDAR frame: yaw; rad. -10 if there is no 3D box.
    pub rotation_y: f64,
    /// Confidence of a detection; larger is more confident. `None` for labels.
    pub score: Option<f64>,
    /// Track id: the same for an object in all frames of a recording; `None` if not known.
    pub track: Option<u64>,
}

impl LabelBox {
    /// Converts a box of the LiDAR frame to [`LabelFrame::Lidar`]. With a score it is a detection, without a label.
    ///
    /// There is no image: the image box is 0 0 50 50 (as OpenPCDet writes it without an image) and alpha is -10
    /// (unknown). Truncation and occlusion are 0 for labels and -1 for detections.
    pub fn from_box(class: &str, bbox: &Box3, score: Option<f32>) -> Self {
        let default = if score.is_some() { -1.0 } else { 0.0 };
        let [dx, dy, dz] = bbox.size;
        LabelBox {
            class: class.into(),
            truncation: default,
            occlusion: default,
            alpha: -10.0,
            image_box: [0.0, 0.0, 50.0, 50.0],
            size_hwl: [dz, dy, dx],
            location: bbox.center,
            rotation_y: bbox.yaw_rad,
            score: score.map(f64::from),
            track: None,
        }
    }

    /// Converts a label in [`LabelFrame::Lidar`] to a box. The inverse of [`LabelBox::from_box`].
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
