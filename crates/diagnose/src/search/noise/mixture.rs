//! Tails of range noise as a mixture: larger errors of single shots, and returns that are spread evenly about surfaces.

use crate::channels::tails::{BEYOND, FrameTails, KINDS, SIZES, Tail, TailBin, size_m};
use crate::inference::counts::{likelihood_beside, likelihood_of_counts};
use crate::inference::simplex::minimise;

/// Law of the larger errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Law {
    Normal,
    /// Double exponential: most errors are smaller and some are larger.
    Laplace,
}

/// Standard deviation of the usual errors in units of the scale of a Laplace law from which on their sum is normal.
const MOSTLY_NORMAL: f64 = 8.0;

impl Law {
    /// Probability that the sum of a usual, normal error and one of this law is larger than a size, m, in either
    /// direction. Both errors by their standard deviation, m.
    fn beyond(self, size_m: f64, usual_m: f64, off_m: f64) -> f64 {
        let root = std::f64::consts::SQRT_2;
        let scale_m = off_m / root;
        if self == Law::Normal || usual_m > MOSTLY_NORMAL * scale_m {
            return libm::erfc(size_m / (usual_m.hypot(off_m) * root));
        }
        let [noise, size] = [usual_m / scale_m, size_m / usual_m];
        let side = |sign: f64| {
            let complement = libm::erfc((noise + sign * size) / root);
            if complement > 0.0 { (0.5 * noise * noise + sign * size_m / scale_m).exp() * complement } else { 0.0 }
        };
        libm::erfc(size / root) + 0.5 * (side(-1.0) - side(1.0))
    }

    /// Mean square of the same sum, m2, each square at most that of `most_m`.
    pub(super) fn capped_m2(self, most_m: f64, usual_m: f64, off_m: f64) -> f64 {
        const STEPS: usize = 64;
        let step_m = most_m / STEPS as f64;
        let of_step = |k: usize| {
            let size_m = (k as f64 + 0.5) * step_m;
            2.0 * size_m * step_m * self.beyond(size_m, usual_m, off_m)
        };
        (0..STEPS).map(of_step).sum()
    }
}

/// What the returns in the tail consist of.
#[derive(Clone, Copy, Debug)]
pub(super) struct Mixture {
    pub(super) law: Law,
    /// Share of the returns with an additional error.
    pub(super) share: f64,
    /// Standard deviation of that error, m.
    pub(super) std_m: f64,
    /// Returns that are spread evenly about surfaces, such as parts of things beside them: share for each metre.
    pub(super) stray_per_m: f64,
}

/// Returns with the same usual distance from surfaces.
struct Usual {
    distance_m: f64,
    /// How many of them are looked at up to sizes of each bin.
    within: [f64; SIZES],
}

/// Tails on surfaces of one kind, summed over frames.
struct OfKind {
    usual: Vec<Usual>,
    /// Returns: measured, simulated.
    all: [f64; 2],
    /// Those in the tail by size.
    sizes: [[f64; SIZES]; 2],
}

impl OfKind {
    fn new(tails: &[&FrameTails], kind: usize) -> OfKind {
        let mut bins = vec![TailBin::default(); tails.first().map_or(0, |t| t[kind][0].bins.len())];
        tails.iter().flat_map(|t| t[kind][0].bins.iter().enumerate()).for_each(|(to, of)| bins[to].merge(of));
        let of_bin = |bin: TailBin| {
            // Half of a bin reaches its middle.
            let farther = |k: usize| bin.most[k + 1..].iter().sum::<f64>() + 0.5 * bin.most[k];
            Usual { distance_m: bin.usual_m / bin.all, within: std::array::from_fn(farther) }
        };
        let sum = |side: usize, of: &dyn Fn(&Tail) -> f64| tails.iter().map(|t| of(&t[kind][side])).sum::<f64>();
        OfKind {
            usual: bins.into_iter().filter(|b| b.all > 0.0).map(of_bin).collect(),
            all: [0, 1].map(|side| sum(side, &|t| t.all)),
            sizes: [0, 1].map(|side| std::array::from_fn(|k| sum(side, &|t| t.sizes[k]))),
        }
    }

