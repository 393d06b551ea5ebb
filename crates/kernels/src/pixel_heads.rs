//! Several 1x1 convolutions of the same image whose outputs are stored channels-last: the heads of a detector, whose
//! outputs are read anchor by anchor.

use crate::matrix::{Matrix, Then, multiply};
use crate::output::{Shared, fill};
use crate::scratch;
use rayon::prelude::*;
use std::ops::Range;

/// Pixels that are processed together.
const PIXELS: usize = 256;

/// Number of partial sums of the gradient with respect to the weights, for any number of threads.
const PARTS: usize = 16;

/// The shape of the heads.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct PixelHeads {
    /// Images.
    pub batch: usize,
    /// Channels of `x`.
    pub inputs: usize,
    /// Pixels of an image: rows times columns.
    pub pixels: usize,
    /// Channels of each head; K is their sum.
    pub outputs: Vec<usize>,
}

/// Gradients of [`PixelHeads`].
#[derive(Clone, Debug, PartialEq)]
pub struct PixelHeadGradients {
    /// With respect to `x`, `[batch, inputs, pixels]`.
    pub x: Vec<f32>,
    /// With respect to the weights, `[K, inputs]`.
    pub weight: Vec<f32>,
    /// With respect to the biases, `[K]`.
    pub bias: Vec<f32>,
}

/// A range of pixels of one image.
struct Block {
    image: usize,
    pixels: Range<usize>,
}

impl PixelHeads {
    /// Computes all heads; `y` holds one after the other, each `[batch, pixels, outputs]`, and is overwritten.
    ///
    /// # Shapes
    /// `x`: `[batch, inputs, pixels]`; `weight`: `[K, inputs]`, head after head; `bias`: `[K]`.
    pub fn forward(&self, x: &[f32], weight: &[f32], bias: &[f32], y: &mut Vec<f32>) {
        let all = self.check(x, weight);
        assert_eq!(bias.len(), all, "biases of {self:?}");
        let work = |y: Shared<'_>| {
            (0..self.blocks()).into_par_iter().for_each(|block| {
                let block = self.block(block);
                scratch::with([PIXELS * all, all * PIXELS], |[rows, row]| {
                    let rows = &mut rows[..block.pixels.len() * all];
                    multiply(
                        self.pixels_of(x, &block),
                        Matrix::new(weight, self.inputs).transposed(),
                        rows,
                        Then::Store,
                    );
                    for_heads(&self.outputs, |head| {
                        let part = &mut row[..block.pixels.len() * head.len()];
                        for (to, from) in part.chunks_exact_mut(head.len()).zip(rows.chunks_exact(all)) {
                            for ((to, from), bias) in to.iter_mut().zip(&from[head.clone()]).zip(&bias[head.clone()]) {
                                *to = from + bias;
                            }
                        }
                        // SAFETY: no pixel is in two blocks.
                        unsafe { y.write(self.place(&block, &head), part) };
                    });
                });
            });
        };
        // SAFETY: the blocks cover all pixels.
        unsafe { fill(y, self.batch * self.pixels * all, |y| work(Shared::new(y))) };
    }

    /// All gradients.
    ///
    /// # Shapes
    /// `dy`: as `y` of [`PixelHeads::forward`].
    pub fn backward(&self, x: &[f32], weight: &[f32], dy: &[f32]) -> PixelHeadGradients {
        let all = self.check(x, weight);
        assert_eq!(dy.len(), self.batch * self.pixels * all, "elements of dy of {self:?}");
        let lengths = [PIXELS * all, self.inputs * PIXELS];
        let work = |dx: Shared<'_>| -> Vec<(Vec<f32>, Vec<f64>)> {
            let of_part = |part: usize| {
                let (mut dw, mut db) = (vec![0.0; all * self.inputs], vec![0.0f64; all]);
                scratch::with(lengths, |[rows, planes]| {
                    for block in self.blocks() * part / PARTS..self.blocks() * (part + 1) / PARTS {
                        let block = self.block(block);
                        let n = block.pixels.len();
                        let (rows, planes) = (&mut rows[..n * all], &mut planes[..self.inputs * n]);
                        for_heads(&self.outputs, |head| {
                            let part = &dy[self.place(&block, &head)..][..n * head.len()];
                            for (to, from) in rows.chunks_exact_mut(all).zip(part.chunks_exact(head.len())) {
                                to[head.clone()].copy_from_slice(from);
                            }
                        });
                        for row in rows.chunks_exact(all) {
                            db.iter_mut().zip(row).for_each(|(sum, &value)| *sum += value as f64);
                        }
                        let dy = Matrix::new(rows, all).transposed();
                        multiply(dy, self.pixels_of(x, &block), &mut dw, Then::Add);
                        multiply(Matrix::new(weight, self.inputs).transposed(), dy, planes, Then::Store);
                        for (channel, plane) in planes.chunks_exact(n).enumerate() {
                            let first = (block.image * self.inputs + channel) * self.pixels + block.pixels.start;
                            // SAFETY: no pixel is in two blocks.
                            unsafe { dx.write(first, plane) };
                        }
                    }
                });
                (dw, db)
            };
            (0..PARTS).into_par_iter().map(of_part).collect()
        };
        let mut dx = Vec::new();
        // SAFETY: the parts cover all blocks, and these all pixels.
        let parts = unsafe { fill(&mut dx, x.len(), |dx| work(Shared::new(dx))) };
        let (mut dw, mut db) = (vec![0.0f32; all * self.inputs], vec![0.0f64; all]);
        for (w, b) in parts {
            dw.iter_mut().zip(w).for_each(|(sum, value)| *sum += value);
            db.iter_mut().zip(b).for_each(|(sum, value)| *sum += value);
        }
        PixelHeadGradients { x: dx, weight: dw, bias: db.into_iter().map(|v| v as f32).collect() }
    }

    fn check(&self, x: &[f32], weight: &[f32]) -> usize {
        let all: usize = self.outputs.iter().sum();
        assert!(self.inputs > 0 && self.outputs.iter().all(|&k| k > 0), "channels of {self:?}");
        assert_eq!(x.len(), self.batch * self.inputs * self.pixels, "elements of x of {self:?}");
        assert_eq!(weight.len(), all * self.inputs, "weights of {self:?}");
        all
    }

    fn blocks(&self) -> usize {
        self.batch * self.pixels.div_ceil(PIXELS)
    }

    fn block(&self, block: usize) -> Block {
        let (image, start) = (block / self.pixels.div_ceil(PIXELS), block % self.pixels.div_ceil(PIXELS) * PIXELS);
        Block { image, pixels: start..self.pixels.min(start + PIXELS) }
    }

    /// `[pixels of the block, inputs]`.
    fn pixels_of<'a>(&self, x: &'a [f32], block: &Block) -> Matrix<'a> {
        let first = block.image * self.inputs * self.pixels + block.pixels.start;
        let end = (block.image + 1) * self.inputs * self.pixels - (self.pixels - block.pixels.end);
        Matrix::window(&x[first..end], self.inputs, block.pixels.len(), self.pixels).transposed()
    }

    /// Offset of a block's rows of a head in `y`; `head`: its range among all channels.
    fn place(&self, block: &Block, head: &Range<usize>) -> usize {
        let pixels = self.batch * self.pixels;
        head.start * pixels + (block.image * self.pixels + block.pixels.start) * head.len()
    }
}

