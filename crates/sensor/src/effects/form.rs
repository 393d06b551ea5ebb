//! Correction of the form of a law by a table.

use super::assumed::kind;
use super::table::{check_table, interpolated};
use crate::directions::{Kind, kind_of};
use crate::scan::{Echo, Incidence};
use data::KeyError;
use geometry::Box3;
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

/// Corrections of a law for finished clouds. Their angles of incidence are estimated from the returns around each
/// return. The estimate is wrong across a kerb and on a curved body. At an edge there is none. The corrections were
/// measured with the same estimates. A simulation knows its surfaces and does not use them.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EstimatedIncidence {
    /// Further corrections of the form on surfaces that are fitted to returns.
    #[serde(default, skip_serializing_if = "OnSurfaces::is_empty")]
    pub fitted: OnSurfaces,
    /// The same where no surface can be fitted, but one of other returns goes on, as a road does to a lone far row.
    #[serde(default, skip_serializing_if = "OnSurfaces::is_empty")]
    pub continued: OnSurfaces,
    /// Losses in place of the law where no surface is known, off the labelled objects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standing_edges: Option<EdgeLoss>,
    /// The same on labelled objects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub object_edges: Option<EdgeLoss>,
}

/// Corrections of the form of a law by kind of surface.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct OnSurfaces {
    /// On the ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ground: Option<Form>,
    /// On standing surfaces.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub standing: Option<Form>,
    /// On labelled objects.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub objects: Option<Form>,
}

impl OnSurfaces {
    fn is_empty(&self) -> bool {
        *self == OnSurfaces::default()
    }

    fn forms(&self) -> impl Iterator<Item = &Form> {
        [&self.ground, &self.standing, &self.objects].into_iter().flatten()
    }

    fn of(&self, kind: Kind) -> Option<&Form> {
        match kind {
            Kind::Ground => self.ground.as_ref(),
            Kind::Standing => self.standing.as_ref(),
            Kind::Object { .. } => self.objects.as_ref(),
        }
    }
}

/// Share of the returns at edges that is lost, by range: interpolated, and constant beyond both ends.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EdgeLoss {
    /// Ranges, strictly ascending, m.
    pub range_m: Vec<f64>,
    /// Share that is lost at each of them, 0 to 1.
    pub share: Vec<f64>,
}

impl EdgeLoss {
    fn check(&self) -> Result<(), KeyError> {
        check_table(("range_m", &self.range_m, [0.0, 1e4]), ("share", &self.share, [0.0, 1.0]))
    }
}

impl EstimatedIncidence {
    pub(super) fn check(&self) -> Result<(), KeyError> {
        self.fitted.forms().chain(self.continued.forms()).try_for_each(Form::check)?;
        [&self.standing_edges, &self.object_edges].into_iter().flatten().try_for_each(EdgeLoss::check)
    }

    /// The share of the returns that is kept like that of an echo, whose law keeps `by_law` of them at a value of its
    /// covariate. `boxes` are those of the labelled objects.
    pub(super) fn kept(&self, echo: &Echo, boxes: &[Box3], by_law: f64, x: f64) -> f64 {
        let formed = |on: &OnSurfaces| by_law * factor(on.of(kind(echo, boxes)), x);
        match echo.incidence {
            Incidence::Known => by_law,
            Incidence::Estimated => formed(&self.fitted),
            Incidence::Continued => formed(&self.continued),
            Incidence::Assumed => {
                let at_object = matches!(kind_of(boxes, echo.point().map(f64::from), None), Kind::Object { .. });
                let loss = if at_object { &self.object_edges } else { &self.standing_edges };
                let lost = |loss: &EdgeLoss| interpolated(&loss.range_m, &loss.share, echo.range_m.into());
                loss.as_ref().map_or(by_law, |loss| 1.0 - lost(loss))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_those_of_the_kind_of_surface_and_of_what_is_known_of_it() {
        let text = "fitted.ground = { at = [0.0, 1.0], factor = [1.0, 0.5] }\n\
                    continued.standing = { at = [0.0], factor = [0.25] }\n\
                    standing_edges = { range_m = [10.0, 30.0], share = [0.0, 0.4] }";
        let estimated: EstimatedIncidence = toml::from_str(text).unwrap();
        estimated.check().unwrap();
        let car = Box3::from_array([20.0, 0.0, 0.0, 4.0, 2.0, 1.6, 0.0]);
        let kept = |incidence: Incidence, normal: [f32; 3], boxes: &[Box3]| {
            let echo = Echo { range_m: 20.0, incidence, normal, ..Echo::nothing([0.0; 3], [1.0, 0.0, 0.0]) };
            estimated.kept(&echo, boxes, 0.7, 0.5)
        };
        let [up, back] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]];
        for (incidence, normal, boxes, want) in [
            (Incidence::Known, up, &[][..], 0.7),
            (Incidence::Estimated, up, &[], 0.525),
            (Incidence::Estimated, back, &[], 0.7),
            (Incidence::Continued, back, &[], 0.175),
            (Incidence::Continued, up, &[], 0.7),
            (Incidence::Assumed, up, &[], 0.8),
            (Incidence::Assumed, up, &[car], 0.7),
            (Incidence::Estimated, up, &[car], 0.7),
        ] {
            assert!((kept(incidence, normal, boxes) - want).abs() < 1e-9, "{incidence:?} {normal:?} {boxes:?}");
        }
        let wrong: EstimatedIncidence = toml::from_str("object_edges = { range_m = [10.0], share = [1.4] }").unwrap();
        assert!(wrong.check().unwrap_err().to_string().contains("share[0]"));
    }
}
