//! Interpolation of features from the three nearest known points (OpenPCDet: `three_interpolate`).

use crate::row_ops;
use burn::tensor::{Device, Tensor, TensorData};
use geometry::three_nearest;
use std::sync::Arc;

/// Added to distances so that the weight of a coincident point is finite, m.
const LEAST_DISTANCE_M: f32 = 1e-8;

/// Source rows and weights of the interpolation at U points.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Interpolation {
    /// Rows of the known features, nearest first. Length U.
    pub source: Vec<[u32; 3]>,
    /// Weights, which add up to 1. Length U.
    pub weight: Vec<[f32; 3]>,
    /// Squared distances, m2. Length U.
    pub distance2: Vec<[f32; 3]>,
}

impl Interpolation {
    /// Weights proportional to the inverse distance, not the inverse squared distance, as in OpenPCDet and the authors'
    /// code.
    pub fn new(unknown: &[[f32; 3]], known: &[[f32; 3]]) -> Self {
        let found = three_nearest(unknown, known);
        let weight = |distance2: &[f32; 3]| {
            let inverse = distance2.map(|d| 1.0 / (d.sqrt() + LEAST_DISTANCE_M));
            let sum = inverse[0] + inverse[1] + inverse[2];
            inverse.map(|w| w / sum)
        };
        Interpolation {
            weight: found.distance2.iter().map(weight).collect(),
            source: found.index,
            distance2: found.distance2,
        }
    }

    /// Appends that of another cloud, whose known rows begin at `first_row`.
    pub fn append(&mut self, other: &Interpolation, first_row: u32) {
        self.source.extend(other.source.iter().map(|three| three.map(|row| row + first_row)));
        self.weight.extend_from_slice(&other.weight);
        self.distance2.extend_from_slice(&other.distance2);
    }

    /// The interpolation on a device.
    pub fn to_device(&self, device: &Device) -> InterpolationTensors {
        let points = self.source.len();
        InterpolationTensors {
            source: self.source.as_flattened().into(),
            weight: Tensor::from_data(TensorData::new(self.weight.as_flattened().to_vec(), [points, 3, 1]), device),
        }
    }
}

/// [`Interpolation`] on a device.
#[derive(Clone, Debug)]
pub struct InterpolationTensors {
    /// Length U * 3.
    source: Arc<[u32]>,
    /// `[U, 3, 1]`.
    weight: Tensor<3>,
}

/// Weighted sums of known rows.
///
/// # Shapes
/// `known`: `[K, C]`; result `[U, C]`.
pub fn interpolate(known: Tensor<2>, from: &InterpolationTensors) -> Tensor<2> {
    let ([points, _, _], channels) = (from.weight.dims(), known.dims()[1]);
    let three = row_ops::gather(known, &from.source).reshape([points, 3, channels]); // [U, 3, C]
    (three * from.weight.clone()).sum_dim(1).reshape([points, channels]) // [U, C]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;

    #[test]
    fn weights_by_distance_and_their_gradient() {
        let known = [[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 6.0, 0.0], [50.0, 0.0, 0.0]];
        let mut from = Interpolation::new(&[[1.0, 0.0, 0.0], [3.0, 0.0, 0.0]], &known);
        assert_eq!(from.source, [[0, 1, 2], [1, 0, 2]]);
        let sum: f32 = from.weight[0].iter().sum();
        assert!((sum - 1.0).abs() < 1e-6 && (from.weight[0][0] / from.weight[0][1] - 2.0).abs() < 1e-5);
        assert!((from.weight[1][0] - 1.0).abs() < 1e-6, "a coincident point has weight 1");

        let device = Device::flex().autodiff();
        let features = Tensor::<2>::from_floats([[1.0], [2.0], [3.0], [9.0]], &device).require_grad();
        let out = interpolate(features.clone(), &from.to_device(&device));
        let want: f32 = from.weight[0].iter().zip([1.0, 2.0, 3.0]).map(|(w, f)| w * f).sum();
        assert!((host(out.clone()).unwrap()[0] - want).abs() < 1e-6);
        let gradient = host(features.grad(&out.sum().backward()).unwrap()).unwrap();
        assert!((gradient[0] - from.weight[0][0] - from.weight[1][1]).abs() < 1e-6 && gradient[3] == 0.0);

        let again = from.clone();
        from.append(&again, 4);
        assert_eq!(from.source[2], [4, 5, 6]);
    }

    #[test]
    fn fewer_than_three_known_points() {
        let from = Interpolation::new(&[[1.0, 0.0, 0.0]], &[[0.0; 3]]);
        assert_eq!(from.weight, [[1.0, 0.0, 0.0]]);
    }
}
