//! Groups of neighbours (OpenPCDet: `QueryAndGroup`, `GroupAll`), without repeated rows.

use crate::layers::RowCounts;
use crate::row_ops::{self, RowGroups};
use burn::tensor::{Device, Tensor, TensorData};
use std::sync::Arc;

/// Neighbours of many centres, sorted by group. G groups have N rows.
///
/// The reference gives every group the same number of rows and pads with copies of the first neighbour. These count in
/// the batch statistics and do not change the maximum. Here each neighbour is one row with a multiplicity.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Groups {
    /// Input row of each row. Length N.
    pub source: Vec<u32>,
    /// Position of each row relative to the centre of its group, m. Length N.
    pub offset_m: Vec<[f32; 3]>,
    /// Multiplicity of each row. Length N.
    pub count: Vec<f32>,
    /// End of each group; the first begins at 0. Length G.
    pub ends: Vec<u32>,
}

impl Groups {
    /// Adds a group: `slots` are its neighbours as `(source, position)`, repetitions included; multiplicities are
    /// multiplied by `times`.
    pub fn push(&mut self, center_m: [f32; 3], slots: impl Iterator<Item = (u32, [f32; 3])>, times: f32) {
        let begin = self.source.len();
        for (source, position) in slots {
            // Linear search: groups are small, and repetitions are mostly of the first row.
            match self.source[begin..].iter().position(|&known| known == source) {
                Some(known) => self.count[begin + known] += times,
                None => {
                    self.source.push(source);
                    self.offset_m.push([0, 1, 2].map(|axis| position[axis] - center_m[axis]));
                    self.count.push(times);
                }
            }
        }
        self.ends.push(self.source.len() as u32);
    }

    /// Adds the groups of another cloud, whose input rows begin at `first_row`.
    pub fn append(&mut self, other: &Groups, first_row: u32) {
        let begin = self.source.len() as u32;
        self.source.extend(other.source.iter().map(|&source| source + first_row));
        self.offset_m.extend_from_slice(&other.offset_m);
        self.count.extend_from_slice(&other.count);
        self.ends.extend(other.ends.iter().map(|&end| end + begin));
    }

    /// The offsets on the device, `[N, 3]`, m.
    pub fn offsets(&self, device: &Device) -> Tensor<2> {
        let values = self.offset_m.as_flattened().to_vec();
        Tensor::from_data(TensorData::new(values, [self.offset_m.len(), 3]), device)
    }

    /// The groups for operations on a device, padded with rows of multiplicity 0.
    pub fn to_device(&self, device: &Device) -> GroupTensors {
        let filled = |values: &[f32], width: usize| {
            let mut values = values.to_vec();
            values.resize(RowCounts::filled_up(self.source.len()) * width, 0.0);
            values
        };
        let mut source = self.source.clone();
        source.resize(RowCounts::filled_up(source.len()), row_ops::ZERO);
        let rows = source.len();
        GroupTensors {
            source: source.into(),
            offset: Tensor::from_data(TensorData::new(filled(self.offset_m.as_flattened(), 3), [rows, 3]), device),
            counts: RowCounts::new(filled(&self.count, 1), device),
            groups: Arc::new(RowGroups::new(&self.ends)),
        }
    }
}

/// [`Groups`] for operations on a device; N is the padded number of rows.
#[derive(Clone, Debug)]
pub struct GroupTensors {
    /// Input row of each row, for [`row_ops::gather`]. Length N.
    pub source: Arc<[u32]>,
    /// `[N, 3]`, m.
    pub offset: Tensor<2>,
    /// Multiplicities of the N rows.
    pub counts: RowCounts,
    groups: Arc<RowGroups>,
}

/// The maximum over each group.
///
/// # Shapes
/// `x`: `[N, C]`; result `[G, C]`.
pub fn group_max(x: Tensor<2>, groups: &GroupTensors) -> Tensor<2> {
    row_ops::group_max(x, &groups.groups)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::layers::host;

    fn two_groups() -> Groups {
        let mut groups = Groups::default();
        let at = |x: f32| [x, 0.0, 0.0];
        groups.push(at(1.0), [(4, at(1.5)), (6, at(2.0)), (4, at(1.5)), (4, at(1.5))].into_iter(), 1.0);
        groups.push(at(0.0), [(2, at(0.5))].into_iter(), 2.0);
        groups
    }

    #[test]
    fn repetitions_are_counted() {
        let mut groups = two_groups();
        assert_eq!((&groups.source, &groups.count, &groups.ends), (&vec![4, 6, 2], &vec![3.0, 1.0, 2.0], &vec![2, 3]));
        assert_eq!(groups.offset_m, [[0.5, 0.0, 0.0], [1.0, 0.0, 0.0], [0.5, 0.0, 0.0]]);
        groups.append(&two_groups(), 10);
        assert_eq!(groups.source, [4, 6, 2, 14, 16, 12]);
        assert_eq!(groups.ends, [2, 3, 5, 6]);
    }

    #[test]
    fn maximum_and_its_gradient() {
        let device = Device::flex().autodiff();
        let groups = two_groups().to_device(&device);
        assert_eq!(groups.counts.total(), 6);
        assert_eq!((groups.source.len(), groups.offset.dims()), (256, [256, 3]));
        let x = Tensor::<2>::from_floats([[1.0, 5.0], [3.0, 2.0], [-1.0, -2.0]], &device).require_grad();
        let y = group_max(x.clone(), &groups);
        assert_eq!(host(y.clone()).unwrap(), [3.0, 5.0, -1.0, -2.0]);
        let weights = Tensor::<2>::from_floats([[1.0, 10.0], [100.0, 1000.0]], &device);
        let gradients = (y * weights).sum().backward();
        assert_eq!(host(x.grad(&gradients).unwrap()).unwrap(), [0.0, 10.0, 1.0, 0.0, 100.0, 1000.0]);
    }
}
