//! Spots on a sensor's window: ellipses of directions in which returns are lost, fitted to the losses of cells.

use super::mask::{AZIMUTH_RAD, DirectionCell, ELEVATION_RAD};
use super::patch::{DirectionLosses, LARGEST_RAD, Patch};
use crate::inference::simplex::minimise;
use sensor::effects::DirtyWindow;
use std::collections::BTreeSet;

/// One-way transmission in the middle of a spot: losses tell its product with the effect's `loss` alone.
pub const TRANSMISSION: f64 = 0.5;

/// Share of the returns that are lost in any direction.
pub const USUAL_LOSS: f64 = 0.02;

/// Smallest loss of a cell that is part of a spot.
const LEAST: f64 = 0.01;

/// Share of the returns from which on all are lost: a few come from what else is seen there, such as droplets.
const OPAQUE: f64 = 0.95;

/// Sharpness of the edge of a spot from which a fit starts: that of the effect where none is given.
const USUAL_SHARPNESS: f64 = 4.0;

/// Smallest and largest sharpness.
const SHARPNESS: [f64; 2] = [1.5, 12.0];

/// Largest radii along azimuth and elevation, rad.
const LARGEST_RADIUS_RAD: [f64; 2] = [0.5 * LARGEST_RAD[0], 0.5 * LARGEST_RAD[1]];

/// An ellipse of directions. At the angles `x` and `y` from its middle, along azimuth and elevation, the window takes
/// a share of the light on each way that is proportional to `exp(-r^sharpness)`, `r^2 = (x / radius[0])^2 +
/// (y / radius[1])^2`. Returns are lost in proportion to the light that is missing after both ways.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spot {
    /// Azimuth and elevation of the middle, rad.
    pub middle: [f64; 2],
    /// Radii along azimuth (an angle on the sphere) and along elevation, rad.
    pub radius: [f64; 2],
    /// Exponent of the profile: 2 is a soft edge, 8 a sharp one.
    pub sharpness: f64,
    /// Share of the returns that is lost in the middle.
    pub most: f64,
}

impl From<&DirtyWindow> for Spot {
    fn from(window: &DirtyWindow) -> Spot {
        let height = window.radius_deg.to_radians();
        Spot {
            middle: [window.azimuth_deg, window.elevation_deg].map(f64::to_radians),
            radius: [window.aspect * height, height],
            sharpness: window.sharpness,
            most: window.loss * (1.0 - window.transmission * window.transmission),
        }
    }
}

/// Azimuth and elevation of the middle of a cell, rad.
fn place(cell: &DirectionCell) -> [f64; 2] {
    [(f64::from(cell.1) + 0.5) * AZIMUTH_RAD, (f64::from(cell.2) + 0.5) * ELEVATION_RAD]
}

impl Spot {
    /// Loss in a cell, as a share of that in the middle.
    fn shape(&self, cell: &DirectionCell) -> f64 {
        let [azimuth, elevation] = place(cell);
        let x = (azimuth - self.middle[0]) * self.middle[1].cos() / self.radius[0];
        let y = (elevation - self.middle[1]) / self.radius[1];
        let passes = 1.0 - (1.0 - TRANSMISSION) * (-(x * x + y * y).powf(0.5 * self.sharpness)).exp();
        (1.0 - passes * passes) / (1.0 - TRANSMISSION * TRANSMISSION)
    }

    /// Azimuth and elevation from the middle within which it loses returns, rad.
    fn reach(&self) -> [f64; 2] {
        let radii = (-LEAST.ln()).powf(1.0 / self.sharpness);
        [self.radius[0] / self.middle[1].cos(), self.radius[1]].map(|r| radii * r)
    }

    /// Loss in a cell.
    pub fn share(&self, cell: &DirectionCell) -> f64 {
        self.most * self.shape(cell)
    }

    /// Cells of a sensor that are part of it.
    pub fn cells(&self, sensor: u8) -> BTreeSet<DirectionCell> {
        let reach = self.reach();
        let bins = |k: usize, width: f64| {
            let at = |rad: f64| (rad / width).floor() as i32;
            at(self.middle[k] - reach[k])..=at(self.middle[k] + reach[k])
        };
        let columns = bins(0, AZIMUTH_RAD);
        let all = columns.flat_map(|az| bins(1, ELEVATION_RAD).map(move |el| (sensor, az, el)));
        all.filter(|c| self.share(c) > LEAST).collect()
    }

    /// Whether a cell tells the spot, or what is lost beside it.
    pub fn is_near(&self, cell: &DirectionCell) -> bool {
        let (reach, place) = (self.reach(), place(cell));
        (0..2).all(|k| (place[k] - self.middle[k]).abs() < 2.0 * reach[k])
    }

    /// Whether it lets no light through in the middle: a thing before the sensor, and no dirt.
    pub fn is_opaque(&self) -> bool {
        self.most > OPAQUE
    }

    /// Width over height.
    pub fn aspect(&self) -> f64 {
        self.radius[0] / self.radius[1]
    }

    /// Whether it is smaller than the largest that is fitted, and no line: a row that loses returns has no ends along
    /// azimuth, and what is no higher than two cells of directions may be the edge of a surface.
    pub fn has_ends(&self) -> bool {
        let [narrowest, widest] = DirtyWindow::ASPECT;
        let is_spot = (narrowest..=widest).contains(&self.aspect());
        is_spot && self.radius[1] > ELEVATION_RAD && (0..2).all(|k| self.radius[k] < 0.98 * LARGEST_RADIUS_RAD[k])
    }

