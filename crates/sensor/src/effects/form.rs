//! Correction of the form of a law by a table.

use super::table::{check_table, interpolated};
use data::KeyError;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The share that a law keeps is multiplied by `factor`, interpolated over `at`, the covariate of the law, and constant
/// beyond both ends. No sensor has exactly the form of a law; a diagnosis writes what it measured.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Form {
    /// Values of the covariate, strictly ascending.
    pub at: Vec<f64>,
    /// Factor at each of them, 0 to 100.
    pub factor: Vec<f64>,
}

impl Form {
    pub(super) fn check(&self) -> Result<(), KeyError> {
        check_table(("form.at", &self.at, [-1e4, 1e4]), ("form.factor", &self.factor, [0.0, 100.0]))
    }
}

/// The factor at a value of the covariate; 1 without a table.
pub(super) fn factor(form: Option<&Form>, x: f64) -> f64 {
    form.map_or(1.0, |form| interpolated(&form.at, &form.factor, x))
}