    fn all_kinds(tails: &[&FrameTails]) -> [OfKind; KINDS] {
        std::array::from_fn(|kind| OfKind::new(tails, kind))
    }

    /// Share of the simulated returns in the tail by size.
    fn simulated(&self) -> [f64; SIZES] {
        self.sizes[1].map(|n| n / self.all[1].max(1.0))
    }

    /// Likelihood of what is measured by size if a mixture is there beside what is simulated, and the likeliest factor
    /// on that.
    fn likelihoods(&self, mixture: &Mixture) -> [[f64; 2]; SIZES] {
        let (simulated, expected) = (self.simulated(), expected(&self.usual, mixture));
        std::array::from_fn(|k| likelihood_beside(self.sizes[0][k], simulated[k] * self.all[0], expected[k]))
    }
}

/// Expected number of returns in the tail by their size.
fn expected(usual: &[Usual], mixture: &Mixture) -> [f64; SIZES] {
    let mut out = [0.0; SIZES];
    for Usual { distance_m, within } in usual {
        let beyond = |size_m: f64| mixture.law.beyond(size_m, *distance_m, mixture.std_m);
        for (bin, sum) in out.iter_mut().enumerate().filter(|(bin, _)| within[*bin] > 0.0) {
            let [from, to] = [size_m(bin).max(BEYOND * distance_m), size_m(bin + 1)];
            if from < to {
                // What is spread evenly alone has no law.
                let of_law = if mixture.share > 0.0 { beyond(from) - beyond(to) } else { 0.0 };
                *sum += within[bin] * (mixture.share * of_law + mixture.stray_per_m * (to - from));
            }
        }
    }
    out
}

/// What is likeliest to be in the measured tails beside what is in the simulated ones (Poisson). Walls have a relief
/// and leaves, of which the two sides may show different parts: for each kind of surface and each size what is
/// simulated has a factor. The ground, which has little of either, tells most.
#[derive(Clone, Copy)]
pub(super) struct Fit {
    /// Share of the simulated returns in the tail by kind of surface and size.
    simulated: [[f64; SIZES]; KINDS],
    /// Factors on these beside the mixture.
    factors: [[f64; SIZES]; KINDS],
    /// By how much the mixture is likelier than what is spread evenly alone, nats, both with their likeliest factors.
    pub(super) evidence: f64,
    /// With errors of the law that is likelier.
    pub(super) mixture: Mixture,
    /// With normal ones, as the simulator has them.
    pub(super) normal: Mixture,
    /// Share and standard deviation of the errors, m: the mean of both laws by their likelihoods.
    pub(super) numbers: [f64; 2],
    /// What the law makes of share and standard deviation: half of the difference between both laws.
    pub(super) of_law: [f64; 2],
    /// What is likeliest without a tail: false alarms, droplets and parts of things beside surfaces alone.
    pub(super) without: Mixture,
}

