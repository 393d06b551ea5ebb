//! Linear causes fitted together with the offsets of rows. Rows that aim or measure otherwise look together a little
//! like a bias or a turn, by chance: offsets of rows are independent of each other, with the standard deviation
//! that is found of them, and what they look like is integrated out.

use super::hypotheses::Hypothesis;
use super::sums::{group_fit, row_columns};
use super::{Context, Search};
use crate::channels::groups::{Group, Grouping, elevation_lever, group_of};
use crate::channels::mean::OWN;
use crate::inference::grouped;
use crate::inference::linear::{LinearFit, at_least};
use crate::pairing::Ray;
use nalgebra::{DMatrix, DVector, DVectorViewMut, UnitQuaternion};
use rayon::prelude::*;
use std::collections::BTreeMap;

/// The fit.
pub(super) struct BesideRows {
    /// Of the base model and the linear causes.
    pub(super) linear: LinearFit,
    /// Of each row, by column.
    rows: BTreeMap<Group, Vec<OfRow>>,
    /// Turn of each sensor.
    turns: Vec<UnitQuaternion<f64>>,
}

/// The offset of a row in one column.
struct OfRow {
    column: usize,
    /// Beyond what was undone, m or rad.
    offset: f64,
    /// By how much it changes as the linear causes do.
    response: DVector<f64>,
}

/// Sums of the rows of one frame, its own pose and displacement over a scan integrated out: their products with each
/// other, with the linear columns, and with what is measured.
struct RowSums {
    /// Products of the offsets of one row with each other.
    within: DMatrix<f64>,
    /// Products with what the frame has of its own, and the covariance of that.
    on_own: DMatrix<f64>,
    own: DMatrix<f64>,
    cross: DMatrix<f64>,
    right: DVector<f64>,
    /// What is added to the products of the linear columns with what is measured.
    on_columns: DVector<f64>,
}

/// Sums over some frames.
struct Total {
    rows: DMatrix<f64>,
    cross: DMatrix<f64>,
    of_rows: DVector<f64>,
    columns: DMatrix<f64>,
    of_columns: DVector<f64>,
}

/// Where the offset of a row is among all of them.
struct Places {
    columns: Vec<usize>,
    groups: Vec<Group>,
}

impl Places {
    fn len(&self) -> usize {
        self.groups.len() * self.columns.len()
    }

    fn first_of(&self, group: Group) -> Option<usize> {
        self.groups.binary_search(&group).ok().map(|at| at * self.columns.len())
    }

    fn column(&self, place: usize) -> usize {
        self.columns[place % self.columns.len()]
    }
}

/// The fit on the estimating frames; `None` where no offsets of rows are among the chosen hypotheses.
pub(super) fn fit(search: &Search, chosen: &[Hypothesis]) -> Option<BesideRows> {
    let (sums, columns) = (&search.sums, row_columns(chosen));
    let mut groups: Vec<Group> = search
        .estimate
        .iter()
        .flat_map(|&f| sums.groups_of(Grouping::Row)[f].iter().map(|(group, _)| *group))
        .collect();
    groups.sort_unstable();
    groups.dedup();
    if columns.is_empty() || groups.is_empty() {
        return None;
    }
    let places = Places { columns, groups };
    let linear = sums.fit_all(&search.estimate, &search.estimate_blocks, chosen).columns;
    let paired = search.paired();
    let of_frame = |&f: &usize| row_sums(search, &paired, f, &places, &linear);
    let frames: Vec<RowSums> = search.estimate.par_iter().map(of_frame).collect();
    let total = total(search, &frames, &linear);
    let all = sums.rows(&search.estimate, chosen);
    let spread = |column: usize| {
        let (std, _) = spread_of(column, &all[column]);
        std.clamp(1e-9, group_fit(column).precision.sqrt().recip())
    };
    let solved = Solved::new(&total, &places, &places.columns.iter().map(|&c| (c, spread(c))).collect())?;
    let scatter = solved.scatter(search, &frames, &linear);
    let covariance = at_least(solved.covariance.clone(), &scatter);
    let mut rows = BTreeMap::<Group, Vec<OfRow>>::new();
    for at in 0..places.len() {
        let (column, group) = (places.column(at), places.groups[at / places.columns.len()]);
        let undone = sums.undone_rows.get(&group).map_or(0.0, |row| row[column]);
        let response = -solved.response.row(at).transpose();
        rows.entry(group).or_default().push(OfRow { column, offset: solved.offsets[at] - undone, response });
    }
    let turns = search.context.rig.sensors.iter().map(|s| s.pose().rotation).collect();
    Some(BesideRows { linear: LinearFit { columns: linear, theta: solved.theta, covariance }, rows, turns })
}

