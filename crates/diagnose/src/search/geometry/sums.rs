//! Sums of all frames that the hypotheses of geometry are fitted on, and the fits.

use super::hypotheses::Hypothesis;
use crate::channels::groups::{GroupFrame, Grouping, PartedFrame, group_frames, total, whole};
use crate::channels::mean::{
    Column, MeanFrame, OWN, OwnPoses, STRUCTURE_M, columns, design_effect, mean_frames, origins, own_poses,
    usual_noise_m,
};
use crate::inference::grouped::{self, GroupFit};
use crate::inference::linear::{LinearFit, LinearFrame, cross_gains, fit};
use crate::inference::median;
use crate::search::Context;
use nalgebra::{DMatrix, SVector};
use rayon::prelude::*;
use sensor::Rig;

/// Sums of all frames.
pub(super) struct Sums {
    /// Columns of the linear fits.
    pub(super) columns: Vec<Column>,
    /// Prior precision of each column.
    pub(super) precision: Vec<f64>,
    /// Columns of the base model: offsets of the surfaces.
    pub(super) base: Vec<usize>,
    /// Linear sums of each frame, its own pose and displacement over a scan integrated out.
    pub(super) linear: Vec<LinearFrame>,
    /// X' W X of each frame with its own pose.
    pub(super) whole: Vec<DMatrix<f64>>,
    /// Sums by row.
    pub(super) rows: Groups,
    /// Sums by strip of azimuth.
    pub(super) strips: Groups,
    /// Pose error of each frame, as each sensor sees it.
    pub(super) poses: Vec<OwnPoses>,
    /// Weights of all returns of each sensor, by frame.
    pub(super) of_sensors: Vec<Vec<f64>>,
}

/// Groups of every frame, by part and whole.
pub(super) struct Groups {
    pub(super) parted: Vec<PartedFrame>,
    pub(super) whole: Vec<GroupFrame>,
}

/// Sums of all frames; priors are fitted on the selecting ones.
pub(super) fn sums(context: &Context, select: &[usize]) -> Sums {
    let (frames, rig) = (context.frames, context.rig);
    let origins = origins(rig);
    let noise_m = usual_noise_m(frames);
    let poses: Vec<OwnPoses> = frames.par_iter().map(|f| own_poses(f, &origins, noise_m)).collect();
    let design = design_effect(frames, &origins, &poses, noise_m);
    let columns = columns(rig);
    let means: Vec<MeanFrame> = mean_frames(frames, rig, &columns, &poses, noise_m, design);
    let of_sensors = sensor_weights(&means, &columns, rig.sensors.len());
    let prior = own_scatter(rig, &poses, select);
    let without_own = |m: &MeanFrame| {
        let (gram, right) = m.without_own(&prior);
        LinearFrame { gram, right }
    };
    let linear: Vec<LinearFrame> = means.iter().map(without_own).collect();
    let precision: Vec<f64> = columns.iter().map(|c| precision(*c)).collect();
    let base: Vec<usize> = (0..columns.len()).filter(|&i| matches!(columns[i], Column::Structure(_))).collect();
    let selected: Vec<&LinearFrame> = select.iter().map(|&i| &linear[i]).collect();
    let structure = fit(&selected, &context.blocks(select), &base, &precision);
    let structure = std::array::from_fn(|k| structure.theta[k]);
    let groups = |g| {
        let parted = group_frames(frames, rig, &poses, structure, g, noise_m, design);
        Groups { whole: parted.iter().map(whole).collect(), parted }
    };
    Sums {
        rows: groups(Grouping::Row),
        strips: groups(Grouping::Azimuth),
        columns,
        precision,
        base,
        linear,
        whole: means.into_iter().map(|m| m.gram).collect(),
        poses,
        of_sensors,
    }
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
        Column::Pose(_) | Column::SensorPose(..) => 0.2,
        Column::Sweep(0..2) => 8.0,
        Column::Sweep(_) => 0.2,
        Column::Structure(_) => STRUCTURE_M,
    };
    1.0 / (sd * sd)
}

