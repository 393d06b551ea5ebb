//! What may be hidden in the measured side, and the truth that is told afterwards.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Which clock is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// That of the targets' positions.
    Targets,
    /// That of the cloud against all positions, the ego car's too.
    Cloud,
}

#[expect(missing_docs, reason = "the variants say what their numbers are, the names say the units")]
/// A hidden difference. Forms differ on purpose from the usual textbook ones.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Noise along the ray: a sum of uniform numbers, standard deviation in m, growing with range by a share per m.
    RangeNoise { sigma_m: f64, growth_per_m: f64 },
    /// Added to every range: an offset and a share of the range.
    RangeBias { offset_m: f64, scale: f64 },
    /// A fixed offset for each row of each sensor, uniform, of that standard deviation.
    BeamRangeOffset { std_m: f64 },
    /// A fixed error of each row's elevation, uniform, of that standard deviation.
    BeamElevationOffset { std_rad: f64 },
    /// Ranges rounded to whole steps.
    Quantisation { step_m: f64 },
    /// The light goes elsewhere than the sensor believes; uniform on a disc, standard deviation of each angle.
    AngularJitter { sigma_rad: f64 },
    /// Returns are lost at random.
    RandomDropout { share: f64 },
    /// Returns are lost as the received energy with speckle falls below a threshold.
    SignalDropout { half_at: f64, speckle: f64 },
    /// Returns are lost with range alone.
    RangeDropout { half_at_m: f64, softness_m: f64 },
    /// Returns are lost with the angle of incidence alone.
    IncidenceDropout { half_at_cos: f64, power: f64 },
    /// One class of surface is darker than believed.
    MaterialDropout { tyres: bool, share: f64 },
    /// Nothing beyond a range.
    RangeCut { max_m: f64 },
    /// A part of the own car stands in the way: a plate in front of the sensor.
    EgoOcclusion { center_m: [f64; 3], size_m: [f64; 3] },
    /// Labels are late or early.
    TimeOffset { seconds: f64, clock: Clock },
    /// Labels are off by a constant in the target's own frame: forward, left, up.
    LabelOffset { offset_m: [f64; 3] },
    /// One sensor is mounted otherwise than believed: turns about x, y, z, and a shift.
    SensorExtrinsics { sensor: usize, turn_rad: [f64; 3], shift_m: [f64; 3] },
    /// The own car leans otherwise than believed, in all frames.
    PitchRoll { pitch_rad: f64, roll_rad: f64 },
    /// The scan takes its time and nobody corrects it.
    RollingShutter { scan_s: f64 },
    /// False alarms, uniform over range.
    Outliers { share: f64 },
    /// Beams have a width; at an edge the ranges mix.
    MixedPixels { divergence_rad: f64 },
    /// Things beside the road that the simulation has not got.
    MissingObject { things: usize },
    /// Cars have another form than believed: longer and higher by these shares.
    WrongShape { length: f64, height: f64 },
    /// Not of the catalogue: the range waves with the azimuth.
    AzimuthRipple { amplitude_m: f64, waves: f64 },
    /// Not of the catalogue: losses in stripes of elevation.
    StripedLoss { share: f64, stripes: f64 },
    /// Not of the catalogue: noise that grows towards one side of the field of view.
    SidedNoise { sigma_m: f64 },
    /// Not of the catalogue: losses within an ellipse of directions of the first sensor, with a soft edge. Its middle is told as a share of the
    /// field of view, from -1/2 to 1/2 across and from 0 at the lowest row to 1.
    Smear { share: f64, middle: [f64; 2], half_rad: [f64; 2] },
}

impl Effect {
    /// The catalogue's name; `None` for what is not in it.
    pub fn cause(&self) -> Option<&'static str> {
        Some(match self {
            Effect::RangeNoise { .. } => "range_noise",
            Effect::RangeBias { .. } => "range_bias",
            Effect::BeamRangeOffset { .. } => "beam_range_offset",
            Effect::BeamElevationOffset { .. } => "beam_elevation_offset",
            Effect::Quantisation { .. } => "quantisation",
            Effect::AngularJitter { .. } => "angular_jitter",
            Effect::RandomDropout { .. } => "random_dropout",
            Effect::SignalDropout { .. } => "signal_dropout",
            Effect::RangeDropout { .. } => "range_dropout",
            Effect::IncidenceDropout { .. } => "incidence_dropout",
            Effect::MaterialDropout { .. } => "material_dropout",
            Effect::RangeCut { .. } => "range_cut",
            Effect::EgoOcclusion { .. } => "ego_occlusion",
            Effect::TimeOffset { .. } => "time_offset",
            Effect::LabelOffset { .. } => "label_offset",
            Effect::SensorExtrinsics { .. } => "sensor_extrinsics",
            Effect::PitchRoll { .. } => "pitch_roll",
            Effect::RollingShutter { .. } => "rolling_shutter",
            Effect::Outliers { .. } => "outliers",
            Effect::MixedPixels { .. } => "mixed_pixels",
            Effect::MissingObject { .. } => "missing_object",
            Effect::WrongShape { .. } => "wrong_shape",
            Effect::AzimuthRipple { .. }
            | Effect::StripedLoss { .. }
            | Effect::SidedNoise { .. }
            | Effect::Smear { .. } => return None,
        })
    }
}