/// Spread of the offsets of rows, with the number of those that are known well; the offsets with their variances.
pub(super) fn rows(search: &Search, column: usize, chosen: &[Hypothesis]) -> ((f64, f64), BTreeMap<Group, [f64; 2]>) {
    let mut rows = std::mem::take(&mut search.sums.rows(&search.estimate, chosen)[column]);
    let spread = spread_of(column, &rows);
    if let Some(fit) = search.reported.as_ref().and_then(|reported| reported.rows.as_ref()) {
        let without = search.sums.fit_all(&search.estimate, &search.estimate_blocks, chosen);
        for (row, [offset, variance]) in &mut rows {
            let [more, by_columns] = fit.more(column, *row, &without, &search.sums.base);
            *offset += more;
            *variance += by_columns;
        }
    }
    (spread, rows)
}

/// Standard deviation of the offsets of rows in a column, and the number of rows that tell it. Errors of ranges are
/// independent from row to row, those of elevations may be along a line.
fn spread_of(column: usize, rows: &BTreeMap<Group, [f64; 2]>) -> (f64, f64) {
    if column == 0 { grouped::spread_of_rows(rows) } else { grouped::spread_of_smooth_rows(rows) }
}

/// Sums of the rows of a frame beside some linear columns.
fn row_sums(search: &Search, context: &Context, frame: usize, places: &Places, linear: &[usize]) -> RowSums {
    let sums = &search.sums;
    let turns: Vec<_> = context.rig.sensors.iter().map(|s| s.pose().rotation).collect();
    let (p, q, each) = (sums.columns.len(), places.len(), places.columns.len());
    let (mut within, mut cross, mut right) = (DMatrix::zeros(q, each), DMatrix::zeros(q, p), DVector::zeros(q));
    let compared = sums.compared(context.rig);
    let (pose, moment) = (&sums.poses[frame], &sums.moments.of_frames[frame]);
    compared.for_each(&context.frames[frame], pose, moment, |ray, x, y, w| {
        let Some(at) = group_of(ray, Grouping::Row).and_then(|group| places.first_of(group)) else { return };
        let levers = [ray.range_lever(), elevation_lever(ray, &turns[usize::from(ray.sensor)])];
        for (i, &a) in places.columns.iter().enumerate() {
            right[at + i] += w * levers[a] * y;
            x.iter().for_each(|&(k, v)| cross[(at + i, k)] += w * levers[a] * v);
            places.columns.iter().enumerate().for_each(|(j, &b)| within[(at + i, j)] += w * levers[a] * levers[b]);
        }
    });
    // What was undone is a part of the whole offsets.
    let undone = DVector::from_fn(q, |at, _| {
        let row = sums.undone_rows.get(&places.groups[at / each]);
        row.map_or(0.0, |row| row[places.column(at)])
    });
    right += within_times(&within, &undone) + &cross * &sums.undone;
    let whole = &sums.whole[frame];
    let own = whole.of_own(&sums.own_prior).unwrap_or_else(|| DMatrix::zeros(OWN, OWN));
    let on_own = cross.columns(0, OWN).into_owned();
    let of_own = whole.right.rows(0, OWN) + whole.gram.rows(0, OWN) * &sums.undone + on_own.transpose() * &undone;
    right -= &on_own * (&own * of_own);
    let cross = cross - &on_own * (&own * whole.gram.rows(0, OWN));
    let cross = DMatrix::from_fn(q, linear.len(), |i, j| cross[(i, linear[j])]);
    RowSums { on_columns: cross.transpose() * undone, within, on_own, own, cross, right }
}

/// Product of the offsets of single rows with all offsets.
fn within_times(within: &DMatrix<f64>, offsets: &DVector<f64>) -> DVector<f64> {
    let each = within.ncols();
    DVector::from_fn(within.nrows(), |at, _| (0..each).map(|j| within[(at, j)] * offsets[at / each * each + j]).sum())
}

impl RowSums {
    /// Products of all offsets with each other, times some offsets.
    fn times(&self, offsets: &DVector<f64>) -> DVector<f64> {
        within_times(&self.within, offsets) - &self.on_own * (&self.own * (self.on_own.transpose() * offsets))
    }

    /// Adds the products of all offsets with each other.
    fn add_to(&self, rows: &mut DMatrix<f64>) {
        let each = self.within.ncols();
        *rows -= &self.on_own * &self.own * self.on_own.transpose();
        for (at, j) in (0..rows.nrows()).flat_map(|at| (0..each).map(move |j| (at, j))) {
            rows[(at, at / each * each + j)] += self.within[(at, j)];
        }
    }
}

