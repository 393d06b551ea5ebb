//! How causes are weighed against each other.

pub mod choice;
pub mod grouped;
pub mod linear;
pub mod losses;
pub mod noise;
pub mod roles;
pub mod simplex;
