//! The configuration of a detector: one TOML file in `configs/detectors`.

pub use crate::NetworkConfig;

use crate::ModelError;
use crate::limits::{MOST_BATCH, MOST_CLASSES, MOST_EPOCHS, at_most};
use data::GroundConfig;
use data::augment::AugmentConfig;
use data::limits::check_name;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Configuration of a detector: classes, range, network, loss, detections, training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DetectorConfig {
    /// Name in run folders and tables.
    pub name: String,
    /// Classes that the network distinguishes; the data set must have all of them.
    pub classes: Vec<String>,
    /// Values of a point that the network reads: 3 (x, y, z) or 4 (and intensity).
    pub channels: usize,
    /// `[x_min, y_min, z_min, x_max, y_max, z_max]`, m, LiDAR frame. Points and training boxes outside are dropped.
    pub range_m: [f32; 6],
    /// Heights of points and boxes count from the ground of the frame, in the network's input, its targets and the z of
    /// `range_m` for points; detections are moved back. For banked or hilly ground. Default: z of the LiDAR frame, as
    /// in OpenPCDet.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ground: Option<GroundConfig>,
    /// The network and its sizes.
    pub network: NetworkConfig,
    /// How the network is trained.
    #[serde(default)]
    pub optimization: OptimizationConfig,
    /// Augmentation of training frames; the default is that of OpenPCDet.
    #[serde(default)]
    pub augmentation: AugmentConfig,
}

/// The anchors of one class.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AnchorConfig {
    /// The class.
    pub class: String,
    /// Length, width, height, m.
    pub size_m: [f32; 3],
    /// z of the bottom face, m, LiDAR frame.
    pub bottom_m: f32,
    /// Headings, rad.
    #[serde(default = "default_rotations")]
    pub rotations_rad: Vec<f32>,
    /// Overlap from which an anchor is positive.
    pub matched: f32,
    /// Overlap below which an anchor is background; between the two thresholds it is ignored.
    pub unmatched: f32,
}

fn default_rotations() -> Vec<f32> {
    vec![0.0, 1.57]
}

/// OpenPCDet's `adam_onecycle`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct OptimizationConfig {
    /// Passes over the training set.
    pub epochs: usize,
    /// Frames a step.
    pub batch_size: usize,
    /// Peak of the one-cycle learning rate.
    pub lr_max: f64,
    /// Decoupled weight decay, on every parameter.
    pub weight_decay: f64,
    /// Largest global L2 norm of the gradients (clipping).
    pub clip_norm: f64,
    /// The initial learning rate is `lr_max / div_factor`.
    pub div_factor: f64,
    /// Fraction of the steps in which the learning rate rises.
    pub pct_start: f64,
    /// Adam's beta1 at the ends of the cycle and at its peak.
    pub momentum: [f64; 2],
}

impl Default for OptimizationConfig {
    fn default() -> Self {
        OptimizationConfig {
            epochs: 80,
            batch_size: 4,
            lr_max: 0.003,
            weight_decay: 0.01,
            clip_norm: 10.0,
            div_factor: 10.0,
            pct_start: 0.4,
            momentum: [0.95, 0.85],
        }
    }
}

impl DetectorConfig {
    /// Reads and checks a detector's TOML.
    ///
    /// # Errors
    /// A file that cannot be read, an unknown key, a wrong type, or sizes that do not fit together.
    pub fn read(path: &Path) -> Result<Self, ModelError> {
        let text = data::limits::read_text(path)?;
        Self::parse(&text).map_err(|message| ModelError::File { path: path.into(), message })
    }

    /// Parses and checks the text of a detector's TOML; the message of the error names line or key.
    pub fn parse(text: &str) -> Result<Self, String> {
        let config: Self = toml::from_str(text).map_err(|e| e.to_string())?;
        config.check()?;
        Ok(config)
    }

    /// Whether the sizes fit together; the message names the key.
    pub fn check(&self) -> Result<(), String> {
        let fail = |message: String| Err(message);
        check_name(&self.name).map_err(|message| format!("name: {message}"))?;
        if self.classes.is_empty() {
            return fail("classes: a detector needs at least one class".into());
        }
        if !(3..=4).contains(&self.channels) {
            return fail(format!("channels = {}: 3 (xyz) or 4 (xyzi)", self.channels));
        }
        if (0..3).any(|i| !(self.range_m[i] < self.range_m[i + 3]) || !self.range_m[i].is_finite()) {
            return fail(format!("range_m = {:?}: each minimum must be below its maximum", self.range_m));
        }
        let o = &self.optimization;
        if o.epochs == 0 || o.batch_size == 0 || !(o.lr_max > 0.0) || !(o.clip_norm > 0.0) || !(o.div_factor >= 1.0) {
            return fail(
                "optimization: epochs, batch_size, lr_max and clip_norm must be above 0, div_factor at least 1".into(),
            );
        }
        if !(0.0..=1.0).contains(&o.pct_start)
            || o.momentum.iter().any(|m| !(0.0..1.0).contains(m))
            || !(o.weight_decay >= 0.0)
        {
            return fail("optimization: pct_start in [0, 1], momentum in [0, 1), weight_decay not negative".into());
        }
        at_most(MOST_CLASSES, &[("the number of classes", &[self.classes.len()])])?;
        at_most(MOST_EPOCHS, &[("optimization.epochs", &[o.epochs])])?;
        at_most(MOST_BATCH, &[("optimization.batch_size", &[o.batch_size])])?;
        if let Some(ground) = &self.ground {
            ground.check()?;
        }
        self.network.check(self)
    }
}
