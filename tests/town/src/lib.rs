//! A second generator of data set pairs with a hidden difference, to test the diagnosis.
//!
//! Streets of a town with houses, trees, signs, parked and moving cars, seen by sensors on the roof and in the grille.
//! It shares no code and no formula with `tests/blind`, the project's simulator or the diagnosis. Nuisances are always
//! present: noise, losses and false returns on both sides, different shots, small errors of poses, labels, houses and
//! ground. The truth is written next to the data, not into them. It contains how strong each effect is for an oracle
//! that knows all forms.

mod case;
mod clutter;
mod draw;
mod effect;
mod facade;
mod footprint;
mod frame;
mod grid;
mod oracle;
mod parts;
mod response;
mod route;
mod scan;
mod scenario;
mod sensor;
mod setting;
mod side;
mod solid;
mod street;
mod town;
mod traffic;
mod vehicle;
mod world;
mod write;

#[cfg(test)]
mod tests;

pub use case::{Case, Kind, draw_case, draw_case_of_two_towns};
pub use draw::{CAUSES, OFF_CATALOGUE};
pub use effect::{Clock, Dark, Effect, Spot};
pub use frame::Frame;
pub use scan::{Light, Scan};
pub use sensor::{Dither, Layout, Mount, Pattern, Shot};
pub use setting::{Intensity, Scene, Setting};
pub use side::{Nuisances, OwnErrors, Side};
pub use write::write_case;