impl Fit {
    /// Of some frames; `None` where the simulated side has as many.
    pub(super) fn of(tails: &[&FrameTails]) -> Option<Fit> {
        let kinds = OfKind::all_kinds(tails);
        let excess = |of: &OfKind| {
            let [measured, simulated] = of.sizes.map(|sizes| sizes.iter().sum::<f64>());
            (measured - simulated * of.all[0] / of.all[1].max(1.0)) / of.all[0].max(1.0)
        };
        let share = kinds.iter().map(excess).fold(0.0, f64::max);
        if share <= 0.0 {
            return None;
        }
        let surprise =
            |mixture: &Mixture| -kinds.iter().flat_map(|of| of.likelihoods(mixture)).map(|l| l[0]).sum::<f64>();
        let stray = |p: &[f64]| Mixture { law: Law::Normal, share: 0.0, std_m: 0.0, stray_per_m: p[0].exp() };
        let start = [(2.0 * share).ln(), 0.1f64.ln(), (0.1 * share).ln()];
        let fitted = |law: Law| {
            let mixture = |p: &[f64]| Mixture { law, share: p[0].exp(), std_m: p[1].exp(), stray_per_m: p[2].exp() };
            let (p, surprise) = minimise(&start, &[0.5, 0.5, -1.0], |p| surprise(&mixture(p)));
            (mixture(&p), surprise)
        };
        let [(normal, by_normal), (laplace, by_laplace)] = [Law::Normal, Law::Laplace].map(fitted);
        let mixture = if by_normal <= by_laplace { normal } else { laplace };
        let of_normal = 1.0 / (1.0 + (by_normal - by_laplace).exp());
        let mean = |of: fn(&Mixture) -> f64| of_normal * of(&normal) + (1.0 - of_normal) * of(&laplace);
        let (alone, by_stray) = minimise(&[share.ln()], &[0.5], |p| surprise(&stray(p)));
        let without = stray(&alone);
        let fit = Fit {
            simulated: kinds.each_ref().map(OfKind::simulated),
            factors: kinds.each_ref().map(|of| of.likelihoods(&mixture).map(|l| l[1])),
            evidence: by_stray - by_normal.min(by_laplace),
            mixture,
            normal,
            numbers: [mean(|m| m.share), mean(|m| m.std_m)],
            of_law: [normal.share - laplace.share, normal.std_m - laplace.std_m].map(|d| 0.5 * d.abs()),
            without,
        };
        (fit.mixture.share < 0.5).then_some(fit)
    }

    /// Gain of a frame by the tail over what is spread evenly alone, nats.
    pub(super) fn gain(&self, frame: &FrameTails) -> f64 {
        let of_kind = |(kind, of): (usize, OfKind)| {
            let simulated = self.simulated[kind].map(|share| share * of.all[1]);
            let measured: [f64; SIZES] =
                std::array::from_fn(|k| self.factors[kind][k] * self.simulated[kind][k] * of.all[0]);
            let likelihood = |mixture: &Mixture| {
                let counts = of.sizes.each_ref().map(|sizes| sizes.as_slice());
                likelihood_of_counts(counts, [&measured, &simulated], &expected(&of.usual, mixture))
            };
            likelihood(&self.mixture) - likelihood(&self.without)
        };
        OfKind::all_kinds(&[frame]).into_iter().enumerate().map(of_kind).sum()
    }

