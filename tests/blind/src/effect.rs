//! Effects that can be hidden in the measured side.

use std::collections::BTreeMap;

/// The clock that is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// Clock of the target positions.
    Targets,
    /// Clock of the cloud relative to all positions, including the ego vehicle's.
    Cloud,
}

#[expect(missing_docs, reason = "the variants say what their numbers are, the names say the units")]
/// A hidden effect. Functional forms deliberately differ from the textbook ones.
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Range noise: a sum of uniform random numbers, standard deviation in m, growing linearly with range by
    /// `growth_per_m`.
    RangeNoise { sigma_m: f64, growth_per_m: f64 },
    /// Range bias: a constant offset and a scale error.
    RangeBias { offset_m: f64, scale: f64 },
    /// A constant range offset per row of each sensor, uniform with the given standard deviation.
    BeamRangeOffset { std_m: f64 },
    /// A constant elevation error per row, uniform with the given standard deviation.
    BeamElevationOffset { std_rad: f64 },
    /// Range quantisation.
    Quantisation { step_m: f64 },
    /// Beam direction jitter unknown to the sensor; uniform on a disc, standard deviation per angle.
    AngularJitter { sigma_rad: f64 },
    /// Random loss of returns.
    RandomDropout { share: f64 },
    /// Loss of returns when the received energy, with speckle, falls below a threshold.
    SignalDropout { half_at: f64, speckle: f64 },
    /// Loss of returns depending on range only.
    RangeDropout { half_at_m: f64, softness_m: f64 },
    /// Loss of returns depending on the angle of incidence only.
    IncidenceDropout { half_at_cos: f64, power: f64 },
    /// Loss of returns on one surface class: lower reflectivity than modelled.
    MaterialDropout { tyres: bool, share: f64 },
    /// No returns beyond a range.
    RangeCut { max_m: f64 },
    /// Occlusion by a part of the ego vehicle: a plate in front of the sensor.
    EgoOcclusion { center_m: [f64; 3], size_m: [f64; 3] },
    /// Time offset of the labels or the cloud.
    TimeOffset { seconds: f64, clock: Clock },
    /// Constant label offset in the target frame: forward, left, up.
    LabelOffset { offset_m: [f64; 3] },
    /// Wrong extrinsics of one sensor: rotations about x, y, z, and a translation.
    SensorExtrinsics { sensor: usize, turn_rad: [f64; 3], shift_m: [f64; 3] },
    /// Constant pitch and roll error of the ego pose.
    PitchRoll { pitch_rad: f64, roll_rad: f64 },
    /// Uncorrected motion distortion of the scan.
    RollingShutter { scan_s: f64 },
    /// False alarms, uniform over range.
    Outliers { share: f64 },
    /// Beam divergence: ranges mix at edges.
    MixedPixels { divergence_rad: f64 },
    /// Objects beside the road that the simulation lacks.
    MissingObject { things: usize },
    /// Wrong target shape: longer and higher by these fractions.
    WrongShape { length: f64, height: f64 },
    /// Not in the catalogue: range error periodic in azimuth.
    AzimuthRipple { amplitude_m: f64, waves: f64 },
    /// Not in the catalogue: losses in stripes of elevation.
    StripedLoss { share: f64, stripes: f64 },
    /// Not in the catalogue: noise that grows towards one side of the field of view.
    SidedNoise { sigma_m: f64 },
    /// Losses within an ellipse of directions of the first sensor, with a soft edge. `middle` is
    /// given as a fraction of the field of view: -1/2 to 1/2 horizontally, 0 (lowest row) to 1 vertically.
    Smear { share: f64, middle: [f64; 2], half_rad: [f64; 2] },
}

impl Effect {
    /// Name in the catalogue; `None` if not in it.
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
            Effect::Smear { .. } => "dirty_window",
            Effect::AzimuthRipple { .. } | Effect::StripedLoss { .. } | Effect::SidedNoise { .. } => return None,
        })
    }
}

impl Effect {
    /// All true parameter values by name.
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
