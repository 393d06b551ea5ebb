//! C10: a world with what another one lacks.

use super::{Need, SensorEffect, WorldPlan};
use crate::object::Group;
use data::KeyError;
use data::toml_text::wrong;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `groups` of the static world are there, also when an effect before it, as [`super::MissingObjects`], left them out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExtraObjects {
    /// What is there.
    pub groups: Vec<Group>,
}

impl Default for ExtraObjects {
    fn default() -> Self {
        ExtraObjects { groups: vec![Group::OutsideGround, Group::OutsideObjects] }
    }
}

impl SensorEffect for ExtraObjects {
    fn check(&self) -> Result<(), KeyError> {
        if self.groups.is_empty() { Err(wrong("groups", "names none")) } else { Ok(()) }
    }

    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_world(&self, world: &mut WorldPlan) {
        world.groups.extend(self.groups.iter().copied());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_there_already_stays_once() {
        let mut world = WorldPlan::default();
        ExtraObjects::default().on_world(&mut world);
        assert_eq!(world, WorldPlan::default());
    }
}
