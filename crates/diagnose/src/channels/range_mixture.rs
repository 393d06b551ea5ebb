//! Returns along the free path of shots as a mixture of laws of range, each with its rate.

use super::free_path::Bin;
use super::range_laws::{Origin, Shape};

/// A shape with its rate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Part {
    /// Shape.
    pub shape: Shape,
    /// Returns for each shot.
    pub rate: f64,
}

/// Returns of several origins, with their most likely rates.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Mixture {
    /// Each origin.
    pub parts: Vec<Part>,
    /// Logarithm of the likelihood over that without such returns, nats.
    pub nats: f64,
}

/// Fewest simulated returns of a bin: one without is no proof that there are none.
const LEAST: f64 = 0.5;

/// Steps by which rates are found.
const STEPS: usize = 200;

/// The most likely rates of some shapes beside what the simulated side shows, by expectation and maximisation.
fn fit(shapes: &[Shape], bins: &[Bin]) -> Mixture {
    let of_one: Vec<Vec<f64>> = shapes.iter().map(|s| s.expected(bins)).collect();
    let all: Vec<f64> = of_one.iter().map(|q| q.iter().sum::<f64>().max(1e-9)).collect();
    let base: Vec<f64> = bins.iter().map(|b| b.simulated.max(LEAST)).collect();
    let more: f64 = bins.iter().zip(&base).map(|(b, base)| (b.measured - base).max(0.0)).sum();
    let mut rates: Vec<f64> = all.iter().map(|all| more.max(1e-3) / all / shapes.len() as f64).collect();
    let expected = |rates: &[f64], k: usize| base[k] + rates.iter().zip(&of_one).map(|(r, q)| r * q[k]).sum::<f64>();
    for _ in 0..STEPS {
        let weights: Vec<f64> = (0..bins.len()).map(|k| bins[k].measured / expected(&rates, k)).collect();
        for ((rate, q), all) in rates.iter_mut().zip(&of_one).zip(&all) {
            *rate *= q.iter().zip(&weights).map(|(q, w)| q * w).sum::<f64>() / all;
        }
    }
    let of_bin = |k: usize| {
        let expected = expected(&rates, k);
        bins[k].measured * (expected / base[k]).ln() - (expected - base[k])
    };
    let nats = (0..bins.len()).map(of_bin).sum();
    Mixture { parts: shapes.iter().zip(rates).map(|(&shape, rate)| Part { shape, rate }).collect(), nats }
}

impl Mixture {
    /// The place of the part of an origin; `None` where there is none.
    pub fn place(&self, origin: Origin) -> Option<usize> {
        self.parts.iter().position(|p| p.shape.origin() == origin)
    }

    /// Expected returns of each part beyond a range.
    fn returns(&self, bins: &[Bin], from_m: f64) -> Vec<f64> {
        let far = |n: Vec<f64>| n.iter().zip(bins).filter(|(_, b)| b.ends_m[0] >= from_m).map(|(n, _)| n).sum::<f64>();
        (0..self.parts.len()).map(|place| far(self.returns_by_bin(place, bins))).collect()
    }

    /// Share of each part in the returns beyond a range.
    pub fn shares(&self, bins: &[Bin], from_m: f64) -> Vec<f64> {
        let returns = self.returns(bins, from_m);
        let all = returns.iter().sum::<f64>().max(1e-9);
        returns.iter().map(|n| n / all).collect()
    }

    /// Share of one part in all returns of each bin.
    pub fn shares_by_bin(&self, place: usize, bins: &[Bin]) -> Vec<f64> {
        let mut all: Vec<f64> = bins.iter().map(|b| b.simulated.max(LEAST)).collect();
        for k in 0..self.parts.len() {
            all.iter_mut().zip(self.returns_by_bin(k, bins)).for_each(|(sum, n)| *sum += n);
        }
        self.returns_by_bin(place, bins).iter().zip(&all).map(|(own, all)| own / all).collect()
    }

    /// Expected returns of one part by bin.
    pub fn returns_by_bin(&self, place: usize, bins: &[Bin]) -> Vec<f64> {
        let part = &self.parts[place];
        part.shape.expected(bins).iter().map(|q| part.rate * q).collect()
    }

