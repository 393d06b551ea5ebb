//! The free path of shots: lone returns in front of surfaces, and how far shots are free to return from there.
//!
//! A shot whose surface lies at range R returns from r < R with the density `rate * f(r)`. The counts of a bin of
//! ranges are Poisson numbers with the mean `rate * f * (metres of free shots in the bin)`.

use super::returns::{NEAREST_M, free_until_m, is_lone_before};
use crate::pairing::FramePair;

/// Ratio of the ends of a bin.
const STEP: f64 = 1.25;

/// One bin of ranges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bin {
    /// Ends, m.
    pub ends_m: [f64; 2],
    /// Lone measured returns.
    pub measured: f64,
    /// Lone simulated returns, for as many shots.
    pub simulated: f64,
    /// Metres of shots without a surface, over all shots.
    pub free_m: f64,
    /// The same in parts of the free path of each shot.
    pub of_path: f64,
}

/// Measured returns for each simulated one.
pub fn scale(frame: &FramePair) -> f64 {
    frame.measured.len() as f64 / frame.simulated.len().max(1) as f64
}

/// Bins up to `end_m` over some frames; `leave_out` says which returns do not count: by frame, side (0 measured) and
/// place.
pub fn bins(frames: &[&FramePair], end_m: f64, leave_out: &dyn Fn(usize, usize, usize) -> bool) -> Vec<Bin> {
    let number = ((end_m / NEAREST_M).max(1.0).ln() / STEP.ln()).ceil().max(1.0) as usize;
    let end = |k: usize| if k == number { end_m } else { NEAREST_M * STEP.powi(k as i32) };
    let empty =
        |k: usize| Bin { ends_m: [end(k), end(k + 1)], measured: 0.0, simulated: 0.0, free_m: 0.0, of_path: 0.0 };
    let mut bins: Vec<Bin> = (0..number).map(empty).collect();
    let of = |range_m: f64| {
        let inside = (NEAREST_M..end_m).contains(&range_m);
        inside.then(|| (((range_m / NEAREST_M).ln() / STEP.ln()) as usize).min(number - 1))
    };
    // Shots that are free up to somewhere in the bin: their number, how far they are, and one over that.
    let mut last = vec![[0.0f64; 3]; number];
    for (f, frame) in frames.iter().enumerate() {
        for (side, rays) in [&frame.measured, &frame.simulated].into_iter().enumerate() {
            for (i, ray) in rays.iter().enumerate().filter(|(_, ray)| is_lone_before(ray)) {
                let Some(k) = of(ray.own_range_m()).filter(|_| !leave_out(f, side, i)) else { continue };
                match side {
                    0 => bins[k].measured += 1.0,
                    _ => bins[k].simulated += scale(frame),
                }
            }
        }
        let all = last.last_mut().expect("at least one bin");
        *all = [all[0] + frame.open, all[1] + frame.open * end_m, all[2] + frame.open / end_m];
        for ray in frame.simulated.iter().filter(|r| r.smooth) {
            let free_m = free_until_m(ray).min(end_m - 1e-6);
            if let Some(k) = of(free_m) {
                last[k] = [last[k][0] + 1.0, last[k][1] + free_m, last[k][2] + 1.0 / free_m];
            }
        }
    }
    let mut beyond = [0.0; 2];
    for (bin, [shots, until_m, inverse]) in bins.iter_mut().zip(&last).rev() {
        let [from, to] = bin.ends_m;
        bin.free_m = beyond[0] * (to - from) + (until_m - shots * from);
        bin.of_path = beyond[1] * (to - from) + (shots - inverse * from);
        beyond = [beyond[0] + shots, beyond[1] + inverse];
    }
    bins
}

/// Where returns along a free path come from: the distribution of their ranges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// Evenly spread up to a range, m: noise of the receiver crosses its threshold at any time.
    Even(f64),
    /// Evenly spread over the free path of each shot.
    OfPath,
    /// An exponential law with this mean, m: droplets in light that they weaken.
    Exponential(f64),
    /// A gamma law of shape 2 with this mean, m: the same where near droplets are out of the field of view.
    Gamma(f64),
    /// As 1 / r up to a range, m: single drops, of which ever larger ones are seen with range.
    Drops(f64),
}

