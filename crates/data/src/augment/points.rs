//! Order and range of the points.

use crate::{Frame, Stream};
use rand::RngExt;

/// Puts the points into a random order.
pub fn shuffle_points(mut frame: Frame, stream: &mut Stream) -> Frame {
    let channels = frame.cloud.channels;
    let values = &mut frame.cloud.values;
    for last in (1..values.len() / channels).rev() {
        let other = stream.random_range(0..=last);
        for c in 0..channels {
            values.swap(last * channels + c, other * channels + c);
        }
    }
    frame
}

/// Crops a frame to `[x_min, y_min, z_min, x_max, y_max, z_max]`, m, bounds included.
///
/// Points are tested in x and y only, as OpenPCDet's mask does. Objects are kept if their centre is inside in x, y and
/// z.
pub fn crop_to_range(mut frame: Frame, range: &[f64; 6]) -> Frame {
    let low = [range[0] as f32, range[1] as f32];
    let high = [range[3] as f32, range[4] as f32];
    frame.cloud.retain(|_, p| p[0] >= low[0] && p[0] <= high[0] && p[1] >= low[1] && p[1] <= high[1]);
    frame.objects.retain(|o| (0..3).all(|i| (range[i]..=range[i + 3]).contains(&o.bbox.center[i])));
    frame
}

#[cfg(test)]
mod tests {
    use super::super::tests::{object, scene};
    use super::*;
    use crate::{Cloud, stream};

    #[test]
    fn shuffling_keeps_every_point_whole() {
        let frame = scene(5, 4);
        let shuffled = shuffle_points(frame.clone(), &mut stream(1, "s", 0, 0));
        let sorted = |f: &Frame| {
            let mut points: Vec<_> =
                f.cloud.points().map(|p| p.iter().map(|v| v.to_bits()).collect::<Vec<_>>()).collect();
            points.sort();
            points
        };
        assert_ne!(frame.cloud, shuffled.cloud);
        assert_eq!(sorted(&frame), sorted(&shuffled));
    }

    #[test]
    fn points_are_cropped_in_x_and_y_and_boxes_in_x_y_and_z() {
        let frame = Frame {
            id: "a".into(),
            cloud: Cloud { values: vec![0.0, 0.0, 9.0, 10.0, 5.0, 0.0, 10.1, 0.0, 0.0, 1.0, -5.1, 0.0], channels: 3 },
            objects: vec![object([1.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]), object([1.0, 0.0, 2.0, 4.0, 2.0, 1.5, 0.0])],
        };
        let cropped = crop_to_range(frame, &[0.0, -5.0, -1.0, 10.0, 5.0, 1.0]);
        assert_eq!(cropped.cloud.values, [0.0, 0.0, 9.0, 10.0, 5.0, 0.0]);
        assert_eq!(cropped.objects.len(), 1);
    }
}
