//! Effects of a change of the study TOML on existing results.

use super::{Source, StudyConfig, StudyRun};
use eval::matrix::RunId;
use std::collections::BTreeMap;

/// Effects of a change of the study TOML on existing runs.
#[derive(Clone, Debug, PartialEq, Default)]
pub struct StudyChanges {
    /// Runs that are new.
    pub added: Vec<RunId>,
    /// Runs that are no longer part of the study.
    pub removed: Vec<RunId>,
    /// Runs that have to be repeated, with the reasons.
    pub invalid: Vec<(RunId, Vec<String>)>,
    /// Test sets whose detections have to be repeated.
    pub tests: Vec<String>,
}

impl StudyConfig {
    /// Compares this configuration with an earlier one.
    pub fn changes_since(&self, before: &StudyConfig) -> StudyChanges {
        let by_id = |study: &StudyConfig| -> BTreeMap<RunId, StudyRun> {
            study.runs().into_iter().map(|run| (run.id.clone(), run)).collect()
        };
        let (old, new) = (by_id(before), by_id(self));
        let mut changes = StudyChanges {
            added: new.keys().filter(|id| !old.contains_key(id)).cloned().collect(),
            removed: old.keys().filter(|id| !new.contains_key(id)).cloned().collect(),
            ..StudyChanges::default()
        };
        for (id, run) in &new {
            let Some(was) = old.get(id) else { continue };
            let mut reasons = Vec::new();
            let mut differs = |what: &str, was: String, is: String| {
                if was != is {
                    reasons.push(format!("{what} was {was}, is {is}"));
                }
            };
            let epochs = |run: &StudyRun| run.epochs.map_or("the detector's own".into(), |n| n.to_string());
            differs("the detector's file", format!("{:?}", was.config), format!("{:?}", run.config));
            differs("epochs", epochs(was), epochs(run));
            differs("set", format!("{:?}", was.set), format!("{:?}", run.set));
            differs("the train set's source", before.source_text(&was.id.train_set), self.source_text(&id.train_set));
            differs("the train split", before.splits.train.clone(), self.splits.train.clone());
            differs("the validation split", before.splits.val.clone(), self.splits.val.clone());
            if !reasons.is_empty() {
                changes.invalid.push((id.clone(), reasons));
            }
        }
        let tests = self.datasets.iter().filter(|dataset| {
            let known = before.datasets.iter().any(|d| d.name == dataset.name);
            let source = before.source_text(&dataset.name) != self.source_text(&dataset.name);
            known && (source || before.splits.test != self.splits.test)
        });
        changes.tests = tests.map(|dataset| dataset.name.clone()).collect();
        changes
    }

    /// Source of a data set as text, including the source of the data set from which it is derived.
    fn source_text(&self, name: &str) -> String {
        let Some(dataset) = self.datasets.iter().find(|d| d.name == name) else { return "unknown".into() };
        match &dataset.source {
            Source::Resim { of, effects, .. } => format!("{} with {}", self.source_text(of), effects.display()),
            Source::TrueLabels { of } => format!("{} with its true boxes", self.source_text(of)),
            source => serde_json::to_string(source).unwrap_or_default(),
        }
    }
}
