//! C10: objects of the static world that are absent.

use super::{Need, SensorEffect, WorldPlan};
use crate::object::Group;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// `groups` of the static world are absent.
///
/// Typical: the simulation of Huch et al. 2023 has nothing behind the outer wall: groups `outside_ground` and
/// `outside_objects`.
#[derive(Clone, Debug, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct MissingObjects {
    /// Groups that are absent.
    pub groups: Vec<Group>,
}

impl SensorEffect for MissingObjects {
    fn needs(&self) -> Option<&'static [Need]> {
        None
    }

    fn on_world(&self, world: &mut WorldPlan) {
        world.groups.retain(|group| !self.groups.contains(group));
    }
}

#[cfg(test)]
mod tests {
    use super::super::ExtraObjects;
    use super::*;

    #[test]
    fn groups_are_removed_and_added_again() {
        let mut world = WorldPlan::default();
        MissingObjects { groups: vec![Group::OutsideGround, Group::OutsideObjects] }.on_world(&mut world);
        assert_eq!(world.groups.len(), Group::ALL.len() - 2);
        assert!(!world.groups.contains(&Group::OutsideObjects));
        ExtraObjects { groups: vec![Group::OutsideObjects] }.on_world(&mut world);
        assert!(world.groups.contains(&Group::OutsideObjects) && !world.groups.contains(&Group::OutsideGround));
    }
}
