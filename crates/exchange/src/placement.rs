//! Where each effect of a list goes: into parameters of a program, into the processing of its finished clouds, or into
//! a list of what to change in the scenario.

use crate::plan::Plan;
use crate::program::Program;
use crate::{carla, gazebo, helios, isaac, rgl, scenario};
use schemars::JsonSchema;
use sensor::effects::WorldPlan;
use sensor::{Effect, EffectList, Rig};
use serde::Serialize;

/// An effect that a program's parameters express.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Expressed {
    /// Index of the effect in the list.
    pub index: usize,
    /// Its kind.
    pub kind: &'static str,
    /// The parameters.
    pub by: String,
}

/// Something that a program's parameters do not express.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct NotExpressed {
    /// Index of the effect in the list; `None` for what belongs to the rig.
    pub index: Option<usize>,
    /// Kind of the effect, or `pattern`.
    pub kind: &'static str,
    /// Why the program cannot express it.
    pub why: String,
    /// What to do about it.
    pub remedy: Remedy,
}

/// What to do about something that is not expressed.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
#[serde(tag = "by", rename_all = "snake_case")]
pub enum Remedy {
    /// `post_process.py` applies it to finished clouds.
    PostProcess {
        /// What must be known of the clouds.
        needs: Vec<&'static str>,
    },
    /// Something has to be changed in the scenario, its assets or its labels.
    Scenario {
        /// What.
        change: String,
    },
    /// Nothing: the parameters of the program are an approximation.
    Approximated {
        /// How good it is.
        how: String,
    },
}

/// A fitted law with its remaining error.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct FitError {
    /// What was fitted to what.
    pub what: String,
    /// Ranges over which both were compared, m.
    pub range_m: [f64; 2],
    /// Largest difference, in the unit of the law.
    pub largest: f64,
    /// Root of the mean squared difference.
    pub rms: f64,
}

/// What a program's parameters do with an effect.
pub(crate) enum Native {
    /// They express it.
    All(String),
    /// They express it in part; the rest is applied to finished clouds.
    Part {
        /// The parameters.
        by: String,
        /// The rest of the effect.
        rest: Effect,
        /// Why there is a rest.
        why: &'static str,
    },
    /// They approximate it, and nothing more is applied.
    About {
        /// The parameters.
        by: String,
        /// What differs.
        how: String,
    },
    /// They do not express it.
    Not(&'static str),
}

/// The effects of a list, placed.
pub(crate) struct Placed {
    pub plan: Plan,
    pub expressed: Vec<Expressed>,
    pub not_expressed: Vec<NotExpressed>,
    /// The list for finished clouds.
    pub remaining: EffectList,
}

/// Effects on finished clouds that change no range: they may follow a rounding of ranges.
const RANGES_AS_THEY_ARE: &[&str] = &[
    "random_dropout",
    "signal_dropout",
    "range_dropout",
    "incidence_dropout",
    "material_dropout",
    "range_limits",
    "packet_loss",
    "bright_target_dropout",
    "intensity_law",
    "intensity_response",
    "beam_intensity",
    "point_order",
];

/// Places all effects of a list.
pub(crate) fn place(program: Program, list: &EffectList, rig: &Rig) -> Placed {
    let placed = place_with(program, list, rig, true);
    // A sensor rounds what it measured. Where something still changes ranges, rounding has to come after it.
    let changes_ranges = |e: &Effect| !RANGES_AS_THEY_ARE.contains(&e.kind()) && e.kind() != "range_quantisation";
    if placed.plan.step_m > 0.0 && placed.remaining.effects.iter().any(changes_ranges) {
        return place_with(program, list, rig, false);
    }
    placed
}

fn place_with(program: Program, list: &EffectList, rig: &Rig, rounds: bool) -> Placed {
    let mut plan = Plan::of(rig);
    let (mut expressed, mut not_expressed, mut remaining) = (Vec::new(), Vec::new(), Vec::new());
    for (index, effect) in list.effects.iter().enumerate() {
        let kind = effect.kind();
        let native = if elsewhere(effect) {
            Native::Not("acts on the scene or on the labels")
        } else if matches!(effect, Effect::RangeQuantisation(_)) && !rounds {
            Native::Not("must follow what post_process.py does to ranges")
        } else {
            match program {
                Program::Carla => carla::take(effect, &mut plan),
                Program::Isaac => isaac::take(effect, &mut plan),
                Program::Gazebo => gazebo::take(effect, &mut plan),
                Program::Rgl => rgl::take(effect, &mut plan),
                Program::Helios => helios::take(effect, &mut plan),
            }
        };
        let mut not = |why: &str, remedy: Remedy| {
            not_expressed.push(NotExpressed { index: Some(index), kind, why: why.into(), remedy });
        };
        match native {
            Native::All(by) => expressed.push(Expressed { index, kind, by }),
            Native::Part { by, rest, why } => {
                expressed.push(Expressed { index, kind, by });
                not(why, post_process(&rest));
                remaining.push(rest);
            }
            Native::About { by, how } => {
                expressed.push(Expressed { index, kind, by });
                not("is approximated", Remedy::Approximated { how });
            }
            Native::Not(why) => {
                let on_clouds = effect.model().needs().is_some() && !elsewhere(effect);
                if on_clouds {
                    not(why, post_process(effect));
                    remaining.push(effect.clone());
                } else {
                    not(why, Remedy::Scenario { change: scenario::change(effect).into() });
                }
            }
        }
    }
    let remaining = EffectList { effects: remaining, made_from: None, ..list.clone() };
    Placed { plan, expressed, not_expressed, remaining }
}

fn post_process(effect: &Effect) -> Remedy {
    let needs = effect.model().needs().unwrap_or_default();
    Remedy::PostProcess { needs: needs.iter().map(|need| need.description()).collect() }
}

/// Whether an effect acts on the world or the labels.
fn elsewhere(effect: &Effect) -> bool {
    let mut world = WorldPlan::default();
    effect.model().on_world(&mut world);
    world != WorldPlan::default() || scenario::of_labels(effect)
}
