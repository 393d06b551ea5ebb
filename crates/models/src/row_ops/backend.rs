//! The operations on the primitives of every backend, and their gradients.

use super::segments::{Places, SegmentSums};
use super::{RowGroups, ZERO};
use burn::backend::autodiff::checkpoint::base::Checkpointer;
use burn::backend::autodiff::checkpoint::strategy::CheckpointStrategy;
use burn::backend::autodiff::grads::Gradients;
use burn::backend::autodiff::ops::{Backward, Ops, OpsKind, unary};
use burn::backend::tensor::{FloatTensor, IntTensor};
use burn::backend::{
    Autodiff, Backend, Dispatch, Flex, NdArray, TensorMetadata, backend_extension, get_device_settings,
};
use burn::tensor::{IntDType, Shape, TensorData};
use std::sync::Arc;

/// Operations on rows. Without autodiff they are compositions of the backend's operations.
#[backend_extension(Flex, NdArray, Cube: cfg(feature = "cube"), Autodiff)]
pub trait RowOps: RowKernels {
    /// See [`super::gather`].
    fn gather_rows(x: FloatTensor<Self>, index: Arc<[u32]>) -> FloatTensor<Self> {
        select::<Self>(x, &index)
    }

    /// See [`super::place`].
    fn rows_at(x: FloatTensor<Self>, places: Arc<[u32]>, count: usize) -> FloatTensor<Self> {
        let rows = (0..places.len() as u32).collect();
        Self::place_rows(x, &Places { rows, places: places.to_vec(), count })
    }

    /// See [`super::group_max`].
    fn max_of_groups(x: FloatTensor<Self>, groups: Arc<RowGroups>) -> FloatTensor<Self> {
        Self::maxima(x, &groups).0
    }
}

/// Parts of the operations that a device may have kernels for.
pub trait RowKernels: Backend {
    /// See [`Places`].
    fn place_rows(x: FloatTensor<Self>, places: &Places) -> FloatTensor<Self> {
        select::<Self>(x, &places.index())
    }

    /// Sums of blocks of `width` rows, as they are in `index`; of one row, copies.
    fn sums_of_blocks(x: FloatTensor<Self>, index: &[u32], width: usize) -> FloatTensor<Self> {
        blocks_of_rows::<Self>(x, index, width)
    }

    /// The maxima over groups, and where they are; `None` without groups.
    fn maxima(x: FloatTensor<Self>, groups: &RowGroups) -> (FloatTensor<Self>, Option<IntTensor<Self>>) {
        max_with_slots::<Self>(x, groups)
    }

    /// The gradient of [`RowKernels::maxima`] by `x`, of `rows` rows.
    fn gradient_of_maxima(
        dy: FloatTensor<Self>,
        places: IntTensor<Self>,
        groups: &RowGroups,
        rows: usize,
    ) -> FloatTensor<Self> {
        max_gradient::<Self>(dy, places, groups, rows)
    }
}

impl RowKernels for Flex {}

impl RowKernels for NdArray {}

impl RowKernels for Dispatch {}

impl<B: Backend, C: CheckpointStrategy> RowKernels for Autodiff<B, C> {}

#[cfg(feature = "cube")]
impl RowKernels for burn::backend::Cube {
    fn place_rows(x: FloatTensor<Self>, places: &Places) -> FloatTensor<Self> {
        let device = x.device();
        let [rows, to] = [&places.rows, &places.places]
            .map(|values| ints::<Self>(values.iter().map(|&value| value as i32).collect(), &device));
        crate::gpu_kernels::place_rows(&x, [&rows, &to], places.count)
            .unwrap_or_else(|| select::<Self>(x, &places.index()))
    }

    fn sums_of_blocks(x: FloatTensor<Self>, index: &[u32], width: usize) -> FloatTensor<Self> {
        if x.shape()[0] == 0 || index.is_empty() || !has_kernels(&x, index.len().max(x.shape()[0])) {
            return blocks_of_rows::<Self>(x, index, width);
        }
        let rows = index.iter().map(|&row| if row == ZERO { -1 } else { row as i32 }).collect();
        let rows = ints::<Self>(rows, &x.device());
        crate::gpu_kernels::sums_of_blocks(x, &rows, width)
    }