/// Nearest range of single drops, m.
const FIRST_DROP_M: f64 = sensor::effects::FIRST_DROP_M as f64;

impl Shape {
    /// Probability of a range up to `r`, m.
    fn cumulative(&self, r: f64) -> f64 {
        match *self {
            Shape::OfPath => f64::NAN,
            Shape::Even(reach) => (r / reach).clamp(0.0, 1.0),
            Shape::Exponential(mean) => 1.0 - (-r / mean).exp(),
            Shape::Gamma(mean) => 1.0 - (-2.0 * r / mean).exp() * (1.0 + 2.0 * r / mean),
            Shape::Drops(to) => ((r / FIRST_DROP_M).ln() / (to / FIRST_DROP_M).ln()).clamp(0.0, 1.0),
        }
    }

    /// Mean range of shots that are free, m; none of a shape that has no range of its own.
    pub fn mean_m(&self) -> f64 {
        match *self {
            Shape::OfPath => f64::NAN,
            Shape::Even(reach) => reach / 2.0,
            Shape::Exponential(mean) | Shape::Gamma(mean) => mean,
            Shape::Drops(to) => (to - FIRST_DROP_M) / (to / FIRST_DROP_M).ln(),
        }
    }

    /// The same shape over so many times the length.
    pub fn scaled(&self, factor: f64) -> Shape {
        match *self {
            Shape::OfPath => Shape::OfPath,
            Shape::Even(reach) => Shape::Even(factor * reach),
            Shape::Exponential(mean) => Shape::Exponential(factor * mean),
            Shape::Gamma(mean) => Shape::Gamma(factor * mean),
            Shape::Drops(to) => Shape::Drops((factor * to).max(2.0 * FIRST_DROP_M)),
        }
    }

    /// Expected returns of each bin at a rate of 1 for each shot.
    fn expected(&self, bins: &[Bin]) -> Vec<f64> {
        let of_bin = |b: &Bin| match self {
            Shape::OfPath => b.of_path,
            _ => {
                let [from, to] = b.ends_m;
                b.free_m / (to - from) * (self.cumulative(to) - self.cumulative(from))
            }
        };
        bins.iter().map(of_bin).collect()
    }
}

/// A shape with its most likely rate.
#[derive(Clone, Copy, Debug)]
pub struct Fit {
    /// Shape.
    pub shape: Shape,
    /// Returns for each shot.
    pub rate: f64,
    /// Logarithm of the likelihood over that without such returns, nats.
    pub nats: f64,
}

/// The most likely rate of a shape beside what the simulated side shows.
pub fn fit(shape: Shape, bins: &[Bin]) -> Fit {
    let of_one = shape.expected(bins);
    // Half a count: a bin without a simulated return is no proof that there are none.
    let base: Vec<f64> = bins.iter().map(|b| b.simulated.max(0.5)).collect();
    let (all, more): (f64, f64) =
        (of_one.iter().sum(), bins.iter().zip(&base).map(|(b, base)| (b.measured - base).max(0.0)).sum());
    let mut rate = more.max(1e-3) / all.max(1e-9);
    // Expectation and maximisation: the share of a count that is not of the base.
    for _ in 0..200 {
        let parts = bins.iter().zip(of_one.iter().zip(&base));
        let of_shape: f64 = parts.map(|(b, (q, base))| b.measured * rate * q / (base + rate * q)).sum();
        rate = of_shape / all.max(1e-9);
    }
    let parts = bins.iter().zip(of_one.iter().zip(&base));
    let nats = parts.map(|(b, (q, base))| b.measured * (1.0 + rate * q / base).ln() - rate * q).sum();
    Fit { shape, rate, nats }
}

