//! Causes: what can be wrong with a simulated sensor, scene or label.

use super::{Family, identifiers};
use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};
use std::fmt;

identifiers! {
    /// A cause of a difference between measured and simulated data.
    Cause {
        /// The direction of each beam scatters from shot to shot.
        AngularJitter = "angular_jitter",
        /// Rows aim at other elevations than the simulation's.
        BeamElevationOffset = "beam_elevation_offset",
        /// Rows differ in intensity on the same surface.
        BeamIntensity = "beam_intensity",
        /// Each row has a range offset of its own.
        BeamRangeOffset = "beam_range_offset",
        /// Bright targets have a halo of false returns at their range.
        Blooming = "blooming",
        /// Shots beside bright targets return nothing.
        BrightTargetDropout = "bright_target_dropout",
        /// Coordinates are rounded.
        CoordinateRounding = "coordinate_rounding",
        /// A patch of directions loses returns: dirt on the sensor's window.
        DirtyWindow = "dirty_window",
        /// Some shots have a second return, farther away.
        DualReturns = "dual_returns",
        /// The ego vehicle pitches with the square of its speed.
        EgoAttitude = "ego_attitude",
        /// A part of the ego vehicle hides some directions.
        EgoOcclusion = "ego_occlusion",
        /// Fog: droplets return light, ever fewer with range, and the light of surfaces falls.
        Fog = "fog",
        /// Shots that a surface mirrors return from others, behind it.
        Ghosts = "ghosts",
        /// The ground is not where the simulation has it, or not the plane that it is taken for.
        GroundError = "ground_error",
        /// Single ranges are much farther off than the others.
        HeavyTails = "heavy_tails",
        /// Returns are lost at grazing incidence.
        IncidenceDropout = "incidence_dropout",
        /// Range noise grows with the angle of incidence.
        IncidenceNoise = "incidence_noise",
        /// Intensities depend otherwise on brightness, range or incidence.
        IntensityLaw = "intensity_law",
        /// Labels are displaced by a constant.
        LabelOffset = "label_offset",
        /// One kind of surface loses returns.
        MaterialDropout = "material_dropout",
        /// Things stand on one side only.
        MissingObject = "missing_object",
        /// A beam that meets two surfaces reports a range between them.
        MixedPixels = "mixed_pixels",
        /// Nothing is measured nearer than a range.
        NearCut = "near_cut",
        /// False alarms.
        Outliers = "outliers",
        /// Neighbouring shots are lost together, in a few places of each scan: packets are lost.
        PacketLoss = "packet_loss",
        /// The ego vehicle is pitched or rolled against the simulation.
        PitchRoll = "pitch_roll",
        /// Ranges are rounded.
        Quantisation = "quantisation",
        /// Rain: drops near the sensor return light.
        Rain = "rain",
        /// The same share of returns is lost everywhere.
        RandomDropout = "random_dropout",
        /// A constant range offset or a scale error.
        RangeBias = "range_bias",
        /// Nothing is measured beyond a range.
        RangeCut = "range_cut",
        /// A range offset that grows over the recording, as by warm-up.
        RangeDrift = "range_drift",
        /// Returns are lost with range.
        RangeDropout = "range_dropout",
        /// Ranges scatter.
        RangeNoise = "range_noise",
        /// Range walk: ranges depend on how bright a surface is.
        ReflectivityWalk = "reflectivity_walk",
        /// Motion distortion: a scan takes its time and is not de-skewed.
        RollingShutter = "rolling_shutter",
        /// One sensor is mounted otherwise than the rig says.
        SensorExtrinsics = "sensor_extrinsics",
        /// Returns are lost as the received signal falls.
        SignalDropout = "signal_dropout",
        /// Range noise grows as the received signal falls.
        SignalNoise = "signal_noise",
        /// Spray or dust behind vehicles returns light.
        Spray = "spray",
        /// Labels or objects are stamped late or early.
        TimeOffset = "time_offset",
        /// No cause of the catalogue: the difference depends on row or azimuth.
        Unexplained = "unexplained",
        /// Objects have another size or shape.
        WrongShape = "wrong_shape",
    }
}