/// One hidden difference as it is told.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Hidden {
    /// The catalogue's name; of what is not in it, a description.
    pub cause: String,
    /// Whether the catalogue has it.
    pub in_catalogue: bool,
    /// True values; the names say the units.
    pub parameters: BTreeMap<String, f64>,
    /// Standard errors of an estimator that knows the form, for some of the parameters.
    pub bound: BTreeMap<String, f64>,
    /// Returns of all frames that what is hidden takes away, adds, or puts elsewhere by more than 0.35 m; 0 of what changes all a little.
    pub touched: f64,
}

/// What a case hides.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// Seed of the case.
    pub seed: u64,
    /// `null`, `single`, `pair`, `off_catalogue` or `shuffled`.
    pub kind: String,
    /// All hidden differences.
    pub hidden: Vec<Hidden>,
}

impl Effect {
    /// The true values by name.
    pub fn parameters(&self) -> BTreeMap<String, f64> {
        let deg = f64::to_degrees;
        let list: Vec<(&str, f64)> = match self {
            Effect::RangeNoise { sigma_m, growth_per_m } => {
                vec![("std_m", *sigma_m), ("per_m", growth_per_m * sigma_m)]
            }
            Effect::RangeBias { offset_m, scale } => vec![("offset_m", *offset_m), ("scale", *scale)],
            Effect::BeamRangeOffset { std_m } => vec![("std_m", *std_m)],
            Effect::BeamElevationOffset { std_rad } => vec![("std_deg", deg(*std_rad))],
            Effect::Quantisation { step_m } => vec![("step_m", *step_m)],
            Effect::AngularJitter { sigma_rad } => vec![("std_deg", deg(*sigma_rad))],
            Effect::RandomDropout { share } => vec![("share", *share)],
            Effect::SignalDropout { half_at, speckle } => vec![("half_at", *half_at), ("speckle", *speckle)],
            Effect::RangeDropout { half_at_m, softness_m } => {
                vec![("half_at_m", *half_at_m), ("softness_m", *softness_m)]
            }
            Effect::IncidenceDropout { half_at_cos, power } => vec![("cos_half", *half_at_cos), ("power", *power)],
            Effect::MaterialDropout { share, .. } => vec![("share", *share)],
            Effect::RangeCut { max_m } => vec![("max_m", *max_m)],
            Effect::EgoOcclusion { center_m, .. } => vec![("center_x_m", center_m[0]), ("center_y_m", center_m[1])],
            Effect::TimeOffset { seconds, .. } => vec![("offset_s", -seconds)],
            Effect::LabelOffset { offset_m } => {
                vec![("forward_m", offset_m[0]), ("left_m", offset_m[1]), ("up_m", offset_m[2])]
            }
            Effect::SensorExtrinsics { sensor, turn_rad, shift_m } => vec![
                ("sensor", *sensor as f64),
                ("roll_deg", deg(turn_rad[0])),
                ("pitch_deg", deg(turn_rad[1])),
                ("yaw_deg", deg(turn_rad[2])),
                ("forward_m", shift_m[0]),
                ("left_m", shift_m[1]),
                ("up_m", shift_m[2]),
            ],
            Effect::PitchRoll { pitch_rad, roll_rad } => {
                vec![("pitch_deg", deg(*pitch_rad)), ("roll_deg", deg(*roll_rad))]
            }
            Effect::RollingShutter { scan_s } => vec![("scan_s", *scan_s)],
            Effect::Outliers { share } => vec![("rate", *share)],
            Effect::MixedPixels { divergence_rad } => vec![("divergence_rad", *divergence_rad)],
            Effect::MissingObject { things } => vec![("things", *things as f64)],
            Effect::WrongShape { length, height } => vec![("length_share", *length), ("height_share", *height)],
            Effect::AzimuthRipple { amplitude_m, waves } => vec![("amplitude_m", *amplitude_m), ("waves", *waves)],
            Effect::StripedLoss { share, stripes } => vec![("share", *share), ("stripes", *stripes)],
            Effect::SidedNoise { sigma_m } => vec![("sigma_m", *sigma_m)],
            Effect::Smear { share, middle, half_rad } => vec![
                ("share", *share),
                ("across", middle[0]),
                ("up", middle[1]),
                ("half_width_deg", deg(half_rad[0])),
                ("half_height_deg", deg(half_rad[1])),
            ],
        };
        list.into_iter().map(|(k, v)| (k.to_owned(), v)).collect()
    }
}
