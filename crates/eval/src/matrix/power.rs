//! What difference of two cells a study can see: from the scatter of the paired differences over seeds and over frames.

use super::{Gap, Matrix, Quantity, Reference};
use crate::bootstrap::Interval;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use statistics::deviation;

/// Standard errors that a difference must have to be seen with 80 % power at the level of 5 %: its interval then
/// excludes zero in 80 of 100 repetitions. 1.960 + 0.842.
const STANDARD_ERRORS: f64 = 2.802;
/// Half of a 95 % interval in standard errors.
const HALF_INTERVAL: f64 = 1.96;

/// Scatter of a paired difference of two cells.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Scatter {
    /// Standard deviation of the difference over the runs of a seed, with divisor n - 1, percentage points.
    pub of_seeds: f64,
    /// Standard error from the frames alone times the square root of their number, percentage points.
    pub of_frames: f64,
}

impl Scatter {
    /// Standard error of the mean difference over `seeds` seeds and `frames` test frames.
    pub fn standard_error(&self, seeds: usize, frames: usize) -> f64 {
        (self.of_seeds.powi(2) / seeds.max(1) as f64 + self.of_frames.powi(2) / frames.max(1) as f64).sqrt()
    }

    /// The smallest difference that is seen in 80 of 100 repetitions, percentage points.
    pub fn detectable(&self, seeds: usize, frames: usize) -> f64 {
        STANDARD_ERRORS * self.standard_error(seeds, frames)
    }
}

/// What a study could see of a gap.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Power {
    /// [`super::Place::name`] of the network.
    pub network: String,
    /// [`super::Place::name`] of the test set.
    pub test_set: String,
    /// [`super::Place::name`] of the train set whose value is subtracted.
    pub train_set: String,
    /// [`super::Place::name`] of the reference train set.
    pub compared_to: String,
    /// Class name.
    pub class: String,
    /// 3D IoU threshold.
    pub overlap: f64,
    /// Number of seeds that both cells have.
    pub seeds: usize,
    /// Number of test frames.
    pub frames: usize,
    /// The scatter; that of seeds is 0 with one seed.
    pub scatter: Scatter,
    /// Difference that the study would see in 80 of 100 repetitions, percentage points.
    pub detectable: f64,
    /// The difference, percentage points.
    pub seen: f64,
    /// Its interval.
    pub interval: Option<Interval>,
}

/// The scatter behind the gaps of 3D AP over the full range against the labels.
pub(super) fn power(matrix: &Matrix) -> Vec<Power> {
    matrix.gaps.iter().filter_map(|gap| of_gap(matrix, gap)).collect()
}

fn of_gap(matrix: &Matrix, gap: &Gap) -> Option<Power> {
    if gap.section.is_some() || gap.quantity != Quantity::Ap40 || gap.reference != Reference::Labels {
        return None;
    }
    let interval = gap.interval?;
    let cell = |train: &str| matrix.cell(&gap.network, train, &gap.test_set);
    let (own, other) = (cell(&gap.compared_to)?, cell(&gap.train_set)?);
    let runs = |cell: &super::Cell| Some(cell.number(&gap.class, None, gap.quantity, gap.overlap)?.of_runs.clone());
    let (of_own, of_other) = (runs(own)?, runs(other)?);
    let difference = |run: &super::RunNumber| {
        let same = of_other.iter().find(|o| o.seed == run.seed)?;
        Some(run.value? - same.value?)
    };
    let differences: Vec<f64> = of_own.iter().filter_map(difference).collect();
    let (seeds, frames) = (differences.len(), own.frames?);
    let unbiased = (seeds as f64 / (seeds as f64 - 1.0)).sqrt();
    let of_seeds = if seeds > 1 { deviation(&differences) * unbiased } else { 0.0 };
    // The interval holds both; what the seeds take is known.
    let both = (interval.high - interval.low) / 2.0 / HALF_INTERVAL;
    let of_frames = (both.powi(2) - of_seeds.powi(2) / seeds.max(1) as f64).max((0.3 * both).powi(2)).sqrt();
    let scatter = Scatter { of_seeds, of_frames: of_frames * (frames as f64).sqrt() };
    Some(Power {
        network: gap.network.clone(),
        test_set: gap.test_set.clone(),
        train_set: gap.train_set.clone(),
        compared_to: gap.compared_to.clone(),
        class: gap.class.clone(),
        overlap: gap.overlap,
        seeds,
        frames,
        scatter,
        detectable: scatter.detectable(seeds, frames),
        seen: gap.gap,
        interval: gap.interval,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn more_seeds_and_frames_see_smaller_differences() {
        let scatter = Scatter { of_seeds: 3.0, of_frames: 30.0 };
        assert!((scatter.standard_error(3, 100) - (3.0f64 + 9.0).sqrt()).abs() < 1e-12);
        assert!(scatter.detectable(5, 100) < scatter.detectable(3, 100));
        assert!(scatter.detectable(3, 400) < scatter.detectable(3, 100));
    }

    #[test]
    fn a_difference_of_that_size_is_seen_four_times_in_five() {
        use data::stream;
        use rand_distr::{Distribution, Normal};
        let scatter = Scatter { of_seeds: 2.0, of_frames: 20.0 };
        let error = scatter.standard_error(3, 100);
        let mut random = stream(1, "power", 0, 0);
        let found = Normal::new(scatter.detectable(3, 100), error).unwrap();
        let seen = (0..4000).filter(|_| found.sample(&mut random) - HALF_INTERVAL * error > 0.0).count();
        assert!((3100..3300).contains(&seen), "{seen} of 4000");
    }
}
