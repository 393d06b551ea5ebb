//! What effects read of finished clouds.

use std::ops::BitOr;

/// What is looked for in a finished cloud, beside sensor, point and intensity of each return. It takes far longer than
/// most effects.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reads {
    /// Row, column and time of each return, and the patterns of [`super::FrameContext::sensors`].
    pub pattern: bool,
    /// Normals, angles of incidence, reflectivity and returned light.
    pub surfaces: bool,
    /// Shots without a return.
    pub empty_shots: bool,
}

impl Reads {
    /// Nothing else.
    pub const NOTHING: Reads = Reads { pattern: false, surfaces: false, empty_shots: false };
    /// Row, column and time.
    pub const PATTERN: Reads = Reads { pattern: true, ..Reads::NOTHING };
    /// Surfaces.
    pub const SURFACES: Reads = Reads { surfaces: true, ..Reads::NOTHING };
    /// Shots without a return.
    pub const EMPTY_SHOTS: Reads = Reads { empty_shots: true, ..Reads::NOTHING };
    /// All of it.
    pub const ALL: Reads = Reads { pattern: true, surfaces: true, empty_shots: true };
}

impl BitOr for Reads {
    type Output = Reads;

    fn bitor(self, other: Reads) -> Reads {
        Reads {
            pattern: self.pattern || other.pattern,
            surfaces: self.surfaces || other.surfaces,
            empty_shots: self.empty_shots || other.empty_shots,
        }
    }
}
