//! The sensor model: an ordered list of physical effects.
//!
//! Each effect is one file with one struct, which documents its formula, units, sources and typical values. An effect
//! can act at four stages. At each stage the effects of a list are applied in their order:
//!
//! 1. on the **world**: objects and their poses, before rays are cast;
//! 2. on the **beams**: true directions and times of the shots;
//! 3. on the **scan**: ranges, returns, intensities;
//! 4. on the **labels**.
//!
//! Each effect has its own random number streams: one for each (seed, data set, index in the list, kind, frame), and
//! one without the frame for values that are constant in a data set, such as the range offset of a beam. The result of
//! an effect therefore depends neither on effects added behind it nor on the number of threads.
//!
//! A parameter that is left out changes nothing: strengths are 0, lists are empty, limits are none. A parameter without
//! such a value is required. What matters only together with a strength has a typical default.
//!
//! The codes (A1, B2, ...) are those of the catalogue in `docs/src/reference/effects.md`.

mod assumed;
mod context;
mod form;
mod local_plane;
mod reads;
mod reshoot;
mod row_table;
mod shot_grid;
mod table;
#[cfg(test)]
pub(crate) mod testing;

pub use assumed::AssumedReflectivity;
pub use context::{Draws, FrameContext, LabelledCar, Need, Undulation, WorldPlan};
pub use empirical::Covariate;
pub use false_alarms::{FIRST_DROP_M, RangeLaw};
pub use form::{EdgeLoss, EstimatedIncidence, Form, OnSurfaces};
pub use incidence_dropout::CosineScale;
pub use label_time_offset::Clock;
pub use material_dropout::SurfaceKind;
pub use reads::Reads;
pub use table::interpolated;

use crate::beams::Beams;
use crate::cloud_scan::{Intensity, Surfaces};
use crate::finished::Refusal;
use crate::rig::Rig;
use crate::scan::Scan;
use data::toml_text::{parse_toml, read_toml, within, wrong};
use data::{DataError, KeyError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// One physical effect. The default of each stage changes nothing.
pub trait SensorEffect {
    /// Checks the parameters. Errors name the key.
    fn check(&self) -> Result<(), KeyError> {
        Ok(())
    }

    /// Quantities that must be known for the effect to be applied to a finished cloud; `None` if it cannot be applied.
    fn needs(&self) -> Option<&'static [Need]> {
        Some(&[])
    }

    /// What it reads of a finished cloud. What no effect of a list reads is not looked for.
    fn reads(&self) -> Reads {
        Reads::ALL
    }

    /// Name of the sensor that it acts on; empty where it acts on all.
    fn sensor(&self) -> &str {
        ""
    }

    /// Changes the world, before rays are cast.
    fn on_world(&self, _world: &mut WorldPlan) {}

    /// Changes the directions and times of shots.
    fn on_beams(&self, _beams: &mut Beams, _frame: &FrameContext, _draws: &Draws) {}

    /// Changes the echoes of a scan.
    fn on_scan(&self, _scan: &mut Scan, _frame: &FrameContext, _draws: &Draws) {}

    /// Changes a finished cloud, for which no rays can be cast.
    fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        self.on_scan(scan, frame, draws);
    }

    /// Changes the labels.
    fn on_labels(&self, _cars: &mut [LabelledCar], _frame: &FrameContext, _draws: &Draws) {}
}

