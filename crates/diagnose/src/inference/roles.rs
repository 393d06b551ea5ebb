//! Roles of frames: to select, to estimate, or held out. No frame has two.

use serde::{Deserialize, Serialize};

/// What a frame is used for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Role {
    /// To find and to name.
    Select,
    /// To fit parameters and their intervals.
    Estimate,
    /// To measure the gain.
    HoldOut,
}

/// Fewest frames that can be divided into roles.
pub const FEWEST_FRAMES: usize = 5;

/// Largest number of blocks of a recording.
const BLOCKS: usize = 20;

/// Roles in the order of blocks.
const ORDER: [Role; 5] = [Role::Select, Role::Estimate, Role::Select, Role::Estimate, Role::HoldOut];

/// Role and block of each frame: contiguous blocks, two fifths to select, two to estimate, one held out.
pub fn roles(frames: usize) -> Vec<(Role, usize)> {
    let blocks = BLOCKS.min(frames / ORDER.len() * ORDER.len()).max(1);
    (0..frames)
        .map(|i| {
            let block = i * blocks / frames;
            (ORDER[block % ORDER.len()], block)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn blocks_are_contiguous_and_every_role_is_filled() {
        for frames in [5, 8, 9, 40, 41, 200] {
            let roles = roles(frames);
            for role in [Role::Select, Role::Estimate, Role::HoldOut] {
                assert!(roles.iter().any(|r| r.0 == role), "{frames} {role:?}");
            }
            assert!(roles.windows(2).all(|w| w[1].1 == w[0].1 || w[1].1 == w[0].1 + 1));
        }
        let count = |role| roles(40).iter().filter(|r| r.0 == role).count();
        assert_eq!((count(Role::Select), count(Role::Estimate), count(Role::HoldOut)), (16, 16, 8));
    }
}
