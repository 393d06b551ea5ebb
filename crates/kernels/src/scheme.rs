//! Convolutions as products of small matrices, in blocks that fit the cache.

use crate::background::Background;
use crate::blocks::{Segment, TileGrid};
use crate::scratch;
use crate::tile::{PIXELS, Row, Tile, TileWork, dispatch_tiles, product, tile_rows, zeros};
use pulp::Simd;
use rayon::prelude::*;
use std::ops::Range;

/// A convolution algorithm: what it reads for a block of tiles, its matrix products, and how it writes the result.
///
/// The panel of a block has rows of [`PIXELS`] values, one a tile. A product multiplies weights `[outputs, rows]` with
/// a range of the panel's rows.
pub(crate) trait Scheme: Sync {
    /// The tiles.
    fn grid(&self) -> TileGrid;

    /// Input channels.
    fn inputs(&self) -> usize;

    /// Output channels.
    fn outputs(&self) -> usize;

    /// Rows of the panel.
    fn panel_rows(&self) -> usize;

    /// The rows of the panel that each product reads.
    fn products(&self) -> Vec<Range<usize>>;

    /// Prefetches what [`Scheme::read`] will read of another block.
    fn prefetch_input(&self, segments: &[Segment], channel: usize);

    /// Prefetches what [`Scheme::write`] will write.
    fn prefetch_output(&self, segments: &[Segment], channel: usize);

    /// Writes the rows of one input channel into the panel.
    fn read<S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, panel: &mut [Row]);

    /// Writes one output channel from its products.
    fn write<'r, S: Simd>(&self, simd: S, segments: &[Segment], channel: usize, products: impl Fn(usize) -> &'r Row);
}

/// Weights in the order in which the products read them: `[outputs / R, rows of all products, R]`.
#[derive(Clone, Debug)]
pub struct PackedWeights {
    tile_rows: usize,
    rows: usize,
    outputs: usize,
    values: Vec<f32>,
}

impl PackedWeights {
    /// `column(output, insert)` calls `insert(row, weight)` for each weight of an output. Rows are numbered through all
    /// products.
    pub(crate) fn new(outputs: usize, rows: usize, column: impl Fn(usize, &mut dyn FnMut(usize, f32)) + Sync) -> Self {
        let tile_rows = tile_rows();
        let mut values = vec![0.0; outputs.div_ceil(tile_rows) * rows * tile_rows];
        if rows > 0 {
            values.par_chunks_mut(rows * tile_rows).enumerate().for_each(|(tile, values)| {
                for r in 0..tile_rows.min(outputs - tile * tile_rows) {
                    column(tile * tile_rows + r, &mut |row, weight| values[row * tile_rows + r] = weight);
                }
            });
        }
        PackedWeights { tile_rows, rows, outputs, values }
    }
}

/// Whether all rows are zero, so that all products are: most blocks of a canvas with few pillars. It ends at the first
/// row that is not.
#[inline(always)]
pub(crate) fn is_zero(rows: &[Row]) -> bool {
    // Without a branch within a row, so that it is compiled to vector instructions. -0 is zero, NaN is not.
    rows.iter().all(|row| row.iter().fold(true, |zero, value| zero & (*value == 0.0)))
}

/// Runs a scheme over all blocks.
pub(crate) fn run<C: Scheme>(scheme: &C, weights: &PackedWeights) {
    let products = scheme.products();
    let rows: usize = products.iter().map(Range::len).sum();
    assert_eq!(
        (weights.outputs, weights.rows),
        (scheme.outputs(), rows),
        "weights were packed for another convolution"
    );
    let tile_rows = weights.tile_rows;
    (0..scheme.grid().blocks()).into_par_iter().for_each_init(Background::default, |background, block| {
        let lengths = [scheme.panel_rows() * PIXELS, products.len() * tile_rows * PIXELS];
        scratch::with(lengths, |[panel, sums]| {
            let (panel, sums) = (panel.as_chunks_mut().0, sums.as_chunks_mut().0);
            let weights = &weights.values;
            dispatch_tiles(Block { scheme, products: &products, weights, block, panel, sums, background });
        });
    });
}

struct Block<'a, C> {
    scheme: &'a C,
    products: &'a [Range<usize>],
    weights: &'a [f32],
    block: usize,
    panel: &'a mut [Row],
    sums: &'a mut [Row],
    background: &'a mut Background,
}

impl<C: Scheme> TileWork for Block<'_, C> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd, const R: usize, const V: usize>(self, simd: S) {
        let Block { scheme, products, weights, block, panel, sums, background } = self;
        let segments = scheme.grid().segments(block);
        let next = scheme.grid().segments(block + 1);
        for channel in 0..scheme.inputs() {
            scheme.prefetch_input(next.list(), channel);
            scheme.read(simd, segments.list(), channel, panel);
        }
        for channel in 0..scheme.outputs() {
            scheme.prefetch_output(segments.list(), channel);
        }
        if is_zero(&panel[..scheme.panel_rows()]) {
            sums[0] = [0.0; PIXELS];
            for channel in 0..scheme.outputs() {
                scheme.write(simd, segments.list(), channel, |_| &sums[0]);
            }
            return;
        }
        let panel = &panel[..scheme.panel_rows()];
        if let Some(sums) = background.find(panel) {
            for (channel, sums) in sums.chunks_exact(products.len()).enumerate() {
                scheme.write(simd, segments.list(), channel, |p| &sums[p]);
            }
            return;
        }
        let mut kept = background.begin(panel, scheme.outputs() * products.len());
        let mut weights = weights.as_chunks::<R>().0;
        for first in (0..scheme.outputs()).step_by(R) {
            for (p, range) in products.iter().enumerate() {
                let (left, behind) = weights.split_at(range.len());
                weights = behind;
                let right = &panel[range.clone()];
                for group in 0..PIXELS / (V * S::F32_LANES) {
                    let tile: Tile<S, R, V> = product(simd, zeros(simd), left, right, group);
                    for r in 0..R {
                        let sums = S::as_mut_simd_f32s(&mut sums[p * R + r]).0;
                        sums.as_chunks_mut::<V>().0[group] = tile[r];
                    }
                }
            }
            for r in 0..R.min(scheme.outputs() - first) {
                scheme.write(simd, segments.list(), first + r, |p| &sums[p * R + r]);
                if let Some(kept) = &mut kept {
                    kept.extend((0..products.len()).map(|p| sums[p * R + r]));
                }
            }
        }
    }
}
