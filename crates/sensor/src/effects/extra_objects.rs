//! C10: objects of the static world that are present.

use super::{Need, SensorEffect, WorldPlan};
use crate::object::Group;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `groups` of the static world are present, even if an effect before this one in the list, such as
/// [`super::MissingObjects`], removed them.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ExtraObjects {
    /// Groups that are present.
    pub groups: Vec<Group>,
}

impl SensorEffect for ExtraObjects {
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
    fn groups_that_are_present_do_not_change() {
        let mut world = WorldPlan::default();
        ExtraObjects { groups: vec![Group::OutsideGround, Group::OutsideObjects] }.on_world(&mut world);
        assert_eq!(world, WorldPlan::default());
    }
}
