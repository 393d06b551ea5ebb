//! Sums of all frames that the hypotheses of geometry are fitted on, and the fits.

use super::displacement::Displacement;
use super::hypotheses::Hypothesis;
use super::own_scatter::own_scatter;
use super::row_offsets::{Rows, row_offsets};
use crate::channels::groups::{
    Group, GroupFrame, Grouping, PARTS, PartedFrame, Seen, Undone, group_frames, total, whole,
};
use crate::channels::mean::{
    Column, Compared, GROUND, KINDS, MeanFrame, OWN, STRUCTURE_M, columns, design_effect, usual_noise_m,
};
use crate::channels::moments::Moments;
use crate::channels::own_poses::{OWN_AT_ONCE, OwnPoses, mounts, own_poses};
use crate::channels::row_patches::{self, Band, Offsets, RowFrame, row_frames};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::linear::{FOLDS, LinearFit, LinearFrame, cross_expected, cross_gains, fit, fold_of};
use crate::inference::median;
use crate::search::Context;
use nalgebra::{DVector, SVector};
use rayon::prelude::*;
use sensor::Rig;
use std::collections::BTreeMap;

/// Sums of all frames.
pub(super) struct Sums {
    /// Columns of the linear fits.
    pub(super) columns: Vec<Column>,
    /// Prior precision of each column.
    pub(super) precision: Vec<f64>,
    /// Columns of the base model: offsets of the surfaces, and what is left of a displacement over a scan that was
    /// undone.
    pub(super) base: Vec<usize>,
    /// Linear sums of each frame, its own pose and displacement over a scan integrated out.
    pub(super) linear: Vec<LinearFrame>,
    /// Sums of each frame with its own pose.
    pub(super) whole: Vec<MeanFrame>,
    /// Prior variances of what each frame has of its own.
    pub(super) own_prior: SVector<f64, OWN>,
    /// What was undone before the frames were paired, by column.
    pub(super) undone: DVector<f64>,
    /// Offsets of rows that were undone as well.
    pub(super) undone_rows: Undone,
    /// Range noise of the simulated side, m.
    pub(super) noise_m: f64,
    /// Variance of means over patches of directions, in units of that of independent residuals.
    pub(super) design: f64,
    /// Sums by row, offsets and slopes of the surfaces in patches integrated out.
    pub(super) rows: Vec<RowFrame>,
    /// Variance of means of rows in patches, in units of the assumed one.
    pub(super) of_patches: f64,
    /// Sums by row, of surfaces as they are.
    pub(super) whole_rows: Vec<GroupFrame>,
    /// The same by part, of the ground and of what stands.
    pub(super) parted_rows: [Vec<PartedFrame>; 2],
    /// The same with the pose and the offsets of surfaces that all frames share: rows may have both in common.
    pub(super) rows_with_pose: [Vec<PartedFrame>; 2],
    /// Sums by strip of azimuth.
    pub(super) strips: Groups,
    /// Sums by step of range.
    pub(super) steps: Groups,
    /// Pose error of each frame, as each sensor sees it.
    pub(super) poses: Vec<OwnPoses>,
    /// Weights of all returns of each sensor, by frame.
    pub(super) of_sensors: Vec<Vec<f64>>,
    /// Moments of all frames.
    pub(super) moments: Moments,
}

/// Groups of every frame, by part and whole.
pub(super) struct Groups {
    pub(super) parted: Vec<PartedFrame>,
    pub(super) whole: Vec<GroupFrame>,
}