    /// Shares of the returns in the tail: those of the simulated side, and those that are of the noise.
    pub(super) fn shares(&self, tails: &[&FrameTails]) -> [f64; 2] {
        let of_noise = Mixture { stray_per_m: 0.0, ..self.mixture };
        let of_kind = |(of, simulated): (&OfKind, &[f64; SIZES])| {
            [simulated.iter().sum::<f64>() * of.all[0], expected(&of.usual, &of_noise).iter().sum(), of.all[0]]
        };
        let kinds = OfKind::all_kinds(tails);
        let of_kinds: Vec<[f64; 3]> = kinds.iter().zip(&self.simulated).map(of_kind).collect();
        let [simulated, noise, all] = [0, 1, 2].map(|k| of_kinds.iter().map(|v| v[k]).sum::<f64>());
        [simulated, noise].map(|n| n / all.max(1.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::RngExt;
    use rand_distr::{Distribution, Exp1, StandardNormal};

    const MIDDLE_M: f64 = 0.02;
    const EVEN_M: f64 = 1.28;

    /// A side with normal noise, some tails, and returns that are spread evenly about the surfaces, as a share of all.
    fn side(rng: &mut data::Stream, tails: Option<Mixture>, stray: f64) -> Tail {
        let all = 400_000;
        let mut tail = Tail { all: f64::from(all), ..Tail::default() };
        tail.bins[0] = TailBin { all: tail.all, usual_m: MIDDLE_M * tail.all, ..TailBin::default() };
        tail.bins[0].most[SIZES - 1] = tail.all;
        for _ in 0..all {
            let mut normal = || -> f64 { StandardNormal.sample(rng) };
            // A normal number by an exponential variance is a Laplace number.
            let (a, b) = (MIDDLE_M * normal(), normal());
            let exponential: f64 = Exp1.sample(rng);
            let off = tails.filter(|t| rng.random_bool(t.share)).map_or(0.0, |t| match t.law {
                Law::Normal => t.std_m * b,
                Law::Laplace => t.std_m * b * exponential.sqrt(),
            });
            let off = if rng.random_bool(stray) { rng.random_range(-EVEN_M..EVEN_M) } else { a + off };
            if off.abs() > BEYOND * MIDDLE_M {
                tail.beyond += 1.0;
                let bin = (0..SIZES).rfind(|k| size_m(*k) <= off.abs()).unwrap_or(0);
                tail.sizes[bin] += 1.0;
            }
        }
        tail
    }

    #[test]
    fn share_and_deviation_are_found_beside_normal_noise() {
        let mut rng = data::stream(3, "tails", 0, 0);
        for (law, stray) in [(Law::Normal, 0.0), (Law::Normal, 0.01), (Law::Laplace, 0.0), (Law::Laplace, 0.01)] {
            let truth = Mixture { law, share: 0.01, std_m: 0.15, stray_per_m: 0.0 };
            let [with, without] = [side(&mut rng, Some(truth), stray), side(&mut rng, None, 0.0)];
            let frame =
                |sides: [&Tail; 2]| -> FrameTails { [sides.map(Tail::clone), Default::default(), Default::default()] };
            let fit = Fit::of(&[&frame([&with, &without])]).unwrap();
            let (found, [share, std_m], [of_share, of_std]) = (fit.mixture, fit.numbers, fit.of_law);
            assert!(stray > 0.0 || found.law == law, "{found:?}");
            // Beside what is spread evenly the law is hard to tell.
            assert!((share - truth.share).abs() < 0.1 * truth.share + 2.0 * of_share, "{share} {of_share}");
            assert!((std_m - truth.std_m).abs() < 0.1 * truth.std_m + 2.0 * of_std, "{std_m} {of_std}");
            assert!(Fit::of(&[&frame([&without, &with])]).is_none(), "the simulated side has them");
        }
    }

    #[test]
    fn what_is_spread_evenly_about_surfaces_is_no_gain_of_tails() {
        let mut rng = data::stream(5, "tails", 0, 0);
        let truth = Mixture { law: Law::Normal, share: 0.005, std_m: 0.2, stray_per_m: 0.0 };
        let mut gain = |tails: Option<Mixture>| {
            let mut frame = || [side(&mut rng, tails, 0.02), side(&mut rng, None, 0.0)];
            let frames = [0, 1].map(|_| -> FrameTails { [frame(), Default::default(), Default::default()] });
            Fit::of(&[&frames[0]]).map_or(0.0, |fit| fit.gain(&frames[1]))
        };
        let [none, some] = [gain(None), gain(Some(truth))];
        assert!(none < 3.0 && some > 20.0, "{none} {some}");
    }

    #[test]
    fn parts_of_the_laws() {
        for law in [Law::Normal, Law::Laplace] {
            assert!((law.beyond(0.0, 0.02, 0.1) - 1.0).abs() < 1e-12);
            let variance_m2 = 0.02f64.powi(2) + 0.1f64.powi(2);
            assert!((law.capped_m2(0.8, 0.02, 0.1) / variance_m2 - 1.0).abs() < 5e-3);
            assert!((law.beyond(0.03, 0.02, 1e-6) - 0.133_614).abs() < 1e-5, "1.5 standard deviations");
        }
        assert!((Law::Normal.beyond(0.196, 1e-6, 0.1) - 0.05).abs() < 1e-4);
        assert!((Law::Laplace.beyond(0.196, 1e-6, 0.1) - (-1.96 * 2f64.sqrt()).exp()).abs() < 1e-6);
        // Both sides of where a sum counts as normal.
        let off_m = 0.02 * 2f64.sqrt() / MOSTLY_NORMAL;
        let [below, above] = [0.999, 1.001].map(|k| Law::Laplace.beyond(0.06, 0.02, k * off_m));
        assert!((below / above - 1.0).abs() < 0.02, "{below} {above}");
    }
}
