//! Reflectivities that an effect assumes of kinds of surfaces, in place of the surfaces' own.

use super::FrameContext;
use crate::directions::{Kind, kind_of};
use crate::scan::Echo;
use crate::signal::returned_light_index;
use data::KeyError;
use data::toml_text::within;
use geometry::Box3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Reflectivity that is assumed of every kind of surface, relative to a white plate. An effect that was fitted without
/// knowing the surfaces' reflectivities has to be applied with what was assumed in the fit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AssumedReflectivity {
    /// Of the ground.
    pub ground: f64,
    /// Of standing surfaces.
    pub standing: f64,
    /// Of labelled objects.
    pub objects: f64,
    /// Of their lower corners, where vehicles have wheels; that of the objects if it is left out.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub wheels: Option<f64>,
}

impl AssumedReflectivity {
    /// The same for all.
    pub fn even(reflectivity: f64) -> Self {
        AssumedReflectivity { ground: reflectivity, standing: reflectivity, objects: reflectivity, wheels: None }
    }

    pub(super) fn check(&self) -> Result<(), KeyError> {
        within("assumed.ground", self.ground, 1e-6, 1e6)?;
        within("assumed.standing", self.standing, 1e-6, 1e6)?;
        within("assumed.objects", self.objects, 1e-6, 1e6)?;
        self.wheels.map_or(Ok(()), |wheels| within("assumed.wheels", wheels, 1e-6, 1e6))
    }

    fn of(&self, kind: Kind) -> f64 {
        match kind {
            Kind::Ground => self.ground,
            Kind::Standing => self.standing,
            Kind::Object { corner: true, .. } => self.wheels.unwrap_or(self.objects),
            Kind::Object { .. } => self.objects,
        }
    }
}

/// Kind of the surface of an echo.
pub(super) fn kind(echo: &Echo, boxes: &[Box3]) -> Kind {
    let normal_z = (echo.normal != [0.0; 3]).then(|| f64::from(echo.normal[2]));
    kind_of(boxes, echo.point().map(f64::from), normal_z)
}

/// Boxes of the labelled objects of a frame.
pub(super) fn boxes(frame: &FrameContext) -> Vec<Box3> {
    frame.cars.iter().map(|car| car.true_box).collect()
}

/// Signal index of an echo: of its own light, or at the reflectivities that are assumed.
pub(super) fn signal(assumed: Option<&AssumedReflectivity>, echo: &Echo, boxes: &[Box3]) -> f32 {
    match assumed {
        None => echo.signal(),
        Some(assumed) => {
            let light = assumed.of(kind(echo, boxes)) * f64::from(echo.cos_incidence).max(1e-4);
            returned_light_index(light as f32, echo.range_m)
        }
    }
}
