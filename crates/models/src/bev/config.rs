//! Sizes of pillars and backbone.

use crate::config::DetectorConfig;
use crate::layers::Resampling;
use crate::limits::{MOST_CELLS, MOST_FILTERS, MOST_LAYERS, MOST_PILLARS, MOST_SAMPLES, MOST_STRIDE, at_most};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Size and number of the pillars.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PillarsConfig {
    /// Extent of a pillar along x, y and z, m.
    pub size_m: [f32; 3],
    /// Largest number of points of a pillar; the first points in the order of the cloud are kept.
    pub max_points: usize,
    /// Largest number of pillars of a training frame.
    pub max_train: usize,
    /// Largest number of pillars of other frames.
    pub max_test: usize,
}

impl Default for PillarsConfig {
    fn default() -> Self {
        PillarsConfig { size_m: [0.16, 0.16, 4.0], max_points: 32, max_train: 16_000, max_test: 40_000 }
    }
}

/// Blocks of convolutions on the BEV canvas, and transposed convolutions that upsample their outputs to a common
/// resolution.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct BackboneConfig {
    /// Convolutions of a block after its first.
    pub layers: Vec<usize>,
    /// Stride of a block's first convolution.
    pub strides: Vec<usize>,
    /// Channels of a block.
    pub filters: Vec<usize>,
    /// Stride and kernel size of the transposed convolution after each block. Below 1 (0.5, 0.25) a convolution whose
    /// stride and kernel size are the inverse.
    pub upsample_strides: Vec<f32>,
    /// Channels of the transposed convolutions.
    pub upsample_filters: Vec<usize>,
}

impl Default for BackboneConfig {
    fn default() -> Self {
        BackboneConfig {
            layers: vec![3, 5, 5],
            strides: vec![2, 2, 2],
            filters: vec![64, 128, 256],
            upsample_strides: vec![1.0, 2.0, 4.0],
            upsample_filters: vec![128, 128, 128],
        }
    }
}

impl BackboneConfig {
    /// Channels of the output.
    pub fn outputs(&self) -> usize {
        self.upsample_filters.iter().sum()
    }

    /// Cells of the canvas that one cell of the output spans, along x and y.
    pub fn output_stride(&self) -> usize {
        let first = self.strides.first().copied().unwrap_or(1);
        match self.upsample_strides.first().and_then(|&stride| Resampling::of(stride)) {
            Some(Resampling::Up(up)) => first / up,
            Some(Resampling::Down(down)) => first * down,
            None => first,
        }
    }

    /// Whether the sizes fit together and to a canvas of `nx` x `ny` cells; the message names the key.
    pub fn check(&self, [nx, ny]: [usize; 2]) -> Result<(), String> {
        let fail = |message: String| Err(message);
        let blocks = self.layers.len();
        let lengths =
            [self.strides.len(), self.filters.len(), self.upsample_strides.len(), self.upsample_filters.len()];
        if blocks == 0 || lengths.iter().any(|&n| n != blocks) {
            return fail(
                "network.backbone: layers, strides, filters, upsample_strides and upsample_filters need one entry a \
                 block"
                    .into(),
            );
        }
        if self.strides.iter().chain(&self.filters).chain(&self.upsample_filters).any(|&n| n == 0) {
            return fail("network.backbone: strides and filters must be above 0".into());
        }
        at_most(MOST_LAYERS, &[("the number of blocks of network.backbone", &[blocks])])?;
        at_most(MOST_LAYERS, &[("network.backbone.layers", &self.layers)])?;
        at_most(MOST_STRIDE, &[("network.backbone.strides", &self.strides)])?;
        let filters = [
            ("network.backbone.filters", &self.filters[..]),
            ("network.backbone.upsample_filters", &self.upsample_filters),
        ];
        at_most(MOST_FILTERS, &filters)?;
        let (mut scale, mut multiple) = (1, 1);
        for (stride, &up) in self.strides.iter().zip(&self.upsample_strides) {
            scale *= stride;
            at_most(MOST_CELLS, &[("the product of network.backbone.strides", &[scale])])?;
            let fits = match Resampling::of(up) {
                None => {
                    return fail(format!(
                        "network.backbone.upsample_strides: {up} is neither a whole number nor the inverse of one"
                    ));
                }
                Some(Resampling::Up(up)) => scale % up == 0 && scale / up == self.output_stride(),
                Some(Resampling::Down(down)) => {
                    multiple = multiple.max(scale * down);
                    scale * down == self.output_stride()
                }
            };
            if !fits {
                return fail(
                    "network.backbone: strides and upsample_strides give the blocks different output sizes".into(),
                );
            }
        }
        let multiple = multiple.max(scale);
        if nx % multiple != 0 || ny % multiple != 0 || nx == 0 || ny == 0 {
            return fail(format!(
                "range_m and network.pillars.size_m give {nx} x {ny} pillars; both must be multiples of {multiple}, the product of the strides"
            ));
        }
        Ok(())
    }
}

impl PillarsConfig {
    /// Pillars along x, y and z.
    pub fn grid_size(&self, detector: &DetectorConfig) -> [usize; 3] {
        let range = detector.range_m;
        [0, 1, 2].map(|i| ((range[i + 3] - range[i]) as f64 / self.size_m[i] as f64).round() as usize)
    }

    /// Whether the sizes are possible and one pillar spans the range along z; the message names the key.
    pub fn check(&self, detector: &DetectorConfig) -> Result<(), String> {
        if self.size_m.iter().any(|&s| !(s > 0.0 && s.is_finite()))
            || self.max_points == 0
            || self.max_train == 0
            || self.max_test == 0
        {
            return Err("network.pillars: sizes and limits must be above 0".into());
        }
        let [nx, ny, nz] = self.grid_size(detector);
        if nx.saturating_mul(ny) > MOST_CELLS {
            return Err(format!(
                "network.pillars.size_m = {:?} makes {nx} x {ny} pillars of range_m; at most {MOST_CELLS} cells are \
                 supported",
                self.size_m
            ));
        }
        at_most(MOST_SAMPLES, &[("network.pillars.max_points", &[self.max_points])])?;
        let pillars =
            [("network.pillars.max_train", &[self.max_train][..]), ("network.pillars.max_test", &[self.max_test])];
        at_most(MOST_PILLARS, &pillars)?;
        if nz != 1 {
            return Err(format!(
                "network.pillars.size_m: {nz} pillars along z; the pillar must span the whole z range"
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_sizes() {
        let of = |strides: [usize; 3], upsample: [f32; 3]| BackboneConfig {
            strides: strides.to_vec(),
            upsample_strides: upsample.to_vec(),
            ..BackboneConfig::default()
        };
        for (config, stride) in [
            (of([2, 2, 2], [1.0, 2.0, 4.0]), 2),
            (of([1, 2, 2], [1.0, 2.0, 4.0]), 1),
            (of([2, 2, 2], [0.5, 1.0, 2.0]), 4),
            (of([1, 2, 2], [0.25, 0.5, 1.0]), 4),
        ] {
            assert_eq!((config.output_stride(), config.check([32, 16])), (stride, Ok(())));
        }
        let message = |config: BackboneConfig, canvas| config.check(canvas).unwrap_err();
        assert!(message(of([2, 2, 2], [1.0, 2.0, 2.0]), [32, 16]).contains("different output sizes"));
        assert!(message(of([2, 2, 2], [1.0, 1.5, 4.0]), [32, 16]).contains("1.5 is neither"));
        assert!(message(of([2, 2, 2], [1.0, 2.0, 4.0]), [32, 20]).contains("32 x 20 pillars"));
    }
}