/// The range of each head among all channels.
fn for_heads(outputs: &[usize], mut work: impl FnMut(Range<usize>)) {
    let mut first = 0;
    for &channels in outputs {
        work(first..first + channels);
        first += channels;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_close, assert_same_for_threads, random};

    fn shapes() -> Vec<PixelHeads> {
        let of = |(batch, inputs, pixels, outputs): (usize, usize, usize, &[usize])| PixelHeads {
            batch,
            inputs,
            pixels,
            outputs: outputs.to_vec(),
        };
        let shapes: [(usize, usize, usize, &[usize]); 5] = [
            (1, 1, 1, &[1]),
            (2, 3, 31, &[2, 5]),
            (1, 20, 257, &[18, 42, 12]),
            (3, 7, 700, &[4, 1, 3]),
            (0, 2, 5, &[3]),
        ];
        shapes.into_iter().map(of).collect()
    }

    fn run(heads: &PixelHeads, [x, w, b, dy]: &[Vec<f32>; 4]) -> [Vec<f32>; 4] {
        let mut y = vec![7.0];
        heads.forward(x, w, b, &mut y);
        let PixelHeadGradients { x, weight, bias } = heads.backward(x, w, dy);
        [y, x, weight, bias]
    }

    fn inputs(heads: &PixelHeads) -> [Vec<f32>; 4] {
        let all: usize = heads.outputs.iter().sum();
        let pixels = heads.batch * heads.pixels;
        let lengths = [pixels * heads.inputs, all * heads.inputs, all, pixels * all];
        std::array::from_fn(|i| random(lengths[i], i as u64))
    }

    #[test]
    fn equals_the_definition() {
        for heads in shapes() {
            let values = inputs(&heads);
            let [x, w, b, dy] = &values;
            let mut want: [Vec<f64>; 4] =
                [vec![0.0; dy.len()], vec![0.0; x.len()], vec![0.0; w.len()], vec![0.0; b.len()]];
            for_heads(&heads.outputs, |head| {
                for (n, p) in (0..heads.batch).flat_map(|n| (0..heads.pixels).map(move |p| (n, p))) {
                    for o in head.clone() {
                        let yi = head.start * heads.batch * heads.pixels + (n * heads.pixels + p) * head.len() + o
                            - head.start;
                        want[0][yi] += b[o] as f64;
                        want[3][o] += dy[yi] as f64;
                        for i in 0..heads.inputs {
                            let (xi, wi) = ((n * heads.inputs + i) * heads.pixels + p, o * heads.inputs + i);
                            want[0][yi] += x[xi] as f64 * w[wi] as f64;
                            want[1][xi] += dy[yi] as f64 * w[wi] as f64;
                            want[2][wi] += dy[yi] as f64 * x[xi] as f64;
                        }
                    }
                }
            });
            for (i, (got, want)) in run(&heads, &values).iter().zip(&want).enumerate() {
                assert_close(got, want, 2e-6, &format!("{i} of {heads:?}"));
            }
        }
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        let heads = PixelHeads { batch: 2, inputs: 33, pixels: 1500, outputs: vec![18, 7] };
        let values = inputs(&heads);
        assert_same_for_threads(|| run(&heads, &values));
    }

    #[test]
    fn nan_propagates() {
        let heads = PixelHeads { batch: 1, inputs: 3, pixels: 40, outputs: vec![2, 1] };
        let mut values = inputs(&heads);
        (values[0][40 + 7], values[3][5 * 2]) = (f32::NAN, f32::NAN);
        let places = |v: &[f32]| (0..v.len()).filter(|&i| v[i].is_nan()).collect::<Vec<_>>();
        let [y, dx, dw, db] = run(&heads, &values);
        assert_eq!(places(&y), [14, 15, 87]);
        assert_eq!(places(&dx), [5, 45, 85]);
        assert_eq!(places(&dw), [0, 1, 2, 4, 7]);
        assert_eq!(places(&db), [0]);
    }
}
