//! How much every frame may have of its own.

use crate::channels::mean::OWN;
use crate::channels::moments::Moments;
use crate::channels::own_poses::{OwnPoses, own_slide};
use crate::inference::median;
use nalgebra::SVector;
use sensor::Rig;

/// Prior variances of what every frame may have of its own. Pose: the robust scatter of the frames' poses about the
/// median of each sensor, the pitch about a line in the square of the speed where that varies. Displacement
/// over a scan: see [`own_slide`].
pub(super) fn own_scatter(rig: &Rig, poses: &[OwnPoses], select: &[usize], moments: &Moments) -> SVector<f64, OWN> {
    let least = [2e-5, 2e-5, 2e-5, 5e-4, 5e-4, 5e-4];
    let scatter = |k: usize| {
        let mut deviations = Vec::new();
        for sensor in 0..poses.first().map_or(0, Vec::len) {
            let mut values: Vec<f64> = select.iter().map(|&f| poses[f][sensor][k]).collect();
            if k == 1 && moments.speed_varies {
                let squares: Vec<f64> = select.iter().map(|&f| moments.of_frames[f].lean()).collect();
                let slope = median_slope(&squares, &values);
                values.iter_mut().zip(&squares).for_each(|(value, square)| *value -= slope * square);
            }
            let middle = median(values.clone());
            deviations.extend(values.iter().map(|v| (v - middle).abs()));
        }
        (median(deviations) / statistics::MEDIAN_OF_NORMAL).max(least[k])
    };
    let slides = rig.sensors.iter().map(own_slide);
    let slide = slides.reduce(|all, of| std::array::from_fn(|k| f64::max(all[k], of[k]))).unwrap_or_default();
    SVector::from_fn(|k, _| if k < 6 { scatter(k) } else { slide[k - 6] }.powi(2))
}

/// Slope of a line through points: the median over pairs, each of a point of the lower and one of the upper half of `x`
/// (Theil).
fn median_slope(x: &[f64], y: &[f64]) -> f64 {
    let mut order: Vec<usize> = (0..x.len()).collect();
    order.sort_by(|&a, &b| x[a].total_cmp(&x[b]));
    let (lower, upper) = order.split_at(order.len() / 2);
    let apart = lower.iter().zip(upper).filter(|(a, b)| x[**a] < x[**b]);
    median(apart.map(|(&a, &b)| (y[b] - y[a]) / (x[b] - x[a])).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slope_is_that_of_most_points() {
        let x: Vec<f64> = (0..12).map(f64::from).collect();
        let mut y: Vec<f64> = x.iter().map(|x| 3.0 - 0.5 * x).collect();
        (y[2], y[9]) = (40.0, -40.0);
        assert!((median_slope(&x, &y) + 0.5).abs() < 1e-9);
        assert_eq!(median_slope(&[1.0; 4], &[0.0, 1.0, 2.0, 3.0]), 0.0);
    }
}
