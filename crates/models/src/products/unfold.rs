//! Indices of gathers that unfold an image and fold it again, kept on the device.

use burn::backend::Backend;
use burn::backend::tensor::IntTensor;
use burn::tensor::TensorData;
use std::any::Any;
use std::collections::HashMap;
use std::sync::{LazyLock, Mutex, PoisonError};

/// Offset of a tap of a 3x3 kernel from its centre, along rows and columns.
fn tap(k: usize) -> [isize; 2] {
    [k as isize / 3 - 1, k as isize % 3 - 1]
}

/// Height or width of the result of a 3x3 convolution with padding 1.
pub fn strided(size: usize, stride: usize) -> usize {
    size.div_ceil(stride)
}

/// Which gather.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Gather {
    /// The pixels that each tap of a 3x3 kernel reads: 9 times the pixels of the result. Outside of the image the index
    /// is the number of pixels.
    Unfold,
    /// The values of an unfolded image that come from each pixel: [`Gather::folds`] times the pixels. Where there are
    /// fewer the index is the number of values.
    Fold,
}

impl Gather {
    /// Most values of an unfolded image that come from one pixel.
    pub fn folds(stride: usize) -> usize {
        3usize.div_ceil(stride).pow(2)
    }

    /// Indices for an image of a height and width.
    fn index(self, [height, width]: [usize; 2], stride: usize) -> Vec<i32> {
        let (rows, columns) = (strided(height, stride), strided(width, stride));
        // The pixel that a tap of a pixel of the result reads.
        let read = |k: usize, row: usize, column: usize| {
            let at = |out: usize, offset: isize, size: usize| {
                (out * stride).checked_add_signed(offset).filter(|&at| at < size)
            };
            let [down, right] = tap(k);
            Some(at(row, down, height)? * width + at(column, right, width)?)
        };
        let outputs = || (0..9).flat_map(|k| (0..rows).flat_map(move |r| (0..columns).map(move |c| (k, r, c))));
        match self {
            Gather::Unfold => {
                let outside = height * width;
                outputs().map(|(k, r, c)| read(k, r, c).unwrap_or(outside) as i32).collect()
            }
            Gather::Fold => {
                let pixels = height * width;
                let mut index = vec![(9 * rows * columns) as i32; Gather::folds(stride) * pixels];
                let mut count = vec![0; pixels];
                for (from, (k, r, c)) in outputs().enumerate() {
                    if let Some(pixel) = read(k, r, c) {
                        index[count[pixel] * pixels + pixel] = from as i32;
                        count[pixel] += 1;
                    }
                }
                index
            }
        }
    }

    /// The same on a device, made once for each size.
    pub fn on_device<B: Backend>(self, size: [usize; 2], stride: usize, device: &B::Device) -> IntTensor<B> {
        let key = (self, size, stride, format!("{device:?}"));
        let mut kept = KEPT.lock().unwrap_or_else(PoisonError::into_inner);
        let tensors = kept.entry(key).or_default();
        if let Some(tensor) = tensors.iter().find_map(|tensor| tensor.downcast_ref::<IntTensor<B>>()) {
            return tensor.clone();
        }
        let values = self.index(size, stride);
        let length = values.len();
        let tensor = B::int_from_data(TensorData::new(values, [length]), device);
        tensors.push(Box::new(tensor.clone()));
        tensor
    }
}

type Key = (Gather, [usize; 2], usize, String);

/// Index tensors, of each backend that asked.
type Kept = HashMap<Key, Vec<Box<dyn Any + Send>>>;

static KEPT: LazyLock<Mutex<Kept>> = LazyLock::new(Mutex::default);
