//! The result of a diagnosis: the file `diagnosis.json`.

use crate::catalogue::{Cause, Channel, Covariate, Family, Hypothesis, Kind, ParameterId, Quantity, Unit};
use crate::curve::Curve;
use data::JsonForm;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Version of the file.
pub const SCHEMA: &str = "lidarshift/diagnosis/1";

/// A diagnosis: the file `diagnosis.json`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Diagnosis {
    /// [`SCHEMA`].
    pub schema: String,
    /// Build of the program that made it: its version and the commit, or a hash of the program. Earlier versions have
    /// none.
    #[serde(default)]
    pub build: String,
    /// The overall result.
    pub verdict: Verdict,
    /// Ids of the frames by role; no frame has two roles, except that of scans alone each is held out in turn.
    pub frames: FrameRoles,
    /// What was found, the largest gain first.
    pub findings: Vec<Finding>,
    /// Detectable effect size of each cause in these data.
    pub minimum_detectable: BTreeMap<Cause, Minimum>,
    /// Distance of the measured held-out frames from the simulation, before and after it is extended.
    pub gain: Gain,
    /// What detectors gain on measured data, where it was asked for (`--detectors`).
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub detectors: Vec<DetectorGain>,
    /// Causes that these data cannot tell, whatever is found: of a twin, of different streets, and where the data lack
    /// what shows them. Every other cause was looked for.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_identifiable: Vec<Unidentifiable>,
    /// Hypotheses that were considered and what became of them.
    pub considered: Vec<Considered>,
    /// Limits of the data, and what else is needed to read the result.
    pub notes: Vec<String>,
}

/// The overall result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// No difference above the detectable effect sizes.
    NothingFound,
    /// All findings have a named cause.
    Explained,
    /// Some findings have a named cause.
    PartlyExplained,
    /// No finding has a named cause.
    Unexplained,
    /// The two sides do not show the same scenes; there is no other result.
    NotScenarioIdentical,
    /// There are too few frames to find anything; there is no other result.
    TooFewFrames,
}

impl Verdict {
    /// The verdict of findings on data that could be compared. Findings that are not identifiable do not count, unless
    /// there is no other.
    pub fn of(findings: &[Finding]) -> Self {
        let named = findings.iter().filter(|f| f.status == Status::Named).count();
        let identifiable = findings.iter().filter(|f| f.status != Status::NotIdentifiable).count();
        match (identifiable, named) {
            (0, _) if !findings.is_empty() => Verdict::Unexplained,
            (0, _) => Verdict::NothingFound,
            (all, named) if all == named => Verdict::Explained,
            (_, 0) => Verdict::Unexplained,
            _ => Verdict::PartlyExplained,
        }
    }
}

/// Ids of the frames by role.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FrameRoles {
    /// To select hypotheses.
    pub select: Vec<String>,
    /// To fit parameters and intervals.
    pub estimate: Vec<String>,
    /// To measure the gain.
    pub hold_out: Vec<String>,
}

/// One difference between measured and simulated data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Finding {
    /// Whether its cause is named.
    pub status: Status,
    /// The cause, where it is named.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub cause: Option<Cause>,
    /// The causes that explain it about equally well, where it is ambiguous; parameters are those of the first.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub candidates: Option<Vec<Cause>>,
    /// Family of its cause.
    pub family: Family,
    /// Fitted parameters; docs/diagnosis.md has names, units and signs.
    pub parameters: BTreeMap<ParameterId, Parameter>,
    /// Share of block-bootstrap repetitions that choose the same cause.
    pub confidence: f64,
    /// What it was found in.
    pub channel: Channel,
    /// On what it depends.
    pub covariate: Covariate,
    /// Its gain on held-out frames.
    pub gain: FindingGain,
    /// Share of the difference in its channel that the fits of all findings there remove, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub predicted: Option<f64>,
    /// Share of the difference in its kind or channel that is gone with the extended simulation, as it was measured; of
    /// what acts in some directions, in these.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub reached: Option<f64>,
    /// The finding in a sentence.
    pub says: String,
    /// What to record to tell the candidates apart.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub separate_by: Option<String>,
    /// The plot: what is measured along the covariate, before and after.
    pub curve: Curve,
    /// What a simulation has to be given to show the same: the entries of `extended.toml`. Not in the file.
    #[serde(skip)]
    pub effects: Vec<sensor::Effect>,
}

