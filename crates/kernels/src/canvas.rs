//! Scatter of pillar features to the BEV canvas (OpenPCDet: `PointPillarScatter`), and the gather that is its gradient.

use crate::output::{Shared, fill};
use rayon::prelude::*;
use std::mem::MaybeUninit;
use std::ops::Range;

/// Pillars a task of [`Canvas::gather`].
const PILLARS: usize = 256;

/// The shape of the BEV canvases of a batch.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Canvas {
    /// Number of canvases.
    pub batch: usize,
    /// Features of a pillar.
    pub channels: usize,
    /// Cells of a canvas: rows times columns.
    pub pixels: usize,
}

impl Canvas {
    /// Writes each pillar's features to its cell and zeros elsewhere. `canvas`, `[batch, channels, pixels]`, is
    /// overwritten.
    ///
    /// # Shapes
    /// `features`: `[P, channels]`; `cells`: `[P]`, indices into `[batch, pixels]`, sorted by canvas. If cells are
    /// equal, the last pillar wins.
    pub fn scatter(&self, features: &[f32], cells: &[u32], canvas: &mut Vec<f32>) {
        let Canvas { batch, channels, pixels } = *self;
        assert_eq!(features.len(), cells.len() * channels, "features of {self:?}");
        let pillars: Vec<Range<usize>> = (0..batch).map(|b| self.pillars_of(cells, b)).collect();
        let work = |canvas: Shared<'_>| {
            (0..batch * channels).into_par_iter().for_each(|plane| {
                // SAFETY: each plane belongs to one task.
                let values = unsafe { canvas.part(plane * pixels, pixels) };
                values.fill(MaybeUninit::new(0.0));
                let (image, channel) = (plane / channels, plane % channels);
                for p in pillars[image].clone() {
                    values[cells[p] as usize - image * pixels].write(features[p * channels + channel]);
                }
            });
        };
        // SAFETY: the tasks cover all planes.
        unsafe { fill(canvas, batch * channels * pixels, |canvas| work(Shared::new(canvas))) };
    }

    /// Reads the canvas at the cells of the pillars: the gradient of [`Canvas::scatter`] if all cells differ.
    /// `features`, `[P, channels]`, is overwritten.
    pub fn gather(&self, canvas: &[f32], cells: &[u32], features: &mut Vec<f32>) {
        let Canvas { batch, channels, pixels } = *self;
        assert_eq!(canvas.len(), batch * channels * pixels, "elements of {self:?}");
        let work = |features: Shared<'_>| {
            (0..cells.len().div_ceil(PILLARS)).into_par_iter().for_each(|task| {
                for p in task * PILLARS..cells.len().min((task + 1) * PILLARS) {
                    // SAFETY: each pillar is in one task.
                    let row = unsafe { features.part(p * channels, channels) };
                    let cell = cells[p] as usize;
                    let first = cell / pixels * channels * pixels + cell % pixels;
                    for (value, place) in row.iter_mut().zip((first..).step_by(pixels)) {
                        value.write(canvas[place]);
                    }
                }
            });
        };
        // SAFETY: the tasks cover all pillars.
        unsafe { fill(features, cells.len() * channels, |features| work(Shared::new(features))) };
    }

    /// The pillars of an image; those of a batch are sorted by image.
    fn pillars_of(&self, cells: &[u32], image: usize) -> Range<usize> {
        let before = |image: usize| cells.partition_point(|&cell| (cell as usize) < image * self.pixels);
        debug_assert!(cells.windows(2).all(|c| c[0] as usize / self.pixels <= c[1] as usize / self.pixels));
        before(image)..before(image + 1)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::reference::{assert_same_for_threads, random};

    /// Every third cell of each canvas, in a shuffled order.
    fn cells(canvas: &Canvas) -> Vec<u32> {
        let n = canvas.pixels / 3;
        let of_image = |b| (0..n).map(move |p| (b * canvas.pixels + (p * 7 + b) % n * 3) as u32);
        (0..canvas.batch).flat_map(of_image).collect()
    }

    #[test]
    fn equals_the_definition_and_gather_inverts_it() {
        for (batch, channels, pixels) in [(1, 1, 3), (2, 3, 30), (3, 20, 1000), (1, 5, 1), (0, 4, 9)] {
            let canvas = Canvas { batch, channels, pixels };
            let cells = cells(&canvas);
            let features = random(cells.len() * channels, 1);
            let mut want = vec![0.0; batch * channels * pixels];
            for (p, &cell) in cells.iter().enumerate() {
                let (image, pixel) = (cell as usize / pixels, cell as usize % pixels);
                for c in 0..channels {
                    want[(image * channels + c) * pixels + pixel] = features[p * channels + c];
                }
            }
            let (mut got, mut back) = (vec![3.0], vec![3.0]);
            canvas.scatter(&features, &cells, &mut got);
            assert_eq!(got, want, "{canvas:?}");
            canvas.gather(&got, &cells, &mut back);
            assert_eq!(back, features, "{canvas:?}");
        }
    }

    #[test]
    fn the_result_is_bit_equal_for_any_number_of_threads() {
        let canvas = Canvas { batch: 2, channels: 9, pixels: 3000 };
        let cells = cells(&canvas);
        let features = random(cells.len() * 9, 2);
        assert_same_for_threads(|| {
            let (mut there, mut back) = (Vec::new(), Vec::new());
            canvas.scatter(&features, &cells, &mut there);
            canvas.gather(&there, &cells, &mut back);
            [there, back]
        });
    }

    #[test]
    fn nan_propagates() {
        let canvas = Canvas { batch: 1, channels: 2, pixels: 4 };
        let mut there = Vec::new();
        canvas.scatter(&[1.0, f32::NAN, 3.0, 4.0], &[2, 0], &mut there);
        assert_eq!((there[0], there[2], there[4]), (3.0, 1.0, 4.0));
        assert!(there[6].is_nan());
    }
}
