//! Parts of effects: parameters that scale a part of an effect, and the effect without that part.

use crate::effect::Effect;

/// A part of an effect.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Name of the parameter that scales it; empty if none does.
    pub name: &'static str,
    /// Value of this parameter in the unit of its name.
    pub value: f64,
    /// What the parameter scales.
    pub scaling: Scaling,
    /// The effect without the part; `None` if nothing remains.
    pub remaining: Option<Effect>,
    /// The effect with the part smaller by [`SMALLER`], if the part turns or shifts rays. Its difference from the whole
    /// effect is a derivative, which can be compared with that by an unknown pose.
    pub nearly: Option<Effect>,
}

/// By how much a part is smaller in [`Part::nearly`].
pub const SMALLER: f64 = 0.01;

/// What a parameter scales.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scaling {
    /// A displacement is proportional to it.
    Shift,
    /// A variance is proportional to its square.
    Deviation,
    /// It is the share of lost returns.
    LostShare,
    /// It is the share of shots that return from elsewhere.
    ClutterShare,
    /// None of these.
    Other,
}

fn whole(name: &'static str, value: f64, scaling: Scaling) -> Vec<Part> {
    vec![Part { name, value, scaling, remaining: None, nearly: None }]
}

/// An effect that turns or shifts rays, and the same effect a little smaller.
fn turning(name: &'static str, value: f64, nearly: Effect) -> Vec<Part> {
    vec![Part { name, value, scaling: Scaling::Shift, remaining: None, nearly: Some(nearly) }]
}

/// A list with one of its values a little smaller.
fn less(values: [f64; 3], k: usize) -> [f64; 3] {
    let mut values = values;
    values[k] *= 1.0 - SMALLER;
    values
}

