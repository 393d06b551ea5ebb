//! Effects that can be hidden in the measured side.

use score::in_catalogue;
use std::collections::BTreeMap;

/// The clock that is wrong.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clock {
    /// Clock of the labelled objects.
    Objects,
    /// Clock of the cloud relative to all positions, the ego vehicle's included.
    Cloud,
}

/// Surfaces that lose returns.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dark {
    /// Tyres.
    Tyres,
    /// Painted and glass parts of vehicles.
    Bodies,
}

/// A soft-edged ellipse of directions of a sensor, rad.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spot {
    /// Number of the sensor.
    pub sensor: usize,
    /// Azimuth and elevation of the centre.
    pub center: [f64; 2],
    /// Radius along azimuth and elevation at which the effect has fallen to one half.
    pub radius: [f64; 2],
}

/// A hidden effect. The variants say what their numbers are, the names say the units. Functional forms differ from
/// those of `tests/blind` and from those that the diagnosis fits.
#[expect(missing_docs, reason = "the variants say what their numbers are, the names say the units")]
#[derive(Clone, Debug, PartialEq)]
pub enum Effect {
    /// Range noise: a mixture of two normal distributions. `growth` adds a part that grows with range, in squares.
    RangeNoise { std_m: f64, growth: f64 },
    /// Range bias: an offset and a scale error with a slight curvature.
    RangeBias { offset_m: f64, scale: f64 },
    /// A range offset per row, Laplace distributed; the standard deviation is that of the rows.
    BeamRangeOffset { std_m: f64 },
    /// An elevation error per row, smooth over the rows and random; the standard deviation is that of the rows.
    BeamElevationOffset { std_rad: f64 },
    /// Rounding of nearly all ranges.
    Quantisation { step_m: f64 },
    /// Direction noise: triangular in both angles.
    AngularJitter { std_rad: f64 },
    /// Loss of returns everywhere; the share varies a little from frame to frame.
    RandomDropout { share: f64 },
    /// Loss with falling signal, ln(rho cos / R^2): a Gompertz function.
    SignalDropout { half_at: f64, steepness: f64 },
    /// Loss with range: an error function.
    RangeDropout { half_at_m: f64, softness_m: f64 },
    /// Loss at grazing incidence: an error function of a power of the cosine.
    IncidenceDropout { cos_half: f64, power: f64 },
    /// Loss on one class of surfaces.
    MaterialDropout { dark: Dark, share: f64 },
    /// Nothing is measured beyond a range.
    RangeCut { max_m: f64 },
    /// A rack on the ego vehicle, or a part in front of the grille: a box in the vehicle frame.
    EgoOcclusion { center_m: [f64; 3], size_m: [f64; 3], returns: bool },
    /// Time offset of labels or cloud.
    TimeOffset { seconds: f64, clock: Clock },
    /// Constant label offset in the frame of the object: forward, left, up.
    LabelOffset { offset_m: [f64; 3] },
    /// Wrong extrinsics of one sensor: turns about x, y, z, and a shift.
    SensorExtrinsics { sensor: usize, turn_rad: [f64; 3], shift_m: [f64; 3] },
    /// Constant pitch and roll error of the ego pose.
    PitchRoll { pitch_rad: f64, roll_rad: f64 },
    /// Motion during the scan that is not corrected; the mirror does not turn evenly.
    RollingShutter { scan_s: f64 },
    /// False alarms: more of them near.
    Outliers { share: f64, reach_m: f64 },
    /// A beam with a Gaussian profile and a pulse of some length: surfaces within a pulse are mixed.
    MixedPixels { divergence_rad: f64, pulse_m: f64 },
    /// Things that only one side has: containers in the measured side, or parked cars in the simulation.
    MissingObject { things: usize, surplus: bool },
    /// Vehicles that are longer and higher by these shares.
    WrongShape { length: f64, height: f64 },
    /// A few ranges with a large, Laplace distributed error.
    HeavyTails { share: f64, std_m: f64 },
    /// Range noise that grows as the signal falls: `std_m` where u = ln(rho cos / R^2) - ln(0.1 / 250^2) is 4.
    SignalNoise { std_m: f64, growth: f64 },
    /// Bright surfaces appear nearer, dark ones farther.
    ReflectivityWalk { walk_m: f64 },
    /// A gain of the intensity per row: `std` of its logarithm.
    BeamIntensity { std: f64 },
    /// Range noise from the footprint on inclined surfaces.
    IncidenceNoise { angle_rad: f64 },
    /// The ground is uneven where it is modelled smooth.
    GroundError { amplitude_m: f64 },
    /// Packets of some columns are lost, in bursts.
    PacketLoss { loss: f64, burst: f64 },
    /// Dirt on a window: loss and noise in a spot.
    DirtyWindow { spot: Spot, share: f64, noise_m: f64 },
    /// Halos of bright signs.
    Blooming { strength: f64, halo_rad: f64 },
    /// Returns next to bright signs are lost.
    BrightTargetDropout { share: f64, halo_rad: f64 },
    /// Returns by way of a mirroring window or car.
    Ghosts { probability: f64 },
    /// Second returns behind edges.
    DualReturns { divergence_rad: f64, share: f64 },
    /// Drops near the sensor and a little attenuation.
    Rain { drops: f64, per_m: f64 },
    /// Attenuation and backscatter.
    Fog { visibility_m: f64, backscatter: f64 },
    /// Plumes behind moving cars; the density grows with the square of the speed and is given at 8 m/s.
    Spray { per_m: f64 },
    /// A common range offset that approaches a value with time.
    RangeDrift { drift_m: f64 },
    /// Pitch that grows with the square of the speed; given at 10 m/s.
    EgoAttitude { pitch_rad: f64 },
    /// Nothing is measured nearer than a range.
    RangeLimits { min_m: f64 },
    /// In no catalogue: a range drift of opposite sign in even and odd rows.
    ThermalRows { drift_m: f64 },
    /// In no catalogue: in some frames ranges in a sector are noisy and some are lost.
    Bursts { frames: f64, std_m: f64 },
    /// In no catalogue: an error of the azimuth that is periodic in the azimuth.
    EncoderRipple { amplitude_rad: f64, waves: f64 },
    /// In no catalogue: false returns in oblique stripes that move from frame to frame.
    Interference { share: f64, stripes: f64 },
    /// In no catalogue: the mount nods with a fixed frequency.
    MountVibration { amplitude_rad: f64, hz: f64 },
    /// In no catalogue: walls are wavy.
    WavyWalls { amplitude_m: f64, length_m: f64 },
    /// In no catalogue: a range error that is periodic in the range.
    RangeRipple { amplitude_m: f64, length_m: f64 },
    /// In no catalogue: every so many columns lose returns.
    ColumnLoss { share: f64, every: usize },
}