    /// A spot about as large as a patch.
    fn around(losses: &DirectionLosses, patch: &Patch) -> Spot {
        let lost = |c: &DirectionCell| losses.get(c).map_or(0.0, |l| l.lost().max(0.0));
        let all: f64 = patch.cells.iter().map(lost).sum::<f64>().max(1e-12);
        let middle = [0, 1].map(|k| patch.cells.iter().map(|c| lost(c) * place(c)[k]).sum::<f64>() / all);
        let half = [0, 1].map(|k| {
            let far = patch.cells.iter().map(|c| (place(c)[k] - middle[k]).abs());
            far.fold(0.0, f64::max).clamp(ELEVATION_RAD, 0.8 * LARGEST_RADIUS_RAD[k])
        });
        let most = patch.sum(losses).share().clamp(2.0 * LEAST, 0.7) * 1.3;
        Spot { middle, radius: [half[0] * middle[1].cos(), half[1]], sharpness: USUAL_SHARPNESS, most }
    }

    /// The spot that makes the losses in and around a patch likeliest, beside a loss that all these cells have. `near`
    /// is one like it.
    pub fn fit(losses: &DirectionLosses, patch: &Patch, near: Option<&Spot>) -> Spot {
        let start = near.copied().unwrap_or_else(|| Spot::around(losses, patch));
        let sensor = patch.sensor();
        let counts: Vec<(DirectionCell, f64, f64)> = losses
            .iter()
            .filter(|(c, _)| c.0 == sensor && start.is_near(c))
            .map(|(c, l)| (*c, l.left(), (l.lost() + USUAL_LOSS * l.left()).clamp(0.0, l.left())))
            .collect();
        let spot_of = |p: &[f64]| Spot {
            middle: [p[0], p[1]],
            radius: [p[2].exp(), p[3].exp()],
            sharpness: p[4].exp(),
            most: p[5],
        };
        let cost = |p: &[f64]| {
            let spot = spot_of(p);
            let is_possible = (LEAST..=1.0).contains(&spot.most)
                && (SHARPNESS[0]..=SHARPNESS[1]).contains(&spot.sharpness)
                && (0..2).all(|k| (0.5 * ELEVATION_RAD..=LARGEST_RADIUS_RAD[k]).contains(&spot.radius[k]));
            if !is_possible {
                return f64::MAX;
            }
            let of_cell = |(c, n, lost): &(DirectionCell, f64, f64)| {
                let share = (USUAL_LOSS + p[6] + spot.share(c)).clamp(0.002, 0.998);
                lost * share.ln() + (n - lost) * (1.0 - share).ln()
            };
            -counts.iter().map(of_cell).sum::<f64>()
        };
        let [wide, high] = start.radius;
        let from = [start.middle[0], start.middle[1], wide.ln(), high.ln(), start.sharpness.ln(), start.most, 0.0];
        let steps = [0.2 * wide, 0.2 * high, -0.2, -0.2, 0.2, -0.2 * start.most, 0.01];
        spot_of(&minimise(&from, &steps, cost).0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::mask::Mask;
    use crate::channels::patch::{patches, testing::field};

    fn spot(middle: [f64; 2], radius: [f64; 2], most: f64) -> Spot {
        Spot { middle, radius, sharpness: 3.0, most }
    }

    #[test]
    fn an_ellipse_is_fitted_with_few_rows_and_beside_a_loss_everywhere() {
        let truth = spot([-0.3, -0.05], [0.16, 0.07], 0.5);
        for (every, beside) in [(1, 0.0), (1, 0.04), (2, 0.0)] {
            let mut losses = field(|c| beside + truth.share(c));
            losses.retain(|c, _| c.2.rem_euclid(every) == 0);
            let found = patches(&losses);
            assert_eq!(found.len(), 1);
            let fit = Spot::fit(&losses, &found[0], None);
            for k in 0..2 {
                assert!((fit.middle[k] - truth.middle[k]).abs() < 0.004, "{fit:?}");
                assert!((fit.radius[k] / truth.radius[k] - 1.0).abs() < 0.04, "{fit:?}");
            }
            assert!((fit.most / truth.most - 1.0).abs() < 0.05 && (fit.sharpness - 3.0).abs() < 0.3, "{fit:?}");
            let cells = fit.cells(0);
            assert!(
                found[0].cells.iter().all(|c| cells.contains(c))
                    && cells.len() < 3 * every as usize * found[0].cells.len()
            );
        }
    }

    #[test]
    fn what_lets_nothing_through_hides_its_directions() {
        for (most, opaque) in [(0.85, false), (0.99, true)] {
            let truth = Spot { sharpness: 8.0, ..spot([-0.3, -0.05], [0.16, 0.07], most) };
            let losses = field(|c| truth.share(c));
            let fit = Spot::fit(&losses, &patches(&losses)[0], None);
            assert_eq!(fit.is_opaque(), opaque, "{fit:?}");
        }
        let window = Spot { sharpness: 8.0, ..spot([0.0, 0.0], [0.2, 0.1], 1.0) };
        let mut mask = Mask::default();
        mask.hide(window.cells(0).into_iter().map(|cell| (cell, window.share(&cell))));
        assert!(mask.blocked.contains(&(0, 0, 0)) && mask.blocked.is_disjoint(&mask.partly) && !mask.partly.is_empty());
    }

    #[test]
    fn a_row_has_no_ends() {
        let losses = field(|c| if c.2 == -3 { 0.4 } else { 0.0 });
        let patch = Patch { cells: (-9..9).map(|az| (0, az, -3)).collect() };
        let fit = Spot::fit(&losses, &patch, None);
        assert!(!fit.has_ends() && fit.radius[1] < 2.0 * ELEVATION_RAD, "{fit:?}");
        assert!(spot([0.0, 0.0], [0.3, 0.1], 0.5).has_ends() && !spot([0.0, 0.0], [0.3, 0.01], 0.5).has_ends());
    }
}
