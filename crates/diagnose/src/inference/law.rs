//! Laws of lost returns and their parameters.

use crate::catalogue::Cause;
use crate::channels::cells::ZONES;
use std::f64::consts::FRAC_1_SQRT_2;

/// A law of losses; several multiply.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Law {
    /// The same share everywhere.
    Random,
    /// Falls with range.
    Range,
    /// Falls with the angle of incidence.
    Incidence,
    /// Falls with the signal cos / R^2; surfaces may be brighter than the ground.
    Signal,
    /// One kind of surface loses a share; see [`WHOLE_OBJECT`].
    Zone(usize),
}

/// Bodies of objects with their lower corners, as a zone.
pub const WHOLE_OBJECT: usize = ZONES;

/// Whether a zone belongs to that of a law.
pub fn in_zone(of_law: usize, zone: usize) -> bool {
    zone == of_law || of_law == WHOLE_OBJECT && zone >= 2
}

/// All laws, from those with the fewest parameters on.
pub const LAWS: [Law; 9] = [
    Law::Random,
    Law::Zone(0),
    Law::Zone(1),
    Law::Zone(2),
    Law::Zone(3),
    Law::Zone(WHOLE_OBJECT),
    Law::Range,
    Law::Incidence,
    Law::Signal,
];

/// Covariates of a cell.
#[derive(Clone, Copy, Debug)]
pub(super) struct Where {
    pub(super) ln_range: f64,
    pub(super) ln_cos: f64,
    pub(super) zone: usize,
}

/// A law with its parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FittedLaw {
    /// Which.
    pub law: Law,
    /// Random, zone: share lost. Range, incidence, signal: place, logarithm of the steepness, logarithm of the skew,
    /// share lost where the law has no effect. Signal, in addition: ln of the reflectivity of standing surfaces, of
    /// bodies of objects and of their lower corners (wheels) over that of the ground.
    pub numbers: [f64; 7],
}

/// A logistic step with a skew, (1 + exp(-k (x - a)))^-skew: the skew lets the two tails differ, as those of real
/// sensors do.
#[derive(Clone, Copy)]
struct Step {
    place: f64,
    steepness: f64,
    skew: f64,
}

impl Step {
    /// How far a covariate lies below the step, and ln(1 + exp of it).
    fn below(&self, x: f64) -> [f64; 2] {
        let below = -self.steepness * (x - self.place);
        [below, below.max(0.0) + (-below.abs()).exp().ln_1p()]
    }

    fn at(&self, x: f64) -> f64 {
        (-self.skew * self.below(x)[1]).exp()
    }

    /// Derivatives of its logarithm by place, logarithm of the steepness, and logarithm of the skew.
    fn slopes(&self, x: f64) -> [f64; 3] {
        let [below, soft] = self.below(x);
        let tilt = self.skew / (1.0 + (-below).exp());
        [-tilt * self.steepness, -tilt * below, -self.skew * soft]
    }
}

/// Steepness of the step without skew that has the same slope at one half: d ln(kept) / dx there, over that of a
/// logistic step.
fn steepness(ln_k: f64, ln_skew: f64) -> f64 {
    2.0 * (ln_k + ln_skew).exp() * (1.0 - 0.5f64.powf((-ln_skew).exp()))
}

/// The place at which a step is one half.
fn half([a, ln_k, ln_skew]: [f64; 3]) -> f64 {
    a - ((0.5f64.powf(-(-ln_skew).exp()) - 1.0).max(1e-12)).ln() / ln_k.exp()
}

/// Prior standard deviation of the logarithm of a ratio of reflectivities.
const BRIGHTNESS: f64 = 1.2;

/// Largest logarithm of a ratio of mean reflectivities of kinds of surfaces: from tar (0.05) to white paint (0.9).
const MOST_BRIGHTNESS: f64 = 2.9;

/// Smallest steepness of a step: flatter ones lose the same share everywhere, which is a random loss.
const LEAST_STEEPNESS: f64 = 0.5;

impl Law {
    /// The cause that has this law.
    pub fn cause(self) -> Cause {
        match self {
            Law::Random => Cause::RandomDropout,
            Law::Range => Cause::RangeDropout,
            Law::Incidence => Cause::IncidenceDropout,
            Law::Signal => Cause::SignalDropout,
            Law::Zone(_) => Cause::MaterialDropout,
        }
    }

