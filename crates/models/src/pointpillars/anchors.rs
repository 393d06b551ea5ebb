//! The anchor boxes of PointPillars (OpenPCDet: `AnchorGenerator`, `align_center` off).

/// The anchors of one class.
#[derive(Clone, Debug, PartialEq)]
pub struct AnchorClass {
    /// The class.
    pub name: String,
    /// Length, width, height, m.
    pub size: [f32; 3],
    /// z of the bottom face, m, LiDAR frame.
    pub bottom: f32,
    /// Headings, rad.
    pub rotations: Vec<f32>,
    /// Overlap from which an anchor is positive.
    pub matched: f32,
    /// Overlap below which an anchor is background; between the two thresholds it is ignored. Above zero.
    pub unmatched: f32,
}

/// Anchors `[x, y, z, dx, dy, dz, yaw]` on a feature map of `[height, width]` cells over `range` (`[x_min, y_min,
/// z_min, x_max, y_max, z_max]`, m, LiDAR frame).
///
/// The first and the last anchor of a row lie on the borders of the range. Positions are computed in f64 and rounded
/// once. The reference uses `torch.arange`, whose vectorised steps round twice, so some values differ by 1 ulp (58 of
/// 248 along y on the published map, by at most 4e-6 m; none along x).
///
/// # Shapes
/// `[height, width, class, rotation]`, row-major: the order of the head's channels.
pub fn anchors(range: [f32; 6], map: [usize; 2], classes: &[AnchorClass]) -> Vec<[f32; 7]> {
    let [height, width] = map;
    let (xs, ys) = (positions(range[0], range[3], width), positions(range[1], range[4], height));
    let mut anchors = Vec::with_capacity(height * width * anchors_per_cell(classes));
    for &y in &ys {
        for &x in &xs {
            for class in classes {
                let [dx, dy, dz] = class.size;
                let z = class.bottom + dz / 2.0;
                anchors.extend(class.rotations.iter().map(|&yaw| [x, y, z, dx, dy, dz, yaw]));
            }
        }
    }
    anchors
}

/// Number of anchors at one position.
pub fn anchors_per_cell(classes: &[AnchorClass]) -> usize {
    classes.iter().map(|class| class.rotations.len()).sum()
}

fn positions(min: f32, max: f32, count: usize) -> Vec<f32> {
    let (min, max) = (f64::from(min), f64::from(max));
    let step = (max - min) / count.saturating_sub(1).max(1) as f64;
    (0..count).map(|k| (min + k as f64 * step) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn class(rotations: Vec<f32>) -> AnchorClass {
        let name = String::from("Car");
        AnchorClass { name, size: [3.9, 1.6, 1.56], bottom: -1.78, rotations, matched: 0.6, unmatched: 0.45 }
    }

    #[test]
    fn order_and_corners() {
        let boxes = anchors([0.0, -2.0, -3.0, 4.0, 2.0, 1.0], [2, 3], &[class(vec![0.0, 1.57]), class(vec![0.0])]);
        assert_eq!(boxes.len(), 2 * 3 * 3);
        assert_eq!(boxes[0], [0.0, -2.0, -1.78 + 1.56 / 2.0, 3.9, 1.6, 1.56, 0.0]);
        assert_eq!(boxes[1][6], 1.57);
        assert_eq!(boxes[3][..2], [2.0, -2.0]);
        assert_eq!(boxes[17][..2], [4.0, 2.0]);
    }

    #[test]
    fn the_published_number() {
        let classes = vec![class(vec![0.0, 1.57]); 3];
        assert_eq!(anchors([0.0, -39.68, -3.0, 69.12, 39.68, 1.0], [248, 216], &classes).len(), 321_408);
    }

    #[test]
    fn a_single_cell() {
        assert_eq!(anchors([0.0, -2.0, -3.0, 4.0, 2.0, 1.0], [1, 1], &[class(vec![0.0])])[0][..2], [0.0, -2.0]);
    }
}
