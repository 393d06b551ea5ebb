//! Directions and ranges without returns whatever the scene: parts of the ego vehicle in the field of view, and the
//! largest range.

use super::range_ends::RangeEnd;
use super::returns::OWN_CAR_M;
use crate::pairing::{FramePair, Lies, Ray};
use rayon::prelude::*;
use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::FRAC_PI_2;

/// Rays that are hidden, whatever the laws of losses.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mask {
    /// Nothing is measured beyond this.
    pub cut: Option<RangeEnd>,
    /// Nothing is measured nearer than this.
    pub near: Option<RangeEnd>,
    /// Hidden cells of directions.
    pub blocked: BTreeSet<DirectionCell>,
    /// Cells at their edge, which are hidden in part.
    pub partly: BTreeSet<DirectionCell>,
    /// Those and the cells around them, which may be hidden in part.
    pub around: BTreeSet<DirectionCell>,
}

/// Sensor and cell of azimuth and elevation.
pub type DirectionCell = (u8, i32, i32);

/// Width of a cell, rad: 1.5 degrees.
pub const AZIMUTH_RAD: f64 = 0.0262;
/// Height of a cell, rad: 1 degree.
pub const ELEVATION_RAD: f64 = 0.0175;

/// The cell of a ray.
pub fn direction_cell(ray: &Ray) -> DirectionCell {
    let az = (f64::from(ray.azimuth_rad) / AZIMUTH_RAD).floor() as i32;
    let el = (f64::from(ray.elevation_rad) / ELEVATION_RAD).floor() as i32;
    (ray.sensor, az, el)
}

impl Mask {
    /// Whether a ray is hidden, or may be.
    pub fn hides(&self, ray: &Ray) -> bool {
        let range_m = f64::from(ray.range_m);
        self.cut.is_some_and(|cut| range_m > cut.about_m()[0])
            || self.near.is_some_and(|near| range_m < near.about_m()[1])
            || !self.around.is_empty() && self.around.contains(&direction_cell(ray))
    }

    /// Adds hidden directions with the share of their returns that is lost: dark ones, and others that are hidden in
    /// part.
    pub fn hide(&mut self, cells: impl Iterator<Item = (DirectionCell, f64)>) {
        for (cell, lost) in cells {
            let of = if lost > 1.0 - DARK { &mut self.blocked } else { &mut self.partly };
            of.insert(cell);
        }
    }

    /// Whether it hides nothing.
    pub fn is_empty(&self) -> bool {
        self.cut.is_none() && self.near.is_none() && self.blocked.is_empty()
    }
}

/// Returns of a cell of directions: simulated, measured beyond the ego vehicle, measured on it; and the share of the
/// frames with some on it.
pub type DirectionCounts = BTreeMap<DirectionCell, [f64; 4]>;

/// A near return below this share of the simulated range is from the ego vehicle and not from the ground.
const HALF_WAY: f64 = 0.6;

/// Whether a return comes from the ego vehicle and not from what the simulation shows there: it is near, and well
/// before the simulated surface.
pub fn on_ego_vehicle(ray: &Ray) -> bool {
    // Without a simulated return nothing is predicted; but a return with a counterpart was moved out of the field of
    // view.
    let predicted = match ray.lies() {
        Lies::Open if ray.matched => 0.0,
        Lies::Open => f64::INFINITY,
        _ => f64::from(if ray.smooth { ray.range_m } else { ray.near_far_m[0] }),
    };
    // Another vehicle may drive as near in all frames.
    ray.own_range_m() < OWN_CAR_M.min(HALF_WAY * predicted) && !ray.at_object
}

/// Counts over some frames.
pub fn direction_counts(frames: &[FramePair], which: &[usize]) -> DirectionCounts {
    let one = |i: &usize| {
        let frame = &frames[*i];
        let mut counts = DirectionCounts::new();
        for ray in frame.simulated.iter().filter(|r| r.own_range_m() > OWN_CAR_M) {
            counts.entry(direction_cell(ray)).or_default()[0] += 1.0;
        }
        for ray in &frame.measured {
            let count = counts.entry(direction_cell(ray)).or_default();
            if on_ego_vehicle(ray) {
                count[2] += 1.0;
                count[3] = 1.0 / which.len() as f64;
            } else {
                // Returns at about the predicted range are seen, on either side of the bound.
                count[1] += 1.0;
            }
        }
        counts
    };
    let merge = |mut a: DirectionCounts, b: DirectionCounts| {
        for (k, v) in b {
            let sum = a.entry(k).or_default();
            (0..4).for_each(|j| sum[j] += v[j]);
        }
        a
    };
    which.par_iter().map(one).reduce(DirectionCounts::new, merge)
}

