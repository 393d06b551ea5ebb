//! Clouds and boxes as the bytes of numpy arrays. The package makes arrays of them and gives arrays as bytes.
//!
//! The crate `numpy` is not used: it turns on features of `ndarray`, with which burn, whose numbers are pinned to the
//! bit, would be built in another form. The bytes are copied instead.

use crate::errors::with_place;
use data::{Cloud, FARTHEST_M};
use geometry::Box3;
use pyo3::prelude::*;
use pyo3::types::PyByteArray;

/// The bytes of values, little-endian.
pub fn bytes_of<'py, const N: usize, T: Copy>(
    py: Python<'py>,
    values: &[T],
    little: impl Fn(T) -> [u8; N],
) -> Bound<'py, PyByteArray> {
    let bytes: Vec<u8> = values.iter().flat_map(|v| little(*v)).collect();
    PyByteArray::new(py, &bytes)
}

/// A cloud as the bytes of an array N x channels of float32, and its channels.
pub fn array_of<'py>(py: Python<'py>, cloud: &Cloud) -> (Bound<'py, PyByteArray>, usize) {
    (bytes_of(py, &cloud.values, f32::to_le_bytes), cloud.channels)
}

/// The bytes of an array N x channels of float32 as a cloud.
///
/// # Errors
/// Another number of columns, no points, values that are not finite, and coordinates beyond 10 km.
pub fn cloud_of(py: Python<'_>, bytes: &[u8], channels: usize) -> PyResult<Cloud> {
    let wrong = |text: String| Err(with_place(py, &text, None));
    if !(3..=4).contains(&channels) {
        return wrong(format!("points have {channels} columns; give N x 3 (x y z) or N x 4 (x y z intensity)"));
    }
    if bytes.is_empty() || !bytes.len().is_multiple_of(channels * 4) {
        return wrong("points are empty; give at least one point".into());
    }
    let values: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    let is_bad = |p: &[f32]| p.iter().any(|v| !v.is_finite()) || p[..3].iter().any(|v| v.abs() > FARTHEST_M);
    if let Some(row) = values.chunks_exact(channels).position(is_bad) {
        return wrong(format!("points[{row}] has a value that is not finite or beyond 10 km; remove such points"));
    }
    Ok(Cloud { values, channels })
}

/// Boxes as the bytes of an array M x 7 of float64.
pub fn array_of_boxes<'py>(py: Python<'py>, boxes: &[Box3]) -> Bound<'py, PyByteArray> {
    let values: Vec<f64> = boxes.iter().flat_map(Box3::to_array).collect();
    bytes_of(py, &values, f64::to_le_bytes)
}

/// The bytes of an array M x 7 of float64 as boxes.
///
/// # Errors
/// Values that are not finite, and sizes that are not positive.
pub fn boxes_of(py: Python<'_>, bytes: &[u8]) -> PyResult<Vec<Box3>> {
    let values: Vec<f64> = bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect();
    let mut boxes = Vec::with_capacity(values.len() / 7);
    for (i, row) in values.as_chunks::<7>().0.iter().enumerate() {
        let bbox = Box3::from_array(*row);
        if row.iter().any(|v| !v.is_finite()) || bbox.size.iter().any(|v| *v <= 0.0) {
            let text = format!("boxes[{i}] has a value that is not finite or a size that is not positive");
            return Err(with_place(py, &text, None));
        }
        boxes.push(bbox);
    }
    Ok(boxes)
}
