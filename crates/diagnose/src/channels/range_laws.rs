//! Laws of the ranges of returns along the free path of shots: what makes them, and where.

use super::free_path::Bin;

/// Where returns along a free path come from: the distribution of their ranges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Noise of the receiver crosses its threshold at any time up to a range, m.
    Even(f64, Fall),
    /// Evenly spread over the free path of each shot.
    OfPath,
    /// An exponential law with this mean, m: droplets in light that they weaken.
    Exponential(f64),
    /// A gamma law of shape 2 with this mean, m: the same where near droplets are out of the field of view.
    Gamma(f64),
    /// As 1 / r up to a range, m: single drops, of which ever larger ones are seen with range.
    Drops(f64),
    /// Evenly spread between two ranges, m: light of another sensor that fires as often.
    Band(f64, f64),
}

/// How the density of false alarms falls with range: the threshold of a receiver may fall with time, and its noise with
/// it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fall {
    /// It does not.
    No,
    /// As a power of the range: from 5 to 50 m by 40 %.
    Power,
    /// In proportion to the range: to the reach by 40 %.
    Linear,
}

/// What makes returns along a free path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// Noise of the receiver.
    Receiver,
    /// Droplets of which there are so many that they weaken the light.
    Droplets,
    /// Single drops.
    Drops,
    /// Light of others.
    Others,
}

/// Nearest range of single drops, m.
const FIRST_DROP_M: f64 = sensor::effects::FIRST_DROP_M as f64;

impl Fall {
    /// Exponent of the power.
    const POWER: f64 = 0.22;

    /// Share by which it falls to the reach.
    const LINEAR: f64 = 0.4;

    /// Probability of a range up to a part of the reach.
    fn cumulative(self, part: f64) -> f64 {
        match self {
            Fall::No => part,
            Fall::Power => part.powf(1.0 - Fall::POWER),
            Fall::Linear => part * (1.0 - 0.5 * Fall::LINEAR * part) / (1.0 - 0.5 * Fall::LINEAR),
        }
    }

    /// Mean range, in parts of the reach.
    fn mean(self) -> f64 {
        match self {
            Fall::No => 0.5,
            Fall::Power => (1.0 - Fall::POWER) / (2.0 - Fall::POWER),
            Fall::Linear => (0.5 - Fall::LINEAR / 3.0) / (1.0 - 0.5 * Fall::LINEAR),
        }
    }
}

impl Shape {
    /// Probability of a range up to `r`, m.
    fn cumulative(&self, r: f64) -> f64 {
        match *self {
            Shape::OfPath => f64::NAN,
            Shape::Even(reach, fall) => fall.cumulative((r / reach).clamp(0.0, 1.0)),
            Shape::Exponential(mean) => 1.0 - (-r / mean).exp(),
            Shape::Gamma(mean) => 1.0 - (-2.0 * r / mean).exp() * (1.0 + 2.0 * r / mean),
            Shape::Drops(to) => ((r / FIRST_DROP_M).ln() / (to / FIRST_DROP_M).ln()).clamp(0.0, 1.0),
            Shape::Band(from, to) => ((r - from) / (to - from)).clamp(0.0, 1.0),
        }
    }

    /// Mean range of shots that are free, m; none of a shape that has no range of its own.
    pub fn mean_m(&self) -> f64 {
        match *self {
            Shape::OfPath => f64::NAN,
            Shape::Even(reach, fall) => reach * fall.mean(),
            Shape::Exponential(mean) | Shape::Gamma(mean) => mean,
            Shape::Drops(to) => (to - FIRST_DROP_M) / (to / FIRST_DROP_M).ln(),
            Shape::Band(from, to) => (from + to) / 2.0,
        }
    }

    /// The same shape over so many times the length.
    pub fn scaled(&self, factor: f64) -> Shape {
        match *self {
            Shape::OfPath => Shape::OfPath,
            Shape::Even(reach, fall) => Shape::Even(factor * reach, fall),
            Shape::Exponential(mean) => Shape::Exponential(factor * mean),
            Shape::Gamma(mean) => Shape::Gamma(factor * mean),
            Shape::Drops(to) => Shape::Drops((factor * to).max(2.0 * FIRST_DROP_M)),
            Shape::Band(from, to) => Shape::Band(factor * from, factor * to),
        }
    }

    /// What makes returns of this shape.
    pub fn origin(&self) -> Origin {
        match self {
            Shape::Even(..) | Shape::OfPath => Origin::Receiver,
            Shape::Exponential(_) | Shape::Gamma(_) => Origin::Droplets,
            Shape::Drops(_) => Origin::Drops,
            Shape::Band(..) => Origin::Others,
        }
    }

    /// Expected returns of each bin at a rate of 1 for each shot.
    pub fn expected(&self, bins: &[Bin]) -> Vec<f64> {
        let of_bin = |b: &Bin| match self {
            Shape::OfPath => b.of_path,
            _ => {
                let [from, to] = b.ends_m;
                b.free_m / (to - from) * (self.cumulative(to) - self.cumulative(from))
            }
        };
        bins.iter().map(of_bin).collect()
    }

    /// Shapes of noise that does not fall with range.
    pub fn steady(end_m: f64) -> impl Iterator<Item = Shape> {
        lengths(5.0, end_m).map(|reach| Shape::Even(reach, Fall::No)).chain([Shape::OfPath])
    }

    /// All shapes of an origin that are tried, where bins end at `end_m`.
    pub fn all(origin: Origin, end_m: f64) -> Vec<Shape> {
        let means = || lengths(1.0, 3.0 * end_m);
        match origin {
            Origin::Receiver => {
                // Noise that falls does so over all the time that a receiver listens.
                let reaches = || lengths(0.5 * end_m, end_m);
                let falling = [Fall::Power, Fall::Linear].into_iter();
                let falling = falling.flat_map(|fall| reaches().map(move |reach| Shape::Even(reach, fall)));
                Shape::steady(end_m).chain(falling).collect()
            }
            Origin::Droplets => means().map(Shape::Exponential).chain(means().map(Shape::Gamma)).collect(),
            Origin::Drops => lengths(3.0, end_m.min(40.0)).map(Shape::Drops).collect(),
            Origin::Others => {
                let bands = |from: f64| BANDS.map(|times| Shape::Band(from, times * from));
                lengths(FIRST_BAND_M, end_m / BANDS[0]).flat_map(bands).collect()
            }
        }
    }
}

/// Ratios of the far end of a band of ranges to its near end.
const BANDS: [f64; 4] = [1.25, 1.5, 1.9, 2.4];

/// Smallest near end of such a band, m: nearer ones may be of droplets.
const FIRST_BAND_M: f64 = 6.0;

/// Steps of the search of a length, as a ratio.
const FINE: f64 = 1.08;

/// Lengths between two, m.
fn lengths(from: f64, to: f64) -> impl Iterator<Item = f64> {
    let steps = ((to / from).ln() / FINE.ln()).ceil().max(1.0) as i32;
    (0..=steps).map(move |k| from * FINE.powi(k))
}