/// Fewest returns that are expected of a cell that is judged.
const FEWEST: f64 = 15.0;

/// Least share of its returns that other losses keep in a cell that is judged: where less is left, the tails of their
/// laws decide.
const LEAST_KEPT: f64 = 0.25;

/// Share of the returns of each cell that other losses keep.
type Kept<'a> = &'a dyn Fn(&DirectionCell) -> f64;

/// Share of the returns that other losses keep in a cell that are measured; `None` where these are too few.
fn share_seen(counts: &DirectionCounts, kept: Kept, cell: &DirectionCell) -> Option<f64> {
    let [n, seen, ..] = counts.get(cell)?;
    let kept = kept(cell);
    (kept >= LEAST_KEPT && n * kept >= FEWEST).then(|| seen / (n * kept))
}

/// Fewest cells of an occlusion.
const FEWEST_CELLS: usize = 4;

/// Fewest cells of an occlusion that covers a whole side of the field of view.
const WHOLE_SIDE_CELLS: usize = 100;

/// Ratio of measured returns from the ego vehicle to simulated returns beyond it from which on the ego vehicle hides
/// a cell.
const ON_EGO_VEHICLE: f64 = 0.4;

/// Share of the expected returns below which a cell is empty.
const EMPTY: f64 = 0.02;

/// Share of the expected returns below which a cell is dark.
const DARK: f64 = 0.12;

/// How the measured scene lies against the simulated one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Shown {
    /// In its place.
    InPlace,
    /// It was turned or shifted, and this was undone.
    MovedBack,
    /// It has motion distortion, or rows aim elsewhere.
    Elsewhere,
    /// It is another scene.
    Another,
}

/// Hidden cells: almost none of the simulated returns is measured that other losses keep.
///
/// Cells are judged in connected regions. A region counts if it stands out, see [`Region::stands_out`]. Where the
/// measured scene is displaced, only regions with returns from the ego vehicle are believed, or regions that are
/// surrounded on all sides, see [`Region::surrounded`], or on both sides of most rows, see [`Region::stands_between`].
pub fn blocked_cells(counts: &DirectionCounts, shown: Shown, kept: Kept) -> BTreeSet<DirectionCell> {
    // Another scene may have less to see in a direction, and seldom nothing at all.
    let dark_below = if shown == Shown::Another { EMPTY } else { DARK };
    let is_dark = |cell: &DirectionCell| share_seen(counts, kept, cell).is_some_and(|seen| seen < dark_below);
    let mut dark: BTreeSet<DirectionCell> =
        counts.keys().filter(|cell| covered(counts, cell) || is_dark(cell)).copied().collect();
    let mut blocked = BTreeSet::new();
    while let Some(first) = dark.first().copied() {
        let region = Region {
            counts,
            kept,
            cells: take_together(&mut dark, first, |(s, az, el), (a, e)| Some((s, az + a, el + e))),
        };
        let stands_out = region.stands_out(shown);
        let believed = match shown {
            Shown::InPlace => true,
            Shown::MovedBack => region.surrounded() || region.stands_between(),
            Shown::Another => region.surrounded(),
            Shown::Elsewhere => false,
        };
        if region.on_ego_vehicle() {
            // Cells of the region that are dark for another reason do not belong to the ego vehicle.
            let empty = |c: &DirectionCell| share_seen(counts, kept, c).is_some_and(|s| s < EMPTY);
            let own = |c: &DirectionCell| covered(counts, c) || stands_out && (shown == Shown::InPlace || empty(c));
            blocked.extend(region.cells.iter().filter(|c| own(c)));
        } else if stands_out && believed {
            blocked.extend(region.cells);
        }
    }
    blocked
}

