//! What a point may belong to: the numbers in the column `object` of attributes.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What a triangle of the static world belongs to; its number stands in the column `object` of attributes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
#[repr(u16)]
pub enum Group {
    /// The racing surface.
    Surface = 1,
    /// The flatter strip inside of it.
    Apron = 2,
    /// Ground inside of the track.
    Infield = 3,
    /// The wall along the outer edge.
    OuterWall = 4,
    /// Posts and cables on the outer wall.
    Fence = 5,
    /// The wall of the pit lane.
    PitWall = 6,
    /// Rows of seats along the front stretch.
    Grandstand = 7,
    /// Buildings, vehicles and poles inside of the track.
    InfieldObjects = 8,
    /// Ground outside of the wall.
    OutsideGround = 9,
    /// Buildings, vehicles and poles outside of the wall.
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

/// Numbers of cars in the column `object` of attributes begin here; the car whose cloud it is has none.
pub const FIRST_CAR: u16 = 100;
