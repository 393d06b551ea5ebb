//! Encoding of boxes relative to points (OpenPCDet: `PointResidualCoder`), and corners of boxes.
//!
//! All in f32, in the reference's order of operations. Boxes are `[x, y, z, dx, dy, dz, yaw]`, m and rad.

use super::point_head::POINT_CODE;

/// Sizes are clamped to at least this, m.
const SMALLEST_SIZE_M: f32 = 1e-5;

/// The code of a box at a point: centre offsets divided by the base diagonal and the height of a box of mean size,
/// logarithms of the size ratios, cosine and sine of the heading.
pub fn encode(bbox: [f32; 7], point: [f32; 3], mean_size: [f32; 3]) -> [f32; POINT_CODE] {
    let [x, y, z, dx, dy, dz, yaw] = bbox;
    let size = [dx, dy, dz].map(|s| s.max(SMALLEST_SIZE_M));
    let [length, width, height] = mean_size;
    let diagonal = (length * length + width * width).sqrt();
    [
        (x - point[0]) / diagonal,
        (y - point[1]) / diagonal,
        (z - point[2]) / height,
        (size[0] / length).ln(),
        (size[1] / width).ln(),
        (size[2] / height).ln(),
        yaw.cos(),
        yaw.sin(),
    ]
}

/// The box of a code at a point; the inverse of [`encode`].
pub fn decode(code: [f32; POINT_CODE], point: [f32; 3], mean_size: [f32; 3]) -> [f32; 7] {
    let [length, width, height] = mean_size;
    let diagonal = (length * length + width * width).sqrt();
    [
        code[0] * diagonal + point[0],
        code[1] * diagonal + point[1],
        code[2] * height + point[2],
        code[3].exp() * length,
        code[4].exp() * width,
        code[5].exp() * height,
        code[7].atan2(code[6]),
    ]
}

/// Signs of the eight corners along length, width and height, in OpenPCDet's order.
pub const CORNER_SIGNS: [[f32; 3]; 8] = [
    [1.0, 1.0, -1.0],
    [1.0, -1.0, -1.0],
    [-1.0, -1.0, -1.0],
    [-1.0, 1.0, -1.0],
    [1.0, 1.0, 1.0],
    [1.0, -1.0, 1.0],
    [-1.0, -1.0, 1.0],
    [-1.0, 1.0, 1.0],
];

/// The eight corners of a box.
pub fn corners(bbox: [f32; 7]) -> [[f32; 3]; 8] {
    let (sin, cos) = bbox[6].sin_cos();
    CORNER_SIGNS.map(|sign| {
        let [x, y, z] = [0, 1, 2].map(|i| bbox[3 + i] * (sign[i] / 2.0));
        [x * cos - y * sin + bbox[0], x * sin + y * cos + bbox[1], z + bbox[2]]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn decode_inverts_encode(
            center in prop::array::uniform3(-50.0f32..50.0),
            size in prop::array::uniform3(0.3f32..6.0),
            yaw in -3.1f32..3.1,
            offset in prop::array::uniform3(-3.0f32..3.0),
        ) {
            let bbox = [center[0], center[1], center[2], size[0], size[1], size[2], yaw];
            let point = [0, 1, 2].map(|i| center[i] + offset[i]);
            let back = decode(encode(bbox, point, [3.9, 1.6, 1.56]), point, [3.9, 1.6, 1.56]);
            prop_assert!((0..7).all(|i| (back[i] - bbox[i]).abs() < 1e-4), "{:?} {:?}", back, bbox);
        }

        #[test]
        fn corners_are_half_a_size_from_the_centre(yaw in -7.0f32..7.0) {
            let bbox = [1.0, 2.0, 3.0, 4.0, 2.0, 1.0, yaw];
            let solid = geometry::Box3::from_array(bbox.map(f64::from));
            for (corner, sign) in corners(bbox).iter().zip(CORNER_SIGNS) {
                let local = solid.to_local(corner.map(f64::from));
                prop_assert!((0..3).all(|i| (local[i] - solid.size[i] / 2.0 * f64::from(sign[i])).abs() < 1e-5));
            }
        }
    }

    #[test]
    fn no_size_is_zero() {
        assert!(encode([0.0; 7], [0.0; 3], [3.9, 1.6, 1.56]).iter().all(|v| v.is_finite()));
    }
}