impl Effect {
    /// Name of the cause in the catalogue of the diagnosis; otherwise the kind of the simulator's effect, or a
    /// description.
    pub fn cause(&self) -> &'static str {
        match self {
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
            Effect::HeavyTails { .. } => "heavy_tails",
            Effect::SignalNoise { .. } => "signal_noise",
            Effect::ReflectivityWalk { .. } => "reflectivity_walk",
            Effect::BeamIntensity { .. } => "beam_intensity",
            Effect::IncidenceNoise { .. } => "incidence_noise",
            Effect::GroundError { .. } => "ground_error",
            Effect::PacketLoss { .. } => "packet_loss",
            Effect::DirtyWindow { .. } => "dirty_window",
            Effect::Blooming { .. } => "blooming",
            Effect::BrightTargetDropout { .. } => "bright_target_dropout",
            Effect::Ghosts { .. } => "ghosts",
            Effect::DualReturns { .. } => "dual_returns",
            Effect::Rain { .. } => "rain",
            Effect::Fog { .. } => "fog",
            Effect::Spray { .. } => "spray",
            Effect::RangeDrift { .. } => "range_drift",
            Effect::EgoAttitude { .. } => "ego_attitude",
            Effect::RangeLimits { .. } => "near_cut",
            Effect::ThermalRows { .. } => "thermal_rows",
            Effect::Bursts { .. } => "bursts",
            Effect::EncoderRipple { .. } => "encoder_ripple",
            Effect::Interference { .. } => "interference",
            Effect::MountVibration { .. } => "mount_vibration",
            Effect::WavyWalls { .. } => "wavy_walls",
            Effect::RangeRipple { .. } => "range_ripple",
            Effect::ColumnLoss { .. } => "column_loss",
        }
    }

    /// Whether the present diagnosis can name it.
    pub fn in_catalogue(&self) -> bool {
        in_catalogue(self.cause())
    }

    /// All true parameter values by name, with the names and units of the diagnosis where it has them.
    pub fn parameters(&self) -> BTreeMap<String, f64> {
        let deg = f64::to_degrees;
        let list: Vec<(&str, f64)> = match *self {
            Effect::RangeNoise { std_m, growth } => match growth {
                0.0 => vec![("std_m", std_m), ("per_m", 0.0)],
                _ => vec![("floor_m", std_m), ("growth", growth)],
            },
            Effect::RangeBias { offset_m, scale } => vec![("offset_m", offset_m), ("scale", scale)],
            Effect::BeamRangeOffset { std_m } => vec![("std_m", std_m)],
            Effect::BeamElevationOffset { std_rad } => vec![("std_deg", deg(std_rad))],
            Effect::Quantisation { step_m } => vec![("step_m", step_m)],
            Effect::AngularJitter { std_rad } => vec![("std_deg", deg(std_rad))],
            Effect::RandomDropout { share } => vec![("share", share)],
            Effect::SignalDropout { half_at, steepness } => {
                vec![("half_at", half_at), ("gompertz_steepness", steepness)]
            }
            Effect::RangeDropout { half_at_m, softness_m } => {
                vec![("half_at_m", half_at_m), ("softness_m", softness_m)]
            }
            Effect::IncidenceDropout { cos_half, power } => vec![("cos_half", cos_half), ("power", power)],
            Effect::MaterialDropout { share, .. } => vec![("share", share)],
            Effect::RangeCut { max_m } => vec![("max_m", max_m)],
            Effect::EgoOcclusion { center_m, size_m, .. } => vec![
                ("center_x_m", center_m[0]),
                ("center_y_m", center_m[1]),
                ("center_z_m", center_m[2]),
                ("size_x_m", size_m[0]),
                ("size_y_m", size_m[1]),
                ("size_z_m", size_m[2]),
            ],
            Effect::TimeOffset { seconds, .. } => vec![("offset_s", -seconds)],
            Effect::LabelOffset { offset_m } => {
                vec![("forward_m", offset_m[0]), ("left_m", offset_m[1]), ("up_m", offset_m[2])]
            }
            Effect::SensorExtrinsics { sensor, turn_rad, shift_m } => vec![
                ("sensor", sensor as f64),
                ("roll_deg", deg(turn_rad[0])),
                ("pitch_deg", deg(turn_rad[1])),
                ("yaw_deg", deg(turn_rad[2])),
                ("forward_m", shift_m[0]),
                ("left_m", shift_m[1]),
                ("up_m", shift_m[2]),
            ],
            Effect::PitchRoll { pitch_rad, roll_rad } => {
                vec![("pitch_deg", deg(pitch_rad)), ("roll_deg", deg(roll_rad))]
            }
            Effect::RollingShutter { scan_s } => vec![("scan_s", scan_s)],
            Effect::Outliers { share, reach_m } => vec![("rate", share), ("reach_m", reach_m)],
            Effect::MixedPixels { divergence_rad, pulse_m } => {
                vec![("divergence_rad", divergence_rad), ("pulse_m", pulse_m)]
            }
            Effect::MissingObject { things, surplus } => {
                vec![("things", things as f64), ("surplus", f64::from(u8::from(surplus)))]
            }
            Effect::WrongShape { length, height } => vec![("length_share", length), ("height_share", height)],
            Effect::HeavyTails { share, std_m } => vec![("share", share), ("std_m", std_m)],
            Effect::SignalNoise { std_m, growth } => vec![("std_m", std_m), ("growth", growth)],
            Effect::ReflectivityWalk { walk_m } => vec![("walk_m", walk_m)],
            Effect::BeamIntensity { std } => vec![("std", std)],
            Effect::IncidenceNoise { angle_rad } => vec![("angle_rad", angle_rad)],
            Effect::GroundError { amplitude_m } => vec![("amplitude_m", amplitude_m)],
            // The share of lost packets as the probability that one is lost after one that arrived.
            Effect::PacketLoss { loss, burst } => vec![("loss", loss * (1.0 - burst) / (1.0 - loss)), ("burst", burst)],
            Effect::DirtyWindow { spot, share, noise_m } => vec![
                ("sensor", spot.sensor as f64),
                ("azimuth_deg", deg(spot.center[0])),
                ("elevation_deg", deg(spot.center[1])),
                ("half_width_deg", deg(spot.radius[0])),
                ("half_height_deg", deg(spot.radius[1])),
                ("share", share),
                ("noise_m", noise_m),
            ],
            Effect::Blooming { strength, halo_rad } => vec![("strength", strength), ("halo_deg", deg(halo_rad))],
            Effect::BrightTargetDropout { share, halo_rad } => vec![("share", share), ("halo_deg", deg(halo_rad))],
            Effect::Ghosts { probability } => vec![("probability", probability)],
            Effect::DualReturns { divergence_rad, share } => {
                vec![("divergence_rad", divergence_rad), ("reported_share", share)]
            }
            Effect::Rain { drops, per_m } => vec![("drops", drops), ("per_m", per_m)],
            Effect::Fog { visibility_m, backscatter } => {
                vec![("visibility_m", visibility_m), ("backscatter", backscatter)]
            }
            Effect::Spray { per_m } => vec![("density_per_m", per_m)],
            Effect::RangeDrift { drift_m } => vec![("drift_m", drift_m)],
            Effect::EgoAttitude { pitch_rad } => vec![("pitch_at_70mps_deg", deg(49.0 * pitch_rad))],
            Effect::RangeLimits { min_m } => vec![("min_m", min_m)],
            Effect::ThermalRows { drift_m } => vec![("drift_m", drift_m)],
            Effect::Bursts { frames, std_m } => vec![("frames", frames), ("std_m", std_m)],
            Effect::EncoderRipple { amplitude_rad, waves } => {
                vec![("amplitude_deg", deg(amplitude_rad)), ("waves", waves)]
            }
            Effect::Interference { share, stripes } => vec![("share", share), ("stripes", stripes)],
            Effect::MountVibration { amplitude_rad, hz } => vec![("amplitude_deg", deg(amplitude_rad)), ("hz", hz)],
            Effect::WavyWalls { amplitude_m, length_m } | Effect::RangeRipple { amplitude_m, length_m } => {
                vec![("amplitude_m", amplitude_m), ("length_m", length_m)]
            }
            Effect::ColumnLoss { share, every } => vec![("share", share), ("every", every as f64)],
        };
        list.into_iter().map(|(k, v)| (k.to_owned(), v)).collect()
    }
}