/// Sums of all frames; priors are fitted on the selecting ones. What was undone before the frames were paired is added
/// to what is left: fits are of the whole displacement, linear about what was undone (a step of Gauss and Newton). The
/// columns `swept` are in the base model.
pub(super) fn sums(context: &Context, select: &[usize], undone: &Displacement, swept: &[Column]) -> Sums {
    let (frames, rig) = (context.frames, context.rig);
    let mounts = mounts(rig);
    let noise_m = usual_noise_m(frames);
    let poses: Vec<OwnPoses> = frames.par_iter().map(|f| own_poses(f, &mounts, noise_m)).collect();
    let design = design_effect(frames, &mounts, &poses, noise_m);
    let moments = context.moments();
    let columns = columns(rig, &moments);
    let compared = Compared { rig, columns: &columns, noise_m, design };
    let means = compared.sums(frames, &poses, &moments.of_frames);
    let of_sensors = sensor_weights(&means, &columns, rig.sensors.len());
    let prior = own_scatter(rig, &poses, select, &moments);
    let without_own = |m: &MeanFrame| {
        let (gram, right) = m.without_own(&prior);
        LinearFrame { gram, right }
    };
    let mut linear: Vec<LinearFrame> = means.iter().map(without_own).collect();
    let precision: Vec<f64> = columns.iter().map(|c| precision(*c)).collect();
    let mut base: Vec<usize> = (0..columns.len()).filter(|&i| matches!(columns[i], Column::Structure(_))).collect();
    base.extend((0..columns.len()).filter(|&i| swept.contains(&columns[i])));
    let selected: Vec<&LinearFrame> = select.iter().map(|&i| &linear[i]).collect();
    let structure = fit(&selected, &context.blocks(select), &base, &precision);
    let structure = std::array::from_fn(|k| structure.theta[k]);
    let by_columns = DVector::from_iterator(columns.len(), columns.iter().map(|c| undone.of_column(*c)));
    linear.iter_mut().for_each(|frame| frame.right += &frame.gram * &by_columns);
    let seen = Seen { poses: &poses, structure, undone: &undone.rows };
    let parted = |groups, seen| group_frames(frames, rig, seen, groups, noise_m, design);
    let groups = |g| {
        let parted = parted((g, 0..KINDS), seen);
        Groups { whole: parted.iter().map(whole).collect(), parted }
    };
    let by_row = |seen| [GROUND..GROUND + 1, GROUND + 1..KINDS].map(|kinds| parted((Grouping::Row, kinds), seen));
    let rows = row_frames(frames, rig, seen, noise_m);
    let with_pose = Seen { poses: &deviations(&poses, select), structure: Default::default(), ..seen };
    let [ground, standing] = by_row(seen);
    Sums {
        of_patches: of_patches(&rows, select, rig.sensors.len()),
        rows,
        whole_rows: ground.iter().zip(&standing).map(|(g, s)| total(g.iter().chain(s)).into_iter().collect()).collect(),
        parted_rows: [ground, standing],
        rows_with_pose: by_row(with_pose),
        strips: groups(Grouping::Azimuth),
        steps: groups(Grouping::Range),
        columns,
        precision,
        base,
        linear,
        whole: means,
        own_prior: prior,
        undone: by_columns,
        undone_rows: undone.rows.clone(),
        noise_m,
        design,
        poses,
        of_sensors,
        moments,
    }
}

/// Poses relative to the median of each sensor's over some frames; displacements over a scan as they are.
fn deviations(poses: &[OwnPoses], select: &[usize]) -> Vec<OwnPoses> {
    let of = |k: usize, sensor: usize| median(select.iter().map(|&f| poses[f][sensor][k]).collect());
    let middle = |sensor: usize| SVector::from_fn(|k, _| if k < OWN_AT_ONCE { of(k, sensor) } else { 0.0 });
    let middles: OwnPoses = (0..poses.first().map_or(0, Vec::len)).map(middle).collect();
    poses.iter().map(|of_frame| of_frame.iter().zip(&middles).map(|(pose, middle)| pose - middle).collect()).collect()
}

/// Prior precisions of the offsets of rows in some columns, times the variance of what they are fitted to.
pub(super) fn precisions(columns: &[usize], variance: f64) -> [Option<f64>; 2] {
    [0, 1].map(|c| columns.contains(&c).then(|| variance * group_fit(c).precision))
}