    fn maxima(x: FloatTensor<Self>, groups: &RowGroups) -> (FloatTensor<Self>, Option<IntTensor<Self>>) {
        if groups.is_empty() || !has_kernels(&x, x.shape()[0]) {
            return max_with_slots::<Self>(x, groups);
        }
        let ends = ints::<Self>(groups.ends.iter().map(|&end| end as i32).collect(), &x.device());
        let (maxima, rows) = crate::gpu_kernels::maxima_of_groups(x, &ends);
        (maxima, Some(rows))
    }

    fn gradient_of_maxima(
        dy: FloatTensor<Self>,
        places: IntTensor<Self>,
        groups: &RowGroups,
        rows: usize,
    ) -> FloatTensor<Self> {
        if !has_kernels(&dy, rows) {
            return max_gradient::<Self>(dy, places, groups, rows);
        }
        crate::gpu_kernels::gradient_of_maxima(dy, &places, rows)
    }
}

/// Whether there are kernels for so many rows of the channels and the precision of `like`.
#[cfg(feature = "cube")]
fn has_kernels(like: &FloatTensor<burn::backend::Cube>, rows: usize) -> bool {
    like.dtype() == burn::tensor::DType::F32 && rows * like.shape()[1] < 1 << 32
}

impl RowOps for Flex {}

impl RowOps for NdArray {}

#[cfg(feature = "cube")]
impl RowOps for burn::backend::Cube {}

impl<B: RowOps, C: CheckpointStrategy> RowOps for Autodiff<B, C> {
    fn gather_rows(x: FloatTensor<Self>, index: Arc<[u32]>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let rows = x.shape()[0];
        let y = B::gather_rows(x, index.clone());
        match GatherRows.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => prepared.finish((index, rows), y),
            OpsKind::UnTracked(prepared) => prepared.finish(y),
        }
    }

    fn rows_at(x: FloatTensor<Self>, places: Arc<[u32]>, count: usize) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let y = B::rows_at(x, places.clone(), count);
        match RowsAt.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => prepared.finish(places, y),
            OpsKind::UnTracked(prepared) => prepared.finish(y),
        }
    }

    fn max_of_groups(x: FloatTensor<Self>, groups: Arc<RowGroups>) -> FloatTensor<Self> {
        let (x, node) = x.into_parts();
        let rows = x.shape()[0];
        let (y, places) = B::maxima(x, &groups);
        match MaxOfGroups.prepare::<C>([node]).compute_bound().stateful() {
            OpsKind::Tracked(prepared) => prepared.finish((places, groups, rows), y),
            OpsKind::UnTracked(prepared) => prepared.finish(y),
        }
    }
}

#[derive(Debug)]
struct GatherRows;

impl<B: RowOps> Backward<B, 1> for GatherRows {
    /// The index and the number of rows it points into.
    type State = (Arc<[u32]>, usize);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let (index, rows) = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |dy| segment_sums::<B>(dy, &SegmentSums::new(&index, rows)));
    }
}

#[derive(Debug)]
struct RowsAt;

impl<B: RowKernels> Backward<B, 1> for RowsAt {
    /// The place of each row.
    type State = Arc<[u32]>;

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let places = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |dy| select::<B>(dy, &places));
    }
}

#[derive(Debug)]
struct MaxOfGroups;

impl<B: RowKernels> Backward<B, 1> for MaxOfGroups {
    /// Where each maximum is, `[G, C]`; the groups; number of rows.
    type State = (Option<IntTensor<B>>, Arc<RowGroups>, usize);

    fn backward(self, ops: Ops<Self::State, 1>, grads: &mut Gradients, _: &mut Checkpointer) {
        let (places, groups, rows) = ops.state;
        unary::<B, _>(ops.parents, ops.node, grads, |dy| match places {
            Some(places) => B::gradient_of_maxima(dy, places, &groups, rows),
            None => zeros::<B>([rows, dy.shape()[1]], &dy),
        });
    }
}

fn zeros<B: Backend>(shape: [usize; 2], like: &FloatTensor<B>) -> FloatTensor<B> {
    B::float_zeros(Shape::from(shape), &like.device(), like.dtype().into())
}

fn ints<B: Backend>(values: Vec<i32>, device: &B::Device) -> IntTensor<B> {
    let length = values.len();
    B::int_from_data(TensorData::new(values, [length]), device)
}

/// The rows of `x` with these indices.
fn select<B: RowKernels>(x: FloatTensor<B>, index: &[u32]) -> FloatTensor<B> {
    B::sums_of_blocks(x, index, 1)
}

