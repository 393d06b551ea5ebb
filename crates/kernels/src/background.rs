//! Blocks of a convolution that read the same values as an earlier one: behind the first convolution nearly all of the
//! places without points. Their products are computed once.

use crate::tile::Row;
use pulp::bytemuck::cast_slice;
use std::ops::Range;

/// Blocks that are remembered: the background inside of an image, and that at its edges.
const MOST: usize = 4;

/// The tiles of a block that are equal in a block of background. Those at its ends may lie at the edge of the image.
const INNER: Range<usize> = 4..28;

/// Panels of blocks of background with their products, `[outputs, products]`.
#[derive(Default)]
pub(crate) struct Background {
    blocks: Vec<(Vec<Row>, Vec<Row>)>,
    next: usize,
}

impl Background {
    /// The products of the same panel, if it is remembered. Equal bits have equal products.
    #[inline]
    pub fn find(&self, panel: &[Row]) -> Option<&[Row]> {
        let bits = |rows| cast_slice::<f32, u32>(<[Row]>::as_flattened(rows));
        // Different panels differ in their first rows already, where the comparison ends.
        self.blocks.iter().find(|(known, _)| bits(&known[..]) == bits(panel)).map(|(_, products)| &products[..])
    }

    /// If the panel is one of background, it is remembered; the caller appends its `products` products in order.
    #[inline]
    pub fn begin(&mut self, panel: &[Row], products: usize) -> Option<&mut Vec<Row>> {
        let is_equal = |row: &Row| row[INNER].iter().fold(true, |equal, v| equal & (v.to_bits() == row[16].to_bits()));
        if !panel.iter().all(is_equal) {
            return None;
        }
        if self.blocks.len() < MOST {
            self.blocks.push((Vec::new(), Vec::with_capacity(products)));
        }
        let place = self.next % MOST;
        self.next += 1;
        let (known, products) = &mut self.blocks[place];
        known.clear();
        known.extend_from_slice(panel);
        products.clear();
        Some(products)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conv3x3::{Algorithm, Conv3x3};
    use crate::epilogue::Epilogue;
    use crate::reference::random;
    use crate::tile::PIXELS;

    fn panel(value: f32, first: f32) -> Vec<Row> {
        let mut row = [value; PIXELS];
        row[0] = first;
        vec![row, [2.0 * value; PIXELS]]
    }

    #[test]
    fn background_is_found_again_and_the_oldest_is_forgotten() {
        let mut background = Background::default();
        let mut dense = panel(1.0, 1.0);
        dense[1][17] = 3.0;
        assert!(background.begin(&dense, 2).is_none());
        for i in 0..=MOST {
            let panel = panel(i as f32, 7.0);
            assert!(background.find(&panel).is_none());
            background.begin(&panel, 1).unwrap().push([i as f32 + 0.5; PIXELS]);
            assert_eq!(background.find(&panel), Some(&[[i as f32 + 0.5; PIXELS]][..]));
        }
        assert!(background.find(&panel(0.0, 7.0)).is_none(), "the oldest");
        assert!(background.find(&panel(1.0, 7.0)).is_some() && background.find(&panel(1.0, 8.0)).is_none());
        assert!(background.find(&panel(-0.0, -0.0)).is_none(), "bits are compared");
    }

    /// An image of background has the same bits as a block of it in an image of noise, where it is computed anew.
    #[test]
    fn convolutions_of_background_have_the_same_bits() {
        for (algorithm, stride) in
            [(Algorithm::WinogradF2, 1), (Algorithm::WinogradF4, 1), (Algorithm::Direct, 1), (Algorithm::Direct, 2)]
        {
            let conv = Conv3x3 { batch: 1, inputs: 3, outputs: 9, height: 64, width: 256, stride, algorithm };
            let (plane, width) = (conv.height * conv.width, conv.width);
            let background: Vec<f32> = (0..conv.x_len()).map(|i| 0.25 + (i / plane) as f32 * 0.3).collect();
            let mut noise = random(conv.x_len(), 4);
            for row in (0..3).flat_map(|channel| (30..38).map(move |row| channel * 64 + row)) {
                let place = row * width + 60..row * width + 196;
                noise[place.clone()].copy_from_slice(&background[place]);
            }
            let weights = conv.pack(&random(conv.weight_len(), 5));
            let of = |x: &[f32]| {
                let mut y = Vec::new();
                conv.forward(x, &weights, Epilogue::default(), &mut y);
                let row = |o: usize| (o * conv.out_height() + 33 / stride) * conv.out_width();
                let places = |o: usize| row(o) + 64 / stride..row(o) + 192 / stride;
                let bits = |o: usize| y[places(o)].iter().map(|v| v.to_bits()).collect::<Vec<_>>();
                (0..9).flat_map(bits).collect::<Vec<_>>()
            };
            assert_eq!(of(&background), of(&noise), "{algorithm:?}, stride {stride}");
        }
    }
}