/// Whether most frames have returns from the ego vehicle in a cell. Another vehicle may come as near, though not in
/// most frames.
fn covered(counts: &DirectionCounts, cell: &DirectionCell) -> bool {
    let stays = |c: &[f64; 4]| c[0].max(c[2]) >= FEWEST && c[2] > ON_EGO_VEHICLE * c[0] && c[3] > 0.5;
    counts.get(cell).is_some_and(stays)
}

/// Connected dark cells of one sensor.
struct Region<'a> {
    counts: &'a DirectionCounts,
    kept: Kept<'a>,
    cells: BTreeSet<DirectionCell>,
}

impl Region<'_> {
    /// Whether returns come back beside a cell on one side. The next cell may be hidden in part; the two after it
    /// count.
    fn open(&self, (s, az, el): DirectionCell, a: i32, e: i32) -> bool {
        (2..4).any(|k| share_seen(self.counts, self.kept, &(s, az + k * a, el + k * e)).is_some_and(|seen| seen > 0.5))
    }

    /// Whether the field of view ends beside a cell on one side, but not above, where the scene ends. Three cells
    /// without any return are an end: rows may be farther apart than cells are high.
    fn ends(&self, (s, az, el): DirectionCell, a: i32, e: i32) -> bool {
        let nothing = |k: i32| !self.counts.contains_key(&(s, az + k * a, el + k * e));
        e <= 0 && (1..4).any(|k| (k..k + 3).all(nothing))
    }

    /// For each side (left, right, above, below) whether an eighth of the cells are bounded there.
    fn bounded(&self, bounds: impl Fn(DirectionCell, i32, i32) -> bool) -> [bool; 4] {
        SIDES.map(|(a, e)| self.cells.iter().filter(|c| bounds(**c, a, e)).count() * 8 >= self.cells.len())
    }

    /// Number of rows of cells.
    fn height(&self, which: impl Fn(&DirectionCell) -> bool) -> usize {
        self.cells.iter().filter(|c| which(c)).map(|c| c.2).collect::<BTreeSet<_>>().len()
    }

    /// Whether returns come from the ego vehicle.
    fn on_ego_vehicle(&self) -> bool {
        self.cells.iter().filter(|c| covered(self.counts, c)).count() >= 2
    }

    /// Whether returns come back beside most of its rows, on one side.
    fn upright_edge(&self, a: i32) -> bool {
        4 * self.height(|c| self.open(*c, a, 0)) >= 3 * self.height(|_| true)
    }

    /// Whether returns come back on both sides of most of its rows. Where a thing that was moved stood before others,
    /// these come back. A single row is the upper edge of a wall that was moved.
    fn stands_between(&self) -> bool {
        self.height(|_| true) > 1 && self.upright_edge(1) && self.upright_edge(-1)
    }

    /// Whether the region differs from the end of a scene: returns come back on two opposite sides; or it hides a
    /// whole side of the field of view with an upright edge, which laws of losses do not; or returns come from the
    /// ego vehicle and the field of view ends on the other side.
    fn stands_out(&self, shown: Shown) -> bool {
        let opposite = |[left, right, above, below]: [bool; 4]| left && right || above && below;
        let open = |c, a, e| self.open(c, a, e);
        let whole_side = shown == Shown::InPlace
            && self.cells.len() >= WHOLE_SIDE_CELLS
            && (self.upright_edge(1) || self.upright_edge(-1));
        self.cells.len() >= FEWEST_CELLS
            && (opposite(self.bounded(open))
                || whole_side
                || self.on_ego_vehicle() && opposite(self.bounded(|c, a, e| open(c, a, e) || self.ends(c, a, e))))
    }

    /// Whether returns come back on at least three sides, and on the fourth or the field of view ends there. A single
    /// row does not count: it is the upper edge of a wall that was moved.
    fn surrounded(&self) -> bool {
        let (opens, closes) = (self.bounded(|c, a, e| self.open(c, a, e)), self.bounded(|c, a, e| self.ends(c, a, e)));
        let sides = opens.iter().filter(|o| **o).count() >= 3 && (0..4).all(|k| opens[k] || closes[k]);
        sides && self.height(|_| true) > 1
    }
}

/// Steps to the cells beside one: left, right, above, below.
pub(super) const SIDES: [(i32, i32); 4] = [(1, 0), (-1, 0), (0, 1), (0, -1)];