/// Variance of means of rows in patches, in units of the assumed one, at least 1: what the patches leave once each row
/// has an offset of its own, in range or in elevation.
fn of_patches(rows: &[RowFrame], select: &[usize], sensors: usize) -> f64 {
    let [squares, freedom] = select.iter().fold([0.0; 2], |s, &i| [s[0] + rows[i].squares, s[1] + rows[i].freedom]);
    let explained = |sensor: usize| {
        let sum = row_patches::total(select.iter().map(|&i| &rows[i]), sensor, &|_| true);
        2.0 * sum.gain(&sum.offsets(precisions(&[0, 1], 1.0)))
    };
    let explained: f64 = (0..sensors).map(explained).sum();
    ((squares - explained.max(0.0)) / freedom.max(1.0)).max(1.0)
}

/// Weights of all returns of each sensor, by frame. Surface normals have length 1, so that the squared levers of the
/// shifts sum to the weights.
fn sensor_weights(means: &[MeanFrame], columns: &[Column], sensors: usize) -> Vec<Vec<f64>> {
    let shift_of = |c: &Column, s: usize| match c {
        Column::SensorPose(of, 3..6) => *of == s,
        Column::Pose(3..6) => sensors == 1,
        _ => false,
    };
    let of_sensor = |m: &MeanFrame, s: usize| {
        let shifts = (0..columns.len()).filter(|&c| shift_of(&columns[c], s));
        shifts.map(|c| m.gram[(c, c)]).sum::<f64>()
    };
    means.iter().map(|m| (0..sensors).map(|s| of_sensor(m, s)).collect()).collect()
}

/// Prior precision of a column: one over the square of the standard deviation that is expected of it.
fn precision(column: Column) -> f64 {
    let sd: f64 = match column {
        Column::RangeOffset => 0.5,
        Column::RangeScale => 0.02,
        Column::Pose(0..3) | Column::SensorPose(_, 0..3) => 0.035,
        Column::Lean => 0.035,
        Column::Pose(_) | Column::SensorPose(..) | Column::Drift(_) => 0.2,
        Column::Sweep(0..2) => 8.0,
        Column::Sweep(_) => 0.2,
        Column::Scan => 0.1,
        Column::Uneven => 0.005,
        Column::Structure(_) => STRUCTURE_M,
    };
    1.0 / (sd * sd)
}

/// Linear columns of some hypotheses, each once, and their groupings with the column of the group sums.
pub(super) fn split(hypotheses: &[Hypothesis]) -> (Vec<usize>, Vec<(Grouping, usize)>) {
    let mut columns: Vec<usize> = Vec::new();
    let mut groups = Vec::new();
    for h in hypotheses {
        match h {
            Hypothesis::Linear { columns: own, .. } => {
                for &c in own {
                    if !columns.contains(&c) {
                        columns.push(c);
                    }
                }
            }
            Hypothesis::Groups { grouping, column, .. } => groups.push((*grouping, *column)),
        }
    }
    (columns, groups)
}

/// Columns of the offsets of rows among some hypotheses.
pub(super) fn row_columns(hypotheses: &[Hypothesis]) -> Vec<usize> {
    let column = |h: &Hypothesis| match h {
        Hypothesis::Groups { grouping: Grouping::Row, column, .. } => Some(*column),
        _ => None,
    };
    hypotheses.iter().filter_map(column).collect()
}

/// Prior of group offsets: standard deviations of 10 cm in range (column 0) and 0.3 degrees in elevation (column 1).
pub(super) fn group_fit(column: usize) -> GroupFit {
    GroupFit { column, precision: [1.0 / (0.1 * 0.1), 1.0 / (0.0052 * 0.0052)][column], centred: true, trust: 1.0 }
}

impl Sums {
    /// What the rays of frames are compared by.
    pub(super) fn compared<'a>(&'a self, rig: &'a Rig) -> Compared<'a> {
        Compared { rig, columns: &self.columns, noise_m: self.noise_m, design: self.design }
    }