/// Prior variances of what every frame may have of its own. Pose: the robust scatter of the frames' poses about the
/// median of each sensor. Displacement over a scan: that of a driving vehicle where a sensor scans row after row,
/// since static surfaces are then displaced along columns, which resembles a pose error of a sensor; zero otherwise.
fn own_scatter(rig: &Rig, poses: &[OwnPoses], select: &[usize]) -> SVector<f64, OWN> {
    let least = [2e-5, 2e-5, 2e-5, 5e-4, 5e-4, 5e-4];
    let scatter = |k: usize| {
        let mut deviations = Vec::new();
        for sensor in 0..poses.first().map_or(0, Vec::len) {
            let values: Vec<f64> = select.iter().map(|&f| poses[f][sensor][k]).collect();
            let middle = median(values.clone());
            deviations.extend(values.iter().map(|v| (v - middle).abs()));
        }
        (median(deviations) / statistics::MEDIAN_OF_NORMAL).max(least[k])
    };
    let by_rows = rig.sensors.iter().find(|s| !s.sequential_rows().is_empty());
    let slide = |k: usize| by_rows.map_or(0.0, |s| OWN_MOTION[k] / s.rate_hz);
    SVector::from_fn(|k, _| if k < 6 { scatter(k) } else { slide(k - 6) }.powi(2))
}

/// Standard deviations of ego motion: speed along and across the heading, m/s; yaw rate, rad/s.
const OWN_MOTION: [f64; 3] = [40.0, 3.0, 0.3];

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

/// Prior of group offsets: standard deviations of 10 cm in range (column 0) and 0.3 degrees in elevation (column 1).
pub(super) fn group_fit(column: usize) -> GroupFit {
    GroupFit { column, precision: [1.0 / (0.1 * 0.1), 1.0 / (0.0052 * 0.0052)][column], centred: true, trust: 1.0 }
}

impl Sums {
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
        for (grouping, column) in groups {
            let parted = if grouping == Grouping::Row { &self.rows.parted } else { &self.strips.parted };
            let of_rows = grouping == Grouping::Row;
            let more = grouped::cross_part_gains(parted, select, blocks, group_fit(column), of_rows);
            out.iter_mut().zip(more).for_each(|(o, g)| *o += g);
        }
        out
    }

    /// The groups of every frame.
    pub(super) fn groups_of(&self, grouping: Grouping) -> &[GroupFrame] {
        if grouping == Grouping::Row { &self.rows.whole } else { &self.strips.whole }
    }

    /// Fit of the base model together with the linear hypotheses.
    pub(super) fn fit_all(&self, frames: &[usize], blocks: &[usize], hypotheses: &[Hypothesis]) -> LinearFit {
        let (columns, _) = split(hypotheses);
        let with: Vec<usize> = self.base.iter().chain(&columns).copied().collect();
        let frames: Vec<&LinearFrame> = frames.iter().map(|&i| &self.linear[i]).collect();
        fit(&frames, blocks, &with, &self.precision)
    }

    /// Gain of one frame by one of the chosen hypotheses, fitted on the estimating frames, over a fit without it, nats.
    pub(super) fn gain_of(
        &self,
        estimate: &[usize],
        blocks: &[usize],
        hypothesis: &Hypothesis,
        chosen: &[Hypothesis],
        frame: usize,
    ) -> f64 {
        match hypothesis {
            Hypothesis::Linear { .. } => {
                let others: Vec<Hypothesis> = chosen.iter().filter(|h| *h != hypothesis).cloned().collect();
                let gain = |of: &[Hypothesis]| self.fit_all(estimate, blocks, of).gain(&self.linear[frame]);
                gain(chosen) - gain(&others)
            }
            Hypothesis::Groups { grouping, column, .. } => {
                let frames = self.groups_of(*grouping);
                let offsets = grouped::offsets(&total(estimate.iter().map(|&i| &frames[i])), group_fit(*column));
                grouped::gain(&frames[frame], *column, &offsets)
            }
        }
    }

    /// Fits of all columns and of the base model alone.
    pub(super) fn full_and_base(&self, frames: &[usize], blocks: &[usize]) -> (LinearFit, LinearFit) {
        let frames: Vec<&LinearFrame> = frames.iter().map(|&i| &self.linear[i]).collect();
        let all: Vec<usize> = (0..self.columns.len()).collect();
        (fit(&frames, blocks, &all, &self.precision), fit(&frames, blocks, &self.base, &self.precision))
    }
}
