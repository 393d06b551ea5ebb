//! What an unordered cloud tells of its shots: the returns of each sensor by direction, the rows and steps of the
//! sensor's pattern, and the surface around each direction. The diagnosis compares two clouds with it, and
//! [`crate::cloud_scan`] applies effects to finished clouds with it, so that both mean the same by a row, an angle of
//! incidence, or ground.

mod around;
mod far_surfaces;
pub mod lasers;
mod pattern;
mod scan;
mod surface;

pub use around::{Around, Kind, Surroundings, in_or_beside, is_level, kind_of};
pub use far_surfaces::{FarSurfaces, LEAST_COS};
pub use pattern::ScanPattern;
pub use scan::{DirectionIndex, Entry, Neighbour, SensorScan, Steps, split_by_sensor, split_with_places};
pub use surface::{LocalSurface, fit_surface, fit_surface_through, fit_surface_to};

use crate::rig::Rig;

/// Distance across a plane from which on a neighbour belongs to another surface, m.
pub const EDGE_M: f64 = 0.12;

/// Half widths of the window of neighbours, in steps of the pattern.
const WINDOW: [f32; 2] = [2.2, 1.4];

/// The sensors of a rig with their scan patterns.
#[derive(Clone, Debug, PartialEq)]
pub struct Sensors {
    /// Mounts.
    pub rig: Rig,
    /// Scan pattern of each.
    pub patterns: Vec<ScanPattern>,
    /// Distance across a plane from which on a neighbour belongs to another surface, m.
    pub edge_m: f64,
}

impl Sensors {
    /// Patterns of the rig's sensors from scans of several frames, each a scan by sensor.
    pub fn find(rig: &Rig, frames: &[&[SensorScan]]) -> Sensors {
        let of_sensor = |k: usize| ScanPattern::of_scans(&frames.iter().map(|f| &f[k]).collect::<Vec<_>>());
        Sensors { rig: rig.clone(), patterns: (0..rig.sensors.len()).map(of_sensor).collect(), edge_m: EDGE_M }
    }

    /// Row, from the lowest, of a return at an elevation and a range; `u16::MAX` where rows are not known.
    pub fn row(&self, sensor: usize, elevation_rad: f32, range_m: f32) -> u16 {
        self.patterns[sensor].row(elevation_rad, range_m).map_or(u16::MAX, |r| r as u16)
    }

    /// Half widths of the window in which the neighbours of a direction are looked for.
    pub fn window(&self, sensor: usize) -> Steps {
        let steps = self.patterns[sensor].steps;
        Steps { azimuth_rad: WINDOW[0] * steps.azimuth_rad, elevation_rad: WINDOW[1] * steps.elevation_rad }
    }
}