    /// Cross-validated gains of the selecting frames over the base model, nats.
    pub(super) fn gains(&self, select: &[usize], blocks: &[usize], hypotheses: &[Hypothesis]) -> Vec<f64> {
        let (columns, groups) = split(hypotheses);
        let mut out = vec![0.0; select.len()];
        if !columns.is_empty() {
            let frames: Vec<&LinearFrame> = select.iter().map(|&i| &self.linear[i]).collect();
            let with: Vec<usize> = self.base.iter().chain(&columns).copied().collect();
            let base = cross_gains(&frames, blocks, &self.base, &self.precision);
            let all = cross_gains(&frames, blocks, &with, &self.precision);
            (0..out.len()).for_each(|i| out[i] += all[i] - base[i]);
        }
        for grouping in [Grouping::Row, Grouping::Azimuth, Grouping::Range] {
            let columns: Vec<usize> = groups.iter().filter(|(g, _)| *g == grouping).map(|(_, c)| *c).collect();
            if !columns.is_empty() {
                let more = self.group_gains(select, blocks, grouping, &columns);
                out.iter_mut().zip(more).for_each(|(o, g)| *o += g);
            }
        }
        out
    }

    /// What the selecting frames are expected to gain by the last of the hypotheses `with` over those `before`, if they
    /// are as other blocks say, nats; empty where the last one is offsets of groups.
    pub(super) fn expected(&self, select: &[usize], blocks: &[usize], [before, with]: [&[Hypothesis]; 2]) -> Vec<f64> {
        let columns = [before, with].map(|hypotheses| [&self.base[..], &split(hypotheses).0].concat());
        if columns[0].len() == columns[1].len() {
            return vec![];
        }
        let frames: Vec<&LinearFrame> = select.iter().map(|&i| &self.linear[i]).collect();
        cross_expected(&frames, blocks, [&columns[0], &columns[1]], &self.precision)
    }

    /// Gains of the selecting frames by offsets of groups in some columns, fitted on other frames and on other parts
    /// of each group; those of rows together.
    pub(super) fn group_gains(
        &self,
        select: &[usize],
        blocks: &[usize],
        grouping: Grouping,
        columns: &[usize],
    ) -> Vec<f64> {
        if grouping != Grouping::Row {
            let parted = if grouping == Grouping::Azimuth { &self.strips.parted } else { &self.steps.parted };
            return grouped::cross_part_gains(parted, select, blocks, group_fit(columns[0]), false);
        }
        let folds = fold_of(blocks);
        let mut out = vec![0.0; select.len()];
        for (fold, part) in (0..FOLDS).flat_map(|fold| (0..PARTS).map(move |part| (fold, part))) {
            let train = || (0..select.len()).filter(|&i| folds[i] != fold).map(|i| &self.rows[select[i]]);
            for sensor in 0..self.of_sensors.first().map_or(0, Vec::len) {
                let others = row_patches::total(train(), sensor, &|p| p != part);
                let priors = others.likeliest(precisions(columns, self.of_patches), self.of_patches);
                for i in (0..select.len()).filter(|&i| folds[i] == fold) {
                    let band = &self.rows[select[i]].sensors[sensor][part];
                    out[i] += others.predicts(band, priors, self.of_patches);
                }
            }
        }
        out
    }

    /// Offsets of groups over some frames; those of rows are fitted together with what else was chosen.
    pub(super) fn offsets(
        &self,
        frames: &[usize],
        grouping: Grouping,
        how: GroupFit,
        chosen: &[Hypothesis],
    ) -> BTreeMap<Group, f64> {
        if grouping != Grouping::Row {
            return grouped::offsets(&total(frames.iter().map(|&i| &self.groups_of(grouping)[i])), how);
        }
        self.rows(frames, chosen)[how.column].iter().map(|(row, [offset, _])| (*row, *offset)).collect()
    }

    /// Offsets of rows in each of the chosen columns with their variances, over some frames, fitted together with what
    /// else was chosen.
    pub(super) fn rows(&self, frames: &[usize], chosen: &[Hypothesis]) -> [Rows; 2] {
        let mut out: [Rows; 2] = Default::default();
        for sensor in 0..self.of_sensors.first().map_or(0, Vec::len) {
            let of_sensor = row_offsets(self, frames, sensor, chosen);
            out.iter_mut().zip(of_sensor).for_each(|(all, of)| all.extend(of));
        }
        out
    }

