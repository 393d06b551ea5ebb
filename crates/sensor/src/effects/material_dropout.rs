//! B5: returns lost on some materials.

use super::assumed::{boxes, kind};
use super::random_dropout::drop_some;
use super::{Draws, FrameContext, Need, Reads, SensorEffect};
use crate::directions::Kind;
use crate::material::MaterialId;
use crate::scan::{Echo, Scan};
use data::KeyError;
use data::toml_text::within;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// A return from one of `materials`, or from one of the kinds of `surfaces`, is lost with probability `share`.
///
/// Typical: 0.3 to 0.8 on tyres (`rubber`), on which Huch et al. 2023 see few points. Tyres reflect a few per cent,
/// carbon and black paint 5 to 10 %.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MaterialDropout {
    /// Names of materials. Names that the data set does not have are ignored.
    pub materials: Vec<String>,
    /// Kinds of surfaces, beside the materials.
    pub surfaces: Vec<SurfaceKind>,
    /// Probability of a loss, 0 to 1.
    pub share: f64,
}

/// Kind of a surface, by its direction and the labelled boxes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SurfaceKind {
    /// Level surfaces.
    Ground,
    /// Walls, posts and all else that is not level.
    Standing,
    /// Labelled objects without their lower corners.
    Bodies,
    /// Lower corners of labelled objects, where vehicles have wheels.
    Wheels,
}

impl SurfaceKind {
    fn of(kind: Kind) -> SurfaceKind {
        match kind {
            Kind::Ground => SurfaceKind::Ground,
            Kind::Standing => SurfaceKind::Standing,
            Kind::Object { corner: false, .. } => SurfaceKind::Bodies,
            Kind::Object { corner: true, .. } => SurfaceKind::Wheels,
        }
    }
}

impl SensorEffect for MaterialDropout {
    fn check(&self) -> Result<(), KeyError> {
        within("share", self.share, 0.0, 1.0)
    }

    fn needs(&self) -> Option<&'static [Need]> {
        Some(if self.materials.is_empty() { &[Need::Incidence, Need::Cars] } else { &[Need::Material] })
    }

    fn reads(&self) -> Reads {
        Reads::SURFACES
    }

    fn on_scan(&self, scan: &mut Scan, frame: &FrameContext, draws: &Draws) {
        let named: Vec<MaterialId> = self.materials.iter().filter_map(|name| frame.materials.find(name)).collect();
        let boxes = boxes(frame);
        let of_kind =
            |echo: &Echo| !self.surfaces.is_empty() && self.surfaces.contains(&SurfaceKind::of(kind(echo, &boxes)));
        let loses = |echo: &Echo| named.contains(&echo.material) || of_kind(echo);
        drop_some(scan, draws, |echo| if loses(echo) { self.share as f32 } else { 0.0 });
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::*;
    use super::*;
    use crate::material::MaterialTable;

    #[test]
    fn other_materials_lose_nothing() {
        let mut before = plate(20_000, 20.0, 0.5);
        for (i, echo) in before.echoes.iter_mut().enumerate() {
            echo.material = MaterialTable::built_in(if i % 2 == 0 { "rubber" } else { "paint" });
        }
        let after = applied(
            &MaterialDropout { materials: vec!["rubber".into(), "lead".into()], surfaces: vec![], share: 0.6 },
            &before,
        );
        assert!((lost(&before, &after) - 0.3).abs() < 0.01);
        assert!(after.echoes.iter().skip(1).step_by(2).all(|e| e.is_return()));
    }

    #[test]
    fn kinds_of_surfaces_lose_by_themselves() {
        let before = crate::effects::testing::scene();
        let ground = MaterialDropout { surfaces: vec![SurfaceKind::Ground], share: 1.0, ..MaterialDropout::default() };
        assert_eq!(ground.needs(), Some(&[Need::Incidence, Need::Cars][..]));
        let after = applied(&ground, &before);
        assert!(after.returns().all(|e| e.normal[2] < 0.9) && after.returns().count() > 1000);
        let standing = MaterialDropout { surfaces: vec![SurfaceKind::Standing], ..ground };
        assert!(applied(&standing, &before).returns().any(|e| e.normal[2] > 0.9));
    }
}