/// Steps of the search of a length, as a ratio.
const FINE: f64 = 1.08;

/// Lengths between two, m.
fn lengths(from: f64, to: f64) -> impl Iterator<Item = f64> {
    let steps = ((to / from).ln() / FINE.ln()).ceil().max(1.0) as i32;
    (0..=steps).map(move |k| from * FINE.powi(k))
}

/// The most likely of some shapes.
fn best(shapes: impl Iterator<Item = Shape>, bins: &[Bin]) -> Option<Fit> {
    shapes.map(|shape| fit(shape, bins)).max_by(|a, b| a.nats.total_cmp(&b.nats))
}

/// What is most likely to have made the counts.
#[derive(Clone, Copy, Debug)]
pub struct Fits {
    /// An even spread.
    pub even: Fit,
    /// An even spread over the free path of each shot.
    pub of_path: Fit,
    /// A law of droplets.
    pub droplets: Fit,
}

/// The most likely shapes; `None` without bins.
pub fn fits(bins: &[Bin]) -> Option<Fits> {
    let end_m = bins.last()?.ends_m[1];
    let even = best(lengths(5.0, end_m).map(Shape::Even), bins)?;
    let means = || lengths(1.0, 3.0 * end_m);
    let drops = lengths(3.0, end_m.min(40.0)).map(Shape::Drops);
    let droplets = best(means().map(Shape::Exponential).chain(means().map(Shape::Gamma)).chain(drops), bins)?;
    Some(Fits { even, of_path: fit(Shape::OfPath, bins), droplets })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bins of shots that are free up to 120 m, with the expected counts of a shape.
    fn of(shape: Shape, rate: f64) -> Vec<Bin> {
        let mut bins = bins(&[], 120.0, &|_, _, _| false);
        // Half of the shots are free to 120 m, the others to 30 m.
        for b in &mut bins {
            let near = (b.ends_m[1].min(30.0) - b.ends_m[0]).max(0.0);
            let far = b.ends_m[1] - b.ends_m[0];
            (b.free_m, b.of_path) = (50_000.0 * (near + far), 50_000.0 * (near / 30.0 + far / 120.0));
        }
        let counts: Vec<f64> = shape.expected(&bins).iter().map(|q| rate * q).collect();
        bins.iter_mut().zip(counts).for_each(|(b, n)| (b.measured, b.simulated) = (n + 20.0, 20.0));
        bins
    }

    #[test]
    fn the_shape_that_made_the_counts_is_the_most_likely() {
        for (shape, rate) in [(Shape::Even(90.0), 0.01), (Shape::Exponential(25.0), 0.02), (Shape::Gamma(18.0), 0.004)]
        {
            let fits = fits(&of(shape, rate)).unwrap();
            let evenly = matches!(shape, Shape::Even(_));
            let (found, other) = if evenly { (fits.even, fits.droplets) } else { (fits.droplets, fits.even) };
            assert!((found.shape.mean_m() / shape.mean_m() - 1.0).abs() < 0.1, "{shape:?}: {found:?}");
            assert!((found.rate / rate - 1.0).abs() < 0.1, "{shape:?}: {found:?}");
            assert!(found.nats > other.nats.max(fits.of_path.nats) + 8.0, "{shape:?}: {other:?}");
        }
        let drops = fits(&of(Shape::Drops(20.0), 0.01)).unwrap().droplets;
        assert!(drops.shape.mean_m() < 8.0, "{drops:?}");
        let of_path = fits(&of(Shape::OfPath, 0.01)).unwrap();
        assert!(of_path.of_path.nats > of_path.droplets.nats + 8.0, "{of_path:?}");
    }

    #[test]
    fn nothing_on_top_of_the_simulated_side_has_no_rate() {
        let nothing = of(Shape::Even(100.0), 0.0);
        let Fits { even, of_path, droplets } = fits(&nothing).unwrap();
        assert!([even, of_path, droplets].iter().all(|f| f.rate < 1e-6 && f.nats < 0.01));
    }
}
