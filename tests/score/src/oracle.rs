//! Strength of hidden effects: by how many standard errors an oracle that knows all forms tells each from its absence.
//!
//! A generator compares each frame with the same frame without one effect (or a part of one), shot by shot, in what is
//! expected: mean range, variance, probability of a return, returns from elsewhere, labels. Nuisances of frames and
//! patches of surface are unknown to the oracle within their standard deviations, so that correlated observations count
//! less.

use crate::evidence::{Covariance, Model, Row, poisson_squared_errors};

/// Sums of one effect beside the linear models.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Counts {
    /// Divergence of the probabilities of a return, nats.
    pub divergence: f64,
    /// Shots that meet something else.
    pub moved: f64,
    /// Of these shots, those that would meet something else in any case: at edges that are a little elsewhere.
    pub moved_usual: f64,
    /// Returns from elsewhere by the effect.
    pub clutter: f64,
    /// Returns from elsewhere at such ranges without the effect.
    pub clutter_usual: f64,
    /// Returns that are removed, added, or moved by more than 0.35 m.
    pub touched: f64,
    /// Squared standard errors of what is in no other sum.
    pub other: f64,
}

/// What a frame says about the effects.
#[derive(Clone, Debug, Default)]
pub struct FrameEvidence {
    /// Mean ranges, m. Columns are parts of effects.
    pub means: Vec<Row>,
    /// Variances of ranges, m2.
    pub variances: Vec<Row>,
    /// Probabilities of a return.
    pub losses: Vec<Row>,
    /// Centres of labels, m.
    pub labels: Vec<Row>,
    /// By effect.
    pub counts: Vec<Counts>,
    /// Returns from surfaces.
    pub returns: f64,
    /// Shots.
    pub shots: f64,
}

/// Standard deviations of the nuisances of a frame, in the order of [`Row::frame`].
#[derive(Clone, Debug)]
pub struct FrameStds {
    /// Of mean ranges.
    pub means: Vec<f64>,
    /// Of variances.
    pub variances: Vec<f64>,
    /// Of losses.
    pub losses: Vec<f64>,
    /// Of the logarithm of the rate of false returns.
    pub false_returns: f64,
    /// Share of the frames that are independent in their errors at edges.
    pub independent: f64,
}

/// Collects evidence over frames.
#[derive(Clone, Debug)]
pub struct Oracle {
    effect_of_column: Vec<usize>,
    stds: FrameStds,
    means: Model,
    variances: Model,
    losses: Model,
    labels: Model,
    counts: Vec<Counts>,
    returns: f64,
    shots: f64,
    frames: f64,
}

impl Oracle {
    /// For effects whose parts are columns. `effect_of_column` has the number of the effect of each column.
    pub fn new(effects: usize, effect_of_column: Vec<usize>, stds: FrameStds) -> Oracle {
        let model = Model::new(effect_of_column.len());
        Oracle {
            effect_of_column,
            stds,
            means: model.clone(),
            variances: model.clone(),
            losses: model.clone(),
            labels: model,
            counts: vec![Counts::default(); effects],
            returns: 0.0,
            shots: 0.0,
            frames: 0.0,
        }
    }

    /// Adds a frame.
    pub fn add(&mut self, frame: &FrameEvidence) {
        self.means.add_frame(&frame.means, &self.stds.means);
        self.variances.add_frame(&frame.variances, &self.stds.variances);
        self.losses.add_frame(&frame.losses, &self.stds.losses);
        self.labels.add_frame(&frame.labels, &[]);
        for (sum, of_frame) in self.counts.iter_mut().zip(&frame.counts) {
            sum.divergence += of_frame.divergence;
            sum.moved += of_frame.moved;
            sum.moved_usual += of_frame.moved_usual;
            sum.clutter += of_frame.clutter;
            sum.clutter_usual += of_frame.clutter_usual;
            sum.touched += of_frame.touched;
            sum.other += of_frame.other;
        }
        self.returns += frame.returns;
        self.shots += frame.shots;
        self.frames += 1.0;
    }

    /// What is known when all frames were added.
    pub fn judge(self) -> Verdicts {
        let [means, variances, losses, labels] =
            [&self.means, &self.variances, &self.losses, &self.labels].map(Model::covariance);
        Verdicts { oracle: self, means, variances, losses, labels }
    }
}