/// Removes the connected region of `first` from `cells`; `next` is the cell on one side of another.
pub(super) fn take_together(
    cells: &mut BTreeSet<DirectionCell>,
    first: DirectionCell,
    next: impl Fn(DirectionCell, (i32, i32)) -> Option<DirectionCell>,
) -> BTreeSet<DirectionCell> {
    cells.remove(&first);
    let mut all = vec![first];
    let mut at = 0;
    while at < all.len() {
        let here = all[at];
        at += 1;
        all.extend(SIDES.into_iter().filter_map(|side| next(here, side)).filter(|c| cells.remove(c)));
    }
    all.into_iter().collect()
}

/// A cell and those around it.
pub(crate) fn neighbours(cell: DirectionCell) -> impl Iterator<Item = DirectionCell> {
    cells_within(cell, 1)
}

/// A cell and those around it up to so many cells away.
pub(crate) fn cells_within((s, az, el): DirectionCell, cells: i32) -> impl Iterator<Item = DirectionCell> {
    (-cells..=cells).flat_map(move |a| (-cells..=cells).map(move |e| (s, az + a, el + e)))
}

/// Share of the expected returns below which a cell is hidden in part.
const IN_PART: f64 = 0.85;

/// Cells at the edge of hidden ones: connected to them and hidden in part. None where they outnumber the hidden ones
/// and the cells around these: then returns are lost for another reason as well.
pub fn edge_cells(blocked: &BTreeSet<DirectionCell>, counts: &DirectionCounts, kept: Kept) -> BTreeSet<DirectionCell> {
    let in_part = |cell: &DirectionCell| share_seen(counts, kept, cell).is_some_and(|seen| seen < IN_PART);
    let mut edge = BTreeSet::new();
    let mut from: Vec<DirectionCell> = blocked.iter().copied().collect();
    while let Some(cell) = from.pop() {
        for next in neighbours(cell).filter(|c| !blocked.contains(c) && in_part(c)) {
            if edge.insert(next) {
                from.push(next);
            }
        }
    }
    if edge.len() > with_neighbours(blocked).len() { BTreeSet::new() } else { edge }
}

/// Cells below others in which the simulation has almost no returns beyond the ego vehicle: the occlusion continues
/// into them.
pub fn below(cells: &BTreeSet<DirectionCell>, counts: &DirectionCounts) -> BTreeSet<DirectionCell> {
    let near = |c: &DirectionCell| counts.get(c).is_none_or(|[n, ..]| *n < FEWEST);
    let lowest = (-FRAC_PI_2 / ELEVATION_RAD) as i32;
    let under = |&(s, az, el): &DirectionCell| (lowest..el).rev().map(move |e| (s, az, e)).take_while(near);
    cells.iter().flat_map(under).collect()
}

