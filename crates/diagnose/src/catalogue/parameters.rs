//! Parameters of findings, with their units.

use super::identifiers;
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};
use std::cmp::Ordering;
use std::fmt;

identifiers! {
    /// A parameter that a finding may have, whatever the sensor.
    Quantity {
        /// Angular size of the beam footprint or of the jitter that explains the noise.
        AngleRad = "angle_rad",
        /// Width of a patch of directions over its height.
        Aspect = "aspect",
        /// Middle of a patch of directions.
        AzimuthDeg = "azimuth_deg",
        /// Right end of the hidden directions.
        AzimuthFromDeg = "azimuth_from_deg",
        /// Left end of the hidden directions.
        AzimuthToDeg = "azimuth_to_deg",
        /// Width of the hidden directions.
        AzimuthWidthDeg = "azimuth_width_deg",
        /// Reflectivity of labelled objects over that of the ground, ln.
        BrighterObjects = "brighter_objects",
        /// Reflectivity of standing surfaces over that of the ground, ln.
        BrighterStanding = "brighter_standing",
        /// Reflectivity of the lower corners of labelled objects (wheels) over that of the ground, ln.
        BrighterWheels = "brighter_wheels",
        /// Probability that a packet is lost after one that was lost.
        Burst = "burst",
        /// Cosine of incidence at which half of the returns are lost.
        CosHalf = "cos_half",
        /// Droplets for each metre of a path behind vehicles, over all vehicles.
        DensityPerM = "density_per_m",
        /// Mean distance of droplets where nothing stands before them.
        DepthM = "depth_m",
        /// Full width of the beam.
        DivergenceRad = "divergence_rad",
        /// What a range offset grows by over the recording.
        DriftM = "drift_m",
        /// Middle of a patch of directions.
        ElevationDeg = "elevation_deg",
        /// Lower end of the hidden directions.
        ElevationFromDeg = "elevation_from_deg",
        /// Upper end of the hidden directions.
        ElevationToDeg = "elevation_to_deg",
        /// Exponent of the noise over the signal.
        Exponent = "exponent",
        /// Shift along the x axis of the object, or of the sensor.
        ForwardM = "forward_m",
        /// Factor on the intensity.
        Gain = "gain",
        /// Exponent of the intensity.
        Gamma = "gamma",
        /// Range at which half of the returns are lost.
        HalfAtM = "half_at_m",
        /// Angle from a bright target at which the rate of false returns has fallen to 1/e.
        HaloDeg = "halo_deg",
        /// Height of what is behind vehicles over the ground.
        HeightM = "height_m",
        /// Measured objects are higher by this.
        HigherM = "higher_m",
        /// Exponent of the cosine of incidence in the intensity.
        IncidenceExponent = "incidence_exponent",
        /// Shift along the y axis of the object, or of the sensor.
        LeftM = "left_m",
        /// Length of what is behind vehicles.
        LengthM = "length_m",
        /// Measured objects are longer by this.
        LongerM = "longer_m",
        /// Probability that a packet is lost after one that arrived.
        Loss = "loss",
        /// Largest range that is measured.
        MaxM = "max_m",
        /// Mean elevation error from the lean of walls.
        MeanByWallsDeg = "mean_by_walls_deg",
        /// Mean elevation error of all rows.
        MeanDeg = "mean_deg",
        /// Smallest range that is measured.
        MinM = "min_m",
        /// Detection probability where the law has no effect.
        Most = "most",
        /// Constant range offset.
        OffsetM = "offset_m",
        /// Time offset.
        OffsetS = "offset_s",
        /// Duration of a packet.
        PacketMs = "packet_ms",
        /// Growth of the noise with range.
        PerM = "per_m",
        /// Turn about the y axis at an ego speed of 70 m/s, where it grows with the square of the speed.
        PitchAt70MpsDeg = "pitch_at_70mps_deg",
        /// Turn about the y axis.
        PitchDeg = "pitch_deg",
        /// Longest jump of the range at an edge over which a beam mixes: about the length of a pulse.
        PulseM = "pulse_m",
        /// Radius of a patch of directions along elevation.
        RadiusDeg = "radius_deg",
        /// Exponent of the decrease of the intensity with range.
        RangeExponent = "range_exponent",
        /// False alarms for each shot.
        Rate = "rate",
        /// Largest range of false alarms.
        ReachM = "reach_m",
        /// Turn about the x axis.
        RollDeg = "roll_deg",
        /// Relative range error.
        Scale = "scale",
        /// Duration of a scan.
        ScanS = "scan_s",
        /// Number of the sensor in the rig.
        Sensor = "sensor",
        /// Share of returns.
        Share = "share",
        /// Share of the ranges at multiples of the step.
        ShareOnComb = "share_on_comb",
        /// Exponent of the profile of a patch of directions: 2 is a soft edge, 8 a sharp one.
        Sharpness = "sharpness",
        /// Displacement along x over a scan.
        ShearXM = "shear_x_m",
        /// Displacement along y over a scan.
        ShearYM = "shear_y_m",
        /// Turn about z over a scan.
        ShearYawDeg = "shear_yaw_deg",
        /// Range noise of the simulated side.
        SimulatedStdM = "simulated_std_m",
        /// Standard deviation of the intensity over rows.
        Std = "std",
        /// Standard deviation of an angle.
        StdDeg = "std_deg",
        /// Standard deviation of a range.
        StdM = "std_m",
        /// Slope of the law at one half.
        Steepness = "steepness",
        /// Quantisation step.
        StepM = "step_m",
        /// Rate of false returns of the shots beside a bright target.
        Strength = "strength",
        /// Signal at which half of the returns are lost.
        Threshold = "threshold",
        /// What shots at a quarter of the scan are early by, as a share of its duration.
        Uneven = "uneven",
        /// Shift along the z axis of the object, or of the sensor.
        UpM = "up_m",
        /// Range at which an eye sees 5 % of the contrast.
        VisibilityM = "visibility_m",
        /// Change of range for each factor e of brightness.
        WalkM = "walk_m",
        /// Measured objects are wider by this.
        WiderM = "wider_m",
        /// Turn about the z axis.
        YawDeg = "yaw_deg",
    }
}