    /// Whether it is a step over a covariate, whose form is never exactly that of the sensor.
    pub fn has_form(self) -> bool {
        matches!(self, Law::Range | Law::Incidence | Law::Signal)
    }

    /// Free parameters.
    pub fn parameters(self) -> usize {
        match self {
            Law::Random | Law::Zone(_) => 1,
            Law::Range | Law::Incidence => 2,
            Law::Signal => 5,
        }
    }

    pub(super) fn count(self) -> usize {
        match self {
            Law::Random | Law::Zone(_) => 1,
            Law::Range | Law::Incidence => 4,
            Law::Signal => 7,
        }
    }

    /// Bounds of its numbers.
    pub(super) fn bounds(self) -> Vec<[f64; 2]> {
        let mut bounds = vec![[f64::NEG_INFINITY, f64::INFINITY]; self.count()];
        if self.has_form() {
            bounds[3] = [0.0, MOST_ANYWAY];
        } else {
            bounds[0] = EVEN;
        }
        bounds
    }

    /// Starting points of a fit, from the cells with returns.
    pub(super) fn starts(self, cells: &[Where]) -> Vec<FittedLaw> {
        let with = |numbers: [f64; 7]| FittedLaw { law: self, numbers };
        let value = |at: &Where| match self {
            Law::Incidence => at.ln_cos,
            Law::Signal => at.ln_cos - 2.0 * at.ln_range,
            _ => at.ln_range,
        };
        let mut values: Vec<f64> = cells.iter().map(value).collect();
        values.sort_by(f64::total_cmp);
        let quantile = |q: f64| values.get(((values.len() as f64 - 1.0) * q) as usize).copied().unwrap_or(0.0);
        match self {
            Law::Random | Law::Zone(_) => vec![with([0.05, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])],
            Law::Range => [0.4, 0.75, 0.97].map(|q| with([quantile(q), 1.5, 0.0, 0.0, 0.0, 0.0, 0.0])).to_vec(),
            _ => [0.03, 0.25, 0.6].map(|q| with([quantile(q), 0.8, 0.0, 0.0, 0.0, 0.0, 0.0])).to_vec(),
        }
    }
}

/// Largest share that a law loses where it has no effect. A larger share is a cause of its own, a random loss.
pub const MOST_ANYWAY: f64 = 0.025;

/// What is improbable of a steepness and a skew, and of losses where the law has no effect; see
/// [`FittedLaw::improbable`]. `usual` is the usual logarithm of the steepness.
fn improbable_shape(ln_k: f64, usual: f64, ln_skew: f64, anyway: f64) -> [f64; 4] {
    let flat = (LEAST_STEEPNESS.ln() - steepness(ln_k, ln_skew).ln()).max(0.0) / 1e-2;
    let [steep, skew, anyway] = [ln_k - usual, ln_skew / 0.7, anyway / 0.01].map(|v| v * FRAC_1_SQRT_2);
    [steep, skew, anyway, flat]
}

impl FittedLaw {
    /// Where one half is kept: for range ln(m), for incidence ln(cos), for signal ln(cos / R^2) on the ground.
    pub fn half(&self) -> f64 {
        let [a, b, s, ..] = self.numbers;
        match self.law {
            Law::Range => -half([-a, b, s]),
            _ => half([a, b, s]),
        }
    }

    /// Steepness of the step without skew that has the same slope at one half.
    pub fn steepness(&self) -> f64 {
        let [_, ln_k, ln_skew, ..] = self.numbers;
        steepness(ln_k, ln_skew)
    }

    /// Covariate of the law, and the share that it keeps, of a surface of a kind at a range and a cosine: ln(m) for
    /// range, ln(cos) for incidence, ln(cos / R^2) at the brightness of the ground for signal.
    pub fn at(&self, range_m: f64, cos_incidence: f64, zone: usize) -> (f64, f64) {
        let at = Where { ln_range: range_m.ln(), ln_cos: cos_incidence.ln(), zone };
        (self.covariate(&at).unwrap_or(at.ln_range), self.kept(&at))
    }