    fn shapes(&self) -> Vec<Shape> {
        self.parts.iter().map(|p| p.shape).collect()
    }

    /// The most likely of some shapes in one place beside the other parts.
    pub fn likeliest(&self, place: usize, shapes: impl IntoIterator<Item = Shape>, bins: &[Bin]) -> Mixture {
        let with = |shape: Shape| {
            let mut shapes = self.shapes();
            shapes.splice(place..(place + 1).min(shapes.len()), [shape]);
            fit(&shapes, bins)
        };
        shapes.into_iter().map(with).fold(Mixture::default(), Mixture::likelier)
    }

    /// The most likely mixture with a further origin, of shapes that are tried in steps; then each shape anew.
    fn with(&self, origin: Origin, bins: &[Bin], end_m: f64) -> Mixture {
        let last = Shape::all(origin, end_m).into_iter().step_by(COARSE);
        self.likeliest(self.parts.len(), last, bins).refined(bins, end_m)
    }

    /// The most likely mixture of two origins. All pairs of shapes are tried, in steps: two laws together may be much
    /// like a third one.
    fn of_two([first, second]: [Origin; 2], bins: &[Bin], end_m: f64) -> Mixture {
        let shapes = |origin| Shape::all(origin, end_m).into_iter().step_by(COARSE);
        let of_first = |shape: Shape| fit(&[shape], bins).likeliest(1, shapes(second), bins);
        shapes(first).map(of_first).fold(Mixture::default(), Mixture::likelier).refined(bins, end_m)
    }

    /// Each shape anew beside the others.
    fn refined(mut self, bins: &[Bin], end_m: f64) -> Mixture {
        for place in 0..self.parts.len() {
            self = self.likeliest(place, Shape::all(self.parts[place].shape.origin(), end_m), bins);
        }
        self
    }

    /// How far other mixtures are preferred to it although they are less likely: the receiver alone needs nothing in
    /// the air, and weather is more frequent than light of others.
    fn rank(&self) -> usize {
        let [receiver, others] = [Origin::Receiver, Origin::Others].map(|o| self.place(o).is_some());
        match self.parts.len() {
            _ if others => 2,
            1 if !receiver => 1,
            _ => 0,
        }
    }

    /// The more likely one.
    fn likelier(self, other: Mixture) -> Mixture {
        if other.nats > self.nats { other } else { self }
    }
}

/// Every how many-th shape is tried in pairs.
const COARSE: usize = 3;

/// Smallest share of one part in the returns of a mixture: no law is exactly that of the sensor, and a second one may
/// fit what the first leaves.
const LEAST_PART: f64 = 0.15;

/// The most likely mixture of up to three origins, each of which gains at least `nats` beside the others. One that is
/// preferred, see [`Mixture::rank`], may be less likely by as much.
pub fn mixture(bins: &[Bin], nats: f64) -> Mixture {
    const ALL: [Origin; 4] = [Origin::Receiver, Origin::Droplets, Origin::Drops, Origin::Others];
    let Some(end_m) = bins.last().map(|b| b.ends_m[1]) else { return Mixture::default() };
    let preferred = |mixtures: Vec<Mixture>| {
        let of_rank = |rank: usize| mixtures.iter().filter(move |m| m.rank() == rank).cloned();
        let best = |rank: usize| of_rank(rank).fold(Mixture::default(), Mixture::likelier);
        (0..3).map(best).fold(Mixture::default(), |a, b| if b.nats > a.nats + nats || a.nats == 0.0 { b } else { a })
    };
    let single = |origin: Origin| Mixture::default().likeliest(0, Shape::all(origin, end_m), bins);
    let pairs = (0..ALL.len()).flat_map(|a| (a + 1..ALL.len()).map(move |b| [ALL[a], ALL[b]]));
    let mut chosen = preferred(ALL.map(single).to_vec());
    if chosen.nats < nats {
        return chosen;
    }
    let mut more = preferred(pairs.map(|pair| Mixture::of_two(pair, bins, end_m)).collect());
    while more.nats > chosen.nats + nats && more.shares(bins, 0.0).iter().all(|share| *share > LEAST_PART) {
        chosen = more;
        let others = ALL.into_iter().filter(|o| chosen.place(*o).is_none());
        more = match chosen.parts.len() {
            2 => preferred(others.map(|o| chosen.with(o, bins, end_m)).collect()),
            _ => break,
        };
    }
    chosen
}