macro_rules! effects {
    ($($file:ident::$name:ident $code:literal,)*) => {
        $(mod $file;)*
        $(pub use $file::$name;)*

        /// One effect of the list, selected by `kind`.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
        #[serde(tag = "kind", rename_all = "snake_case")]
        #[allow(missing_docs, reason = "each variant is the documented struct of the same name")]
        pub enum Effect {
            $($name($name),)*
        }

        impl Effect {
            /// The parameters and implementation of the effect.
            pub fn model(&self) -> &dyn SensorEffect {
                match self {
                    $(Effect::$name(effect) => effect,)*
                }
            }

            /// Its `kind` in TOML.
            pub fn kind(&self) -> &'static str {
                match self {
                    $(Effect::$name(_) => stringify!($file),)*
                }
            }

            /// Its code in the catalogue.
            pub fn code(&self) -> &'static str {
                match self {
                    $(Effect::$name(_) => $code,)*
                }
            }

            /// Why it cannot act on data of a rig: it names a sensor that the rig does not have.
            pub fn strange_to(&self, rig: &Rig) -> Option<String> {
                let name = self.model().sensor();
                let own: Vec<&str> = rig.sensors.iter().map(|s| s.name.as_str()).collect();
                (!name.is_empty() && rig.find(name).is_none()).then(|| {
                    format!(
                        "acts on the sensor {name:?}, but the rig has {}; give the rig that the list was made for \
                         (--sensor)",
                        own.join(", ")
                    )
                })
            }

            /// Kind and code of every effect.
            pub const CATALOGUE: &'static [(&'static str, &'static str)] = &[$((stringify!($file), $code),)*];
        }
    };
}

effects! {
    range_noise::RangeNoise "A1",
    range_noise_by_range::RangeNoiseByRange "A2",
    range_noise_by_signal::RangeNoiseBySignal "A3",
    range_noise_by_incidence::RangeNoiseByIncidence "A4",
    heavy_tails::HeavyTails "A5",
    range_bias::RangeBias "A6",
    beam_range_offset::BeamRangeOffset "A7",
    reflectivity_walk::ReflectivityWalk "A8",
    range_quantisation::RangeQuantisation "A9",
    coordinate_rounding::CoordinateRounding "A9",
    range_drift::RangeDrift "A10",
    random_dropout::RandomDropout "B1",
    signal_dropout::SignalDropout "B2",
    range_dropout::RangeDropout "B3",
    incidence_dropout::IncidenceDropout "B4",
    material_dropout::MaterialDropout "B5",
    range_limits::RangeLimits "B6",
    ego_body_mask::EgoBodyMask "B7",
    dirty_window::DirtyWindow "B8",
    packet_loss::PacketLoss "B9",
    bright_target_dropout::BrightTargetDropout "B10",
    angular_jitter::AngularJitter "C1",
    sensor_pose_error::SensorPoseError "C2",
    beam_angle_error::BeamAngleError "C3",
    rolling_shutter::RollingShutter "C4",
    label_time_offset::LabelTimeOffset "C5",
    label_offset::LabelOffset "C6",
    label_noise::LabelNoise "C7",
    ego_attitude::EgoAttitude "C8",
    target_attitude::TargetAttitude "C8",
    ground_error::GroundError "C9",
    missing_objects::MissingObjects "C10",
    extra_objects::ExtraObjects "C10",
    target_shape::TargetShape "C11",
    beam_divergence::BeamDivergence "D1",
    ghosts::Ghosts "D2",
    blooming::Blooming "D3",
    fog::Fog "D4",
    rain::Rain "D4",
    spray::Spray "D4",
    false_alarms::FalseAlarms "D5",
    dual_returns::DualReturns "D6",
    intensity_law::IntensityLaw "D7",
    intensity_response::IntensityResponse "D8",
    beam_intensity::BeamIntensity "D9",
    encoder_ripple::EncoderRipple "E1",
    mount_vibration::MountVibration "E2",
    point_order::PointOrder "E3",
    empirical::Empirical "E4",
}

/// An ordered list of effects: `[[effect]]` tables in TOML.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EffectList {
    /// Meaning of the intensity column of finished clouds to which the list is applied.
    #[serde(default, skip_serializing_if = "is_default")]
    pub intensity: Intensity,
    /// Reflectivity of all surfaces of finished clouds whose intensities do not tell it, 0 to 10.
    #[serde(default, skip_serializing_if = "is_default")]
    pub reflectivity: Option<f64>,
    /// What the list was made from, where a diagnosis wrote it.
    #[serde(default, skip_serializing_if = "is_default")]
    pub made_from: Option<MadeFrom>,
    /// The effects, in the order in which they are applied.
    #[serde(rename = "effect", default)]
    pub effects: Vec<Effect>,
}

