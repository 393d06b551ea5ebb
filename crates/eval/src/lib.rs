//! Boxes in, numbers out: KITTI average precision and recall.