/// Sums over the estimating frames.
fn total(search: &Search, frames: &[RowSums], linear: &[usize]) -> Total {
    let sums = &search.sums;
    let (q, k) = frames.first().map_or((0, 0), |f| f.cross.shape());
    let precision = |i: usize, j: usize| if i == j { sums.precision[linear[i]].max(1e-12) } else { 0.0 };
    let mut total = Total {
        rows: DMatrix::zeros(q, q),
        cross: DMatrix::zeros(q, k),
        of_rows: DVector::zeros(q),
        columns: DMatrix::from_fn(k, k, precision),
        of_columns: DVector::zeros(k),
    };
    for (frame, &f) in frames.iter().zip(&search.estimate) {
        frame.add_to(&mut total.rows);
        total.cross += &frame.cross;
        total.of_rows += &frame.right;
        let own = &sums.linear[f];
        total.columns += DMatrix::from_fn(k, k, |i, j| own.gram[(linear[i], linear[j])]);
        total.of_columns += DVector::from_fn(k, |i, _| own.right[linear[i]]) + &frame.on_columns;
    }
    total
}

/// The solution for standard deviations of the offsets of rows.
struct Solved {
    theta: DVector<f64>,
    offsets: DVector<f64>,
    /// Of the linear columns, offsets of rows integrated out.
    covariance: DMatrix<f64>,
    /// By how much an offset is smaller where a linear column is larger: rows by columns.
    response: DMatrix<f64>,
}

impl Solved {
    /// For the standard deviation of the offsets in each column.
    fn new(total: &Total, places: &Places, spread: &BTreeMap<usize, f64>) -> Option<Solved> {
        let mut rows = total.rows.clone();
        (0..places.len()).for_each(|at| rows[(at, at)] += spread[&places.column(at)].powi(-2));
        let rows = rows.cholesky()?;
        let response = rows.solve(&total.cross);
        let covariance = (&total.columns - total.cross.transpose() * &response).try_inverse()?;
        let theta = &covariance * (&total.of_columns - response.transpose() * &total.of_rows);
        let offsets = rows.solve(&(&total.of_rows - &total.cross * &theta));
        Some(Solved { theta, offsets, covariance, response })
    }

    /// Covariance of the linear columns by the scatter of the blocks (sandwich estimate).
    fn scatter(&self, search: &Search, frames: &[RowSums], linear: &[usize]) -> DMatrix<f64> {
        let k = linear.len();
        let mut blocks = BTreeMap::<usize, DVector<f64>>::new();
        for ((frame, &f), block) in frames.iter().zip(&search.estimate).zip(&search.estimate_blocks) {
            let own = &search.sums.linear[f];
            let fitted = DVector::from_fn(k, |i, _| {
                let of = (0..k).map(|j| own.gram[(linear[i], linear[j])] * self.theta[j]).sum::<f64>();
                own.right[linear[i]] - of
            });
            let of_columns = fitted + &frame.on_columns - frame.cross.transpose() * &self.offsets;
            let of_rows = &frame.right - &frame.cross * &self.theta - frame.times(&self.offsets);
            *blocks.entry(*block).or_insert_with(|| DVector::zeros(k)) +=
                of_columns - self.response.transpose() * of_rows;
        }
        let n = blocks.len() as f64;
        let squares = blocks.values().fold(DMatrix::zeros(k, k), |sum, score| sum + score * score.transpose());
        &self.covariance * squares * &self.covariance * (n / (n - 1.0).max(1.0))
    }
}

impl BesideRows {
    /// By how much the offset of a row is larger with the coefficients of this fit than with those of a fit without
    /// rows, and its variance by what is not known of them. Surfaces that stand elsewhere are no cause: only the
    /// columns but the `base` ones count.
    pub(super) fn more(&self, column: usize, row: Group, without: &LinearFit, base: &[usize]) -> [f64; 2] {
        let of_row = self.rows.get(&row).and_then(|all| all.iter().find(|of_row| of_row.column == column));
        let Some(OfRow { response, .. }) = of_row else { return [0.0; 2] };
        let is_cause = |i: usize| if base.contains(&self.linear.columns[i]) { 0.0 } else { 1.0 };
        let response = DVector::from_fn(response.len(), |i, _| is_cause(i) * response[i]);
        let changed = &self.linear.theta - &without.theta;
        [response.dot(&changed), response.dot(&(&self.linear.covariance * &response))]
    }

    /// Adds to the derivatives of a ray's distance by the linear causes what its row changes with them, and returns the
    /// distance by the offsets of the row, m.
    pub(super) fn add_response(&self, ray: &Ray, levers: &mut DVectorViewMut<f64>) -> f64 {
        let Some(all) = group_of(ray, Grouping::Row).and_then(|group| self.rows.get(&group)) else { return 0.0 };
        let of_row = |of: &OfRow| {
            let lever = if of.column == 0 {
                ray.range_lever()
            } else {
                elevation_lever(ray, &self.turns[usize::from(ray.sensor)])
            };
            levers.axpy(lever, &of.response, 1.0);
            lever * of.offset
        };
        all.iter().map(of_row).sum()
    }
}