identifiers! {
    /// Unit of a parameter.
    Unit {
        /// A share, or another number without a unit.
        One = "1",
        /// Degrees.
        Degree = "deg",
        /// Metres.
        Metre = "m",
        /// Milliseconds.
        Millisecond = "ms",
        /// For each metre.
        PerMetre = "1/m",
        /// Metres for each metre of range.
        MetrePerMetre = "m/m",
        /// A number of a sensor.
        Number = "number",
        /// Radians.
        Radian = "rad",
        /// Seconds.
        Second = "s",
    }
}

impl Quantity {
    /// Its unit.
    pub const fn unit(self) -> Unit {
        match self {
            Quantity::DepthM
            | Quantity::DriftM
            | Quantity::ForwardM
            | Quantity::HalfAtM
            | Quantity::HeightM
            | Quantity::HigherM
            | Quantity::LeftM
            | Quantity::LengthM
            | Quantity::LongerM
            | Quantity::MaxM
            | Quantity::MinM
            | Quantity::OffsetM
            | Quantity::PulseM
            | Quantity::ReachM
            | Quantity::ShearXM
            | Quantity::ShearYM
            | Quantity::SimulatedStdM
            | Quantity::StdM
            | Quantity::StepM
            | Quantity::UpM
            | Quantity::VisibilityM
            | Quantity::WalkM
            | Quantity::WiderM => Unit::Metre,
            Quantity::AzimuthDeg
            | Quantity::AzimuthFromDeg
            | Quantity::AzimuthToDeg
            | Quantity::AzimuthWidthDeg
            | Quantity::ElevationDeg
            | Quantity::ElevationFromDeg
            | Quantity::ElevationToDeg
            | Quantity::HaloDeg
            | Quantity::MeanByWallsDeg
            | Quantity::MeanDeg
            | Quantity::PitchAt70MpsDeg
            | Quantity::PitchDeg
            | Quantity::RadiusDeg
            | Quantity::RollDeg
            | Quantity::ShearYawDeg
            | Quantity::StdDeg
            | Quantity::YawDeg => Unit::Degree,
            Quantity::AngleRad | Quantity::DivergenceRad => Unit::Radian,
            Quantity::OffsetS | Quantity::ScanS => Unit::Second,
            Quantity::PacketMs => Unit::Millisecond,
            Quantity::DensityPerM => Unit::PerMetre,
            Quantity::PerM => Unit::MetrePerMetre,
            Quantity::Sensor => Unit::Number,
            _ => Unit::One,
        }
    }
}

/// Identifies a parameter of a finding: a quantity, or the value of one row of a sensor.
#[derive(Clone, Debug, PartialEq, Eq, JsonSchema)]
#[schemars(with = "String")]
pub enum ParameterId {
    /// A quantity of the catalogue.
    Of(Quantity),
    /// Offset of one row; written as `SENSOR/ROW`.
    Row {
        /// Name of the sensor.
        sensor: String,
        /// Number of the row, from the lowest.
        row: usize,
    },
}

impl From<Quantity> for ParameterId {
    fn from(quantity: Quantity) -> Self {
        ParameterId::Of(quantity)
    }
}

impl fmt::Display for ParameterId {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            ParameterId::Of(quantity) => f.write_str(quantity.name()),
            ParameterId::Row { sensor, row } => write!(f, "{sensor}/{row}"),
        }
    }
}

/// In the order of the names as they are written.
impl Ord for ParameterId {
    fn cmp(&self, other: &Self) -> Ordering {
        match (self, other) {
            (ParameterId::Of(a), ParameterId::Of(b)) => a.cmp(b),
            _ => self.to_string().cmp(&other.to_string()),
        }
    }
}

impl PartialOrd for ParameterId {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Serialize for ParameterId {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ParameterId {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        if let Some(quantity) = Quantity::ALL.iter().find(|q| q.name() == text) {
            return Ok(ParameterId::Of(*quantity));
        }
        let row = text.rsplit_once('/').and_then(|(sensor, row)| Some((sensor.to_owned(), row.parse().ok()?)));
        let (sensor, row) = row.ok_or_else(|| D::Error::custom(format!("unknown parameter `{text}`")))?;
        Ok(ParameterId::Row { sensor, row })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parameters_are_written_and_read_as_their_names() {
        let row = |row| ParameterId::Row { sensor: "a/b".into(), row };
        for (id, text) in [(Quantity::StdM.into(), "std_m"), (row(12), "a/b/12")] {
            assert_eq!(serde_json::to_value(&id).unwrap(), text);
            assert_eq!(serde_json::from_value::<ParameterId>(text.into()).unwrap(), id);
        }
        assert!(serde_json::from_value::<ParameterId>("nothing".into()).is_err());
        assert!(row(10) < row(2) && row(2) < Quantity::AzimuthDeg.into(), "the order of the text");
    }
}