/// A set of cells and those around them.
pub fn with_neighbours(cells: &BTreeSet<DirectionCell>) -> BTreeSet<DirectionCell> {
    cells.iter().flat_map(|c| neighbours(*c)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hole_in_all_frames_is_found_and_a_single_dark_cell_is_not() {
        let mut counts = DirectionCounts::new();
        for az in -20..10 {
            for el in -5..5 {
                let hole = (2..5).contains(&az) && (-3..-1).contains(&el) || (az, el) == (-8, 0);
                let end = az < -12 && el > 2;
                counts.insert((0, az, el), [100.0, if hole || end { 2.0 } else { 97.0 }, 0.0, 0.0]);
            }
        }
        let blocked = blocked_cells(&counts, Shown::InPlace, &|_| 1.0);
        assert_eq!(blocked.len(), 6);
        assert!(blocked_cells(&counts, Shown::Elsewhere, &|_| 1.0).is_empty(), "a displaced scene has dark regions");
        assert_eq!(blocked_cells(&counts, Shown::MovedBack, &|_| 1.0).len(), 6, "returns come back on all sides");
        let mut beside_the_end = counts.clone();
        beside_the_end.retain(|(_, az, _), _| *az < 5);
        assert_eq!(blocked_cells(&beside_the_end, Shown::MovedBack, &|_| 1.0).len(), 6, "the field of view ends there");
        let mut plate = counts.clone();
        plate.iter_mut().filter(|(c, _)| blocked.contains(c)).for_each(|(_, c)| (c[2], c[3]) = (90.0, 0.2));
        assert!(
            blocked_cells(&plate, Shown::Elsewhere, &|_| 1.0).is_empty(),
            "another vehicle came near in some frames"
        );
        plate.iter_mut().filter(|(c, _)| blocked.contains(c)).for_each(|(_, c)| c[3] = 1.0);
        assert_eq!(blocked_cells(&plate, Shown::Elsewhere, &|_| 1.0).len(), 6);
        assert!(!blocked.contains(&(0, -8, 0)) && !blocked.contains(&(0, -15, 4)));
        assert!(blocked_cells(&counts, Shown::InPlace, &|_| 0.2).is_empty(), "other losses explain it");
        assert_eq!(with_neighbours(&blocked).len(), 20);
        // Cells along its edge that are hidden in part; one that is not connected.
        let mut edges = counts.clone();
        for c in [(0, 5, -3), (0, 6, -3), (0, 7, -2), (0, 9, 4)] {
            edges.insert(c, [100.0, 60.0, 0.0, 0.0]);
        }
        let at_edge = edge_cells(&blocked, &edges, &|_| 1.0);
        assert_eq!(at_edge.into_iter().collect::<Vec<_>>(), [(0, 5, -3), (0, 6, -3), (0, 7, -2)]);
        edges.values_mut().for_each(|c| c[1] = c[1].min(60.0));
        assert!(edge_cells(&blocked, &edges, &|_| 1.0).is_empty(), "all around is lost in part");
        assert!(edge_cells(&blocked, &edges, &|_| 0.6).is_empty(), "other losses explain it");
        let under = below(&blocked, &counts);
        assert!(under.is_empty(), "the simulation has something there");
        let under = below(&[(0, 3, -5)].into(), &counts);
        assert!(under.contains(&(0, 3, -6)) && under.contains(&(0, 3, -80)) && under.iter().all(|c| c.1 == 3));
        // A plate close to the sensor that hides one side of the field of view; a shorter side is a sensor that aims
        // elsewhere.
        for (from, found) in [(-20, 130), (-13, 0)] {
            let mut side = DirectionCounts::new();
            for (az, el) in (from..10).flat_map(|az| (-5..5).map(move |el| (az, el))) {
                side.insert((0, az, el), [100.0, if az < -7 { 0.0 } else { 97.0 }, 0.0, 0.0]);
            }
            assert_eq!(blocked_cells(&side, Shown::InPlace, &|_| 1.0).len(), found);
        }
        // A plate that extends below the field of view, with returns along its upper edge alone.
        let mut low = DirectionCounts::new();
        for (az, el) in (-20..10).flat_map(|az| (-5..5).map(move |el| (az, el))) {
            let hidden = (-6..3).contains(&az) && el < -2;
            let near = if hidden && el == -3 { 90.0 } else { 0.0 };
            low.insert((0, az, el), [100.0, if hidden { 0.0 } else { 97.0 }, near, near / 90.0]);
        }
        assert_eq!(blocked_cells(&low, Shown::InPlace, &|_| 1.0).len(), 27);
        assert_eq!(blocked_cells(&low, Shown::Elsewhere, &|_| 1.0).len(), 27);
        low.values_mut().filter(|c| c[1] == 0.0 && c[2] == 0.0).for_each(|c| c[1] = 5.0);
        assert_eq!(
            blocked_cells(&low, Shown::Elsewhere, &|_| 1.0).len(),
            9,
            "a displaced scene has dark regions beside the plate"
        );
    }

    #[test]
    fn a_post_before_the_sky_is_found_in_a_scene_that_was_moved_back() {
        // Returns come back on both sides, none above. A wall that ends lower is no post, nor is a single row.
        for (rows, right, found) in [(0..5, 97.0, 5), (0..5, 0.0, 0), (4..5, 97.0, 0)] {
            let mut post = DirectionCounts::new();
            for (az, el) in (-20..10).flat_map(|az| (-5..5).map(move |el| (az, el))) {
                let seen = if rows.contains(&el) && az >= 3 { if az == 3 { 0.0 } else { right } } else { 97.0 };
                post.insert((0, az, el), [100.0, seen, 0.0, 0.0]);
            }
            assert_eq!(blocked_cells(&post, Shown::MovedBack, &|_| 1.0).len(), found);
        }
    }
}