/// What an oracle knows.
#[derive(Clone, Debug)]
pub struct Verdicts {
    oracle: Oracle,
    means: Covariance,
    variances: Covariance,
    losses: Covariance,
    labels: Covariance,
}

impl Verdicts {
    /// Strength of an effect, standard errors.
    pub fn strength(&self, effect: usize) -> f64 {
        let oracle = &self.oracle;
        let columns = oracle.effect_of_column.len();
        let own: Vec<usize> = (0..columns).filter(|&c| oracle.effect_of_column[c] == effect).collect();
        let c = &oracle.counts[effect];
        let lost_alone = own.iter().map(|&column| self.lost_alone(column)).fold(1.0, f64::min);
        // What a pose explains of mean ranges it explains of silhouettes as well.
        let moved_alone = own.iter().map(|&column| oracle.means.own_share(&self.means, column)).fold(1.0, f64::min);
        let clutter = poisson_squared_errors(c.clutter + c.clutter_usual, c.clutter_usual);
        let unsteady = (oracle.stds.false_returns * c.clutter_usual / c.clutter.max(1e-9)).powi(2) / oracle.frames;
        let squared = self.means.squared_errors(&own)
            + self.variances.squared_errors(&own)
            + self.labels.squared_errors(&own)
            + 2.0 * c.divergence * lost_alone
            + moved_alone * oracle.stds.independent * poisson_squared_errors(c.moved, c.moved_usual)
            + clutter / (1.0 + clutter * unsteady)
            + c.other;
        squared.max(0.0).sqrt()
    }

    /// Returns that an effect removes, adds, or moves by more than 0.35 m, over all frames.
    pub fn touched(&self, effect: usize) -> f64 {
        self.oracle.counts[effect].touched
    }

    /// Relative standard error of a parameter to which a displacement is proportional.
    pub fn shift_error(&self, column: usize) -> Option<f64> {
        self.means.variance(column).or(self.labels.variance(column)).map(f64::sqrt)
    }

    /// Relative standard error of a standard deviation.
    pub fn deviation_error(&self, column: usize) -> Option<f64> {
        self.variances.variance(column).map(|variance| 0.5 * variance.sqrt())
    }

    /// Relative standard error of a share of lost returns.
    pub fn lost_error(&self, column: usize, share: f64) -> f64 {
        ((1.0 - share) / (share * self.oracle.returns * self.lost_alone(column).max(1e-9))).sqrt()
    }

    /// Relative standard error of a share of shots that return from elsewhere.
    pub fn clutter_error(&self, share: f64) -> f64 {
        1.0 / (share * self.oracle.shots).sqrt()
    }

    /// Share of the information about a loss that no nuisance and no other loss explains.
    fn lost_alone(&self, column: usize) -> f64 {
        self.oracle.losses.own_share(&self.losses, column)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn evidence_of_all_kinds_adds_up() {
        let stds = FrameStds { means: vec![], variances: vec![], losses: vec![], false_returns: 0.0, independent: 1.0 };
        let mut oracle = Oracle::new(2, vec![0, 1, 1], stds);
        let row = |columns: [f64; 3]| Row { columns: columns.to_vec(), frame: vec![], patch: None, weight: 1.0 };
        let counts = |divergence: f64| Counts { divergence, ..Counts::default() };
        let frame = FrameEvidence {
            means: vec![row([3.0, 0.0, 0.0]), row([0.0, 2.0, 0.0]), row([0.0, 0.0, 1.0])],
            counts: vec![counts(8.0), counts(0.0)],
            ..FrameEvidence::default()
        };
        (0..4).for_each(|_| oracle.add(&frame));
        let verdicts = oracle.judge();
        assert!((verdicts.strength(0) - (4.0f64 * 9.0 + 4.0 * 16.0).sqrt()).abs() < 1e-3);
        assert!((verdicts.strength(1) - (4.0f64 * (4.0 + 1.0)).sqrt()).abs() < 1e-3);
        assert!((verdicts.shift_error(1).unwrap() - 0.25).abs() < 1e-3);
    }
}