/// What a list of effects was made from: it corrects these simulated data, recorded with these sensors.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct MadeFrom {
    /// Folder of the measured data set.
    pub measured: PathBuf,
    /// Folder of the simulated data set.
    pub simulated: PathBuf,
    /// Names of the sensors.
    pub sensors: Vec<String>,
}

/// Whether a value is that of a key that is left out.
fn is_default<T: Default + PartialEq>(value: &T) -> bool {
    *value == T::default()
}

impl EffectList {
    /// A list of these effects alone.
    pub fn of(effects: Vec<Effect>) -> EffectList {
        EffectList { effects, ..EffectList::default() }
    }

    /// The list without the effects that were refused.
    pub fn without(&self, refused: &[Refusal]) -> EffectList {
        let kept = |(at, _): &(usize, &Effect)| refused.iter().all(|r| r.index != *at);
        let effects = self.effects.iter().enumerate().filter(kept).map(|(_, effect)| effect.clone()).collect();
        EffectList { effects, ..self.clone() }
    }

    /// The list with those effects alone that act on beams and scans: the sensor without the scene and the labels.
    pub fn of_sensor(&self) -> EffectList {
        let ideal = WorldPlan::default();
        self.silencing(|effect| {
            let mut world = WorldPlan::default();
            effect.model().on_world(&mut world);
            world != ideal
                || matches!(effect, Effect::LabelNoise(_) | Effect::LabelOffset(_) | Effect::LabelTimeOffset(_))
        })
    }

    /// The list with some effects replaced by one that changes nothing, so that the random numbers of the rest stay
    /// the same.
    pub fn silencing(&self, which: impl Fn(&Effect) -> bool) -> EffectList {
        let neutral = || Effect::RangeBias(RangeBias::default());
        let effect = |effect: &Effect| if which(effect) { neutral() } else { effect.clone() };
        EffectList { effects: self.effects.iter().map(effect).collect(), ..self.clone() }
    }

    /// What the list says of the surfaces of finished clouds.
    pub fn surfaces(&self) -> Surfaces {
        Surfaces { intensity: self.intensity, reflectivity: self.reflectivity }
    }

    /// What the effects of the list read of a finished cloud.
    pub fn reads(&self) -> Reads {
        self.effects.iter().fold(Reads::NOTHING, |all, effect| all | effect.model().reads())
    }

    /// Reads a list from a TOML file.
    pub fn read(path: &Path) -> Result<EffectList, DataError> {
        read_toml(path, EffectList::check)
    }

    /// Parses a list from TOML; `path` is for error messages.
    pub fn parse(text: &str, path: &Path) -> Result<EffectList, DataError> {
        parse_toml(text, path, EffectList::check)
    }

    /// Checks the parameters of all effects. Errors name the key.
    pub fn check(&self) -> Result<(), KeyError> {
        within("reflectivity", self.reflectivity.unwrap_or(1.0), 0.0, 10.0)?;
        for (i, effect) in self.effects.iter().enumerate() {
            effect.model().check().map_err(|e| e.below(&format!("effect[{i}]")))?;
        }
        if self.effects.iter().enumerate().any(|(i, e)| {
            matches!(e, Effect::DualReturns(_))
                && !self.effects[..i].iter().any(|e| matches!(e, Effect::BeamDivergence(_)))
        }) {
            return Err(wrong(
                "effect",
                "dual_returns needs a beam_divergence before it: without divergence a shot has one return",
            ));
        }
        Ok(())
    }