    /// The groups of every frame, of surfaces as they are.
    pub(super) fn groups_of(&self, grouping: Grouping) -> &[GroupFrame] {
        match grouping {
            Grouping::Row => &self.whole_rows,
            Grouping::Azimuth => &self.strips.whole,
            Grouping::Range => &self.steps.whole,
        }
    }

    /// Fit of the base model together with the linear hypotheses.
    pub(super) fn fit_all(&self, frames: &[usize], blocks: &[usize], hypotheses: &[Hypothesis]) -> LinearFit {
        let (mut columns, _) = split(hypotheses);
        columns.retain(|c| !self.base.contains(c));
        let with: Vec<usize> = self.base.iter().chain(&columns).copied().collect();
        let frames: Vec<&LinearFrame> = frames.iter().map(|&i| &self.linear[i]).collect();
        fit(&frames, blocks, &with, &self.precision)
    }

    /// The coefficient of a column in a fit with its standard error; `None` where it was not fitted.
    pub(super) fn fitted(&self, fit: &LinearFit, column: Column) -> Option<[f64; 2]> {
        let i = fit.columns.iter().position(|c| self.columns[*c] == column)?;
        Some([fit.theta[i], fit.error(i)])
    }

    /// Gains of frames by one of the chosen hypotheses, fitted on the estimating frames, over a fit without it, nats.
    pub(super) fn gains_of(
        &self,
        estimate: &[usize],
        blocks: &[usize],
        hypothesis: &Hypothesis,
        chosen: &[Hypothesis],
        frames: &[usize],
    ) -> Vec<f64> {
        match hypothesis {
            Hypothesis::Linear { .. } => {
                let others: Vec<Hypothesis> = chosen.iter().filter(|h| *h != hypothesis).cloned().collect();
                let [with, without] = [chosen, &others].map(|of| self.fit_all(estimate, blocks, of));
                frames.iter().map(|&f| with.gain(&self.linear[f]) - without.gain(&self.linear[f])).collect()
            }
            Hypothesis::Groups { grouping: grouping @ (Grouping::Azimuth | Grouping::Range), column, .. } => {
                let offsets = self.offsets(estimate, *grouping, group_fit(*column), chosen);
                let groups = self.groups_of(*grouping);
                frames.iter().map(|&f| grouped::gain(&groups[f], *column, &offsets)).collect()
            }
            Hypothesis::Groups { grouping: Grouping::Row, .. } => {
                let others: Vec<Hypothesis> = chosen.iter().filter(|h| *h != hypothesis).cloned().collect();
                let [with, without] = [chosen, &others].map(|of| self.gains_of_rows(estimate, frames, of));
                with.iter().zip(without).map(|(with, without)| with - without).collect()
            }
        }
    }

    /// Gains of frames by the offsets of rows among the chosen hypotheses, fitted together, nats.
    fn gains_of_rows(&self, estimate: &[usize], frames: &[usize], chosen: &[Hypothesis]) -> Vec<f64> {
        let fitted = self.rows(estimate, chosen);
        let of_sensor = |(sensor, parts): (usize, &[Band; PARTS])| -> f64 {
            let rows = parts.iter().map(Band::rows).max().unwrap_or(0);
            let of = |column: usize, row| fitted[column].get(&row_patches::group(sensor, row)).map_or(0.0, |[o, _]| *o);
            let of_rows: Offsets = std::array::from_fn(|column| (0..rows).map(|row| of(column, row)).collect());
            parts.iter().map(|band| band.gain(&of_rows)).sum()
        };
        let of_frame = |&f: &usize| self.rows[f].sensors.iter().enumerate().map(of_sensor).sum::<f64>();
        frames.iter().map(|f| of_frame(f) / self.of_patches).collect()
    }

    /// Fits of all columns and of the base model alone.
    pub(super) fn full_and_base(&self, frames: &[usize], blocks: &[usize]) -> (LinearFit, LinearFit) {
        let frames: Vec<&LinearFrame> = frames.iter().map(|&i| &self.linear[i]).collect();
        let all: Vec<usize> = (0..self.columns.len()).collect();
        (fit(&frames, blocks, &all, &self.precision), fit(&frames, blocks, &self.base, &self.precision))
    }
}
