//! The truth of a case: hidden effects with their parameters, bounds and strengths.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Amount of data in a case.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CaseSize {
    /// Frames per side.
    pub frames: usize,
    /// Shots per scan.
    pub shots: usize,
}

impl CaseSize {
    /// Usual size.
    pub const USUAL: CaseSize = CaseSize { frames: 40, shots: 25_000 };
}

/// Strength of a hidden effect in three classes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// Below 8 standard errors.
    Weak,
    /// 8 to 40 standard errors.
    Medium,
    /// Above 40 standard errors.
    Strong,
}

impl Level {
    /// All levels.
    pub const ALL: [Level; 3] = [Level::Weak, Level::Medium, Level::Strong];

    /// The level of a strength in standard errors.
    pub fn of(strength: f64) -> Level {
        match strength {
            s if s > 40.0 => Level::Strong,
            s if s >= 8.0 => Level::Medium,
            _ => Level::Weak,
        }
    }

    /// Name in tables and files.
    pub fn name(self) -> &'static str {
        match self {
            Level::Weak => "weak",
            Level::Medium => "medium",
            Level::Strong => "strong",
        }
    }
}

/// A hidden effect in the truth file.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Hidden {
    /// Name in the catalogue; otherwise the kind of the simulator's effect, or a description.
    pub cause: String,
    /// Whether it is in the catalogue.
    pub in_catalogue: bool,
    /// True values; units are part of the names.
    pub parameters: BTreeMap<String, f64>,
    /// Standard errors of an efficient estimator that knows the functional form (Cramér-Rao bound), for some
    /// parameters.
    pub bound: BTreeMap<String, f64>,
    /// Number of returns over all frames that the effect removes, adds, or moves by more than 0.35 m; 0 for effects
    /// that change all returns slightly.
    pub touched: f64,
    /// Number of standard errors by which an oracle that knows the form tells the effect from its absence; `None`
    /// where it was not computed.
    #[serde(default)]
    pub strength: Option<f64>,
    /// Class of the strength.
    #[serde(default)]
    pub level: Option<Level>,
}

impl Hidden {
    /// With a strength in standard errors and its level.
    pub fn with_strength(self, strength: f64) -> Hidden {
        Hidden { strength: Some(strength), level: Some(Level::of(strength)), ..self }
    }

    /// Whether the present diagnosis can name it and an oracle sees it with at least 8 standard errors.
    pub fn is_identifiable(&self) -> bool {
        self.in_catalogue && self.level.is_some_and(|level| level >= Level::Medium)
    }
}

/// Truth of a case.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Truth {
    /// Seed of the case.
    pub seed: u64,
    /// Kind of the case, as its generator names it; `shuffled` for frames that are paired wrongly.
    pub kind: String,
    /// What was drawn besides the effects: sensor, scene, columns. Empty if the generator does not say.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub setting: String,
    /// All hidden effects.
    pub hidden: Vec<Hidden>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn levels_begin_at_8_and_40() {
        for (strength, level) in [(7.9, "weak"), (8.0, "medium"), (40.0, "medium"), (41.0, "strong")] {
            assert_eq!(Level::of(strength).name(), level);
        }
    }

    #[test]
    fn truth_files_without_strengths_can_be_read() {
        let old = r#"{"seed": 1, "kind": "single", "hidden": [{"cause": "range_noise", "in_catalogue": true,
            "parameters": {"std_m": 0.02}, "bound": {}, "touched": 0.0}]}"#;
        let truth: Truth = serde_json::from_str(old).unwrap();
        assert!(truth.hidden[0].strength.is_none() && !truth.hidden[0].is_identifiable());
        assert!(truth.hidden[0].clone().with_strength(9.0).is_identifiable());
    }
}