/// The most likely mixture with another origin in one place.
pub fn instead(mixture: &Mixture, place: usize, origin: Origin, bins: &[Bin]) -> Mixture {
    bins.last().map_or_else(Mixture::default, |b| mixture.likeliest(place, Shape::all(origin, b.ends_m[1]), bins))
}

/// The most likely mixture with noise that does not fall with range in one place.
pub fn steady_instead(mixture: &Mixture, place: usize, bins: &[Bin]) -> Mixture {
    bins.last().map_or_else(Mixture::default, |b| mixture.likeliest(place, Shape::steady(b.ends_m[1]), bins))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::channels::free_path::bins;
    use crate::channels::range_laws::Fall;

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

    /// The only part of a mixture.
    fn only(mixture: &Mixture) -> Part {
        let [part] = mixture.parts[..] else { panic!("{mixture:?}") };
        part
    }

    #[test]
    fn the_shape_that_made_the_counts_is_the_most_likely() {
        let shapes = [
            (Shape::Even(90.0, Fall::No), 0.01),
            (Shape::Even(90.0, Fall::Power), 0.01),
            (Shape::Even(90.0, Fall::Linear), 0.01),
            (Shape::Exponential(25.0), 0.02),
            (Shape::Gamma(18.0), 0.004),
            (Shape::Gamma(60.0), 0.01),
            (Shape::Drops(20.0), 0.01),
        ];
        for (shape, rate) in shapes {
            let found = only(&mixture(&of(shape, rate), 8.0));
            assert_eq!(found.shape.origin(), shape.origin(), "{shape:?}: {found:?}");
            assert!((found.shape.mean_m() / shape.mean_m() - 1.0).abs() < 0.1, "{shape:?}: {found:?}");
            assert!((found.rate / rate - 1.0).abs() < 0.1, "{shape:?}: {found:?}");
        }
        assert_eq!(only(&mixture(&of(Shape::OfPath, 0.01), 8.0)).shape, Shape::OfPath);
        let bins = of(Shape::Gamma(9.0), 0.01);
        let fog = mixture(&bins, 8.0);
        assert!(instead(&fog, 0, Origin::Drops, &bins).nats < fog.nats - 8.0);
    }

    #[test]
    fn origins_that_come_together_are_both_found() {
        let both = |[a, b]: [(Shape, f64); 2]| {
            let mut bins = of(a.0, a.1);
            bins.iter_mut().zip(of(b.0, b.1)).for_each(|(x, y)| x.measured += y.measured - y.simulated);
            mixture(&bins, 8.0)
        };
        for made in [
            [(Shape::Drops(22.0), 0.07), (Shape::Gamma(43.0), 0.1)],
            [(Shape::Even(90.0, Fall::No), 0.01), (Shape::Drops(22.0), 0.005)],
            [(Shape::Even(90.0, Fall::No), 0.01), (Shape::Gamma(15.0), 0.005)],
            [(Shape::Even(90.0, Fall::No), 0.01), (Shape::Band(15.0, 29.0), 0.005)],
            [(Shape::Gamma(28.0), 0.01), (Shape::Band(18.0, 28.0), 0.01)],
        ] {
            let found = both(made);
            let rate = |origin| found.parts.iter().find(|p| p.shape.origin() == origin).map_or(0.0, |p| p.rate);
            assert_eq!(found.parts.len(), 2, "{made:?}: {found:?}");
            for (shape, is) in made {
                assert!((rate(shape.origin()) / is - 1.0).abs() < 0.3, "{made:?}: {found:?}");
            }
        }
    }

    #[test]
    fn nothing_on_top_of_the_simulated_side_has_no_rate() {
        let nothing = mixture(&of(Shape::Even(100.0, Fall::No), 0.0), 8.0);
        assert!(nothing.nats < 0.01 && nothing.parts.iter().all(|p| p.rate < 1e-6), "{nothing:?}");
    }
}