impl Cause {
    /// Its family, and its place in the extended sensor model: the world first, then shots, returns, range values and
    /// labels. Places have gaps for new causes; causes without an effect of the simulator come last.
    const fn entry(self) -> (Family, u16) {
        match self {
            Cause::MissingObject => (Family::Geometry, 10),
            Cause::WrongShape => (Family::Geometry, 20),
            Cause::PitchRoll => (Family::Geometry, 30),
            Cause::EgoAttitude => (Family::Geometry, 35),
            Cause::SensorExtrinsics => (Family::Geometry, 40),
            Cause::BeamElevationOffset => (Family::Geometry, 50),
            Cause::AngularJitter => (Family::RangeError, 60),
            Cause::RollingShutter => (Family::Timing, 70),
            Cause::MixedPixels => (Family::Returns, 80),
            Cause::DualReturns => (Family::Returns, 85),
            Cause::Blooming => (Family::Returns, 87),
            Cause::BrightTargetDropout => (Family::Detection, 88),
            Cause::EgoOcclusion => (Family::Detection, 90),
            Cause::DirtyWindow => (Family::Detection, 95),
            Cause::MaterialDropout => (Family::Detection, 100),
            Cause::SignalDropout => (Family::Detection, 110),
            Cause::IncidenceDropout => (Family::Detection, 120),
            Cause::RangeDropout => (Family::Detection, 130),
            Cause::RandomDropout => (Family::Detection, 140),
            Cause::Outliers => (Family::Returns, 150),
            Cause::Fog => (Family::Returns, 152),
            Cause::Rain => (Family::Returns, 154),
            Cause::Spray => (Family::Returns, 156),
            Cause::Ghosts => (Family::Returns, 158),
            Cause::RangeBias => (Family::RangeError, 160),
            Cause::RangeDrift => (Family::RangeError, 165),
            Cause::BeamRangeOffset => (Family::RangeError, 170),
            Cause::ReflectivityWalk => (Family::RangeError, 175),
            Cause::RangeNoise => (Family::RangeError, 180),
            Cause::IncidenceNoise => (Family::RangeError, 185),
            Cause::SignalNoise => (Family::RangeError, 190),
            Cause::HeavyTails => (Family::RangeError, 191),
            Cause::BeamIntensity => (Family::Returns, 192),
            Cause::IntensityLaw => (Family::Returns, 194),
            Cause::RangeCut => (Family::Detection, 200),
            Cause::NearCut => (Family::Detection, 201),
            Cause::PacketLoss => (Family::Detection, 203),
            Cause::Unexplained => (Family::Unknown, 205),
            Cause::Quantisation => (Family::RangeError, 210),
            Cause::CoordinateRounding => (Family::RangeError, 212),
            Cause::LabelOffset => (Family::Labels, 220),
            Cause::TimeOffset => (Family::Timing, 230),
            Cause::GroundError => (Family::Geometry, LAST),
        }
    }

    /// The family that a finding of it belongs to.
    pub const fn family(self) -> Family {
        self.entry().0
    }

    /// Where its effect stands in the extended sensor model: smaller numbers act earlier.
    pub const fn place(self) -> u16 {
        self.entry().1
    }
}

/// Place of findings that are written after all effects with a place of their own.
const LAST: u16 = u16::MAX;

identifiers! {
    /// Covariates that a law of range noise may have.
    NoiseForm {
        /// Constant.
        Constant = "the same everywhere",
        /// Grows with the angle of incidence.
        Incidence = "with incidence",
        /// Grows with range.
        Range = "with range",
        /// Grows with both.
        RangeAndIncidence = "with range and incidence",
    }
}

/// A hypothesis as the list of what was considered has it: a cause, or a form of it; written as `CAUSE` or `CAUSE,
/// FORM`.
#[derive(Clone, Copy, Debug, PartialEq, Eq, JsonSchema)]
#[schemars(with = "String")]
pub struct Hypothesis {
    /// The cause.
    pub cause: Cause,
    /// Its form, where several were compared.
    pub form: Option<NoiseForm>,
}

impl From<Cause> for Hypothesis {
    fn from(cause: Cause) -> Self {
        Hypothesis { cause, form: None }
    }
}

impl Serialize for Hypothesis {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl fmt::Display for Hypothesis {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self.form {
            None => f.write_str(self.cause.name()),
            Some(form) => write!(f, "{}, {form}", self.cause),
        }
    }
}

impl<'de> Deserialize<'de> for Hypothesis {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        let (cause, form) = text.split_once(", ").map_or((text.as_str(), None), |(cause, form)| (cause, Some(form)));
        let unknown = || D::Error::custom(format!("unknown hypothesis `{text}`"));
        let cause = *Cause::ALL.iter().find(|c| c.name() == cause).ok_or_else(unknown)?;
        let form = match form {
            None => None,
            Some(form) => Some(*NoiseForm::ALL.iter().find(|f| f.name() == form).ok_or_else(unknown)?),
        };
        Ok(Hypothesis { cause, form })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hypotheses_are_written_and_read_with_their_form() {
        let noise = Hypothesis { cause: Cause::RangeNoise, form: Some(NoiseForm::Range) };
        for (hypothesis, text) in [(noise, "range_noise, with range"), (Cause::RangeCut.into(), "range_cut")] {
            assert_eq!(serde_json::to_value(hypothesis).unwrap(), text);
            assert_eq!(serde_json::from_value::<Hypothesis>(text.into()).unwrap(), hypothesis);
        }
    }
}