impl Diagnosis {
    /// Lists causes that these data cannot tell: no size of them is detectable.
    pub(crate) fn cannot_tell(&mut self, causes: impl IntoIterator<Item = Unidentifiable>) {
        self.not_identifiable.extend(causes);
        self.minimum_detectable.retain(|cause, _| self.not_identifiable.iter().all(|n| n.cause != *cause));
    }
}

impl Finding {
    /// Whether it has this cause, or may have it.
    pub fn may_be(&self, cause: Cause) -> bool {
        self.cause == Some(cause) || self.candidates.iter().flatten().any(|c| *c == cause)
    }

    /// One of its parameters.
    pub fn parameter(&self, quantity: Quantity) -> Option<&Parameter> {
        self.parameters.get(&ParameterId::Of(quantity))
    }

    /// Takes its name: these data cannot identify its cause. `why` follows "not identifiable", `tell_by` says what
    /// recording can. An ambiguous finding keeps its candidates: one of them may be true.
    pub(crate) fn becomes_not_identifiable(&mut self, why: &str, tell_by: &str) {
        let named = self.cause.take().map(|cause| vec![cause]);
        self.candidates = self.candidates.take().or(named);
        self.status = Status::NotIdentifiable;
        self.effects.clear();
        self.says.push_str(&format!("; not identifiable{why}"));
        self.separate_by = Some(tell_by.into());
    }
}

/// Whether the cause of a finding is named.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Status {
    /// One cause of the catalogue explains it.
    Named,
    /// Several do, and these data do not tell which.
    Ambiguous,
    /// None does.
    Unexplained,
    /// It may be no error of the sensor: the simulated side was made of the measured one, and its cause is in both; or
    /// the two sides show different streets, and the streets differ.
    NotIdentifiable,
}

/// A fitted number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Parameter {
    /// Best value.
    pub estimate: f64,
    /// Its unit; `1` for a share.
    pub unit: Unit,
    /// Interval that holds the true value with a probability of 95 %.
    pub ci95: [f64; 2],
}

/// Gain of one finding.
#[derive(Clone, Copy, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FindingGain {
    /// Logarithm of the likelihood ratio on held-out frames by simulated return.
    pub nats_per_ray: f64,
    /// From a bootstrap over blocks of held-out frames.
    pub ci95: [f64; 2],
}

impl Minimum {
    /// Of a quantity, with its unit.
    pub fn new(parameter: Quantity, value: f64) -> Self {
        Minimum { parameter, value, unit: parameter.unit() }
    }
}

/// A detectable effect size.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Minimum {
    /// Which number.
    pub parameter: Quantity,
    /// Its smallest value.
    pub value: f64,
    /// Its unit.
    pub unit: Unit,
}

/// Distance between measured and simulated held-out frames. The totals are over the channels in which something was
/// found and those that the extension changed, for better or worse; they are zero where nothing was found. `channels`
/// has all.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Gain {
    /// `nats_per_ray`: what lookup tables of the measured data, fitted on other frames, predict better than the
    /// simulation, by simulated return (logarithm of the likelihood ratio). It is 0 where nothing differs.
    pub metric: String,
    /// With the simulation as it is.
    pub before: f64,
    /// With the frames that were made anew from `extended.toml`.
    pub after: f64,
    /// Of two draws of the extended simulation from each other.
    pub floor: f64,
    /// (before - after) / (before - floor); null where nothing was found, or before is not above the floor.
    pub closed: Option<f64>,
    /// Interval of `closed`, from a bootstrap over blocks of held-out frames.
    pub ci95: Option<[f64; 2]>,
    /// Channels of the totals.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub counted: Vec<Channel>,
    /// `before`, `after` and `floor` by channel.
    #[serde(default)]
    pub channels: BTreeMap<Channel, [f64; 3]>,
    /// The same by kind of differences, for channels whose kinds have different causes.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub kinds: BTreeMap<Kind, [f64; 3]>,
    /// `closed` with its interval by channel, for channels of which a significant part of the difference is.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub closed_by_channel: BTreeMap<Channel, Closed>,
    /// The same by kind of differences.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub closed_by_kind: BTreeMap<Kind, Closed>,
    /// Effects of `extended.toml` that were left out because the simulated data cannot be made anew with them. What
    /// they would change counts as not closed.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub not_applied: Vec<NotApplied>,
    /// What the fits in memory say that would be reached; nothing was made anew for it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub predicted: Option<Predicted>,
}