/// See [`RowKernels::sums_of_blocks`].
fn blocks_of_rows<B: Backend>(x: FloatTensor<B>, index: &[u32], width: usize) -> FloatTensor<B> {
    let (blocks, channels) = (index.len() / width, x.shape()[1]);
    let rows = copies_of_rows::<B>(x, index);
    if width == 1 {
        return rows;
    }
    let rows = B::float_reshape(rows, Shape::from([blocks, width, channels]));
    B::float_reshape(B::float_sum_dim(rows, 1), Shape::from([blocks, channels]))
}

fn copies_of_rows<B: Backend>(x: FloatTensor<B>, index: &[u32]) -> FloatTensor<B> {
    let [rows, channels] = [x.shape()[0], x.shape()[1]];
    if rows == 0 || index.is_empty() {
        return zeros::<B>([index.len(), channels], &x);
    }
    let to_row = |&i: &u32| if i == ZERO { rows as i32 } else { i as i32 };
    let rows_of_x = ints::<B>(index.iter().map(to_row).collect(), &x.device());
    let x = if index.contains(&ZERO) {
        let nothing = zeros::<B>([1, channels], &x);
        B::float_cat(vec![x, nothing], 0) // [R + 1, C]
    } else {
        x
    };
    B::float_select(x, 0, rows_of_x)
}

fn segment_sums<B: RowKernels>(mut x: FloatTensor<B>, plan: &SegmentSums) -> FloatTensor<B> {
    for level in &plan.levels {
        x = B::sums_of_blocks(x, &level.index, level.width);
    }
    match &plan.last {
        Some(places) => B::place_rows(x, places),
        None => x,
    }
}

/// The maxima, `[G, C]`, and the slot of each in its group, `None` without groups.
fn max_with_slots<B: RowKernels>(x: FloatTensor<B>, groups: &RowGroups) -> (FloatTensor<B>, Option<IntTensor<B>>) {
    let channels = x.shape()[1];
    if groups.is_empty() {
        return (zeros::<B>([0, channels], &x), None);
    }
    let filled = select::<B>(x, &groups.places().collect::<Vec<_>>());
    let filled = B::float_reshape(filled, Shape::from([groups.len(), groups.most, channels])); // [G, S, C]
    let (most, slots) = B::float_max_dim_with_indices(filled, 1, IntDType::I32); // [G, 1, C]
    let shape = Shape::from([groups.len(), channels]);
    (B::float_reshape(most, shape.clone()), Some(B::int_reshape(slots, shape)))
}

/// Each row gets the gradient of its group in those channels whose maximum it has.
fn max_gradient<B: RowKernels>(
    dy: FloatTensor<B>,
    slots: IntTensor<B>,
    groups: &RowGroups,
    rows: usize,
) -> FloatTensor<B> {
    let (device, channels) = (dy.device(), dy.shape()[1]);
    let column = |values: Vec<i32>, to: usize| {
        let values = B::int_reshape(ints::<B>(values, &device), Shape::from([to, 1]));
        B::int_expand(values, Shape::from([to, channels]))
    };
    // The row of each maximum, [G, C]. A slot behind the end of its group is the group's first row.
    let first_slots = (0..groups.len()).map(|group| (group * groups.most) as i32).collect();
    let places = B::int_add(slots, column(first_slots, groups.len()));
    let places = B::int_reshape(places, Shape::from([groups.len() * channels]));
    let rows_of_places = ints::<B>(groups.places().map(|row| row as i32).collect(), &device);
    let winners = B::int_select(rows_of_places, 0, places);
    let winners = B::int_reshape(winners, Shape::from([groups.len(), channels]));

    let group_of_row = groups.group_of_row(rows);
    let index = ints::<B>(group_of_row.iter().map(|&group| group as i32).collect(), &device);
    let winners = B::int_select(winners, 0, index); // [N, C]
    let members = groups.ends.last().copied().unwrap_or(0) as usize;
    let own = (0..rows).map(|row| if row < members { row as i32 } else { -1 }).collect();
    let bool_dtype = get_device_settings::<B>(&device).bool_dtype;
    let lost = B::int_not_equal(winners, column(own, rows), bool_dtype);
    B::float_mask_fill(select::<B>(dy, &group_of_row), lost, 0.0.into())
}
