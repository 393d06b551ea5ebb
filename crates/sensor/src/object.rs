//! Objects that points belong to: the values of the column `object` in attributes.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Group of static objects that a triangle or point belongs to. Its number is the value of `object` in attributes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[repr(u16)]
pub enum Group {
    /// The racing surface.
    Surface = 1,
    /// The flatter strip along the inner edge of the surface.
    Apron = 2,
    /// Ground inside the track.
    Infield = 3,
    /// The wall along the outer edge.
    OuterWall = 4,
    /// Posts and cables on the outer wall.
    Fence = 5,
    /// The wall of the pit lane.
    PitWall = 6,
    /// Rows of seats along the front stretch.
    Grandstand = 7,
    /// Buildings, vehicles and poles inside the track.
    InfieldObjects = 8,
    /// Ground outside the wall.
    OutsideGround = 9,
    /// Buildings, vehicles and poles outside the wall.
    OutsideObjects = 10,
}

impl Group {
    /// All groups, in the order of their numbers.
    pub const ALL: [Group; 10] = [
        Group::Surface,
        Group::Apron,
        Group::Infield,
        Group::OuterWall,
        Group::Fence,
        Group::PitWall,
        Group::Grandstand,
        Group::InfieldObjects,
        Group::OutsideGround,
        Group::OutsideObjects,
    ];
}

/// First number of cars in the column `object` of attributes. The ego vehicle has no number.
pub const FIRST_CAR: u16 = 100;