/// Share of a channel's difference that is gone.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Closed {
    /// (before - after) / (before - floor).
    pub closed: f64,
    /// From a bootstrap over blocks of held-out frames.
    pub ci95: Option<[f64; 2]>,
}

/// An effect that could not be applied.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct NotApplied {
    /// Its kind.
    pub effect: String,
    /// Why, and what would help.
    pub why: String,
}

/// Distances as the fits predict them: Kullback-Leibler distance of what the channels see, nats by simulated return.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct Predicted {
    /// With the simulation as it is.
    pub before: f64,
    /// With the fitted laws of the findings.
    pub after: f64,
    /// With unconstrained lookup tables fitted on the same frames as the findings.
    pub floor: f64,
    /// (before - after) / (before - floor).
    pub closed: Option<f64>,
    /// Its interval, from a bootstrap over blocks of held-out frames.
    pub ci95: Option<[f64; 2]>,
    /// `before`, `after` and `floor` by channel.
    pub channels: BTreeMap<Channel, [f64; 3]>,
}

/// Average precision on the measured test frames of a detector trained on each kind of data, percent.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DetectorGain {
    /// The detector.
    pub detector: String,
    /// Class name.
    pub class: String,
    /// 3D overlap that has to be exceeded.
    pub overlap: f64,
    /// Measured test frames.
    pub frames: usize,
    /// Runs of each, one a seed.
    pub runs: usize,
    /// Trained on the simulation as it is, mean over the runs.
    pub before: f64,
    /// Trained on the extended simulation.
    pub after: f64,
    /// Trained on measured data: the ceiling.
    pub ceiling: f64,
    /// `after` - `before`, points of percent.
    pub gain: f64,
    /// Its interval: the same measured frames drawn for both, seeds for each.
    pub ci95: Option<[f64; 2]>,
}

/// A cause that these data cannot tell.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Unidentifiable {
    /// The cause.
    pub cause: Cause,
    /// Why these data cannot tell it.
    pub why: String,
    /// What recording can tell it.
    pub tell_by: String,
}

/// A hypothesis that was considered.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Considered {
    /// Cause.
    pub cause: Hypothesis,
    /// Channel.
    pub channel: Channel,
    /// Cross-validated gain on the selecting frames, nats per ray.
    pub nats_per_ray: f64,
    /// That over its standard error.
    pub z: f64,
    /// `chosen`, or the reason why not.
    pub outcome: String,
}

/// Version of a [`Verification`].
pub const VERIFICATION_SCHEMA: &str = "lidarshift/verification/1";

/// The content of `verification.json`: the gain of a given list of effects.
#[derive(Clone, Debug, PartialEq, Serialize, JsonSchema)]
pub struct Verification {
    /// [`VERIFICATION_SCHEMA`].
    pub schema: String,
    /// The gain.
    #[serde(flatten)]
    pub gain: Gain,
}

impl Verification {
    /// Of a gain.
    pub fn new(gain: Gain) -> Self {
        Verification { schema: VERIFICATION_SCHEMA.into(), gain }
    }
}

/// The forms of the JSON files of this crate.
pub fn json_forms() -> Vec<JsonForm> {
    vec![
        JsonForm::of::<Diagnosis>("diagnosis", "`diagnosis.json` of `diagnose`, `diagnose --json`", Some(SCHEMA)),
        JsonForm::of::<Verification>(
            "verification",
            "`verification.json` of `diagnose --verify`, `--json` with it",
            Some(VERIFICATION_SCHEMA),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_in_the_file_are_those_of_the_schema() {
        let schema = schemars::schema_for!(Diagnosis).to_value();
        let required: Vec<&str> = schema["required"].as_array().unwrap().iter().filter_map(|v| v.as_str()).collect();
        for name in ["schema", "verdict", "frames", "findings", "minimum_detectable", "gain"] {
            assert!(required.contains(&name), "{name}");
        }
        for (verdict, name) in [
            (Verdict::NothingFound, "nothing_found"),
            (Verdict::Explained, "explained"),
            (Verdict::PartlyExplained, "partly_explained"),
            (Verdict::Unexplained, "unexplained"),
            (Verdict::NotScenarioIdentical, "not_scenario_identical"),
            (Verdict::TooFewFrames, "too_few_frames"),
        ] {
            assert_eq!(serde_json::to_value(verdict).unwrap(), name);
        }
    }
}