    /// The effects of the list with their random number streams.
    fn each<'a>(&'a self, seed: u64, set: &'a str, frame: u64) -> impl Iterator<Item = (&'a Effect, Draws)> + 'a {
        let draws = move |(i, effect): (usize, &'a Effect)| {
            (effect, Draws::new(seed, format!("{set}/effect {i} {}", effect.kind()), frame))
        };
        self.effects.iter().enumerate().map(draws)
    }

    /// Applies the list to the world.
    pub fn on_world(&self, world: &mut WorldPlan) {
        self.effects.iter().for_each(|effect| effect.model().on_world(world));
    }

    /// Applies the list to the shots of a frame.
    pub fn on_beams(&self, beams: &mut Beams, frame: &FrameContext) {
        for (effect, draws) in self.each(frame.seed, frame.set, frame.index) {
            effect.model().on_beams(beams, frame, &draws);
        }
    }

    /// Applies the list to the echoes of a scan.
    pub fn on_scan(&self, scan: &mut Scan, frame: &FrameContext) {
        for (effect, draws) in self.each(frame.seed, frame.set, frame.index) {
            effect.model().on_scan(scan, frame, &draws);
        }
    }

    /// Applies the list to a finished cloud.
    pub fn on_cloud(&self, scan: &mut Scan, frame: &FrameContext) {
        for (effect, draws) in self.each(frame.seed, frame.set, frame.index) {
            effect.model().on_cloud(scan, frame, &draws);
        }
    }

    /// Applies the list to the labels.
    pub fn on_labels(&self, cars: &mut [LabelledCar], frame: &FrameContext) {
        for (effect, draws) in self.each(frame.seed, frame.set, frame.index) {
            effect.model().on_labels(cars, frame, &draws);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::object::Group;
    use crate::scan::Echo;

    #[test]
    fn lists_are_read_in_their_order() {
        let text =
            "[[effect]]\nkind = \"range_noise\"\nstd_m = 0.03\n\n[[effect]]\nkind = \"random_dropout\"\nshare = 0.2\n";
        let list = EffectList::parse(text, Path::new("e.toml")).unwrap();
        assert_eq!(
            list.effects.iter().map(|e| (e.kind(), e.code())).collect::<Vec<_>>(),
            [("range_noise", "A1"), ("random_dropout", "B1")]
        );
        assert_eq!(EffectList::parse(&toml::to_string(&list).unwrap(), Path::new("e")).unwrap(), list);
        assert_eq!(EffectList::parse("", Path::new("e")).unwrap(), EffectList::default());
    }

    #[test]
    fn bad_lists_are_refused_by_line() {
        for (text, want) in [
            ("[[effect]]\nkind = \"range_noise\"\nstd_m = -1\n", "e.toml:3: effect[0].std_m: -1 is not between"),
            (
                "[[effect]]\nkind = \"range_noise\"\n[[effect]]\nkind = \"random_dropout\"\nshare = 2\n",
                "e.toml:5: effect[1].share: 2",
            ),
            (
                "[[effect]]\nkind = \"range_noise\"\nstd_mm = 1\n",
                "e.toml:3: unknown field `std_mm`: did you mean `std_m`?",
            ),
            ("a = 1\n", "e.toml:1: unknown field `a`"),
            ("[[effect]]\nkind = \"range_nose\"\n", "unknown variant `range_nose`"),
            ("[[effect]]\nkind = \"dual_returns\"\n", "needs a beam_divergence before it"),
        ] {
            let error = EffectList::parse(text, Path::new("e.toml")).unwrap_err().to_string();
            assert!(error.contains(want), "{error}, not {want}");
        }
    }

    #[test]
    fn the_catalogue_is_complete() {
        let kinds: Vec<&str> = Effect::CATALOGUE.iter().map(|(kind, _)| *kind).collect();
        assert!(kinds.len() >= 30);
        let mut sorted = kinds.clone();
        sorted.sort_unstable();
        sorted.dedup();
        assert_eq!(sorted.len(), kinds.len());
        for code in ["A1", "A10", "B1", "B10", "C1", "C11", "D1", "D7"] {
            assert!(Effect::CATALOGUE.iter().any(|(_, c)| *c == code), "{code}");
        }
    }

    /// Parameters without a neutral value: effect, the parameters before it, and its key.
    const REQUIRED: [(&str, &str, &str); 8] = [
        ("signal_dropout", "", "threshold"),
        ("signal_dropout", "threshold = 0", "steepness"),
        ("incidence_dropout", "", "cos_half"),
        ("incidence_dropout", "cos_half = 0.03", "steepness"),
        ("rolling_shutter", "", "deskewed"),
        ("fog", "", "visibility_m"),
        ("intensity_law", "", "gain"),
        ("point_order", "", "shuffled"),
    ];

    #[test]
    fn parameters_without_a_neutral_value_are_required() {
        for (kind, parameters, key) in REQUIRED {
            let text = format!("[[effect]]\nkind = \"{kind}\"\n{parameters}\n");
            let error = EffectList::parse(&text, Path::new("e.toml")).unwrap_err().to_string();
            assert!(error.contains(&format!("missing field `{key}`")), "{kind}: {error}");
        }
    }

    #[test]
    fn what_is_left_out_changes_nothing() {
        let parsed = |text: &str| EffectList::parse(text, Path::new("e.toml")).unwrap();
        for (kind, _) in Effect::CATALOGUE {
            if REQUIRED.iter().any(|(required, ..)| required == kind) {
                continue;
            }
            // The divergence is for `dual_returns`.
            let list = parsed(&format!("[[effect]]\nkind = \"beam_divergence\"\n[[effect]]\nkind = \"{kind}\"\n"));
            assert_eq!(list.effects[1].kind(), *kind);
            assert_neutral(&list);
        }
        for names_alone in [
            "kind = \"sensor_pose_error\"\nsensor = \"front\"",
            "kind = \"dirty_window\"\nsensor = \"front\"",
            "kind = \"empirical\"\nsensor = \"front\"\ncovariate = \"signal\"",
            "kind = \"material_dropout\"\nmaterials = [\"wall\"]",
            "kind = \"point_order\"\nshuffled = false",
        ] {
            assert_neutral(&parsed(&format!("[[effect]]\n{names_alone}\n")));
        }
    }

    /// Asserts that a list changes nothing at any stage.
    fn assert_neutral(list: &EffectList) {
        let mut other = WorldPlan {
            undulation: Some(Undulation { amplitude_m: 0.1, length_m: 80.0, phase_rad: 1.0 }),
            car_scale: [0.9, 1.0, 1.1],
            car_shift_m: [0.1, -0.2, 0.3],
            car_tilt: [[0.01, 0.02], [-0.03, 0.04]],
            ..WorldPlan::default()
        };
        other.groups.remove(&Group::Fence);
        for before in [WorldPlan::default(), other] {
            let mut after = before.clone();
            list.on_world(&mut after);
            assert_eq!(after, before, "{list:?}");
        }
        // With a return nearer than 1 cm, and one without light.
        let mut before = testing::scene();
        let wall = *before.returns().next().unwrap();
        let dark = Echo { returned: 0.0, reflectivity: 0.0, ..wall };
        before.echoes.extend([Echo { range_m: 0.005, ..wall }, dark]);
        for index in [0, 7] {
            testing::with_frame(index, |frame, _| {
                let nominal = Beams { ego_heave_m: 0.1, ..Beams::of(frame.rig) };
                let mut beams = nominal.clone();
                list.on_beams(&mut beams, frame);
                for (a, b) in beams.sensors.iter().zip(&nominal.sensors) {
                    assert_eq!((a.true_mount, a.directions()), (b.true_mount, b.directions()), "{list:?}");
                    assert_eq!((a.nominal_mount, a.limits_m), (b.nominal_mount, b.limits_m), "{list:?}");
                }
                assert_eq!((beams.ego_tilt, beams.ego_heave_m), (nominal.ego_tilt, nominal.ego_heave_m), "{list:?}");
                assert_eq!((beams.shutter, beams.width), (None, None), "{list:?}");
                let mut after = before.clone();
                list.on_scan(&mut after, frame);
                assert!(after == before, "on_scan: {list:?}");
                list.on_cloud(&mut after, frame);
                assert!(after == before, "on_cloud: {list:?}");
                let mut cars = testing::cars();
                list.on_labels(&mut cars, frame);
                assert_eq!(cars, testing::cars(), "{list:?}");
            });
        }
    }
}