impl Effect {
    /// The parts of an effect: at least one, together the whole effect.
    pub fn parts(&self) -> Vec<Part> {
        let mut list: Vec<(&'static str, f64, Effect, Option<Effect>)> = Vec::new();
        let keep = 1.0 - SMALLER;
        match *self {
            Effect::RangeBias { offset_m, scale } => {
                list.push(("offset_m", offset_m, Effect::RangeBias { offset_m: 0.0, scale }, None));
                list.push(("scale", scale, Effect::RangeBias { offset_m, scale: 0.0 }, None));
            }
            Effect::PitchRoll { pitch_rad, roll_rad } => {
                let of = |pitch_rad, roll_rad| Effect::PitchRoll { pitch_rad, roll_rad };
                let [nearly, rolled] = [of(keep * pitch_rad, roll_rad), of(pitch_rad, keep * roll_rad)];
                list.push(("pitch_deg", pitch_rad.to_degrees(), of(0.0, roll_rad), Some(nearly)));
                list.push(("roll_deg", roll_rad.to_degrees(), of(pitch_rad, 0.0), Some(rolled)));
            }
            Effect::LabelOffset { offset_m } => {
                for (k, name) in ["forward_m", "left_m", "up_m"].into_iter().enumerate() {
                    let mut rest = offset_m;
                    rest[k] = 0.0;
                    list.push((name, offset_m[k], Effect::LabelOffset { offset_m: rest }, None));
                }
            }
            Effect::SensorExtrinsics { sensor, turn_rad, shift_m } => {
                for (k, name) in ["roll_deg", "pitch_deg", "yaw_deg"].into_iter().enumerate() {
                    let mut rest = turn_rad;
                    rest[k] = 0.0;
                    let of = |turn_rad| Effect::SensorExtrinsics { sensor, turn_rad, shift_m };
                    list.push((name, turn_rad[k].to_degrees(), of(rest), Some(of(less(turn_rad, k)))));
                }
                for (k, name) in ["forward_m", "left_m", "up_m"].into_iter().enumerate() {
                    let mut rest = shift_m;
                    rest[k] = 0.0;
                    let of = |shift_m| Effect::SensorExtrinsics { sensor, turn_rad, shift_m };
                    list.push((name, shift_m[k], of(rest), Some(of(less(shift_m, k)))));
                }
            }
            Effect::BeamRangeOffset { std_m } => return whole("std_m", std_m, Scaling::Shift),
            Effect::BeamElevationOffset { std_rad } => {
                let nearly = Effect::BeamElevationOffset { std_rad: keep * std_rad };
                return turning("std_deg", std_rad.to_degrees(), nearly);
            }
            Effect::TimeOffset { seconds, .. } => return whole("offset_s", -seconds, Scaling::Shift),
            Effect::RollingShutter { scan_s } => {
                return turning("scan_s", scan_s, Effect::RollingShutter { scan_s: keep * scan_s });
            }
            Effect::ReflectivityWalk { walk_m } => return whole("walk_m", walk_m, Scaling::Shift),
            Effect::RangeDrift { drift_m } => return whole("drift_m", drift_m, Scaling::Shift),
            Effect::EgoAttitude { pitch_rad } => {
                let nearly = Effect::EgoAttitude { pitch_rad: keep * pitch_rad };
                return turning("pitch_at_70mps_deg", 49.0 * pitch_rad.to_degrees(), nearly);
            }
            Effect::EncoderRipple { amplitude_rad, waves } => {
                let nearly = Effect::EncoderRipple { amplitude_rad: keep * amplitude_rad, waves };
                return turning("amplitude_deg", amplitude_rad.to_degrees(), nearly);
            }
            Effect::MountVibration { amplitude_rad, hz } => {
                let nearly = Effect::MountVibration { amplitude_rad: keep * amplitude_rad, hz };
                return turning("amplitude_deg", amplitude_rad.to_degrees(), nearly);
            }
            Effect::RangeNoise { std_m, growth: 0.0 } => return whole("std_m", std_m, Scaling::Deviation),
            Effect::AngularJitter { std_rad } => return whole("std_deg", std_rad.to_degrees(), Scaling::Deviation),
            Effect::SignalNoise { std_m, .. } => return whole("std_m", std_m, Scaling::Deviation),
            Effect::IncidenceNoise { angle_rad } => return whole("angle_rad", angle_rad, Scaling::Deviation),
            Effect::RandomDropout { share } => return whole("share", share, Scaling::LostShare),
            Effect::Outliers { share, .. } => return whole("rate", share, Scaling::ClutterShare),
            _ => return whole("", 0.0, Scaling::Other),
        }
        list.retain(|(_, value, ..)| *value != 0.0);
        let alone = list.len() == 1;
        let part = |(name, value, rest, nearly)| Part {
            name,
            value,
            scaling: Scaling::Shift,
            remaining: if alone { None } else { Some(rest) },
            nearly,
        };
        list.into_iter().map(part).collect()
    }

    /// Whether the effect changes what shots meet.
    pub fn changes_rays(&self) -> bool {
        matches!(
            self,
            Effect::BeamElevationOffset { .. }
                | Effect::EgoOcclusion { .. }
                | Effect::SensorExtrinsics { .. }
                | Effect::PitchRoll { .. }
                | Effect::RollingShutter { .. }
                | Effect::MixedPixels { .. }
                | Effect::MissingObject { .. }
                | Effect::WrongShape { .. }
                | Effect::GroundError { .. }
                | Effect::DualReturns { .. }
                | Effect::EgoAttitude { .. }
                | Effect::EncoderRipple { .. }
                | Effect::MountVibration { .. }
                | Effect::WavyWalls { .. }
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn parts_are_the_nonzero_parameters() {
        let both = Effect::PitchRoll { pitch_rad: 0.01, roll_rad: -0.02 };
        let names: Vec<&str> = both.parts().iter().map(|p| p.name).collect();
        assert_eq!(names, ["pitch_deg", "roll_deg"]);
        assert_eq!(both.parts()[0].remaining, Some(Effect::PitchRoll { pitch_rad: 0.0, roll_rad: -0.02 }));
        let one = Effect::LabelOffset { offset_m: [0.0, 0.2, 0.0] }.parts();
        assert_eq!((one.len(), one[0].name, &one[0].remaining), (1, "left_m", &None));
    }
}