    /// What the law is a function of; `None` where it is none.
    pub(super) fn covariate(&self, at: &Where) -> Option<f64> {
        let [.., standing, bodies, wheels] = self.numbers;
        match self.law {
            Law::Random | Law::Zone(_) => None,
            Law::Range => Some(at.ln_range),
            Law::Incidence => Some(at.ln_cos),
            Law::Signal => Some(at.ln_cos - 2.0 * at.ln_range + [0.0, standing, bodies, wheels][at.zone]),
        }
    }

    /// Share that a law of range or of incidence keeps at a range and a cosine.
    pub fn kept_there(&self, range_m: f64, cos_incidence: f64) -> f64 {
        self.kept(&Where { ln_range: range_m.ln(), ln_cos: cos_incidence.ln(), zone: 0 })
    }

    /// Share kept where the law has no effect.
    pub fn most(&self) -> f64 {
        1.0 - self.numbers[3]
    }

    pub(super) fn kept(&self, at: &Where) -> f64 {
        self.form().kept(at)
    }

    /// The law with what does not depend on the cell worked out.
    pub(super) fn form(&self) -> Form {
        let [a, b, s, ..] = self.numbers;
        let place = if self.law == Law::Range { -a } else { a };
        Form { law: *self, most: self.most(), step: Step { place, steepness: b.exp(), skew: s.exp() } }
    }

    /// What is improbable of the numbers of the law: the sum of the squares is minus the logarithm of their
    /// probability.
    pub(super) fn improbable(&self) -> Vec<f64> {
        match self.law {
            Law::Signal => {
                let [_, steep, skew, anyway, brighter @ ..] = self.numbers;
                let beyond = |v: f64| (v.abs() - MOST_BRIGHTNESS).max(0.0) / 1e-2;
                let of = brighter.into_iter().flat_map(|v| [v / BRIGHTNESS * FRAC_1_SQRT_2, beyond(v)]);
                of.chain(improbable_shape(steep, 0.8, skew, anyway)).collect()
            }
            Law::Range | Law::Incidence => {
                let [_, steep, skew, anyway, ..] = self.numbers;
                improbable_shape(steep, 1.0, skew, anyway).to_vec()
            }
            _ => vec![],
        }
    }
}

/// A fitted law, ready to be evaluated in many cells.
pub(super) struct Form {
    law: FittedLaw,
    most: f64,
    step: Step,
}

impl Form {
    /// Share kept in a cell.
    pub(super) fn kept(&self, at: &Where) -> f64 {
        let x = self.law.covariate(at).unwrap_or_default();
        match self.law.law {
            Law::Random => self.even(),
            Law::Zone(zone) if in_zone(zone, at.zone) => self.even(),
            Law::Zone(_) => 1.0,
            Law::Range => self.most * self.step.at(-x),
            Law::Incidence | Law::Signal => self.most * self.step.at(x),
        }
    }

    /// Share that a law without a form keeps.
    fn even(&self) -> f64 {
        1.0 - self.law.numbers[0]
    }

    /// Derivatives of the logarithm of the share kept in a cell by the numbers of the law.
    pub(super) fn slopes(&self, at: &Where) -> [f64; 7] {
        let mut out = [0.0; 7];
        let x = self.law.covariate(at).unwrap_or_default();
        match self.law.law {
            Law::Random => out[0] = -1.0 / self.even(),
            Law::Zone(zone) if in_zone(zone, at.zone) => out[0] = -1.0 / self.even(),
            Law::Zone(_) => {}
            law => {
                let sign = if law == Law::Range { -1.0 } else { 1.0 };
                let [place, steepness, skew] = self.step.slopes(sign * x);
                out[..3].copy_from_slice(&[sign * place, steepness, skew]);
                out[3] = -1.0 / self.most;
                if law == Law::Signal && at.zone > 0 {
                    // Brighter is as if the step began lower.
                    out[3 + at.zone] = -place;
                }
            }
        }
        out
    }
}

/// Least and most share that a law without a form loses; of a negative one the simulation loses more.
const EVEN: [f64; 2] = [-0.5, 0.999];
